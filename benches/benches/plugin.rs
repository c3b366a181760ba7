//! What the way through the plugin contract costs: the published configuration with the built-in hash grid, and with the
//! same hash grid loaded as a plugin (`plugins/tests/rehashed`, built by this bench), step by step in turn.
//!
//! `cargo bench -p conefield-benches --bench plugin`

use conefield_backend_cpu::Cpu;
use conefield_benches::{RAYS, SAMPLES, Training, millions, published, published_with, rays, spread};
use conefield_core::registry::read;
use conefield_core::settings::EncoderSpec;
use conefield_plugins::{Place, Plugins};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

const STEPS: u64 = 60;
const WARM_UP: u64 = 10;

fn main() -> Result<(), Box<dyn Error>> {
    Plugins::default().load(library()?, Place::Named)?;
    let loaded = read::<dyn EncoderSpec>(serde_json::json!({ "type": "rehashed" }))?;
    let rays = rays(RAYS);
    let mut built_in = Training::new(&Cpu::new(), published(SAMPLES)?)?;
    let mut plugin = Training::new(&Cpu::new(), published_with(loaded.build()?, SAMPLES)?)?;
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
    for (name, times) in ["built in", "plugin"].iter().zip(&mut times) {
        println!("{name:<9} {}", millions((RAYS * SAMPLES) as f64, spread(times), "samples", "median step"));
    }
    let [low, ratio, high] = spread(&mut ratios);
    println!("a step takes {ratio:.3} times as long (median of pairs; {low:.3} to {high:.3})");
    println!("parameters after {STEPS} steps: {}", if same { "the same bits" } else { "DIFFERENT" });
    Ok(())
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
