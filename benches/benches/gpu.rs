//! Speed on a GPU of the published configuration (hash grid of 10 levels × 2, tables of 2^19, LayerNorm, MLP; 1024 rays ×
//! 320 samples a step) and of a step 16 times as large, time and share of every kernel, export, and back-projection, beside
//! what the device can do at most, measured in the same run.
//!
//! `cargo bench -p conefield-benches --bench gpu -- [ADAPTER]`; `benches/gpu.sh` checks parity first. A software device does
//! less work of each.

use conefield_backend_wgpu::{Limits, Wgpu};
use conefield_benches::{rays, spread};
use conefield_core::backend::{Adam, Backend, Executable, Work};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_encoders::hash_grid::HashGrid;
use conefield_fields::mlp::Mlp;
use conefield_normalizers::layer_norm::LayerNorm;
use conefield_projectors::ray_march::{RayMarch, Sampling};
use conefield_projectors::simulate::{Protocol, phantom, simulate};
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::layout::Pinhole;
use conefield_solvers::losses::L1;
use ndarray::Array3;
use std::error::Error;
use std::time::Instant;

const SAMPLES: usize = 320;

fn pipeline() -> Result<Pipeline, Box<dyn Error>> {
    let encoder = HashGrid::default().build()?;
    let width = encoder.info().output;
    let march = RayMarch { samples: Some(SAMPLES), sampling: Sampling::Uniform, ..RayMarch::default() };
    let norm = LayerNorm::default().build(width)?;
    Ok(Pipeline::new(encoder, vec![norm], Mlp::default().build(width)?, march.build()?)?)
}

struct Training {
    model: Model,
    exe: Box<dyn Executable>,
}

impl Training {
    fn new(backend: &Wgpu) -> Result<Self, Box<dyn Error>> {
        let pipeline = pipeline()?;
        let (exe, _) = backend.compile(&pipeline)?;
        Ok(Self { model: Model::random(pipeline, 1), exe })
    }

    /// Seconds of `steps` steps with `count` rays, after some to warm up: lowest, median, highest.
    fn steps(&mut self, count: usize, warm_up: u64, steps: u64) -> Result<[f64; 3], Box<dyn Error>> {
        let rays = rays(count);
        let mut times = vec![];
        for step in 1..=warm_up + steps {
            if step == warm_up + 1 {
                self.exe.profile();
            }
            let start = Instant::now();
            let work = Work { step, seed: 0, loss: &L1 {}, rays: &rays, points: &[], priors: &[] };
            self.exe.step(&mut self.model, &work)?;
            self.exe.update(&mut self.model, &Adam { lr: 1e-3, beta1: 0.9, beta2: 0.999, eps: 1e-8, step })?;
            if step > warm_up {
                times.push(start.elapsed().as_secs_f64());
            }
        }
        Ok(spread(&mut times))
    }
}

/// FDK's back-projection, in voxel updates (a voxel and a view each), and the step of an algebraic method.
fn updates(backend: &Wgpu, software: bool) -> Result<(), Box<dyn Error>> {
    let (side, views) = if software { (48, 12) } else { (256, 50) };
    let (truth, protocol) = (phantom(side), Protocol::r2(&phantom(side).grid).with_views(views));
    let scan = simulate(&truth, &protocol.with_detector([side, side]))?;
    let g = &scan.geometry;
    let seen: Vec<_> = (0..views).map(|v| Pinhole::of(g, v).voxels(&g.volume, 1.0)).collect();
    let all: Vec<usize> = (0..views).collect();
    let joseph = backend.place(Box::new(Joseph {}))?;
    let mut volume = Array3::<f32>::zeros(g.volume.shape);
    let mut lines = scan.projections.clone();
    let timed = |what: &str,
                 mut run: Box<dyn FnMut() -> Result<(), Box<dyn Error>> + '_>|
     -> Result<(), Box<dyn Error>> {
        let mut times = vec![];
        for i in 0..6 {
            let start = Instant::now();
            run()?;
            if i > 0 {
                times.push(start.elapsed().as_secs_f64());
            }
        }
        let [low, median, high] = spread(&mut times);
        let n = (side * side * side * views) as f64 / 1e9;
        println!("{what:<20} {:.3} GUPS (median; {:.3} to {:.3}), transfers included", n / median, n / high, n / low);
        Ok(())
    };
    timed(
        "FDK back-projection",
        Box::new(|| Ok(backend.backproject(&seen, scan.projections.view(), volume.view_mut()).map(drop)?)),
    )?;
    timed(
        "forward projection",
        Box::new(|| {
            joseph.operator().forward(g, &all, truth.data.view(), lines.view_mut());
            Ok(joseph.operator().fault()?)
        }),
    )?;
    let mut back = Array3::<f32>::zeros(g.volume.shape);
    timed(
        "its adjoint",
        Box::new(|| {
            joseph.operator().adjoint(g, &all, scan.projections.view(), back.view_mut());
            Ok(joseph.operator().fault()?)
        }),
    )
}

fn rate(n: f64, [low, median, high]: [f64; 3]) -> String {
    format!("{:.2} M/s (median; {:.2} to {:.2})", n / median / 1e6, n / high / 1e6, n / low / 1e6)
}

fn main() -> Result<(), Box<dyn Error>> {
    let adapter = std::env::args().skip(1).find_map(|a| a.parse().ok());
    let backend = Wgpu::open(adapter)?;
    let software = backend.adapter().software;
    println!("adapter              {}", backend.adapter());
    let explain = backend.compile(&pipeline()?)?.1;
    explain.notes.iter().for_each(|n| println!("  {n}"));
    // A software device takes seconds for what a GPU does in a millisecond.
    let (published, large, warm_up, steps) = if software { (64, 128, 2, 3) } else { (1024, 16_384, 30, 100) };

    let mut training = Training::new(&backend)?;
    let samples = (published * SAMPLES) as f64;
    let time = training.steps(published, warm_up, steps)?;
    println!("training             {} samples, {published} rays x {SAMPLES}", rate(samples, time));
    let time = training.steps(large, warm_up, steps)?;
    println!("training, large      {} samples, {large} rays x {SAMPLES}", rate((large * SAMPLES) as f64, time));
    if backend.adapter().subgroups.is_some() {
        let mut training =
            Training::new(&Wgpu::with_limits(adapter, Limits { subgroups: true, ..Limits::default() })?)?;
        for (what, count) in [("with subgroups", published), ("with subgroups, large", large)] {
            let time = training.steps(count, warm_up, steps)?;
            println!("{what:<20} {} samples", rate((count * SAMPLES) as f64, time));
        }
    }

    let side = if software { 32 } else { 256 };
    let points: Vec<[f32; 3]> = (0..side * side * side)
        .map(|i| [i / (side * side), i / side % side, i % side].map(|k| (k as f32 + 0.5) / side as f32))
        .collect();
    let mut out = vec![0.0; points.len()];
    let mut times = vec![];
    for _ in 0..5 {
        let start = Instant::now();
        training.exe.evaluate(&training.model, &points, &mut out)?;
        times.push(start.elapsed().as_secs_f64());
    }
    println!("export               {} points", rate(points.len() as f64, spread(&mut times)));

    updates(&backend, software)?;

    let timed = Wgpu::with_limits(adapter, Limits { profile: true, ..Limits::default() })?;
    let mut training = Training::new(&timed)?;
    training.steps(published, warm_up, steps)?;
    let kernels = training.exe.profile();
    let all: f64 = kernels.iter().map(|(_, s)| s).sum();
    println!("time on the device, by timestamps{}", if kernels.is_empty() { ": the adapter has none" } else { "" });
    for (name, seconds) in &kernels {
        println!("  {name:<18} {:5.1} % ({:.3} ms a step)", 100.0 * seconds / all, 1e3 * seconds / steps as f64);
    }

    let ceiling = backend.shared().ceiling()?;
    // Forward once, once more on the way back, then inputs and weights.
    let macs = 4.0 * pipeline()?.macs() as f64;
    // 8 corners of 2 numbers on 10 levels, read and then updated.
    let reads = 2.0 * 8.0 * 10.0;
    let device = all / steps as f64;
    let (by_math, by_reads) = (ceiling.multiply_adds / macs, ceiling.random_reads / reads);
    let of = |limit: f64| {
        if all > 0.0 { format!(", reached {:.0} %", 100.0 * samples / device / limit) } else { String::new() }
    };
    println!("limits of this device, measured now:");
    println!(
        "  multiply-adds      {:.1} G/s; a sample takes {macs}: {:.1} M samples/s{}",
        ceiling.multiply_adds / 1e9,
        by_math / 1e6,
        of(by_math)
    );
    println!(
        "  random reads       {:.1} M/s; a sample takes {reads}: {:.1} M samples/s{}",
        ceiling.random_reads / 1e6,
        by_reads / 1e6,
        of(by_reads)
    );
    println!("  bandwidth          {:.1} GB/s", ceiling.bytes / 1e9);
    Ok(())
}
