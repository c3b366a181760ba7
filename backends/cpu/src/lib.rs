//! The CPU backend.
//!
//! A step is processed in waves of some hundred thousand rows. In a wave, every slot samples its share of the rays. All
//! slots then run the encoder pass by pass, so that a level's table is read while it is in the cache. Then each slot
//! processes its share in groups: normalize, evaluate the field, integrate, compute the loss and run backward, tile by
//! tile, while a tile is in the cache ([`rows`]). Dense stages sum their gradients in one copy per slot, merged in
//! order. Stages with scattered parameters process the rows of the wave a second time, each worker with its own range
//! of parameters ([`step`]). The number of slots and the order of every sum depend on the plan only, so that results
//! are bit-identical on any number of threads.

pub mod adam;
pub mod rows;
pub mod step;

use conefield_core::backend::{Adam, Backend, Executable, Explain, StepStats, Work};
use conefield_core::error::{Error, Result};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::simd;
use conefield_core::stage::{GradKind, Samples, TILE_ROWS, UnitRay, titled};
use conefield_core::words::counted;
use rayon::prelude::*;
use rows::{Belong, Encoded, Kernels, Scratch};
use step::Slots;

/// Points encoded at once when the field is evaluated or rays are rendered.
const CHUNK_ROWS: usize = 32_768;
/// Maximum number of rays rendered at once.
const CHUNK_RAYS: usize = 256;

/// The CPU backend: rayon threads, SIMD selected at run time.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

impl Cpu {
    /// The backend. It uses rayon's current pool.
    pub fn new() -> Self {
        Self
    }
}

impl Backend for Cpu {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn describe(&self) -> String {
        format!("cpu, {}, {}", simd::level_name(), counted(rayon::current_num_threads(), "thread"))
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let mut notes = vec![];
        for (name, stage) in pipeline.stages() {
            let info = stage.info();
            let name = titled(&name, &stage.describe());
            if info.grads == GradKind::Scatter && info.tape > 0 {
                return Err(Error::unsupported(
                    format!("{name} on the CPU backend"),
                    "a stage with scattered parameters must not keep a tape",
                ));
            }
            notes.push(match (info.identity, info.grads) {
                (true, _) => format!("{name}: identity, left out"),
                (_, GradKind::None) => format!("{name}: fused"),
                (_, GradKind::Dense) => format!("{name}: fused, gradients in one copy per slot"),
                (_, GradKind::Scatter) => {
                    format!(
                        "{name}: fused; gradients in a second pass over {} disjoint ranges",
                        stage.partition().len()
                    )
                }
            });
        }
        let kernels = kernels(pipeline);
        let evaluating = rayon::current_num_threads() * CHUNK_ROWS * kernels.encoded_numbers() * size_of::<f32>();
        let explain = Explain { backend: self.describe(), notes, scratch_bytes: Slots::bytes(&kernels) + evaluating };
        Ok((Box::new(CpuExecutable { slots: None, clean: false }), explain))
    }
}

struct CpuExecutable {
    /// Created by the first step: evaluation needs none.
    slots: Option<Slots<f32>>,
    /// Whether the arena's gradients are known to be zero.
    clean: bool,
}

/// The kernels for training.
fn kernels(pipeline: &Pipeline) -> Kernels<'_, f32> {
    Kernels::new(pipeline, |stage| stage.kernel())
}

impl Executable for CpuExecutable {
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        let kernels = kernels(&model.pipeline);
        if !self.clean {
            model.arena.grads.fill(0.0);
        }
        self.clean = false;
        let pipeline = &model.pipeline;
        if pipeline.field.lines().is_some() {
            return Err(Error::unsupported(pipeline.field.describe(), "its method trains it"));
        }
        let stats = self.slots.get_or_insert_with(|| Slots::new(&kernels)).step(
            &kernels,
            pipeline.projector.as_ref(),
            &model.arena.params,
            &mut model.arena.grads,
            work,
        );
        pipeline.fault()?;
        work.fault()?;
        Ok(stats)
    }

    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()> {
        adam::update(&mut model.arena, adam);
        self.clean = true;
        Ok(())
    }

    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        let kernels = kernels(&model.pipeline);
        out.par_chunks_mut(CHUNK_ROWS).zip(points.par_chunks(CHUNK_ROWS)).for_each_init(
            || (Encoded::default(), Scratch::default()),
            |(encoded, scratch), (out, points)| {
                let params = &model.arena.params;
                encoded.forward(&kernels, params, points);
                for (i, out) in out.chunks_mut(TILE_ROWS).enumerate() {
                    scratch.forward(&kernels, params, encoded, i * TILE_ROWS, &[out.len()], Belong::Nowhere);
                    out.copy_from_slice(scratch.outputs());
                }
            },
        );
        model.pipeline.fault()
    }

    fn encode(&mut self, model: &Model, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        let mut encoded = Encoded::default();
        encoded.forward(&kernels(&model.pipeline), &model.arena.params, points);
        model.pipeline.fault()?;
        Ok(encoded.features().to_vec())
    }

    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        if let Some(lines) = model.pipeline.field.lines() {
            let parts = out.par_chunks_mut(CHUNK_RAYS).zip(rays.par_chunks(CHUNK_RAYS));
            parts.for_each(|(out, rays)| lines.project(&model.arena.params, rays, out));
            return model.pipeline.fault();
        }
        let kernels = kernels(&model.pipeline);
        let projector = model.pipeline.projector.as_ref();
        let longest = rays.iter().map(|ray| projector.max_samples(ray)).max().unwrap_or(0);
        let each = (CHUNK_ROWS / longest.max(1)).clamp(1, CHUNK_RAYS);
        out.par_chunks_mut(each).zip(rays.par_chunks(each)).for_each_init(
            || (Encoded::default(), Scratch::default(), Samples::default(), vec![], vec![]),
            |(encoded, scratch, samples, counts, mu), (out, rays)| {
                samples.points.clear();
                samples.weights.clear();
                counts.clear();
                for ray in rays {
                    let before = samples.points.len();
                    projector.sample(ray, None, samples);
                    counts.push(samples.points.len() - before);
                }
                let params = &model.arena.params;
                encoded.forward(&kernels, params, &samples.points);
                let mut first = 0;
                for (out, &n) in out.iter_mut().zip(&*counts) {
                    *out = 0.0;
                    if n > 0 {
                        scratch.forward(&kernels, params, encoded, first, &kernels.ray_tiles(n), Belong::ToRays);
                        mu.clear();
                        mu.extend(scratch.outputs().iter().map(|&m| f64::from(m)));
                        *out = projector.integrate(&samples.weights[first..first + n], mu) as f32;
                    }
                    first += n;
                }
            },
        );
        model.pipeline.fault()
    }
}
