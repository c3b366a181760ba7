//! The example plugins: their own tests, the conformance check, and a reconstruction with each.

use crate::build::{cargo, cc, example, sources};
use crate::common::{Folder, number, text};

#[test]
fn rust_examples_pass_their_own_tests() {
    let folder = sources().join("plugins/examples");
    cargo(&folder, &["fmt", "--all", "--check"]);
    cargo(&folder, &["test", "--release", "--locked"]);
}

#[test]
fn every_example_is_checked_and_reconstructs() {
    let d = Folder::after(&["simulate phantom:head:32 -o scan --views 16 --detector 32x32"]);
    cc(&sources().join("plugins/examples/dense/dense.c"), &d.at("dense.so"));
    for (library, sets) in [
        (example("siren"), &["field.type=siren"][..]),
        (example("siren"), &["normalizers.0.type=ray-smooth"]),
        (example("triplane"), &["encoder.type=triplane", "encoder.levels=1", "encoder.resolution=24"]),
        (d.at("dense.so"), &["encoder.type=one-grid"]),
    ] {
        let library = text(&library);
        // Grids in single precision: positions near a node are rounded into another cell.
        passes(&d, &format!("{library} --single 5e-5"));
        let sets: String = sets.iter().map(|s| format!(" --set {s}")).collect();
        let small = format!("--steps 150 --set projector.samples=48 --set training.rays=256{sets}");
        let psnr = psnr(&d, &format!("--plugin {library} reconstruct scan --spec fast {small}"));
        println!("{sets}: {psnr:.2} dB");
        // A volume of zeros has 13.1 dB.
        assert!(psnr > 14.1, "{sets}: {psnr} dB");
    }
}

/// Checks the plugin of a line.
fn passes(d: &Folder, line: &str) {
    let report = d.json(&format!("plugins check {line} --json"));
    assert_eq!(report["passed"], true, "{report:#}");
}

/// The PSNR of the run of a line.
fn psnr(d: &Folder, line: &str) -> f64 {
    number(&d.json(&format!("{line} -o run --force --reference truth --json"))["scores"]["psnr"])
}

/// The regularizer runs in `fista` and gives a better volume than no prior.
#[test]
fn huber_denoises() {
    let d = Folder::after(&["simulate phantom:head:32 -o scan --views 16 --detector 32x32 --noise poisson:1e3"]);
    let library = text(&example("huber"));
    passes(&d, &library);
    let of = |prior: &str| psnr(&d, &format!("--plugin {library} reconstruct scan --spec fista --set prior={prior}"));
    let [none, huber] = ["none", "huber"].map(of);
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
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 6 --detector 16x16"]);
    let library = text(&example("triplane"));
    let run = |spec: &str, sets: &str| {
        let encoder = if CHAINS.contains(&spec) { "methods.0.encoder.type" } else { "encoder.type" };
        let small = format!("--backend cpu --steps 4 --set {encoder}=triplane {sets}");
        let psnr = psnr(&d, &format!("--plugin {library} reconstruct scan --spec {spec} {small}"));
        assert!(psnr.is_finite(), "{spec}");
    };
    for spec in FIELDS {
        let one = if spec == "sax-nerf" { "--set training.windows.count=1" } else { "" };
        run(spec, &format!("--set training.rays=128 {one}"));
    }
    CHAINS.iter().for_each(|spec| run(spec, ""));
    let weights = || {
        let weights = conefield_io::read_weights(d.at("run/weights.safetensors")).unwrap();
        weights.tensors.into_keys().filter(|name| name.starts_with("encoder.")).collect::<Vec<_>>()
    };
    // 16 voxels per side need no level of 64 nodes, and none of 32.
    run("balanced", "--set scene.levels=needed");
    assert_eq!(weights().len(), 6, "{:?}", weights());
    run("ni-naf", "--set 'callbacks=[{type=\"fft-mask\",keep=[0,1,2,12]}]'");
    assert_eq!(weights(), ["encoder.0.0.line", "encoder.0.0.plane", "encoder.1.0.line", "encoder.1.0.plane"]);
}
