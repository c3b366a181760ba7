//! Speed of conefield, measured in `benches/`, and what the machine allows at most, measured in the same run.

use conefield_core::Result;
use conefield_core::backend::{Adam, Backend, Executable, StepStats, TrainRay, Work};
use conefield_core::dense::{WeightMatrix, affine};
use conefield_core::pages::Pages;
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::{mix, unit};
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_core::stage::{Encoder, UnitRay};
use conefield_encoders::hash_grid::HashGrid;
use conefield_fields::mlp::Mlp;
use conefield_fields::normalizers::layer_norm::LayerNorm;
use conefield_projectors::ray_march::{RayMarch, Sampling};
use conefield_solvers::losses::L1;
use rayon::prelude::*;
use std::time::Instant;

/// Rays of a step of the published configuration.
pub const RAYS: usize = 1024;
/// Samples of a ray in it.
pub const SAMPLES: usize = 320;

/// The published configuration with `samples` a ray: a hash grid of 10 levels of 2 features with tables of 2^19 entries,
/// LayerNorm, an MLP.
pub fn published(samples: usize) -> Result<Pipeline> {
    published_with(HashGrid::default().build()?, samples)
}

/// The same with another encoder.
pub fn published_with(encoder: Box<dyn Encoder>, samples: usize) -> Result<Pipeline> {
    let width = encoder.info().output;
    let norm = LayerNorm::default().build(width)?;
    let march = RayMarch { samples: Some(samples), sampling: Sampling::Uniform, ..RayMarch::default() };
    Pipeline::new(encoder, vec![norm], Mlp::default().build(width)?, march.build()?)
}

/// A model in training.
pub struct Training {
    /// The model.
    pub model: Model,
    /// Its kernels on a backend.
    pub exe: Box<dyn Executable>,
}

impl Training {
    /// Random parameters on `backend`.
    pub fn new(backend: &dyn Backend, pipeline: Pipeline) -> Result<Self> {
        let (exe, _) = backend.compile(&pipeline)?;
        Ok(Self { model: Model::random(pipeline, 1), exe })
    }

    /// Gradients of a step.
    pub fn gradients(&mut self, rays: &[TrainRay], step: u64) -> Result<StepStats> {
        self.exe.step(&mut self.model, &Work { step, seed: 0, loss: &L1 {}, rays, points: &[], priors: &[] })
    }

    /// The update after them.
    pub fn update(&mut self, step: u64) -> Result<()> {
        self.exe.update(&mut self.model, &Adam { lr: 1e-3, beta1: 0.9, beta2: 0.999, eps: 1e-8, step })
    }

    /// Seconds of a whole step.
    pub fn step(&mut self, rays: &[TrainRay], step: u64) -> Result<f64> {
        let start = Instant::now();
        self.gradients(rays, step)?;
        self.update(step)?;
        Ok(start.elapsed().as_secs_f64())
    }
}

/// The centres of `side`³ voxels of the unit cube.
pub fn points(side: usize) -> Vec<[f32; 3]> {
    let at = |i: usize| [i / (side * side), i / side % side, i % side].map(|k| (k as f32 + 0.5) / side as f32);
    (0..side * side * side).map(at).collect()
}

/// Minimum, median and maximum.
pub fn spread(times: &mut [f64]) -> [f64; 3] {
    times.sort_by(f64::total_cmp);
    [times[0], times[times.len() / 2], times[times.len() - 1]]
}

/// `n` things in each of these seconds, in millions, for a line of a report; `of` says what the median is of.
pub fn millions(n: f64, [low, median, high]: [f64; 3], things: &str, of: &str) -> String {
    let [slow, middle, fast] = [high, median, low].map(|t| n / t / 1e6);
    format!("{middle:.2} M {things}/s ({of}; {slow:.2} to {fast:.2})")
}

/// Minimum, median and maximum of some runs, in seconds.
pub fn times(runs: usize, mut f: impl FnMut()) -> [f64; 3] {
    let mut all: Vec<f64> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            f();
            start.elapsed().as_secs_f64()
        })
        .collect();
    spread(&mut all)
}

/// Multiply-adds a second of all threads, in dense layers that stay in the first-level cache.
pub fn multiply_adds() -> f64 {
    let rounds = 4000;
    let threads = rayon::current_num_threads();
    let (w, x) = (vec![0.01; 64 * 64], vec![0.02; 64 * 64]);
    let [best, ..] = times(5, || {
        (0..threads).into_par_iter().for_each(|_| {
            let mut y = vec![0.0; 64 * 64];
            for _ in 0..rounds {
                affine(WeightMatrix { data: &w, ld: 64, column: 0 }, None, &x, &mut y, 64);
            }
        });
    });
    (threads * rounds * 64 * 64 * 64) as f64 / best
}

/// Bytes a second that all threads together read from memory, one after the other.
pub fn bandwidth() -> f64 {
    let data = vec![1.0f32; 64 << 20];
    let threads = rayon::current_num_threads();
    let [best, ..] = times(5, || {
        let sum: f32 = data
            .par_chunks(data.len().div_ceil(threads))
            .map(|part| {
                // As many sums as keep every load in flight.
                let mut sums = [0.0f32; 64];
                for line in part.as_chunks::<64>().0 {
                    for (sum, x) in sums.iter_mut().zip(line) {
                        *sum += x;
                    }
                }
                sums.iter().sum::<f32>()
            })
            .sum();
        assert!(sum > 0.0);
    });
    (4 * data.len()) as f64 / best
}

/// Reads a second of all threads together from random cache lines of 32 MiB.
pub fn random_reads() -> f64 {
    // Written once: pages that were only ever read are all one page of zeros, which stays in the cache.
    let table: Pages = (0..8 << 20).map(|i| (i % 3) as f32).collect();
    let count = 4_000_000u32;
    let each: Vec<f64> = (0..rayon::current_num_threads())
        .into_par_iter()
        .map(|t| {
            let (mut state, mut sum) = (t as u32 + 1, 0.0);
            let start = Instant::now();
            for _ in 0..count {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                sum += table[(state >> 9) as usize];
            }
            let time = start.elapsed().as_secs_f64();
            assert!(sum > 0.0);
            f64::from(count) / time
        })
        .collect();
    each.iter().sum()
}

/// `count` rays of a scan at five half sides, through random pixels.
pub fn rays(count: usize) -> Vec<TrainRay> {
    let random = |i: u64, k: u64| unit(mix(i, k));
    (0..count as u64)
        .map(|i| {
            let (s, c) = (random(i, 1) * std::f32::consts::TAU).sin_cos();
            let origin = [0.5 + 2.5 * c, 0.5 + 2.5 * s, 0.5];
            let (u, v) = (0.7 * (random(i, 2) - 0.5), 0.7 * (random(i, 3) - 0.5));
            let to = [0.5 - u * s - origin[0], 0.5 + u * c - origin[1], 0.5 + v - origin[2]];
            let length = to.iter().map(|d| d * d).sum::<f32>().sqrt();
            let direction = to.map(|d| d / length);
            TrainRay {
                ray: UnitRay { origin, direction, inside: [2.0, 3.0], published: [1.8, 3.2], per_mm: 0.01 },
                target: 0.3,
            }
        })
        .collect()
}
