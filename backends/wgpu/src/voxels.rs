//! Projection of voxel volumes, its adjoint, and FDK's back-projection, on the device.
//!
//! A volume that is larger than a buffer may be is gone through slab by slab along x, projections view by view. The
//! adjoint adds to voxels atomically: sums have no fixed order.

use crate::Shared;
use crate::compose::{GROUP, fragment_of};
use crate::device::{Atomics, Gpu};
use crate::kernel::Buffers;
use crate::pace::Pace;
use crate::source::{Access, Source};
use crate::wave::MOST_GROUPS;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::{Geometry, sub};
use conefield_core::voxel::{VoxelOperator, VoxelProjector, VoxelView};
use conefield_core::wgsl::Fragment;
use ndarray::{ArrayView3, ArrayViewMut3, Axis, s};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use wgpu::BufferUsages as U;

/// Bytes of projections on the device at once.
const LINES_BYTES: u64 = 64 << 20;
/// Views that one uniform buffer holds for back-projection.
const VIEWS: usize = 128;
/// Rays or voxels of a launch at first, on a software device and on others, at least and at most.
const FIRST: [u32; 2] = [1 << 15, 1 << 20];
const LEAST: u32 = 1 << 10;
const MOST: u32 = 1 << 22;

/// `Projection` in `kernels/project.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Projection {
    shape: [u32; 3],
    count: u32,
    spacing: [f32; 3],
    columns: u32,
    held: u32,
    held_end: u32,
    pixels: u32,
    begin: u32,
    end: u32,
    pad: [u32; 3],
}

/// `Back` in `kernels/backproject.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Back {
    shape: [u32; 3],
    views: u32,
    held: u32,
    begin: u32,
    end: u32,
    rows: u32,
    columns: u32,
    pad: [u32; 3],
}

/// `SeenView` in `kernels/backproject.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct SeenView {
    depth: [f32; 4],
    row: [f32; 4],
    column: [f32; 4],
    scale: f32,
    pad: [f32; 3],
}

/// `ProjectedView` in `kernels/project.wgsl`.
fn projected(geometry: &Geometry, view: usize) -> [[f32; 4]; 4] {
    let (w, grid) = (&geometry.views[view], &geometry.volume);
    let lower = grid.voxel([0; 3]);
    let voxels = |d: [f64; 3]| {
        let v: [f32; 3] = std::array::from_fn(|k| (d[k] / grid.spacing[k]) as f32);
        [v[0], v[1], v[2], 0.0]
    };
    let corner = sub(w.pixel(geometry.detector, 0.0, 0.0), w.source);
    [voxels(sub(w.source, lower)), voxels(corner), voxels(w.u), voxels(w.v)]
}

fn kernel(fragment: &Fragment, name: &str, atomics: Atomics, forward: bool) -> Source {
    let mut source = Source::default();
    source.add("projection", include_str!("kernels/project.wgsl"));
    source.bind("projection", Access::Uniform, "Projection");
    source.bind("views", Access::Read, "array<ProjectedView>");
    let (what, begin, end) = if forward {
        source.bind("volume", Access::Read, "array<f32>");
        source.bind("lines", Access::Write, "array<f32>");
        ("value += weight * volume[i];".to_owned(), "value = 0.0;", "lines[line] += value;")
    } else {
        source.bind("volume", Access::Write, &format!("array<atomic<{}>>", atomics.number()));
        source.bind("lines", Access::Read, "array<f32>");
        let begin = "value = lines[line];\n        if value == 0.0 { continue; }";
        (format!("let v = weight * value;\n{}", atomics.sum("volume[i]")), begin, "")
    };
    source.add(
        "visit",
        &format!(
            "var<private> value: f32;

fn walk_visit(voxel: vec3<u32>, weight: f32) {{
    if voxel.x >= projection.held && voxel.x < projection.held_end {{
        let i = walk_index(voxel);
        {what}
    }}
}}
"
        ),
    );
    source.add(name, &fragment.named("walk_"));
    source.add(
        "rays",
        &format!(
            "@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {{
    for (var i = projection.begin + id.x; i < projection.end; i += groups.x * 64u) {{
        let line = line_of(i);
        {begin}
        walk_walk(projected(line));
        {end}
    }}
}}
"
        ),
    );
    source
}

/// What a launch works on: buffers that are used again, and how many rays or voxels it may take.
struct Room {
    buffers: Buffers,
    pace: Pace,
}

impl Room {
    fn new(gpu: &Gpu) -> Self {
        let first = FIRST[usize::from(!gpu.adapter.software)];
        Self { buffers: Buffers::default(), pace: Pace::new(first, LEAST, MOST) }
    }

    /// Runs `source` over `0..count` in launches, each after `uniform` has written where it begins and ends.
    fn run<T: bytemuck::Pod>(
        &mut self,
        shared: &Shared,
        label: &str,
        source: &Source,
        uniform: (&str, impl Fn(u32, u32) -> T),
        count: u32,
    ) -> Result<()> {
        let gpu = &shared.gpu;
        let kernel = shared.kernels.get(gpu, label, source)?;
        self.buffers.reserve(gpu, uniform.0, size_of::<T>() as u64, U::UNIFORM | U::COPY_DST)?;
        let bound = kernel.bind(gpu, &self.buffers)?;
        let started = Instant::now();
        let (mut at, mut launches) = (0, 0);
        while at < count {
            let end = count.min(at.saturating_add(self.pace.size()));
            let value = uniform.1(at, end);
            self.buffers.get(uniform.0).inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::bytes_of(&value)));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let groups = (end - at).div_ceil(GROUP).min(MOST_GROUPS as u32);
            kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), &bound, groups);
            gpu.queue.submit([encoder.finish()]);
            at = end;
            launches += 1;
        }
        gpu.wait()?;
        self.pace.heard(started.elapsed().as_secs_f64(), launches, count.min(self.pace.size()));
        Ok(())
    }

    fn write(&self, shared: &Shared, name: &str, data: &[f32]) {
        self.buffers.get(name).inspect(|b| shared.gpu.queue.write_buffer(b, 0, bytemuck::cast_slice(data)));
    }

    fn clear(&self, shared: &Shared, name: &str) {
        let mut encoder = shared.gpu.device.create_command_encoder(&Default::default());
        self.buffers.get(name).inspect(|b| encoder.clear_buffer(b, 0, None));
        shared.gpu.queue.submit([encoder.finish()]);
    }

    /// Hands the first `count` numbers of `name` to `take`.
    fn read(&mut self, shared: &Shared, name: &str, count: usize, take: impl FnOnce(&[f32])) -> Result<()> {
        let gpu = &shared.gpu;
        let bytes = 4 * count as u64;
        self.buffers.reserve(gpu, "staging", bytes, U::MAP_READ | U::COPY_DST)?;
        let (Some(from), Some(staging)) = (self.buffers.get(name), self.buffers.get("staging")) else { return Ok(()) };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(from, 0, staging, 0, bytes);
        gpu.queue.submit([encoder.finish()]);
        gpu.read(staging, bytes, |found| take(bytemuck::cast_slice(found)))
    }

    /// Adds the numbers of `name` to those of `part`, in order.
    fn add_to(&mut self, shared: &Shared, name: &str, mut part: ArrayViewMut3<'_, f32>) -> Result<()> {
        self.read(shared, name, part.len(), |found| part.iter_mut().zip(found).for_each(|(p, f)| *p += f))
    }
}

impl Shared {
    /// Planes of x of a volume that one buffer holds.
    fn slabs(&self, shape: [usize; 3]) -> Result<Vec<Range<usize>>> {
        let plane = 4 * (shape[1] * shape[2]) as u64;
        let bytes = self.gpu.adapter.bound_bytes();
        let most = (bytes / plane) as usize;
        if most == 0 {
            return Err(self.gpu.error(format!("a plane of voxels takes {plane} bytes, a buffer holds {bytes}")));
        }
        // Parts of nearly the same size.
        let parts = shape[0].div_ceil(most).max(1);
        let each = shape[0].div_ceil(parts).max(1);
        Ok((0..shape[0]).step_by(each).map(|x| x..(x + each).min(shape[0])).collect())
    }
}

/// A projector's work on a device.
pub struct DeviceOperator {
    shared: Arc<Shared>,
    forward: Source,
    adjoint: Source,
    room: Mutex<Room>,
    fault: Mutex<Option<Error>>,
}

/// A projector with its work on a device.
pub struct OnDevice {
    inner: Box<dyn VoxelProjector>,
    operator: DeviceOperator,
}

impl OnDevice {
    /// Takes a projector's work to the device; refuses one without WGSL.
    pub fn new(shared: Arc<Shared>, inner: Box<dyn VoxelProjector>) -> Result<Self> {
        let name = format!("projector ({})", inner.describe());
        let fragment = fragment_of(&name, inner.wgsl())?;
        let atomics = shared.gpu.adapter.atomics;
        let [forward, adjoint] = [true, false].map(|forward| kernel(&fragment, &name, atomics, forward));
        forward.validate()?;
        adjoint.validate()?;
        let room = Mutex::new(Room::new(&shared.gpu));
        let operator = DeviceOperator { shared, forward, adjoint, room, fault: Mutex::default() };
        Ok(Self { inner, operator })
    }
}

impl VoxelProjector for OnDevice {
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        &self.operator
    }
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self.inner.reference()
    }
    fn wgsl(&self) -> Option<Fragment> {
        self.inner.wgsl()
    }
    fn describe(&self) -> String {
        format!("{}, on {}", self.inner.describe(), self.operator.shared.gpu.adapter)
    }
}

impl DeviceOperator {
    /// How many views are on the device at once.
    fn views_at_once(&self, pixels: usize) -> usize {
        let bytes = LINES_BYTES.min(self.shared.gpu.adapter.bound_bytes());
        (bytes as usize / (4 * pixels).max(1)).max(1)
    }

    /// Writes the views. Returns the uniform values of a launch, still without the range of planes.
    fn prepare(&self, room: &mut Room, geometry: &Geometry, views: &[usize]) -> Result<Projection> {
        let data: Vec<f32> = views.iter().flat_map(|&v| projected(geometry, v)).flatten().collect();
        room.buffers.reserve(&self.shared.gpu, "views", 4 * data.len() as u64, U::STORAGE | U::COPY_DST)?;
        room.write(&self.shared, "views", &data);
        let [rows, columns] = geometry.detector;
        let pixels = (rows * columns) as u32;
        Ok(Projection {
            shape: geometry.volume.shape.map(|n| n as u32),
            count: views.len() as u32 * pixels,
            spacing: geometry.volume.spacing.map(|h| h as f32),
            columns: columns as u32,
            pixels,
            ..Projection::default()
        })
    }

    fn buffers(&self, room: &mut Room, slab: usize, lines: usize) -> Result<()> {
        let usage = U::STORAGE | U::COPY_SRC | U::COPY_DST;
        room.buffers.reserve(&self.shared.gpu, "volume", 4 * slab as u64, usage)?;
        room.buffers.reserve(&self.shared.gpu, "lines", 4 * lines as u64, usage)?;
        Ok(())
    }

    fn project(
        &self,
        geometry: &Geometry,
        views: &[usize],
        volume: ArrayView3<'_, f32>,
        mut out: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        let room = &mut *self.room.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = &self.shared;
        let plane = volume.len() / volume.len_of(Axis(0)).max(1);
        let pixels = geometry.detector[0] * geometry.detector[1];
        let chunk = self.views_at_once(pixels);
        let slabs = shared.slabs(geometry.volume.shape)?;
        for (views, mut out) in views.chunks(chunk).zip(out.axis_chunks_iter_mut(Axis(0), chunk)) {
            let uniform = self.prepare(room, geometry, views)?;
            self.buffers(room, slabs[0].len() * plane, views.len() * pixels)?;
            room.clear(shared, "lines");
            for slab in &slabs {
                let part = volume.slice(s![slab.clone(), .., ..]);
                let part = part.as_standard_layout();
                room.write(shared, "volume", part.as_slice().unwrap_or_default());
                let (held, held_end) = (slab.start as u32, slab.end as u32);
                let uniforms = |begin, end| Projection { held, held_end, begin, end, ..uniform };
                room.run(shared, "forward projection", &self.forward, ("projection", uniforms), uniform.count)?;
            }
            room.read(shared, "lines", out.len(), |found| out.iter_mut().zip(found).for_each(|(o, l)| *o = *l))?;
        }
        Ok(())
    }

    fn back(
        &self,
        geometry: &Geometry,
        views: &[usize],
        projections: ArrayView3<'_, f32>,
        mut volume: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        let room = &mut *self.room.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = &self.shared;
        let plane = volume.len() / volume.len_of(Axis(0)).max(1);
        let pixels = geometry.detector[0] * geometry.detector[1];
        let chunk = self.views_at_once(pixels);
        for slab in shared.slabs(geometry.volume.shape)? {
            self.buffers(room, slab.len() * plane, chunk.min(views.len()) * pixels)?;
            room.clear(shared, "volume");
            for (views, lines) in views.chunks(chunk).zip(projections.axis_chunks_iter(Axis(0), chunk)) {
                let uniform = self.prepare(room, geometry, views)?;
                room.write(shared, "lines", lines.as_standard_layout().as_slice().unwrap_or_default());
                let (held, held_end) = (slab.start as u32, slab.end as u32);
                let uniforms = |begin, end| Projection { held, held_end, begin, end, ..uniform };
                room.run(shared, "adjoint of projection", &self.adjoint, ("projection", uniforms), uniform.count)?;
            }
            room.add_to(shared, "volume", volume.slice_mut(s![slab, .., ..]))?;
        }
        Ok(())
    }

    fn keep(&self, done: Result<()>) {
        if let Err(e) = done {
            self.fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(e);
        }
    }
}

impl VoxelOperator<f32> for DeviceOperator {
    fn forward(&self, geometry: &Geometry, views: &[usize], volume: ArrayView3<'_, f32>, out: ArrayViewMut3<'_, f32>) {
        self.keep(self.project(geometry, views, volume, out));
    }

    fn adjoint(
        &self,
        geometry: &Geometry,
        views: &[usize],
        projections: ArrayView3<'_, f32>,
        volume: ArrayViewMut3<'_, f32>,
    ) {
        self.keep(self.back(geometry, views, projections, volume));
    }

    fn fault(&self) -> Result<()> {
        self.fault.lock().unwrap_or_else(PoisonError::into_inner).take().map_or(Ok(()), Err)
    }
}

/// The kernels of FDK's back-projection: views with rows and columns exchanged, and voxels.
fn back_kernels() -> [Source; 2] {
    let begun = || {
        let mut source = Source::default();
        source.add("structures", include_str!("kernels/back.wgsl"));
        source.bind("back", Access::Uniform, "Back");
        source
    };
    let (mut pad, mut voxels) = (begun(), begun());
    pad.bind("images", Access::Read, "array<f32>");
    pad.bind("padded", Access::Write, "array<f32>");
    pad.add("exchange", include_str!("kernels/pad.wgsl"));
    voxels.bind("views", Access::Uniform, &format!("array<SeenView, {VIEWS}>"));
    voxels.bind("padded", Access::Read, "array<f32>");
    voxels.bind("volume", Access::Write, "array<f32>");
    voxels.add("back-projection", include_str!("kernels/backproject.wgsl"));
    [pad, voxels]
}

/// FDK's back-projection on the device; see [`conefield_core::backend::Backend::backproject`].
pub fn backproject(
    shared: &Shared,
    views: &[VoxelView],
    images: ArrayView3<'_, f32>,
    mut volume: ArrayViewMut3<'_, f32>,
) -> Result<()> {
    let [pad, voxels] = back_kernels();
    let gpu = &shared.gpu;
    let (_, rows, columns) = images.dim();
    let shape: [usize; 3] = volume.dim().into();
    let plane = shape[1] * shape[2];
    let padded = (rows + 2) * (columns + 2);
    let (bytes, most) = (4 * padded as u64, gpu.adapter.bound_bytes());
    if bytes > most {
        return Err(gpu.error(format!("a view takes {bytes} bytes, a buffer holds {most}")));
    }
    let chunk = ((LINES_BYTES.min(most) / bytes) as usize).min(VIEWS).clamp(1, views.len().max(1));
    let narrow = |n: [f64; 4]| n.map(|x| x as f32);
    let seen = |v: &VoxelView| SeenView {
        depth: narrow(v.depth),
        row: narrow(v.row),
        column: narrow(v.column),
        scale: v.scale as f32,
        pad: [0.0; 3],
    };
    let mut room = Room::new(gpu);
    let usage = U::STORAGE | U::COPY_SRC | U::COPY_DST;
    room.buffers.reserve(gpu, "views", (VIEWS * size_of::<SeenView>()) as u64, U::UNIFORM | U::COPY_DST)?;
    room.buffers.reserve(gpu, "images", (chunk * rows * columns * 4) as u64, usage)?;
    room.buffers.reserve(gpu, "padded", chunk as u64 * bytes, usage)?;
    for slab in shared.slabs(shape)? {
        let count = slab.len() * plane;
        room.buffers.reserve(gpu, "volume", 4 * count as u64, usage)?;
        room.clear(shared, "volume");
        for (views, images) in views.chunks(chunk).zip(images.axis_chunks_iter(Axis(0), chunk)) {
            let seen: Vec<SeenView> = views.iter().map(seen).collect();
            room.write(shared, "views", bytemuck::cast_slice(&seen));
            room.write(shared, "images", images.as_standard_layout().as_slice().unwrap_or_default());
            let uniforms = |begin, end| Back {
                shape: shape.map(|n| n as u32),
                views: views.len() as u32,
                held: slab.start as u32,
                begin,
                end,
                rows: rows as u32,
                columns: columns as u32,
                pad: [0; 3],
            };
            room.run(shared, "exchange", &pad, ("back", uniforms), (views.len() * padded) as u32)?;
            room.run(shared, "back-projection", &voxels, ("back", uniforms), count as u32)?;
        }
        room.add_to(shared, "volume", volume.slice_mut(s![slab, .., ..]))?;
    }
    Ok(())
}
