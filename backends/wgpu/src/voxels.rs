//! Projection of voxel volumes, its adjoint, and FDK's back-projection, on the device.
//!
//! A volume larger than a buffer is processed in slabs along x, projections in groups of views. The adjoint adds to
//! voxels atomically, so its sums have no fixed order.

use crate::Shared;
use crate::compose::{GROUP, fragment_of};
use crate::device::{Atomics, Gpu};
use crate::kernel::Buffers;
use crate::pace::Pace;
use crate::source::{Access, Source};
use crate::wave::MOST_GROUPS;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::{Geometry, sub};
use conefield_core::resident::{Resident, Volumes};
use conefield_core::voxel::{VoxelOperator, VoxelProjector, VoxelView};
use conefield_core::wgsl::Fragment;
use ndarray::{ArrayView3, ArrayViewMut3, Axis, Ix3, Zip, s};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use wgpu::BufferUsages as U;

/// Bytes of projections on the device at once.
const LINES_BYTES: u64 = 64 << 20;
/// Usage of arrays by kernels and the host.
pub(crate) const ARRAY: U = U::STORAGE.union(U::COPY_SRC).union(U::COPY_DST);
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

/// A kernel that runs `body` for each i of a launch, from `begin` to `end` of the uniform buffer `launch`.
pub(crate) fn each(launch: &str, body: &str) -> String {
    format!(
        "@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {{
    for (var i = {launch}.begin + id.x; i < {launch}.end; i += groups.x * 64u) {{
        {body}
    }}
}}
"
    )
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
    let body = format!("let line = line_of(i);\n        {begin}\n        walk_walk(projected(line));\n        {end}");
    source.add("rays", &each("projection", &body));
    source
}

/// Buffers that launches share, and the size of launches.
pub(crate) struct Room {
    pub(crate) buffers: Buffers,
    pace: Pace,
}

impl Room {
    pub(crate) fn new(gpu: &Gpu) -> Self {
        let first = FIRST[usize::from(!gpu.adapter.software)];
        Self { buffers: Buffers::default(), pace: Pace::new(first, LEAST, MOST) }
    }

    /// Runs each of `sources` over `0..count` in launches, each after `uniform` has written where it begins and ends.
    pub(crate) fn run<T: bytemuck::Pod>(
        &mut self,
        shared: &Shared,
        sources: &[(&str, &Source)],
        uniform: (&str, impl Fn(u32, u32) -> T),
        count: u32,
    ) -> Result<()> {
        let gpu = &shared.gpu;
        self.buffers.reserve(gpu, uniform.0, size_of::<T>() as u64, U::UNIFORM | U::COPY_DST)?;
        let mut kernels = vec![];
        for (label, source) in sources {
            let kernel = shared.kernels.get(gpu, label, source)?;
            let bound = kernel.bind(gpu, &self.buffers)?;
            kernels.push((kernel, bound));
        }
        let started = Instant::now();
        let mut launches = 0;
        for (kernel, bound) in &kernels {
            let mut at = 0;
            while at < count {
                let end = count.min(at.saturating_add(self.pace.size()));
                let value = uniform.1(at, end);
                self.buffers.get(uniform.0).inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::bytes_of(&value)));
                let mut encoder = gpu.device.create_command_encoder(&Default::default());
                let groups = (end - at).div_ceil(GROUP).min(MOST_GROUPS as u32);
                kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), bound, groups);
                gpu.queue.submit([encoder.finish()]);
                at = end;
                launches += 1;
            }
        }
        gpu.wait()?;
        self.pace.heard(started.elapsed().as_secs_f64(), launches, count.min(self.pace.size()));
        Ok(())
    }

    pub(crate) fn write(&self, shared: &Shared, name: &str, data: &[f32]) {
        self.buffers.get(name).inspect(|b| shared.gpu.queue.write_buffer(b, 0, bytemuck::cast_slice(data)));
    }

    pub(crate) fn clear(&self, shared: &Shared, name: &str) {
        let mut encoder = shared.gpu.device.create_command_encoder(&Default::default());
        self.buffers.get(name).inspect(|b| encoder.clear_buffer(b, 0, None));
        shared.gpu.queue.submit([encoder.finish()]);
    }

    /// Calls `take` with the first `count` numbers of `name`.
    pub(crate) fn read(&mut self, shared: &Shared, name: &str, count: usize, take: impl FnOnce(&[f32])) -> Result<()> {
        let gpu = &shared.gpu;
        let bytes = 4 * count as u64;
        let staging = self.buffers.staging(gpu, bytes)?;
        let Some(from) = self.buffers.get(name) else { return Ok(()) };
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(from, 0, &staging, 0, bytes);
        gpu.queue.submit([encoder.finish()]);
        gpu.read(&staging, bytes, |found| take(bytemuck::cast_slice(found)))
    }

    /// Adds the numbers of `name` to those of `part`, in order.
    fn add_to(&mut self, shared: &Shared, name: &str, mut part: ArrayViewMut3<'_, f32>) -> Result<()> {
        let shape = part.raw_dim();
        self.read(shared, name, part.len(), |found| {
            Zip::from(&mut part).and(shaped(shape, found)).par_for_each(|p, f| *p += f);
        })
    }
}

/// Read numbers as an array of `shape`.
fn shaped(shape: Ix3, found: &[f32]) -> ArrayView3<'_, f32> {
    ArrayView3::from_shape(shape, found).unwrap_or_else(|e| unreachable!("as many numbers as asked for: {e}"))
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

    /// Makes room for the largest of `slabs`, the first.
    fn reserve_slab(&self, room: &mut Room, slabs: &[Range<usize>], shape: (usize, usize, usize)) -> Result<()> {
        let planes = slabs.first().map_or(0, Range::len);
        room.buffers.reserve(&self.gpu, "volume", 4 * (planes * shape.1 * shape.2) as u64, ARRAY).map(drop)
    }
}

/// A projector's kernels: they take line integrals of the buffer `volume` and add up `lines`, or the reverse.
pub(crate) struct Walks {
    pub(crate) shared: Arc<Shared>,
    forward: Source,
    adjoint: Source,
}

impl Walks {
    fn new(shared: Arc<Shared>, projector: &dyn VoxelProjector) -> Result<Self> {
        let name = format!("projector ({})", projector.describe());
        let fragment = fragment_of(&name, projector.wgsl())?;
        let atomics = shared.gpu.adapter.atomics;
        let [forward, adjoint] = [true, false].map(|forward| kernel(&fragment, &name, atomics, forward));
        forward.validate()?;
        adjoint.validate()?;
        Ok(Self { shared, forward, adjoint })
    }

    /// How many views are on the device at once.
    pub(crate) fn views_at_once(&self, pixels: usize) -> usize {
        let bytes = LINES_BYTES.min(self.shared.gpu.adapter.bound_bytes());
        (bytes as usize / (4 * pixels).max(1)).max(1)
    }

    /// Writes the views and makes room for their line integrals. Returns the uniform values of a launch, still without
    /// the range of planes.
    fn prepare(&self, room: &mut Room, geometry: &Geometry, views: &[usize]) -> Result<Projection> {
        let gpu = &self.shared.gpu;
        let data: Vec<f32> = views.iter().flat_map(|&v| projected(geometry, v)).flatten().collect();
        room.buffers.reserve(gpu, "views", 4 * data.len() as u64, U::STORAGE | U::COPY_DST)?;
        room.write(&self.shared, "views", &data);
        let [rows, columns] = geometry.detector;
        let pixels = rows * columns;
        room.buffers.reserve(gpu, "lines", 4 * (views.len() * pixels) as u64, ARRAY)?;
        Ok(Projection {
            shape: geometry.volume.shape.map(|n| n as u32),
            count: (views.len() * pixels) as u32,
            spacing: geometry.volume.spacing.map(|h| h as f32),
            columns: columns as u32,
            pixels: pixels as u32,
            ..Projection::default()
        })
    }

    /// Overwrites `out` with line integrals for some views that are on the device at once. For each of `slabs`, `fill`
    /// writes its voxels into `volume`.
    pub(crate) fn integrate(
        &self,
        room: &mut Room,
        (geometry, views): (&Geometry, &[usize]),
        slabs: &[Range<usize>],
        mut fill: impl FnMut(&Room, &Range<usize>),
        mut out: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        let uniform = self.prepare(room, geometry, views)?;
        room.clear(&self.shared, "lines");
        for slab in slabs {
            fill(room, slab);
            self.walk(room, &self.forward, uniform, slab)?;
        }
        let shape = out.raw_dim();
        room.read(&self.shared, "lines", out.len(), |found| out.assign(&shaped(shape, found)))
    }

    /// Adds the adjoint of `lines` for some views that are on the device at once to `volume`, which is `slab`.
    pub(crate) fn spread(
        &self,
        room: &mut Room,
        (geometry, views): (&Geometry, &[usize]),
        slab: &Range<usize>,
        lines: ArrayView3<'_, f32>,
    ) -> Result<()> {
        let uniform = self.prepare(room, geometry, views)?;
        room.write(&self.shared, "lines", lines.as_standard_layout().as_slice().unwrap_or_default());
        self.walk(room, &self.adjoint, uniform, slab)
    }

    fn walk(&self, room: &mut Room, source: &Source, uniform: Projection, slab: &Range<usize>) -> Result<()> {
        let label = if std::ptr::eq(source, &self.forward) { "forward projection" } else { "adjoint of projection" };
        let (held, held_end) = (slab.start as u32, slab.end as u32);
        let uniforms = |begin, end| Projection { held, held_end, begin, end, ..uniform };
        room.run(&self.shared, &[(label, source)], ("projection", uniforms), uniform.count)
    }
}

/// A projector's work on a device.
pub struct DeviceOperator {
    walks: Arc<Walks>,
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
        let room = Mutex::new(Room::new(&shared.gpu));
        let walks = Arc::new(Walks::new(shared, inner.as_ref())?);
        Ok(Self { inner, operator: DeviceOperator { walks, room, fault: Mutex::default() } })
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
    fn resident(&self, volumes: Volumes<'_>) -> Option<Result<Box<dyn Resident>>> {
        let placed = crate::resident::DeviceVolumes::new(self.operator.walks.clone(), volumes);
        Some(placed.map(|resident| Box::new(resident) as Box<dyn Resident>))
    }
    fn describe(&self) -> String {
        format!("{}, on {}", self.inner.describe(), self.operator.walks.shared.gpu.adapter)
    }
}

impl DeviceOperator {
    fn project(
        &self,
        geometry: &Geometry,
        views: &[usize],
        volume: ArrayView3<'_, f32>,
        mut out: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        let room = &mut *self.room.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = &self.walks.shared;
        let chunk = self.walks.views_at_once(geometry.detector[0] * geometry.detector[1]);
        let slabs = shared.slabs(geometry.volume.shape)?;
        shared.reserve_slab(room, &slabs, volume.dim())?;
        let fill = |room: &Room, slab: &Range<usize>| {
            let part = volume.slice(s![slab.clone(), .., ..]);
            room.write(shared, "volume", part.as_standard_layout().as_slice().unwrap_or_default());
        };
        for (views, out) in views.chunks(chunk).zip(out.axis_chunks_iter_mut(Axis(0), chunk)) {
            self.walks.integrate(room, (geometry, views), &slabs, fill, out)?;
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
        let shared = &self.walks.shared;
        let chunk = self.walks.views_at_once(geometry.detector[0] * geometry.detector[1]);
        let slabs = shared.slabs(geometry.volume.shape)?;
        shared.reserve_slab(room, &slabs, volume.dim())?;
        for slab in slabs {
            room.clear(shared, "volume");
            for (views, lines) in views.chunks(chunk).zip(projections.axis_chunks_iter(Axis(0), chunk)) {
                self.walks.spread(room, (geometry, views), &slab, lines)?;
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
    room.buffers.reserve(gpu, "views", (VIEWS * size_of::<SeenView>()) as u64, U::UNIFORM | U::COPY_DST)?;
    room.buffers.reserve(gpu, "images", (chunk * rows * columns * 4) as u64, ARRAY)?;
    room.buffers.reserve(gpu, "padded", chunk as u64 * bytes, ARRAY)?;
    for slab in shared.slabs(shape)? {
        let count = slab.len() * plane;
        room.buffers.reserve(gpu, "volume", 4 * count as u64, ARRAY)?;
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
            room.run(shared, &[("exchange", &pad)], ("back", uniforms), (views.len() * padded) as u32)?;
            room.run(shared, &[("back-projection", &voxels)], ("back", uniforms), count as u32)?;
        }
        room.add_to(shared, "volume", volume.slice_mut(s![slab, .., ..]))?;
    }
    Ok(())
}
