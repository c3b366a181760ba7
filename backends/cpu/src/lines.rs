//! Line integrals computed by a field itself, with their gradients.

use conefield_core::backend::Work;
use conefield_core::stage::{Field, Grads, Lines, UnitRay};
use rayon::prelude::*;

/// Rays projected at once by a worker.
const TOGETHER: usize = 64;

/// The line integrals of `rays`.
pub fn project(lines: &dyn Lines<f32>, params: &[f32], rays: &[UnitRay], out: &mut [f32]) {
    out.par_chunks_mut(TOGETHER)
        .zip(rays.par_chunks(TOGETHER))
        .for_each(|(out, rays)| lines.project(params, rays, out));
}

/// Adds the gradients of the mean loss of `work`'s rays to `grads`, which are those of `field` alone; returns the loss.
/// One worker sums a parameter's gradient in the order of the rays, so that the number of threads changes no bit.
pub fn step(field: &dyn Field, lines: &dyn Lines<f32>, params: &[f32], grads: &mut [f32], work: &Work<'_>) -> f64 {
    let rays: Vec<UnitRay> = work.rays.iter().map(|r| r.ray).collect();
    let mut found = vec![0.0; rays.len()];
    project(lines, params, &rays, &mut found);
    let scale = 1.0 / rays.len().max(1) as f64;
    let mut loss = 0.0;
    for (found, ray) in found.iter_mut().zip(work.rays) {
        let (value, slope) = work.loss.at(f64::from(*found), f64::from(ray.target));
        loss += value * scale;
        *found = (slope * scale) as f32;
    }
    let (mut rest, mut taken, mut tasks) = (grads, 0, vec![]);
    for range in field.partition() {
        let (own, after) = std::mem::take(&mut rest)[range.start - taken..].split_at_mut(range.len());
        (rest, taken) = (after, range.end);
        tasks.push((range, own));
    }
    tasks.into_par_iter().with_max_len(1).for_each(|(range, values)| {
        lines.backproject(params, &rays, &found, Grads { values, range });
    });
    loss
}
