//! FDK: weights, the ramp filter along rows, and distance-weighted back-projection.
//!
//! Rows are convolved in space. Their number of multiply-adds is far below that of the back-projection, and no size of
//! row is special.

use super::launch::{Room, Task};
use super::{Array, parts, plane};
use conefield_core::device::Access;
use conefield_core::error::Result;
use conefield_core::parallel;
use conefield_core::place::FilteredViews;
use conefield_core::voxel::VoxelView;
use wgpu::BufferUsages as U;

/// Bytes of filtered views on the device at once.
const PADDED_BYTES: u64 = 512 << 20;
/// Views that one uniform buffer holds for back-projection.
const VIEWS: usize = 128;

/// `Back` in `kernels/back.wgsl`.
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
    /// First of the views among the images.
    first: u32,
    pad: [u32; 2],
}

/// `SeenView` in `kernels/back.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct SeenView {
    depth: [f32; 4],
    row: [f32; 4],
    column: [f32; 4],
    scale: f32,
    pad: [f32; 3],
}

impl SeenView {
    fn of(v: &VoxelView) -> Self {
        let narrow = |n: [f64; 4]| n.map(|x| x as f32);
        let (depth, row, column) = (narrow(v.depth), narrow(v.row), narrow(v.column));
        Self { depth, row, column, scale: v.scale as f32, pad: [0.0; 3] }
    }
}

/// The kernels: weights of pixels; rows convolved, with rows and columns exchanged; voxels.
fn tasks() -> [Task<'static>; 3] {
    let task = |label| Task::new(label, include_str!("../kernels/back.wgsl"), "back", "Back");
    let weights = task("weights of rows").bind("rows", Access::Read, "RowWeights").bind("counts", Access::Read, "f32");
    let convolve = task("ramp filter").bind("taps", Access::Read, "f32").bind("images", Access::Read, "f32");
    let voxels = task("back-projection").uniform("seen_views", &format!("array<SeenView, {VIEWS}>"));
    [
        weights.bind("images", Access::Write, "f32").each(include_str!("../kernels/row_weights.wgsl")),
        convolve.bind("padded", Access::Write, "f32").add("ramp", include_str!("../kernels/ramp.wgsl")),
        voxels
            .bind("padded", Access::Read, "f32")
            .bind("volume", Access::Write, "f32")
            .add("back-projection", include_str!("../kernels/backproject.wgsl")),
    ]
}

/// [`conefield_core::place::Place::filtered`].
pub(super) fn backproject(
    room: &mut Room,
    work: &dyn FilteredViews,
    (views, images): (&[usize], &Array),
    (slab, first): (&mut Array, usize),
) -> Result<()> {
    let [weights, convolve, voxels] = tasks();
    let shared = room.shared.clone();
    let gpu = &shared.gpu;
    let [_, rows, columns] = images.shape();
    let shape = slab.shape();
    let padded = (rows + 2) * (columns + 2);
    let (bytes, most) = (4 * padded as u64, gpu.adapter.bound_bytes());
    if bytes > most {
        return Err(gpu.error(format!("a view takes {bytes} bytes, a buffer holds {most}")));
    }
    let chunk = ((PADDED_BYTES.min(most) / bytes) as usize).clamp(1, VIEWS);
    room.write("taps", &work.taps())?;
    // A uniform buffer is bound as a whole.
    room.buffers.reserve(gpu, "seen_views", (VIEWS * size_of::<SeenView>()) as u64, U::UNIFORM | U::COPY_DST)?;
    for part in parts(images) {
        let Some(of_part) = views.get(part.planes.start..part.planes.end.min(views.len())) else { break };
        for (k, some) in of_part.chunks(chunk).enumerate() {
            let all = parallel::map(some, |_, &v| work.weights(v));
            let wide = |x: [f64; 3]| [x[0] as f32, x[1] as f32, x[2] as f32, 0.0];
            let data: Vec<[[f32; 4]; 4]> = all.iter().map(|w| [w.corner, w.u, w.v, w.normal].map(wide)).collect();
            room.write("rows", &data)?;
            room.write("counts", &all.iter().flat_map(|w| w.columns.iter().copied()).collect::<Vec<f32>>())?;
            room.buffers.reserve(gpu, "padded", some.len() as u64 * bytes, super::ARRAY)?;
            let seen: Vec<SeenView> = some.iter().map(|&v| SeenView::of(&work.seen(v))).collect();
            room.write("seen_views", &seen)?;
            let whole = Back {
                shape: shape.map(|n| n as u32),
                views: some.len() as u32,
                rows: rows as u32,
                columns: columns as u32,
                first: (k * chunk) as u32,
                ..Back::default()
            };
            let uniform = |begin, end| Back { begin, end, ..whole };
            let of_images = [("images", &part.buffer)];
            room.run(&weights, &of_images, uniform, (some.len() * rows * columns) as u32)?;
            // Four rows and 64 columns per group, and a column of zeros on each side.
            let tiles = some.len() * (rows + 2).div_ceil(4) * (columns + 2).div_ceil(64);
            room.run(&convolve, &of_images, uniform, (64 * tiles) as u32)?;
            for held in parts(slab) {
                let uniform = |begin, end| Back { begin, end, held: (first + held.planes.start) as u32, ..whole };
                let bind = [("volume", &held.buffer)];
                room.run(&voxels, &bind, uniform, (held.planes.len() * plane(shape)) as u32)?;
            }
        }
    }
    Ok(())
}
