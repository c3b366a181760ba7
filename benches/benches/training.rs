//! Speed of the published configuration: a hash grid of 10 levels × 2 with tables of 2^19, LayerNorm, a
//! 20→32→32→(+20)→32→1 MLP, 1024 rays × 320 samples a step.
//!
//! Reports training samples a second and export points a second (medians with the spread), the share of time of each
//! part, and beside them what the machine allows: the rate of fused multiply-adds and of random reads, measured in
//! the same run. `cargo bench -p conefield-benches --bench training`; `benches/peers/train.sh` puts the same step in
//! PyTorch beside it.

use conefield_backend_cpu::Cpu;
use conefield_benches::{
    RAYS, SAMPLES, Training, millions, multiply_adds, points, published, random_reads, rays, spread, times,
};
use conefield_core::backend::Backend;
use std::error::Error;
use std::time::Instant;

const STEPS: u64 = 40;
const WARM_UP: u64 = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let (backend, pipeline) = (Cpu::new(), published(SAMPLES)?);
    println!("backend              {}", backend.describe());
    let macs = pipeline.macs();
    let mut training = Training::new(&backend, pipeline)?;
    let rays = rays(RAYS);
    let (mut total, mut dense, mut scatter, mut adam) = (vec![], vec![], vec![], vec![]);
    for step in 1..=STEPS {
        let start = Instant::now();
        let stats = training.gradients(&rays, step)?;
        let updating = Instant::now();
        training.update(step)?;
        if step > WARM_UP {
            total.push(start.elapsed().as_secs_f64());
            dense.push(stats.dense_s);
            scatter.push(stats.scatter_s);
            adam.push(updating.elapsed().as_secs_f64());
        }
    }
    let samples = (RAYS * SAMPLES) as f64;
    let total = spread(&mut total);
    let [_, step, _] = total;
    println!("training             {}", millions(samples, total, "samples", "median step"));
    for (name, part) in [("forward and dense", &mut dense), ("table gradients", &mut scatter), ("adam", &mut adam)] {
        let [_, t, _] = spread(part);
        println!("  {name:<18} {:5.1} % ({:.1} ms)", 100.0 * t / step, t * 1e3);
    }

    let points = points(128);
    let (mut out, mut failed) = (vec![0.0; points.len()], None);
    let Training { model, exe } = &mut training;
    let export = times(7, || failed = exe.evaluate(model, &points, &mut out).err());
    failed.map_or(Ok(()), Err)?;
    println!("export               {}", millions(points.len() as f64, export, "points", "median"));

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
