//! Every shipped neural spec makes a volume that is worth something on the CPU: a head of 64³ voxels from 20 views, few steps.

mod common;
use common::{done, json, text};
use conefield::specs::SHIPPED;

/// Steps, rays a step, and the least PSNR in dB, a good dB below what was measured. A volume of zeros has 11.6 dB.
const RUNS: [(&str, u32, u32, f64); 8] = [
    ("fast", 150, 256, 20.0),
    ("balanced", 150, 256, 20.0),
    ("accurate", 150, 256, 20.0),
    ("ni-naf", 150, 256, 20.0),
    ("ni-naf-published", 150, 256, 20.0),
    ("naf", 150, 256, 20.0),
    ("dense", 150, 256, 20.0),
    ("nerf", 60, 64, 16.0),
];

#[test]
fn every_shipped_field_makes_a_volume() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:64", "-o", &at("scan"), "--views", "20", "--detector", "64x64"]);
    let neural = |name: &str| {
        // A chain's field is that of a spec of its own.
        json(&["explain", name, "--json"])["stages"].as_array().is_some_and(|stages| !stages.is_empty())
    };
    let missing: Vec<&str> =
        SHIPPED.iter().map(|s| s.name).filter(|n| neural(n) && !RUNS.iter().any(|(name, ..)| name == n)).collect();
    assert!(missing.is_empty(), "no run of {missing:?}");
    let mut faults = vec![];
    for (name, steps, rays, least) in RUNS {
        let rays = format!("training.rays={rays}");
        let record = json(&[
            "reconstruct",
            &at("scan"),
            "--spec",
            name,
            "-o",
            &at(name),
            "--reference",
            "truth",
            "--steps",
            &steps.to_string(),
            "--set",
            &rays,
            "--json",
        ]);
        let psnr = record["scores"]["psnr"].as_f64().unwrap();
        println!("{name}: {psnr:.2} dB, {:.1} s", record["total_s"].as_f64().unwrap());
        if psnr < least {
            faults.push(format!("{name}: {psnr:.2} dB, less than {least}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
