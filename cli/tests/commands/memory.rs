//! Memory: estimates compared with peaks, refusals before any allocation, and exports larger than memory.

use crate::common::{Folder, number};
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::scan::{Scan, Unit};
use ndarray::Array3;
use serde_json::{Value, json};
use std::time::Instant;

const MIB: u64 = 1 << 20;

/// A folder with `scan`: `views` × `side` × `side` pixels, each view with the shadow of a box, for `voxels`³ voxels.
pub fn scan_of(views: usize, side: usize, voxels: usize) -> Folder {
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
    let d = Folder::new();
    conefield_io::write_scan(d.at("scan"), &scan, None).unwrap();
    d
}

/// Peak of a run in bytes. Its estimate is within 0.8 and 1.35 of that, unless the peak is below `says`: for tiny problems the
/// estimate exceeds the program's own size.
fn measured(d: &Folder, says: u64, spec: &str, sets: &[&str]) -> u64 {
    let sets: String = sets.iter().map(|s| format!(" --set {s}")).collect();
    let record = d.json(&format!("reconstruct scan --spec {spec} -o run --json --steps 1{sets}"));
    let [estimate, peak] = [&record["memory"]["total"], &record["peak_bytes"]].map(|n| n.as_u64().unwrap());
    let ratio = estimate as f64 / peak as f64;
    println!("{spec}{sets}: estimate {} MiB, peak {} MiB, ratio {ratio:.2}", estimate / MIB, peak / MIB);
    assert!(peak < says || (0.8..1.35).contains(&ratio), "{spec}{sets}: estimate {estimate}, peak {peak}");
    peak
}

/// The same for a peak that must say something.
fn large(d: &Folder, spec: &str, sets: &[&str]) {
    let peak = measured(d, 0, spec, sets);
    assert!(peak > 150 * MIB, "{spec}: {peak} bytes say little");
}

/// Both if the scan dominates and if the model does.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_measured_peak() {
    large(&scan_of(60, 768, 32), "fast", &["training.pixels=all", "encoder.levels=2"]);
    let sets = ["encoder.log2_table_size=21", "encoder.base_resolution=128", "encoder.levels=6"];
    large(&scan_of(4, 32, 32), "fast", &sets);
}

/// The estimate for the surround of the volume assumes an object that is cut off on all sides.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_peak_with_a_surround() {
    let d = scan_of(8, 64, 32);
    let mut cut = conefield_scans::read_scan(d.at("scan")).unwrap();
    // Without noise there would be no prior, whose dual is a large part of the memory.
    cut.projections.iter_mut().enumerate().for_each(|(i, p)| *p = 1.5 + 1e-3 * f32::from((i * 7919 % 101) as u8));
    std::fs::remove_dir_all(d.at("scan")).unwrap();
    conefield_io::write_scan(d.at("scan"), &cut, None).unwrap();
    large(&d, "sirt", &["scene.surround.coarse.passes=1", "scene.surround.coarse.margin=1.0"]);
}

/// The same for methods on voxels, where the scan, the volume or both dominate; FDK takes little else.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn the_estimate_is_near_the_peak_of_methods_on_voxels() {
    let run = |spec: &str, views: usize, side: usize, voxels: usize, sets: &[&str]| {
        measured(&scan_of(views, side, voxels), 100 * MIB, spec, sets)
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
    run("cgls", 60, 512, 64, &["nonnegative=true"]);
    run("cgls", 16, 128, 224, &[]);
    run("sirt", 30, 320, 144, &[]);
    run("os-sart", 40, 320, 128, &["stop.change=0.001", "subsets=5"]);
    run("fista-tv", 16, 256, 144, &[]);
    run("asd-pocs", 16, 256, 160, &["descents=1", "subsets=4"]);
}

#[test]
fn what_does_not_fit_is_refused_with_figures_before_anything_is_made() {
    let d = scan_of(4, 32, 32);
    let run = "reconstruct scan --spec naf -o run --memory 300MiB --set encoder.log2_table_size";
    let start = Instant::now();
    let said = d.refused(1, &format!("{run}=22"));
    for want in
        ["memory: needs ", "GiB: scan ", "model ", "optimizer ", "buffers ", "--memory allows 300 MiB; tables of 2^"]
    {
        assert!(said.contains(want), "{want:?} is not in: {said}");
    }
    assert!(!d.has("run"));
    assert!(start.elapsed().as_secs() < 20, "it was refused before work");
    // The suggested reduction fits.
    let bits = said.split("tables of 2^").nth(1).unwrap().split(' ').next().unwrap();
    d.done(&format!("{run}={bits} --steps 1 --set encoder.levels=4"));

    for line in [
        "simulate phantom:head:256 -o other",
        "pretrain phantom:head:256 --spec fast -o other.safetensors",
        "reconstruct scan --spec fast -o other --reference truth",
        "convert scan other",
        "explain fast --scan scan",
        "export run -o other.npy",
    ] {
        let said = d.refused(1, &format!("{line} --memory 20MiB"));
        assert!(said.contains("memory: needs ") && said.contains("--memory allows 20.0 MiB"), "{line}: {said}");
        assert_eq!(d.names(""), ["run", "scan"], "{line}");
    }
    // Here the detector is too large.
    d.refused_with(
        1,
        "simulate phantom:head:16 -o other --detector 2048x2048 --memory 100MiB",
        &[" views", "a detector of 512x512 would fit"],
    );
}

#[test]
fn calibration_counts_its_copies_of_the_views() {
    let d = scan_of(1200, 64, 32);
    let views = 1200.0 * 64.0 * 64.0 * 4.0 / MIB as f64;
    let [plain, jitter] = ["", "--jitter"].map(|option| {
        let said = d.refused(1, &format!("calibrate scan {option} --memory 30MiB"));
        let needs = said.split("memory: needs ").nth(1).unwrap().split(" MiB").next().unwrap();
        needs.parse::<f64>().unwrap_or_else(|_| panic!("{said}"))
    });
    println!("{plain} MiB, {jitter} MiB with shifts of single views, for {views} MiB of views");
    assert!(plain > 3.0 * views && jitter > plain + 4.0 * views);
}

/// A folder with the run of a small field.
fn field() -> Folder {
    let d = scan_of(4, 32, 32);
    let sets = "--set field.skips=[] --set encoder.levels=2 --set field.width=8 --set field.depth=2 --steps 2";
    d.done(&format!("reconstruct scan --spec fast -o run {sets}"));
    d
}

/// A layer of 576 MB is written row by row. The file reaches its size limit, and the error reports this.
#[test]
#[cfg(target_os = "linux")]
fn an_export_of_large_layers_stays_within_its_memory() {
    let d = field();
    // One GiB of address space, files of at most 20 MB.
    let limited = "ulimit -v 1048576; ulimit -f 20000; trap '' XFSZ; exec \"$0\" \"$@\"";
    for name in ["x.npy", "x.nii"] {
        let line = format!("--quiet --threads 2 --memory 200MiB export run --voxels 12000 -o {name}");
        let output = d.shell(limited, &line);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{name}: {said}");
        assert!(said.contains(name) && said.to_lowercase().contains("too large"), "{name}: {said}");
    }
}

/// Writing a volume takes less memory than half of the volume.
#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "the peak is read from /proc")]
fn an_export_does_not_hold_its_volume() {
    let d = field();
    let export = |n: &str, name: &str| d.json(&format!("export run -o {name} --voxels {n} --json"));
    let (small, large) = (export("32", "small.nii"), export("360", "large.nii"));
    let volume = 4 * 360u64.pow(3);
    assert_eq!(large["shape"], json!([360, 360, 360]));
    assert_eq!(d.at("large.nii").metadata().unwrap().len(), volume + 352);
    let [least, most] = [&small, &large].map(|made| number(&made["peak_bytes"]));
    println!("volume {} MiB, {} MiB more than for a small one", volume / MIB, (most - least) / MIB as f64);
    assert!(most - least < volume as f64 / 2.0, "{least}, {most} and {volume} bytes");
    assert!(most <= number(&large["memory"]["total"]));
    // At the resolution of the run, the voxels equal those that the run wrote.
    let [run, small] = ["run/volume.nii.gz", "small.nii"].map(|name| conefield_io::read_volume(d.at(name)).unwrap());
    assert!(small.data == run.data);
    d.refused_with(1, "export run -o large.nii", &["--force"]);
}
