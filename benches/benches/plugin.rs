//! What the way through the plugin contract costs: the published configuration with the built-in hash grid, and with the
//! same hash grid loaded as a plugin (`plugins/tests/rehashed`, built by this bench), step by step in turn.
//!
//! `cargo bench -p conefield-benches --bench plugin`

use conefield_backend_cpu::Cpu;
use conefield_benches::{rays, spread};
use conefield_core::backend::{Adam, Backend, Executable, TrainRay, Work};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::registry::read;
use conefield_core::settings::{EncoderSpec, FieldSpec, NormalizerSpec, ProjectorSpec};
use conefield_core::stage::Encoder;
use conefield_encoders::hash_grid::HashGrid;
use conefield_fields::mlp::Mlp;
use conefield_fields::normalizers::layer_norm::LayerNorm;
use conefield_plugins::{Place, Plugins};
use conefield_projectors::ray_march::{RayMarch, Sampling};
use conefield_solvers::losses::L1;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

const RAYS: usize = 1024;
const SAMPLES: usize = 320;
const STEPS: u64 = 60;
const WARM_UP: u64 = 10;

fn main() -> Result<(), Box<dyn Error>> {
    Plugins::default().load(library()?, Place::Named)?;
    let loaded = read::<dyn EncoderSpec>(serde_json::json!({ "type": "rehashed" }))?;
    let rays = rays(RAYS);
    let mut built_in = Runner::new(HashGrid::default().build()?)?;
    let mut plugin = Runner::new(loaded.build()?)?;
    let (mut ratios, mut times) = (vec![], [vec![], vec![]]);
    for step in 1..=STEPS {
        // Which goes first changes, so that neither profits from the other's caches.
        let (a, b) = if step % 2 == 0 {
            let a = built_in.step(&rays, step)?;
            (a, plugin.step(&rays, step)?)
        } else {
            let b = plugin.step(&rays, step)?;
            (built_in.step(&rays, step)?, b)
        };
        if step > WARM_UP {
            ratios.push(b / a);
            times[0].push(a);
            times[1].push(b);
        }
    }
    let same = *built_in.model.arena.params == *plugin.model.arena.params;
    let samples = (RAYS * SAMPLES) as f64 / 1e6;
    for (name, times) in ["built in", "plugin"].iter().zip(&mut times) {
        let [low, median, high] = spread(times);
        println!(
            "{name:<9} {:.2} M samples/s (median step; {:.2} to {:.2})",
            samples / median,
            samples / high,
            samples / low
        );
    }
    let [low, ratio, high] = spread(&mut ratios);
    println!("a step takes {ratio:.3} times as long (median of pairs; {low:.3} to {high:.3})");
    println!("parameters after {STEPS} steps: {}", if same { "the same bits" } else { "DIFFERENT" });
    Ok(())
}

struct Runner {
    model: Model,
    exe: Box<dyn Executable>,
}

impl Runner {
    fn new(encoder: Box<dyn Encoder>) -> Result<Self, Box<dyn Error>> {
        let width = encoder.info().output;
        let norm = LayerNorm::default().build(width)?;
        let march = RayMarch { samples: Some(SAMPLES), sampling: Sampling::Uniform, ..RayMarch::default() };
        let pipeline = Pipeline::new(encoder, vec![norm], Mlp::default().build(width)?, march.build()?)?;
        let (exe, _) = Cpu::new().compile(&pipeline)?;
        Ok(Self { model: Model::random(pipeline, 1), exe })
    }

    /// Seconds of one step.
    fn step(&mut self, rays: &[TrainRay], step: u64) -> Result<f64, Box<dyn Error>> {
        let start = Instant::now();
        self.exe.step(&mut self.model, &Work { step, seed: 0, loss: &L1 {}, rays, points: &[], priors: &[] })?;
        self.exe.update(&mut self.model, &Adam { lr: 1e-3, beta1: 0.9, beta2: 0.999, eps: 1e-8, step })?;
        Ok(start.elapsed().as_secs_f64())
    }
}

/// Builds the plugin.
fn library() -> Result<PathBuf, Box<dyn Error>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../plugins/examples");
    let target = std::env::temp_dir().join("conefield-bench-plugin");
    let mut cargo = Command::new(env!("CARGO"));
    cargo.current_dir(folder).args(["build", "--release", "--locked", "-p", "rehashed", "--target-dir"]).arg(&target);
    if !cargo.status()?.success() {
        return Err("the plugin cannot be built".into());
    }
    let name = format!("{}rehashed{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    Ok(target.join("release").join(name))
}
