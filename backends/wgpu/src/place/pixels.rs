//! Data terms: computed line integrals against measured ones.

use super::launch::{Named, Room, Task};
use super::{Array, Chunk, DevicePlace, flag, parts, plane};
use conefield_core::device::{Access, fragment_of};
use conefield_core::error::Result;
use conefield_core::place::{Place, Weighing};
use conefield_core::wgsl::Fragment;
use ndarray::s;

/// `Pixels` in `kernels/pixels.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
struct Pixels {
    begin: u32,
    end: u32,
    /// Pixels of a view.
    pixels: u32,
    pad: u32,
}

/// In place of the index of an image that a part does not hold.
const NONE: u32 = u32::MAX;

/// The index in `part` of each of `wanted`; `None` if it holds none of them.
fn indices(part: &Chunk, wanted: &[usize]) -> Option<Vec<u32>> {
    let at = |i: &usize| if part.planes.contains(i) { (i - part.planes.start) as u32 } else { NONE };
    let all: Vec<u32> = wanted.iter().map(at).collect();
    all.iter().any(|i| *i != NONE).then_some(all)
}

/// Calls `launch` for each part of the images with its number of pixels and its buffers: images, measured ones, and what has a
/// value for every pixel of the scan, shadow and weights.
fn over(
    place: &DevicePlace,
    by: &Weighing<'_>,
    views: &[usize],
    images: &Array,
    launch: &mut dyn FnMut(&mut Room, &Named<'_>, u32) -> Result<()>,
) -> Result<()> {
    let pixels = plane(images.shape());
    for part in parts(images) {
        let Some(some) = views.get(part.planes.start..part.planes.end.min(views.len())) else { break };
        let mut loaded;
        let (measured, wanted): (_, Vec<usize>) = match &by.views.here {
            Some(here) => (parts(here), some.to_vec()),
            // Measured views that are not on the device come for each use.
            None => {
                loaded = place.zeros([some.len(), images.shape()[1], images.shape()[2]])?;
                for (i, &view) in some.iter().enumerate() {
                    place.load(by.views.measured.slice(s![view..view + 1, .., ..]), &mut loaded, i)?;
                }
                (parts(&loaded), (0..some.len()).collect())
            }
        };
        let of_all = by.shadow.map(parts).or_else(|| by.weights.map(parts));
        for held in measured {
            let Some(at) = indices(held, &wanted) else { continue };
            for k in 0..of_all.map_or(1, <[Chunk]>::len) {
                let at_all = match of_all {
                    Some(all) => indices(&all[k], some),
                    None => Some(at.clone()),
                };
                let Some(at_all) = at_all else { continue };
                let index: Vec<[u32; 2]> = at.iter().zip(at_all).map(|(&a, b)| [a, b]).collect();
                let mut bind = vec![("images", &part.buffer), ("measured", &held.buffer)];
                bind.extend(by.shadow.map(|shadow| ("shadow", &parts(shadow)[k].buffer)));
                bind.extend(by.weights.map(|weights| ("weights", &parts(weights)[k].buffer)));
                let mut room = place.room();
                room.write("index", &index)?;
                launch(&mut room, &bind, (some.len() * pixels) as u32)?;
            }
        }
    }
    Ok(())
}

/// A kernel with the bindings of pixels.
fn task<'a>(label: &'a str, by: &Weighing<'_>, term: Option<&Fragment>) -> Result<Task<'a>> {
    let mut task = Task::new(label, include_str!("../kernels/pixels.wgsl"), "pixels", "Pixels")
        .bind("index", Access::Read, "vec2<u32>")
        .bind("images", Access::Write, "f32")
        .bind("measured", Access::Read, "f32");
    if by.shadow.is_some() {
        task = task.bind("shadow", Access::Read, "u32");
    }
    if by.weights.is_some() {
        task = task.bind("weights", Access::Read, "f32");
    }
    if let Some(term) = term {
        task = task.add("data term", &fragment_of("the data term", Some(term.clone()))?.named("term_"));
    }
    Ok(task)
}

fn uniform(images: &Array) -> impl Fn(u32, u32) -> Pixels {
    let pixels = plane(images.shape()) as u32;
    move |begin, end| Pixels { begin, end, pixels, pad: 0 }
}

/// [`Place::compare`] with the data term `term`, or least squares.
pub(super) fn compare(
    place: &DevicePlace,
    by: &Weighing<'_>,
    term: Option<&Fragment>,
    views: &[usize],
    images: &mut Array,
) -> Result<[f64; 2]> {
    let inside = if by.shadow.is_some() { flag("shadow", "all") } else { "true".into() };
    let weight = if by.weights.is_some() { "weights[all]" } else { "1.0" };
    let derivative = if term.is_some() { "term_differentiate(p, r)" } else { "vec2<f32>(0.5 * r * r, r)" };
    let body = include_str!("../kernels/compare.wgsl").replace("INSIDE", &inside).replace("WEIGHT", weight);
    let task = task("data term", by, term)?.summing(&body.replace("DERIVATIVE", derivative), false);
    let mut sums = [0.0; 2];
    over(place, by, views, images, &mut |room, bind, count| {
        let found = room.sum(&task, bind, uniform(images), count, false)?;
        sums = std::array::from_fn(|k| sums[k] + found[k]);
        Ok(())
    })?;
    Ok(sums)
}

/// [`Place::weigh`].
pub(super) fn weigh(
    place: &DevicePlace,
    by: &Weighing<'_>,
    term: &Fragment,
    spread: bool,
    views: &[usize],
    images: &mut Array,
) -> Result<()> {
    let by = &Weighing { shadow: None, weights: None, ..*by };
    let (label, value) = if spread { ("noise", "term_spread") } else { ("curvature", "term_curve") };
    let body = include_str!("../kernels/weigh.wgsl").replace("VALUE", value);
    let task = task(label, by, Some(term))?.each(&body);
    over(place, by, views, images, &mut |room, bind, count| room.run(&task, bind, uniform(images), count))
}
