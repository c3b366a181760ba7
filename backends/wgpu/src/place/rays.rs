//! Line integrals of voxel volumes and their adjoint.

use super::elements::fill;
use super::launch::{Room, Task};
use super::{Array, parts, plane};
use crate::Shared;
use crate::source::validate;
use conefield_core::device::{Access, fragment_of};
use conefield_core::error::Result;
use conefield_core::geometry::{Geometry, cross, dot, norm, sub};
use conefield_core::place::ViewRays;
use conefield_core::voxel::VoxelProjector;

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

/// `ProjectedView` in `kernels/project.wgsl`. Rays begin shortly before the volume instead of at the source where that is
/// possible: positions in single precision are then counted from a point nearby.
fn projected(geometry: &Geometry, view: usize) -> [[f32; 4]; 4] {
    let (w, grid) = (&geometry.views[view], &geometry.volume);
    let lower = grid.voxel([0; 3]);
    let voxels = |d: [f64; 3]| {
        let v: [f32; 3] = std::array::from_fn(|k| (d[k] / grid.spacing[k]) as f32);
        [v[0], v[1], v[2], 0.0]
    };
    let first = w.pixel(geometry.detector, 0.0, 0.0);
    let corner = sub(first, w.source);
    // The share of a ray, counted from its pixel, that reaches beyond the volume for every pixel.
    let [rows, columns] = geometry.detector.map(|n| n as f64 - 1.0);
    let corners = [[0.0, 0.0], [rows, 0.0], [0.0, columns], [rows, columns]];
    let pixels = corners.map(|[row, column]| w.pixel(geometry.detector, row, column));
    let most = pixels.iter().map(|p| norm(sub(*p, grid.center))).fold(0.0, f64::max);
    let normal = cross(w.u, w.v);
    let least = dot(normal, corner).abs() / norm(normal);
    let near = ((most + 2.0 * norm(grid.size())) / least).min(1.0) as f32;
    let start = if near < 1.0 { first } else { w.source };
    let [x, y, z, _] = voxels(sub(start, lower));
    [[x, y, z, near], voxels(corner), voxels(w.u), voxels(w.v)]
}

/// A projector's kernel: it takes line integrals of the buffer `volume` and adds up `lines`, or the reverse. Refuses a projector
/// without WGSL.
fn task(shared: &Shared, projector: &dyn VoxelProjector, forward: bool) -> Result<Task<'static>> {
    let name = format!("projector ({})", projector.describe());
    let walk = fragment_of(&name, projector.wgsl())?.named("walk_");
    let atomics = shared.gpu.adapter.atomics;
    let label = if forward { "forward projection" } else { "adjoint of projection" };
    let task = Task::new(label, include_str!("../kernels/project.wgsl"), "projection", "Projection");
    let task = task.bind("views", Access::Read, "ProjectedView");
    let (task, what, begin, end) = if forward {
        let task = task.bind("volume", Access::Read, "f32").bind("lines", Access::Write, "f32");
        (task, "value += weight * volume[i];".to_owned(), "value = 0.0;", "lines[line] += value;")
    } else {
        let task = task.bind("volume", Access::Write, &format!("atomic<{}>", atomics.number()));
        let begin = "value = lines[line];\n        if value == 0.0 { continue; }";
        let what = format!("let v = weight * value;\n{}", atomics.sum("volume[i]"));
        (task.bind("lines", Access::Read, "f32"), what, begin, "")
    };
    let body = format!("let line = line_of(i);\n        {begin}\n        walk_walk(projected(line));\n        {end}");
    let visit = include_str!("../kernels/visit.wgsl").replace("WHAT", &what);
    Ok(task.add("visit", &visit).add(&name, &walk).each(&body))
}

/// Refuses a projector without WGSL or with invalid WGSL.
pub(super) fn admits(shared: &Shared, projector: &dyn VoxelProjector) -> Result<()> {
    [true, false].into_iter().try_for_each(|forward| validate(&task(shared, projector, forward)?.source))
}

/// Line integrals overwrite `images` if `forward`, else their adjoint adds to `volume`.
pub(super) fn project(
    room: &mut Room,
    forward: bool,
    ViewRays { projector, geometry, views }: ViewRays<'_>,
    volume: &Array,
    images: &Array,
) -> Result<()> {
    let task = task(&room.shared, projector, forward)?;
    if forward {
        // Line integrals are added up part by part of the volume.
        fill(room, images, 0.0)?;
    }
    let pixels = plane(images.shape());
    for part in parts(images) {
        let Some(some) = views.get(part.planes.start..part.planes.end.min(views.len())) else { break };
        let data: Vec<f32> = some.iter().flat_map(|&v| projected(geometry, v)).flatten().collect();
        room.write("views", &data)?;
        let count = (some.len() * pixels) as u32;
        for held in parts(volume) {
            let whole = Projection {
                shape: geometry.volume.shape.map(|n| n as u32),
                count,
                spacing: geometry.volume.spacing.map(|h| h as f32),
                columns: geometry.detector[1] as u32,
                pixels: pixels as u32,
                held: held.planes.start as u32,
                held_end: held.planes.end as u32,
                ..Projection::default()
            };
            let bind = [("volume", &held.buffer), ("lines", &part.buffer)];
            room.run(&task, &bind, |begin, end| Projection { begin, end, ..whole }, count)?;
        }
    }
    Ok(())
}
