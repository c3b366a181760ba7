//! Memory: estimates compared with peaks, refusals before any allocation, and exports larger than memory.

use crate::common::{done, json, refused, text};
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::scan::{Scan, Unit};
use ndarray::Array3;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::Instant;

const MIB: u64 = 1 << 20;

/// A scan of `views` × `side` × `side` pixels, each view with the shadow of a box, for 32³ voxels.
fn scan(folder: &Path, views: usize, side: usize) -> PathBuf {
    scan_of(folder, views, side, 32)
}

/// The same for `voxels`³ voxels.
pub fn scan_of(folder: &Path, views: usize, side: usize, voxels: usize) -> PathBuf {
    let mm = |x: f64| Millimetres(x);
    let view = |i: usize| {
        let (angle, pixel) = (Radians(std::f64::consts::TAU * i as f64 / views as f64), mm(200.0 / side as f64));
        View::circular(angle, mm(500.0), mm(750.0), [pixel; 2], [mm(0.0); 2])
    };
    let volume = VoxelGrid { shape: [voxels; 3], spacing: [96.0 / voxels as f64; 3], center: [0.0; 3] };
    let geometry = Geometry { detector: [side; 2], views: (0..views).map(view).collect(), volume };
    let inside = |i: usize| i > side / 4 && i < 3 * side / 4;
    let shadow = |(_, r, c)| if inside(r) && inside(c) { 1.5 } else { 0.0 };
    let projections = Array3::from_shape_fn((views, side, side), shadow);
    let scan = Scan { geometry, projections, unit: Unit::default(), provenance: Value::Null };
    let path = folder.join("scan");
    conefield_io::write_scan(&path, &scan, None).unwrap();
    path
}

/// Estimate and peak of a run in bytes.
fn measured(scan: &Path, run: &Path, spec: &str, sets: &[&str]) -> [u64; 2] {
    let (scan, run) = (text(scan), text(run));
    let mut args = vec!["reconstruct", &scan, "--spec", spec, "-o", &run, "--json", "--steps", "1"];
    args.extend(sets.iter().flat_map(|s| ["--set", s]));
    let record = json(&args);
    [&record["memory"]["total"], &record["peak_bytes"]].map(|n| n.as_u64().unwrap())
}

/// The estimate is within 0.8 and 1.35 of the peak, both if the scan dominates and if the model does.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_measured_peak() {
    let dir = tempfile::tempdir().unwrap();
    let large = scan(dir.path(), 60, 768);
    let pixels = measured(&large, &dir.path().join("a"), "fast", &["training.pixels=all", "encoder.levels=2"]);
    let dir = tempfile::tempdir().unwrap();
    let small = scan(dir.path(), 4, 32);
    let sets = ["encoder.log2_table_size=21", "encoder.base_resolution=128", "encoder.levels=6"];
    let tables = measured(&small, &dir.path().join("b"), "fast", &sets);
    for (what, [estimate, peak]) in [("scan", pixels), ("model", tables)] {
        let ratio = estimate as f64 / peak as f64;
        println!("{what}: estimate {} MiB, peak {} MiB, ratio {ratio:.2}", estimate / MIB, peak / MIB);
        assert!(peak > 150 * MIB, "{what}: {peak} bytes say little");
        assert!((0.8..1.35).contains(&ratio), "{what}: estimate {estimate}, peak {peak}");
    }
}

/// The estimate for the surround of the volume assumes an object that is cut off on all sides.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_peak_with_a_surround() {
    let dir = tempfile::tempdir().unwrap();
    let path = scan(dir.path(), 8, 64);
    let mut cut = conefield_scans::read_scan(&path).unwrap();
    // Without noise there would be no prior, whose dual is a large part of the memory.
    cut.projections.iter_mut().enumerate().for_each(|(i, p)| *p = 1.5 + 1e-3 * f32::from((i * 7919 % 101) as u8));
    std::fs::remove_dir_all(&path).unwrap();
    conefield_io::write_scan(&path, &cut, None).unwrap();
    let sets = ["scene.surround.coarse.passes=1", "scene.surround.coarse.margin=1.0"];
    let [estimate, peak] = measured(&path, &dir.path().join("run"), "sirt", &sets);
    println!("estimate {} MiB, peak {} MiB", estimate / MIB, peak / MIB);
    assert!(peak > 150 * MIB, "{peak} bytes say little");
    assert!((0.8..1.35).contains(&(estimate as f64 / peak as f64)), "{estimate} and {peak}");
}

/// The same for methods on voxels, where the scan, the volume or both dominate; FDK takes little else.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_peak_of_methods_on_voxels() {
    let run = |spec: &str, views: usize, side: usize, voxels: usize, sets: &[&str]| {
        let dir = tempfile::tempdir().unwrap();
        let scan = scan_of(dir.path(), views, side, voxels);
        let [estimate, peak] = measured(&scan, &dir.path().join("run"), spec, sets);
        let ratio = estimate as f64 / peak as f64;
        let mib = |n: u64| n / MIB;
        println!(
            "{spec}, {views} x {side}², {voxels}³: estimate {}, peak {} MiB, {ratio:.2}",
            mib(estimate),
            mib(peak)
        );
        // For tiny problems the estimate exceeds the program's own size.
        let says = peak > 100 * MIB;
        assert!(!says || (0.8..1.35).contains(&ratio), "{spec}, {views} x {side}², {voxels}³: {estimate} and {peak}");
        peak
    };
    let least = run("fdk", 4, 32, 16, &[]);
    for (views, side, voxels) in [(60, 512, 288), (120, 640, 64), (16, 128, 352)] {
        let held = 4 * (views * side * side + voxels * voxels * voxels) as u64;
        let more = run("fdk", views, side, voxels, &[]) - least;
        println!("  {:.3} of projections and volume, beside {} MiB", more as f64 / held as f64, least / MIB);
        // A copy of the larger of both is at least 0.6 more; how many pages of the program itself are mapped varies by
        // 10 MiB.
        assert!(more as f64 <= 1.2 * held as f64, "{more} bytes more for {held}");
    }
    let nonnegative = ["nonnegative=true"];
    run("cgls", 60, 512, 64, &nonnegative);
    run("cgls", 16, 128, 224, &[]);
    run("sirt", 30, 320, 144, &[]);
    run("os-sart", 40, 320, 128, &["stop.change=0.001", "subsets=5"]);
    run("fista-tv", 16, 256, 144, &[]);
    run("asd-pocs", 16, 256, 160, &["descents=1", "subsets=4"]);
}

#[test]
fn what_does_not_fit_is_refused_with_figures_before_anything_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&scan(dir.path(), 4, 32));
    let run = text(&dir.path().join("run"));
    let tables = "encoder.log2_table_size=22";
    let args = ["reconstruct", &scan, "--spec", "naf", "--set", tables, "-o", &run, "--memory", "300MiB"];
    let start = Instant::now();
    let said = refused(1, &args);
    for want in
        ["memory: needs ", "GiB: scan ", "model ", "optimizer ", "buffers ", "--memory allows 300 MiB; tables of 2^"]
    {
        assert!(said.contains(want), "{want:?} is not in: {said}");
    }
    assert!(!dir.path().join("run").exists());
    assert!(start.elapsed().as_secs() < 20, "it was refused before work");
    // The suggested reduction fits.
    let bits = said.split("tables of 2^").nth(1).unwrap().split(' ').next().unwrap();
    let fits = format!("encoder.log2_table_size={bits}");
    let more = ["--steps", "1", "--set", "encoder.levels=4"];
    done(
        &[&["reconstruct", &scan, "--spec", "naf", "--set", &fits, "-o", &run, "--memory", "300MiB"], &more[..]]
            .concat(),
    );

    let out = text(&dir.path().join("other"));
    for args in [
        &["simulate", "phantom:head:256", "-o", &out][..],
        &["pretrain", "phantom:head:256", "--spec", "fast", "-o", &format!("{out}.safetensors")],
        &["reconstruct", &scan, "--spec", "fast", "-o", &out, "--reference", "truth"],
        &["convert", &scan, &out],
        &["explain", "fast", "--scan", &scan],
        &["export", &run, "-o", &format!("{out}.npy")],
    ] {
        let said = refused(1, &[args, &["--memory", "20MiB"]].concat());
        assert!(said.contains("memory: needs ") && said.contains("--memory allows 20.0 MiB"), "{args:?}: {said}");
        assert!(!Path::new(&out).exists(), "{args:?}");
    }
    // Here the detector is too large.
    let args = ["simulate", "phantom:head:16", "-o", &out, "--detector", "2048x2048", "--memory", "100MiB"];
    let said = refused(1, &args);
    assert!(said.contains(" views") && said.contains("a detector of 512x512 would fit"), "{said}");
}

/// A layer of 576 MB is written row by row. The file reaches its size limit, and the error reports this.
#[test]
#[cfg(target_os = "linux")]
fn an_export_of_large_layers_stays_within_its_memory() {
    let dir = tempfile::tempdir().unwrap();
    scan(dir.path(), 4, 32);
    let sets = ["--set", "encoder.levels=2", "--set", "field.width=8", "--set", "field.depth=2", "--steps", "2"];
    let (scan, run) = (text(&dir.path().join("scan")), text(&dir.path().join("run")));
    done(&[&["reconstruct", &scan, "--spec", "fast", "-o", &run, "--set", "field.skips=[]"], &sets[..]].concat());
    // One GiB of address space, files of at most 20 MB.
    let limited = "ulimit -v 1048576; ulimit -f 20000; trap '' XFSZ; exec \"$0\" \"$@\"";
    let program = assert_cmd::cargo::cargo_bin("conefield");
    for name in ["x.npy", "x.nii"] {
        let output = assert_cmd::Command::new("sh")
            .args(["-c", limited])
            .arg(&program)
            .args(["--quiet", "--threads", "2", "--memory", "200MiB", "export", &run, "--voxels", "12000", "-o"])
            .arg(dir.path().join(name))
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {said}");
        assert!(said.contains(name) && said.to_lowercase().contains("too large"), "{name}: {said}");
    }
}

/// Writing a volume takes less memory than half of the volume.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn an_export_does_not_hold_its_volume() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    scan(dir.path(), 4, 32);
    let sets = ["--set", "encoder.levels=2", "--set", "field.width=8", "--set", "field.depth=2", "--steps", "2"];
    done(
        &[&["reconstruct", &at("scan"), "--spec", "fast", "-o", &at("run"), "--set", "field.skips=[]"], &sets[..]]
            .concat(),
    );
    let export = |n: &str, name: &str| json(&["export", &at("run"), "-o", &at(name), "--voxels", n, "--json"]);
    let peak = |made: &Value| made["peak_bytes"].as_u64().unwrap();
    let (small, large) = (export("32", "small.nii"), export("360", "large.nii"));
    let volume = 4 * 360u64.pow(3);
    assert_eq!(large["shape"], serde_json::json!([360, 360, 360]));
    assert_eq!(dir.path().join("large.nii").metadata().unwrap().len(), volume + 352);
    let more = peak(&large) - peak(&small);
    println!("volume {} MiB, {} MiB more than for a small one", volume / MIB, more / MIB);
    assert!(more < volume / 2, "{more} bytes more for {volume}");
    assert!(peak(&large) <= large["memory"]["total"].as_u64().unwrap());
    // At the resolution of the run, the voxels equal those that the run wrote.
    let run = conefield_io::read_volume(dir.path().join("run/volume.nii.gz")).unwrap();
    assert!(conefield_io::read_volume(dir.path().join("small.nii")).unwrap().data == run.data);
    let said = refused(1, &["export", &at("run"), "-o", &at("large.nii")]);
    assert!(said.contains("--force"), "{said}");
}
