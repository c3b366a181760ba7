//! Shipped neural specs give a useful volume on the CPU: a head of 64³ voxels from 20 views, with fewer steps, smaller
//! tables and fewer samples than in the specs.

use crate::common::{Folder, number};
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
/// Its wide network takes many minutes to get better than an empty volume.
const TOO_SLOW: &str = "nerf";

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

/// Reconstructs `scan` with a shipped spec; returns the PSNR.
fn psnr(d: &Folder, name: &str, sets: &[&str], more: &str) -> f64 {
    let sets: String = sets.iter().map(|set| format!(" --set {set}")).collect();
    let record = d.json(&format!("reconstruct scan --spec {name} -o {name} --reference truth --json {more}{sets}"));
    let psnr = number(&record["scores"]["psnr"]);
    println!("{name}: {psnr:.2} dB, {:.1} s", number(&record["total_s"]));
    psnr
}

#[test]
fn every_shipped_field_makes_a_volume() {
    let d = Folder::after(&["simulate phantom:head:64 -o scan --views 20 --detector 64x64"]);
    // The field of a chain has its own spec.
    let has_field = |name: &str| {
        d.json(&format!("explain {name} --json"))["stages"].as_array().is_some_and(|stages| !stages.is_empty())
    };
    let untried = |name: &&str| *name != TOO_SLOW && has_field(name) && !RUNS.iter().any(|(run, ..)| run == name);
    let missing: Vec<&str> = SHIPPED.iter().map(|s| s.name).filter(untried).collect();
    assert!(missing.is_empty(), "no run of {missing:?}");
    let mut faults = vec![];
    for (name, steps, sets, least) in RUNS {
        assert!(least > EMPTY + 1.0, "{name}: a volume of zeros would pass");
        let psnr = psnr(&d, name, sets, &format!("--steps {steps}"));
        if psnr < least {
            faults.push(format!("{name}: {psnr:.2} dB, less than {least}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// Every other shipped spec, with its own settings, on a scan that takes seconds.
#[test]
fn every_shipped_method_on_voxels_makes_a_volume() {
    let d = Folder::after(&["simulate phantom:head:32 -o scan --views 24 --detector 48x48"]);
    let truth = conefield_io::read_volume(d.at("scan/truth.nii.gz")).unwrap().data;
    let square = truth.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / truth.len() as f64;
    let empty = -10.0 * square.log10();
    let mut tried = 0;
    for name in SHIPPED.iter().map(|s| s.name).filter(|name| RUNS.iter().all(|(run, ..)| run != name)) {
        let fewer = match name {
            "smooth-gaussians" => {
                &["methods.3.start.count=300", "methods.3.most=400", "methods.3.training.steps=60"][..]
            }
            "field-tv" | "accurate-tv" => &["methods.0.training.steps=100", "methods.0.encoder.log2_table_size=12"],
            TOO_SLOW => &["training.steps=2", "projector.samples=16"],
            _ => &[],
        };
        let psnr = psnr(&d, name, fewer, "--peak 1");
        assert!(psnr > empty + 5.0 || name == TOO_SLOW, "{name}: {psnr:.2} dB, empty {empty:.2}");
        tried += 1;
    }
    assert!(tried >= 8, "{tried} specs");
}
