//! The example plugins: their own tests, the conformance check, and a reconstruction with each.

use crate::build::{cargo, cc, example, sources};
use crate::common::{done, json, text};

#[test]
fn rust_examples_pass_their_own_tests() {
    let folder = sources().join("plugins/examples");
    cargo(&folder, &["fmt", "--all", "--check"]);
    cargo(&folder, &["test", "--release", "--locked"]);
}

#[test]
fn every_example_is_checked_and_reconstructs() {
    let dir = tempfile::tempdir().unwrap();
    let dense = dir.path().join("dense.so");
    cc(&sources().join("plugins/examples/dense/dense.c"), &dense);
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:32", "-o", &scan, "--views", "16", "--detector", "32x32"]);
    for (library, sets) in [
        (example("siren"), &["field.type=siren"][..]),
        (example("siren"), &["normalizers.0.type=ray-smooth"]),
        (example("triplane"), &["encoder.type=triplane", "encoder.levels=1", "encoder.resolution=24"]),
        (dense, &["encoder.type=one-grid"]),
    ] {
        let library = text(&library);
        // Grids in single precision: positions near a node are rounded into another cell.
        let report = json(&["plugins", "check", &library, "--single", "5e-5", "--json"]);
        assert_eq!(report["passed"], true, "{report:#}");
        let run = text(&dir.path().join(sets[0]));
        let mut args = vec!["--plugin", &library, "reconstruct", &scan, "--spec", "fast", "-o", &run, "--json"];
        args.extend(["--reference", "truth", "--steps", "150", "--set", "projector.samples=48"]);
        args.extend(["--set", "training.rays=256"]);
        for set in sets {
            args.extend(["--set", set]);
        }
        let psnr = json(&args)["scores"]["psnr"].as_f64().unwrap();
        println!("{sets:?}: {psnr:.2} dB");
        // A volume of zeros has 13.1 dB.
        assert!(psnr > 14.1, "{sets:?}: {psnr} dB");
    }
}

/// The regularizer runs in `fista` and gives a better volume than no prior.
#[test]
fn huber_denoises() {
    let dir = tempfile::tempdir().unwrap();
    let library = text(&example("huber"));
    let report = json(&["plugins", "check", &library, "--json"]);
    assert_eq!(report["passed"], true, "{report:#}");
    let scan = text(&dir.path().join("scan"));
    let noise = ["--noise", "poisson:1e3"];
    done(&[&["simulate", "phantom:head:32", "-o", &scan, "--views", "16", "--detector", "32x32"][..], &noise].concat());
    let psnr = |prior: &str| {
        let run = text(&dir.path().join(prior));
        let prior = format!("prior={prior}");
        let args = ["--plugin", &library, "reconstruct", &scan, "--spec", "fista", "-o", &run, "--json"];
        let args = [&args[..], &["--reference", "truth", "--set", &prior]].concat();
        json(&args)["scores"]["psnr"].as_f64().unwrap()
    };
    let [none, huber] = ["none", "huber"].map(psnr);
    println!("huber: {huber:.2} dB, without a prior {none:.2} dB");
    assert!(huber > none + 1.0, "{huber} dB, without a prior {none} dB");
}

/// The shipped specs that train a field and stop.
const FIELDS: [&str; 9] =
    ["naf", "ni-naf", "ni-naf-published", "nerf", "sax-nerf", "dense", "fast", "balanced", "accurate"];
/// Specs that continue from the field's volume.
const CHAINS: [&str; 2] = ["field-tv", "accurate-tv"];

/// A plugin's encoder replaces the built-in one in every spec that has one, with everything that specs require of an
/// encoder.
#[test]
fn the_planes_run_in_every_shipped_spec() {
    let dir = tempfile::tempdir().unwrap();
    let library = text(&example("triplane"));
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "16x16"]);
    let run = |name: &str, spec: &str, sets: &[&str]| {
        let run = text(&dir.path().join(name));
        let mut args = vec!["--plugin", &library, "reconstruct", &scan, "--spec", spec, "-o", &run, "--json"];
        args.extend(["--backend", "cpu", "--reference", "truth", "--steps", "4"]);
        let encoder = if CHAINS.contains(&spec) { "methods.0.encoder.type" } else { "encoder.type" };
        let encoder = format!("{encoder}=triplane");
        for set in sets.iter().chain([&&encoder[..]]) {
            args.extend(["--set", set]);
        }
        let record = json(&args);
        let psnr = record["scores"]["psnr"].as_f64();
        assert!(psnr.is_some_and(f64::is_finite), "{name}: {record:#}");
        dir.path().join(name)
    };
    for spec in FIELDS {
        let few = ["training.rays=128", "training.windows.count=1"];
        run(spec, spec, if spec == "sax-nerf" { &few } else { &few[..1] });
    }
    for spec in CHAINS {
        run(spec, spec, &[]);
    }
    let weights = |run: &std::path::Path| {
        let weights = conefield_io::read_weights(run.join("weights.safetensors")).unwrap();
        weights.tensors.into_keys().filter(|name| name.starts_with("encoder.")).collect::<Vec<_>>()
    };
    // 16 voxels per side need no level of 64 nodes, and none of 32.
    let needed = weights(&run("needed", "balanced", &["scene.levels=needed"]));
    assert_eq!(needed.len(), 6, "{needed:?}");
    let masked = weights(&run("masked", "ni-naf", &["callbacks=[{type=\"fft-mask\",keep=[0,1,2,12]}]"]));
    assert_eq!(masked, ["encoder.0.0.line", "encoder.0.0.plane", "encoder.1.0.line", "encoder.1.0.plane"]);
}
