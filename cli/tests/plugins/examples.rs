//! The example plugins: their own tests, the check, and a reconstruction with each.

use crate::build::{cargo, cc, example, sources};
use crate::common::{done, json, text};

#[test]
fn rust_examples_pass_their_own_tests() {
    let folder = sources().join("plugins/examples");
    cargo(&folder, &["fmt", "--all", "--check"]);
    cargo(&sources().join("plugins/tests"), &["fmt", "--all", "--check"]);
    cargo(&folder, &["test", "--release", "--locked"]);
}

#[test]
fn every_example_is_checked_and_reconstructs() {
    let dir = tempfile::tempdir().unwrap();
    let dense = dir.path().join("dense.so");
    cc(&sources().join("plugins/examples/dense/dense.c"), &["NDEBUG"], &dense);
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:32", "-o", &scan, "--views", "16", "--detector", "32x32"]);
    for (library, sets) in [
        (example("siren"), &["field.type=siren"][..]),
        (example("siren"), &["normalizers.0.type=ray-smooth"]),
        (example("triplane"), &["encoder.type=triplane", "encoder.resolution=24"]),
        (dense, &["encoder.type=one-grid"]),
    ] {
        let library = text(&library);
        // Grids in single precision: positions near a node are rounded to another cell.
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
