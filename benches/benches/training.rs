//! Speed of the published configuration: a hash grid of 10 levels × 2 with tables of 2^19, LayerNorm, a
//! 20→32→32→(+20)→32→1 MLP, 1024 rays × 320 samples a step.
//!
//! Reports training samples a second and export points a second (medians with the spread), the share of time of each
//! part, and beside them what the machine allows: the rate of fused multiply-adds and of random reads, measured in
//! the same run. `cargo bench -p conefield-benches --bench training`; `benches/peers/train.sh` puts the same step in
//! PyTorch beside it.

use conefield_backend_cpu::Cpu;
use conefield_benches::{multiply_adds, random_reads, rays, spread};
use conefield_core::backend::{Adam, Backend, Work};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_encoders::hash_grid::HashGrid;
use conefield_fields::mlp::Mlp;
use conefield_fields::normalizers::layer_norm::LayerNorm;
use conefield_projectors::ray_march::{RayMarch, Sampling};
use conefield_solvers::losses::L1;
use std::error::Error;
use std::time::Instant;

const RAYS: usize = 1024;
const SAMPLES: usize = 320;
const STEPS: u64 = 40;
const WARM_UP: u64 = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let encoder = HashGrid::default().build()?;
    let width = encoder.info().output;
    let norm = LayerNorm::default().build(width)?;
    let field = Mlp::default().build(width)?;
    let march = RayMarch { samples: Some(SAMPLES), sampling: Sampling::Uniform, ..RayMarch::default() };
    let pipeline = Pipeline::new(encoder, vec![norm], field, march.build()?)?;
    let (mut exe, explain) = Cpu::new().compile(&pipeline)?;
    println!("backend              {}", explain.backend);
    let macs = pipeline.macs();
    let mut model = Model::random(pipeline, 1);
    let rays = rays(RAYS);
    let (mut total, mut dense, mut scatter, mut adam) = (vec![], vec![], vec![], vec![]);
    for step in 1..=STEPS {
        let start = Instant::now();
        let work = Work { step, seed: 0, loss: &L1 {}, rays: &rays, points: &[], priors: &[] };
        let stats = exe.step(&mut model, &work)?;
        let updating = Instant::now();
        exe.update(&mut model, &Adam { lr: 1e-3, beta1: 0.9, beta2: 0.999, eps: 1e-8, step })?;
        if step > WARM_UP {
            total.push(start.elapsed().as_secs_f64());
            dense.push(stats.dense_s);
            scatter.push(stats.scatter_s);
            adam.push(updating.elapsed().as_secs_f64());
        }
    }
    let samples = (RAYS * SAMPLES) as f64;
    let [low, step, high] = spread(&mut total);
    println!(
        "training             {:.2} M samples/s (median step; {:.2} to {:.2})",
        samples / step / 1e6,
        samples / high / 1e6,
        samples / low / 1e6
    );
    for (name, part) in [("forward and dense", &mut dense), ("table gradients", &mut scatter), ("adam", &mut adam)] {
        let [_, t, _] = spread(part);
        println!("  {name:<18} {:5.1} % ({:.1} ms)", 100.0 * t / step, t * 1e3);
    }

    let side = 128;
    let points: Vec<[f32; 3]> = (0..side * side * side)
        .map(|i| [i / (side * side), i / side % side, i % side].map(|k| (k as f32 + 0.5) / side as f32))
        .collect();
    let mut out = vec![0.0; points.len()];
    let mut times: Vec<f64> = vec![];
    for _ in 0..7 {
        let start = Instant::now();
        exe.evaluate(&model, &points, &mut out)?;
        times.push(start.elapsed().as_secs_f64());
    }
    let n = points.len() as f64;
    let [low, export, high] = spread(&mut times);
    println!(
        "export               {:.2} M points/s (median; {:.2} to {:.2})",
        n / export / 1e6,
        n / high / 1e6,
        n / low / 1e6
    );

    // Forward once, backward twice (gradients of inputs and of weights), for all but the interpolation.
    let (peak, reads) = (multiply_adds(), random_reads());
    let per_sample = 3 * macs;
    // On each of the 7 hashed levels 4 of the 8 corners lie in lines of their own, read forward and updated backward.
    let lines = 2 * 4 * 7;
    let (by_math, by_reads) = (peak / per_sample as f64, reads / f64::from(lines));
    println!("limits of this machine, measured now:");
    println!(
        "  multiply-adds      {:.0} G/s; a sample takes {per_sample}: {:.1} M samples/s",
        peak / 1e9,
        by_math / 1e6
    );
    println!("  random lines       {:.0} M/s; a sample takes {lines}: {:.1} M samples/s", reads / 1e6, by_reads / 1e6);
    let limit = 1.0 / (1.0 / by_math + 1.0 / by_reads);
    println!("  one after another  {:.1} M samples/s; reached {:.0} %", limit / 1e6, 100.0 * samples / step / limit);
    Ok(())
}
