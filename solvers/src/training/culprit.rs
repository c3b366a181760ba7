//! Finds the stage whose numbers are not finite, when a loss is not.

use crate::training::run::{HINT, Run, strayed};
use conefield_core::backend::Work;
use conefield_core::error::Error;
use conefield_core::parallel;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::stage::{Stage, Tile, TileMut, UnitRay};

/// Points looked at on each ray.
const POINTS: usize = 128;

/// The error of a run whose loss or prior, as in `what`, is not finite in the step `work`. It names the first stage
/// whose output is not finite with the current parameters: a slower rate does not help a faulty stage.
pub fn diverged(run: &mut Run<'_>, work: &Work<'_>, what: &str) -> Error {
    let found = match run.exe.fetch(&mut run.model) {
        Ok(()) if strayed(&run.model.arena).is_none() => culprit(&run.model, work),
        _ => None,
    };
    let what = match found {
        Some(found) => format!("{what}; the first stage whose output is not finite: {found}; correct it, or {HINT}"),
        None => format!("{what}; {HINT}"),
    };
    Error::Diverged { step: run.step, what }
}

/// The first of the model's stages whose output is not finite on the rays of `work`, with the place.
fn culprit(model: &Model, work: &Work<'_>) -> Option<String> {
    let pipeline = &model.pipeline;
    if pipeline.field.lines().is_some() {
        return None;
    }
    // Of several rays, the one that fails in the earliest stage.
    let found = parallel::map(work.rays, |_, r| on_ray(pipeline, &model.arena.params, &r.ray));
    found.into_iter().flatten().min_by_key(|(stage, ..)| *stage).map(|(stage, [x, y, z], value)| {
        let (name, stage) = &pipeline.stages()[stage];
        format!("{name} ({}), {value} at ({x:.3}, {y:.3}, {z:.3}) of the unit cube", stage.describe())
    })
}

/// Index of the first stage whose output is not finite on `ray`, with the point and the value.
fn on_ray(pipeline: &Pipeline, params: &[f32], ray: &UnitRay) -> Option<(usize, [f32; 3], f32)> {
    let points = points(ray);
    let rows = points.len();
    let mut x: Vec<f32> = (0..3).flat_map(|k| points.iter().map(move |p| p[k])).collect();
    for (i, ((_, stage), range)) in pipeline.stages().iter().zip(pipeline.ranges()).enumerate() {
        let y = outputs(*stage, &params[range.clone()], &x, rows);
        if let Some(at) = y.iter().position(|v| !v.is_finite()) {
            return Some((i, points[at % rows], y[at]));
        }
        x = y;
    }
    None
}

/// Evenly spaced points of `ray` within the box, ends included.
fn points(ray: &UnitRay) -> Vec<[f32; 3]> {
    let [from, to] = ray.inside;
    let at = |i: usize| from + (to - from) * i as f32 / (POINTS - 1) as f32;
    (0..POINTS).map(|i| std::array::from_fn(|k| (ray.origin[k] + at(i) * ray.direction[k]).clamp(0.0, 1.0))).collect()
}

fn outputs(stage: &dyn Stage, params: &[f32], x: &[f32], rows: usize) -> Vec<f32> {
    let info = stage.info();
    let [mut y, mut tape] = [info.output, info.tape].map(|channels| vec![0.0; channels * rows]);
    stage.kernel().forward(params, Tile::new(x, rows), TileMut::new(&mut y, rows), TileMut::new(&mut tape, rows));
    y
}
