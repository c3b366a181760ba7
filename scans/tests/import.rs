//! Counts of a simulated detector become line integrals.

use conefield_core::scan::Scan;
use conefield_io::I0;
use conefield_scans::diagnosis::check_line_integrals;
use conefield_scans::{ImportOptions, import, read_scan};
use ndarray::{Array3, Axis};
use std::path::{Path, PathBuf};

/// The description of the shared counts, with the geometry of `ellipsoids_50_r2`.
const ELLIPSOIDS: &str = r#"format = "conefield-scanner"
version = 1

[files]
projections = "scan.npz:counts"
flat = "scan.npz:flat"
dark = "scan.npz:dark"

[circle]
dso = 500.0
dsd = 800.0
pixel = { u = 2.0, v = 2.0 }
start_deg = 0.0
step_deg = 14.4
direction = "counterclockwise"

[values]
flat_includes_dark = false

[volume]
shape = [64, 64, 64]
spacing = [1.5625, 1.5625, 1.5625]
"#;

fn rms(a: &Array3<f32>, b: &Array3<f32>) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum();
    (sum / a.len() as f64).sqrt()
}

#[test]
fn counts_through_flat_and_dark_are_the_line_integrals_within_the_noise() {
    let data = std::env::var_os("CONEFIELD_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let [counts, exact] = ["ellipsoids_counts.npz", "ellipsoids_50_r2"].map(|name| data.join("interop").join(name));
    if !counts.exists() || !exact.exists() {
        eprintln!("skipped: {} is not there; CONEFIELD_DATA names the folder of the shared data", counts.display());
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    std::fs::copy(counts, dir.path().join("scan.npz")).unwrap();
    let read = |text: &str, i0: Option<I0>| {
        let path = dir.path().join("scanner.toml");
        std::fs::write(&path, text).unwrap();
        import(path, &ImportOptions { i0, ..ImportOptions::default() }).unwrap()
    };
    let imported = read(ELLIPSOIDS, None);
    // The counts are of every other view.
    let every_other: Vec<usize> = (0..25).map(|i| 2 * i).collect();
    let truth = read_scan(exact).unwrap().projections.select(Axis(0), &every_other);
    let found = &imported.scan.projections;
    // Counting N photons leaves the line integral with a standard deviation of 1/√N: 0.0069 in the open beam of
    // 20 890 counts, more behind the object. In units of that the residual must be 1.
    let open = imported.counts.as_ref().unwrap().open_beam[1];
    let mut sum = 0.0;
    for (a, t) in found.iter().zip(&truth) {
        sum += f64::from(a - t).powi(2) * open * f64::from(-t).exp();
    }
    let normalised = (sum / truth.len() as f64).sqrt();
    let mean: f64 = found.iter().zip(&truth).map(|(a, t)| f64::from(a - t)).sum::<f64>() / truth.len() as f64;
    println!("rms {:.5}, in units of the noise {normalised:.4}, mean {mean:.6}", rms(found, &truth));
    assert!((0.95..1.05).contains(&normalised), "{normalised}");
    assert!(mean.abs() < 2e-4, "{mean}");
    // The dark field has been subtracted from this file's flat field. The opposite flag makes everything too low by
    // −ln(1 − 110/20 890), less than the noise of a pixel but far more than that of the mean.
    let wrong = read(&ELLIPSOIDS.replace("flat_includes_dark = false", "flat_includes_dark = true"), None).scan;
    let shift: f64 = wrong.projections.iter().zip(&truth).map(|(a, t)| f64::from(a - t)).sum::<f64>();
    let shift = shift / truth.len() as f64;
    println!("with the dark field taken off twice the mean is {shift:.6}");
    assert!((shift - (1.0f64 - 110.0 / 20891.0).ln()).abs() < 2e-4, "{shift}");
    let report = imported.counts.unwrap();
    assert_eq!(imported.scan.provenance["counts"]["bad"], 0.0);
    assert_eq!((report.clamped, report.bad), (0.0, 0.0), "{report:?}");
    let complaints = |scan: &Scan| check_line_integrals(scan.projections.view()).complaints;
    assert!(complaints(&imported.scan).is_empty());

    // Without the flat field the beam's shape stays in the projections, and the estimate at the border is rough.
    let by_air = read(ELLIPSOIDS, Some(I0::Air));
    let by_number = read(ELLIPSOIDS, Some(I0::Number(21000.0)));
    let (air, number) = (rms(&by_air.scan.projections, &truth), rms(&by_number.scan.projections, &truth));
    println!("air {air:.4}, number {number:.4}");
    assert!(air < 0.1 && number < 0.1 && air > 2.0 * rms(found, &truth), "{air} {number}");
    // If the beam is brighter than the single number, air becomes negative; a warning says so.
    assert!(complaints(&by_number.scan)[0].contains("I0 is too low"));

    // Counts read as line integrals are recognized.
    let raw = ELLIPSOIDS
        .replace("flat = \"scan.npz:flat\"\ndark = \"scan.npz:dark\"", "")
        .replace("flat_includes_dark = false", "kind = \"line-integrals\"");
    let raw = read(&raw, None).scan;
    assert!(complaints(&raw)[0].contains("looks like intensities, not line integrals"));
}
