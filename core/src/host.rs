//! Runs stages on the host with their `f32` kernels, on any backend, to inspect a model beside training.

use crate::error::{Result, ensure};
use crate::pipeline::Model;
use crate::stage::{Kernel, Scope, Stage, TILE_ROWS, Tile, TileMut};
use std::ops::Range;

/// The encoder's features `[F][rows]` after the normalizers, `[F'][rows]`. Rows are points off any ray. The model's
/// arena must be up to date ([`crate::backend::Executable::fetch`]).
pub fn normalize(model: &Model, features: &[f32], rows: usize) -> Result<Vec<f32>> {
    through(model, 1..model.pipeline.normalizers.len() + 1, features, rows)
}

/// The attenuation `[rows]` computed by normalizers and field from the encoder's features `[F][rows]`, in the scale of
/// the stages. Otherwise as [`normalize`].
pub fn attenuation(model: &Model, features: &[f32], rows: usize) -> Result<Vec<f32>> {
    through(model, 1..model.pipeline.normalizers.len() + 2, features, rows)
}

/// Applies some consecutive stages of the pipeline to `features`.
fn through(model: &Model, which: Range<usize>, features: &[f32], rows: usize) -> Result<Vec<f32>> {
    let pipeline = &model.pipeline;
    let stages: Vec<(&dyn Stage, &[f32])> = pipeline
        .stages()
        .into_iter()
        .zip(pipeline.ranges())
        .map(|((_, stage), range)| (stage, &model.arena.params[range.clone()]))
        .collect();
    let stages = &stages[which];
    let width = pipeline.encoder.info().output;
    let (found, expected) = (features.len(), format!("{width} channels of {rows} rows"));
    ensure(found == width * rows, "features", "length", found, expected)?;
    let wide = stages.last().map_or(width, |(stage, _)| stage.info().output);
    let mut out = vec![0.0; wide * rows];
    // Some stages that look along rays need points off any ray one at a time.
    let most = if stages.iter().all(|(s, _)| of_points(*s).is_some()) { TILE_ROWS } else { 1 };
    for at in (0..rows).step_by(most) {
        let n = most.min(rows - at);
        let mut x: Vec<f32> = features.chunks_exact(rows).flat_map(|c| &c[at..at + n]).copied().collect();
        for (stage, params) in stages {
            let info = stage.info();
            let (mut y, mut tape) = (vec![0.0; info.output * n], vec![0.0; info.tape * n]);
            let kernel = of_points(*stage).unwrap_or_else(|| stage.kernel());
            kernel.forward(params, Tile::new(&x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
            x = y;
        }
        for (out, x) in out.chunks_exact_mut(rows).zip(x.chunks_exact(n)) {
            out[at..at + n].copy_from_slice(x);
        }
    }
    pipeline.fault()?;
    Ok(out)
}

/// The kernel that takes whole tiles of points off any ray, if the stage has one.
fn of_points(stage: &dyn Stage) -> Option<&dyn Kernel<f32>> {
    match stage.info().scope {
        Scope::Ray => stage.kernel().points(),
        Scope::Row => Some(stage.kernel()),
    }
}
