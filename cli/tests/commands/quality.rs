//! Shipped neural specs give a useful volume on the CPU: a head of 64³ voxels from 20 views, with fewer steps, smaller
//! tables and fewer samples than in the specs.

use crate::common::{done, json, text};
use conefield::specs::SHIPPED;

/// PSNR of a volume of zeros.
const EMPTY: f64 = 13.04;

const FEW: &[&str] = &["training.rays=256"];
const SMALL: &[&str] =
    &["training.rays=128", "projector.samples=64", "optimizer.lr=1e-2", "encoder.log2_table_size=14"];
const DENSE: &[&str] = &["training.rays=128", "projector.samples=64", "optimizer.lr=1e-2"];
const MIXTURE: &[&str] = &["most=6000", "start.count=5000"];
const WINDOW: &[&str] = &[
    "training.rays=128", "training.windows.count=1", "projector.samples=64", "optimizer.lr=5e-3",
    "encoder.log2_table_size=14",
];
/// The wide network of `nerf` takes many minutes to get better than an empty volume.
const TOO_SLOW: [&str; 1] = ["nerf"];

/// Steps, settings, and the required PSNR in dB, at least 1 dB below the measured one.
const RUNS: [(&str, u32, &[&str], f64); 10] = [
    ("fast", 150, FEW, 20.0),
    ("balanced", 150, FEW, 17.5),
    ("accurate", 150, FEW, 17.5),
    ("ni-naf", 300, SMALL, 20.5),
    ("ni-naf-published", 300, SMALL, 22.5),
    ("naf", 300, SMALL, 18.5),
    ("sax-nerf", 150, WINDOW, 16.5),
    ("dense", 300, DENSE, 20.5),
    ("gaussians", 60, MIXTURE, 16.0),
    ("gaussians-published", 60, MIXTURE, 16.0),
];

#[test]
fn every_shipped_field_makes_a_volume() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:64", "-o", &at("scan"), "--views", "20", "--detector", "64x64"]);
    // The field of a chain has its own spec.
    let has_field =
        |name: &str| json(&["explain", name, "--json"])["stages"].as_array().is_some_and(|stages| !stages.is_empty());
    let untried =
        |name: &&str| !TOO_SLOW.contains(name) && has_field(name) && !RUNS.iter().any(|(run, ..)| run == name);
    let missing: Vec<&str> = SHIPPED.iter().map(|s| s.name).filter(untried).collect();
    assert!(missing.is_empty(), "no run of {missing:?}");
    let mut faults = vec![];
    for (name, steps, sets, least) in RUNS {
        assert!(least > EMPTY + 1.0, "{name}: a volume of zeros would pass");
        let (scan, run, steps) = (at("scan"), at(name), steps.to_string());
        let mut args = vec!["reconstruct", &scan, "--spec", name, "-o", &run, "--reference", "truth", "--json"];
        args.extend(["--steps", &steps]);
        args.extend(sets.iter().flat_map(|set| ["--set", set]));
        let record = json(&args);
        let psnr = record["scores"]["psnr"].as_f64().unwrap();
        println!("{name}: {psnr:.2} dB, {:.1} s", record["total_s"].as_f64().unwrap());
        if psnr < least {
            faults.push(format!("{name}: {psnr:.2} dB, less than {least}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// Every other shipped spec, with its own settings, on a scan that takes seconds.
#[test]
fn every_shipped_method_on_voxels_makes_a_volume() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:32", "-o", &at("scan"), "--views", "24", "--detector", "48x48"]);
    let truth = conefield_io::read_volume(dir.path().join("scan/truth.nii.gz")).unwrap().data;
    let square = truth.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / truth.len() as f64;
    let mut tried = 0;
    for name in SHIPPED.iter().map(|s| s.name).filter(|name| RUNS.iter().all(|(run, ..)| run != name)) {
        let fewer = match name {
            "smooth-gaussians" => {
                &["methods.3.start.count=300", "methods.3.most=400", "methods.3.training.steps=60"][..]
            }
            "field-tv" | "accurate-tv" => &["methods.0.training.steps=100", "methods.0.encoder.log2_table_size=12"],
            "nerf" => continue,
            _ => &[],
        };
        let (scan, run) = (at("scan"), at(name));
        let mut args = vec!["reconstruct", &scan, "--spec", name, "-o", &run, "--reference", "truth", "--json"];
        args.extend(["--peak", "1"]);
        args.extend(fewer.iter().flat_map(|set| ["--set", *set]));
        let record = json(&args);
        let (psnr, empty) = (record["scores"]["psnr"].as_f64().unwrap(), -10.0 * square.log10());
        println!("{name}: {psnr:.2} dB, empty {empty:.2}, {:.1} s", record["total_s"].as_f64().unwrap());
        assert!(psnr > empty + 5.0, "{name}: {psnr:.2} dB, empty {empty:.2}");
        tried += 1;
    }
    assert!(tried >= 8, "{tried} specs");
}
