//! A geometry with nothing square, even or centred, through every command.

use crate::common::{conefield, done, json, refused, text};
use conefield_core::geometry::{VoxelGrid, norm};
use conefield_core::scan::Volume;
use conefield_evaluation::report::Pixels;
use conefield_io::{Parts, read_volume, write_r2, write_scan, write_volume};
use conefield_scans::{read_data_set, read_scan};
use ndarray::Array3;
use serde_json::{Value, json};
use std::fs;
use tempfile::{TempDir, tempdir};

const SMALL: [&str; 10] = [
    "--set", "encoder.levels=3", "--set", "encoder.log2_table_size=10", "--set", "projector.samples=24", "--steps",
    "8", "--seed", "2",
];

/// A short scan with uneven steps, in degrees.
const ANGLES: [f64; 13] = [-20.0, -2.5, 10.0, 31.0, 40.0, 62.0, 75.0, 94.0, 110.0, 126.0, 149.0, 170.0, 188.0];

/// 12 × 9 × 7 voxels of 4 × 6 × 5 mm, with an off-centre ellipsoid.
fn volume() -> Volume {
    let grid = VoxelGrid { shape: [12, 9, 7], spacing: [4.0, 6.0, 5.0], center: [0.0; 3] };
    let data = Array3::from_shape_fn((12, 9, 7), |(x, y, z)| {
        let p = grid.voxel([x, y, z]);
        let r = ((p[0] - 3.0) / 14.0).powi(2) + ((p[1] + 4.0) / 18.0).powi(2) + ((p[2] - 2.0) / 11.0).powi(2);
        if r < 1.0 { 0.6 } else { 0.0 }
    });
    Volume { data, grid, affine: None }
}

struct Bench {
    dir: TempDir,
}

impl Bench {
    /// The volume and a scan of it with a shifted detector of 14 × 22 pixels.
    fn new() -> Self {
        let bench = Self { dir: tempdir().unwrap() };
        write_volume(bench.at("truth.mha"), &volume()).unwrap();
        fs::write(bench.at("angles.txt"), ANGLES.map(|a| a.to_string()).join("\n")).unwrap();
        let (angles, scan) = (bench.at("angles.txt"), bench.at("scan"));
        let (detector, offset) = (["--detector", "14x22"], ["--offset", "-3,4.5"]);
        let mut args = vec!["simulate", "", "-o", &scan, "--angles", &angles];
        let truth = bench.at("truth.mha");
        args[1] = &truth;
        args.extend(detector.into_iter().chain(offset));
        done(&args);
        bench
    }

    fn at(&self, name: &str) -> String {
        text(&self.dir.path().join(name))
    }

    fn info(&self, name: &str) -> Value {
        json(&["info", &self.at(name), "--json"])
    }
}

/// Checks that numbers agree to a relative 1e-6.
fn near(a: &Value, b: &Value, what: &str) {
    match (a, b) {
        (Value::Array(x), Value::Array(y)) if x.len() == y.len() => x.iter().zip(y).for_each(|(a, b)| near(a, b, what)),
        (Value::Object(x), Value::Object(y)) if x.len() == y.len() => {
            x.iter().for_each(|(k, v)| near(v, &y[k], &format!("{what}.{k}")));
        }
        _ => match (a.as_f64(), b.as_f64()) {
            (Some(x), Some(y)) => assert!((x - y).abs() <= 1e-6 * x.abs().max(1.0), "{what}: {x} {y}"),
            _ => assert_eq!(a, b, "{what}"),
        },
    }
}

/// Facts that every format preserves.
const KEPT: [&str; 13] = [
    "views", "detector", "pixel_mm", "detector_mm", "offset_mm", "source_to_axis_mm", "source_to_detector_mm",
    "angles", "circle", "field_of_view", "volume", "coverage", "line_integrals",
];

#[test]
fn info_says_what_was_asked_for() {
    let b = Bench::new();
    let found = b.info("scan");
    assert_eq!((&found["views"], &found["detector"]), (&json!(13), &json!([14, 22])));
    near(&found["offset_mm"], &json!([-3.0, 4.5]), "offset");
    near(&found["angles"]["first_deg"], &json!(340.0), "first");
    near(&found["angles"]["step_deg"], &json!(17.5), "step");
    assert_eq!(found["angles"]["full_circle"], false);
    near(&found["volume"]["size_mm"], &json!([48.0, 54.0, 35.0]), "size");
    let pixel = found["pixel_mm"].as_array().unwrap().iter().map(|p| p.as_f64().unwrap()).collect::<Vec<_>>();
    let m = found["magnification"].as_f64().unwrap();
    near(&found["supported_voxel_mm"], &json!([pixel[1] / m, pixel[1] / m, pixel[0] / m]), "supported voxel");

    let (png, other) = (b.at("info.png"), b.at("volume.png"));
    done(&["info", &b.at("scan"), "--png", &png]);
    done(&["info", &b.at("truth.mha"), "--png", &other]);
    for path in [png, other] {
        let image = Pixels::open(path).unwrap();
        assert!(image.width > 900 && image.colours().any(|p| p.0 != [255; 3]));
    }
}

#[test]
fn every_format_keeps_the_geometry() {
    let b = Bench::new();
    let want = b.info("scan");
    for (to, name) in [("r2", "r2"), ("naf", "scan.pickle"), ("rtk", "rtk")] {
        done(&["convert", &b.at("scan"), &b.at(name), "--to", to]);
        let back = format!("back-{to}");
        done(&["convert", &b.at(name), &b.at(&back)]);
        for found in [b.info(name), b.info(&back)] {
            KEPT.iter().for_each(|key| near(&found[key], &want[key], &format!("{to}: {key}")));
            assert_eq!(found["truth"], to != "rtk", "{to}");
        }
    }
    done(&["import", &b.at("rtk/scanner.toml"), "-o", &b.at("imported")]);
    let found = b.info("imported");
    KEPT.iter().for_each(|key| near(&found[key], &want[key], &format!("import: {key}")));
    assert_eq!(b.info("rtk/geometry.xml")["views"], 13);
    assert_eq!(read_scan(b.at("rtk")).unwrap().projections, read_scan(b.at("scan")).unwrap().projections);
}

#[test]
fn test_views_are_kept_or_their_loss_is_reported() {
    let b = Bench::new();
    let whole = read_data_set(b.at("scan"), Parts::ALL).unwrap();
    let (train, test) = whole.train.split(&[1, 4, 5]).unwrap();
    write_r2(b.at("r2"), &train, Some(&test), whole.volume.as_ref()).unwrap();
    for (from, to, name) in [("r2", "naf", "a.pickle"), ("a.pickle", "r2", "again")] {
        done(&["convert", &b.at(from), &b.at(name), "--to", to]);
        assert_eq!(b.info(name)["test_views"], 3);
        assert_eq!(read_data_set(b.at(name), Parts::ALL).unwrap().test.unwrap().projections, test.projections);
    }
    for to in ["conefield", "rtk"] {
        let mut command = assert_cmd::Command::cargo_bin("conefield").unwrap();
        let out = command.args(["convert", &b.at("r2"), &b.at(to), "--to", to]).output().unwrap();
        let said = String::from_utf8(out.stderr).unwrap();
        assert!(out.status.success() && said.contains("3 test views are left out"), "{said}");
    }
}

#[test]
fn reconstruction_pretraining_and_scores_take_it() {
    let b = Bench::new();
    let truth = b.at("truth.mha");
    done(&["convert", &b.at("scan"), &b.at("rtk"), "--to", "rtk"]);
    let explained = json(&["explain", "fast", "--scan", &b.at("rtk"), "--json"]);
    assert_eq!(explained["scan"]["detector"], json!([14, 22]));
    assert_eq!(explained["scan"]["volume"], json!([12, 9, 7]));
    let weights = b.at("w.safetensors");
    let mut args = vec!["pretrain", &truth, "--spec", "fast", "-o", &weights];
    args.extend(SMALL);
    done(&args);
    let (scan, run) = (b.at("scan"), b.at("run"));
    let mut args = vec!["reconstruct", &scan, "--spec", "fast", "-o", &run, "--json"];
    args.extend(["--reference", "truth", "--hold-out", "every:5", "--init", &weights].into_iter().chain(SMALL));
    let record = json(&args);
    assert!(record["scores"]["psnr"].as_f64().is_some_and(f64::is_finite), "{record}");
    let found = b.info("run/volume.nii.gz");
    assert_eq!(found["shape"], json!([12, 9, 7]));
    near(&found["spacing_mm"], &json!([4.0, 6.0, 5.0]), "spacing");
    let scores = json(&["evaluate", &b.at("run/volume.nii.gz"), &truth, "--json", "--png", &b.at("e.png")]);
    near(&scores["psnr"], &record["scores"]["psnr"], "psnr");
    // A scan converted through RTK is the same scan.
    let volumes = ["scan", "rtk"].map(|name| {
        let (scan, run) = (b.at(name), b.at(&format!("run-{name}")));
        let mut args = vec!["reconstruct", &scan, "--spec", "fast", "-o", &run];
        args.extend(SMALL);
        done(&args);
        read_volume(b.at(&format!("run-{name}/volume.nii.gz"))).unwrap()
    });
    // One is written in the data set's own unit, the other in 1/mm.
    let unit = b.info("scan")["unit"]["mm"].as_f64().unwrap() as f32;
    let highest = volumes[0].data.iter().copied().fold(0.0, f32::max);
    for (a, b) in volumes[0].data.iter().zip(&volumes[1].data) {
        assert!((a - b * unit).abs() <= 1e-3 * highest, "{a} {b}");
    }
}

#[test]
fn views_that_are_no_circle_are_read_drawn_and_reconstructed() {
    let b = Bench::new();
    let mut scan = read_scan(b.at("scan")).unwrap();
    for (i, view) in scan.geometry.views.iter_mut().enumerate() {
        // Rising, more distant from view to view, with the detector rotated in its plane.
        let rise = 0.4 * i as f64 - 2.4;
        (view.source[2], view.detector[2]) = (view.source[2] + rise, view.detector[2] + rise);
        (0..2).for_each(|k| view.source[k] *= 1.0 + 0.005 * i as f64);
        let (s, c) = 0.03f64.sin_cos();
        let (pu, pv) = (norm(view.u), norm(view.v));
        let (u, v) = (view.u.map(|x| x / pu), view.v.map(|x| x / pv));
        view.u = std::array::from_fn(|k| pu * (c * u[k] + s * v[k]));
        view.v = std::array::from_fn(|k| pv * (c * v[k] - s * u[k]));
    }
    write_scan(b.at("free"), &scan, None).unwrap();
    let want = b.info("free");
    assert_eq!(want["circle"], false);
    done(&["info", &b.at("free"), "--png", &b.at("free.png")]);
    done(&["convert", &b.at("free"), &b.at("rtk"), "--to", "rtk"]);
    let found = b.info("rtk");
    // RTK's rows run up: the same pixels, counted from below.
    for key in KEPT.iter().filter(|k| **k != "offset_mm") {
        near(&found[key], &want[key], key);
    }
    let said = refused(1, &["convert", &b.at("free"), &b.at("r2"), "--to", "r2"]);
    assert!(said.contains("circle"), "{said}");
    let (scan, run) = (b.at("rtk"), b.at("run"));
    let mut args = vec!["reconstruct", &scan, "--spec", "fast", "-o", &run];
    args.extend(SMALL);
    conefield(&args).assert().success();
}

/// A parallel beam over half a turn, through simulation, scan folder, R2-Gaussian's format and back, and every kind of
/// method.
#[test]
fn a_parallel_beam_goes_through_every_command() {
    let bench = Bench::new();
    let protocol = "beam = 'parallel'\ndetector = [16, 24]\nextent = { pixel = [4.0, 4.0] }\n\
                    angles = { even = { views = 30, arc_deg = 180.0 } }\n";
    fs::write(bench.at("beam.toml"), protocol).unwrap();
    let (truth, scan, other) = (bench.at("truth.mha"), bench.at("beam"), bench.at("r2"));
    done(&["simulate", &truth, "-o", &scan, "--protocol", &bench.at("beam.toml")]);
    let said = done(&["info", &scan]);
    assert!(said.contains("none: a parallel beam"), "{said}");
    done(&["convert", &scan, &other, "--to", "r2"]);
    let score = |scan: &str, spec: &[&str]| {
        let run = bench.at("run");
        done(&[&["reconstruct", scan, "-o", &run, "--force", "--spec"], spec].concat());
        let found = json(&["evaluate", &format!("{run}/volume.nii.gz"), &truth, "--json"]);
        found["psnr"].as_f64().unwrap()
    };
    let [own, back] = [&scan, &other].map(|scan| score(scan, &["fdk"]));
    assert!((own - back).abs() < 0.01, "{own} and {back} dB");
    let empty =
        20.0 * (volume().data.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / 756.0).sqrt().recip().log10() - 4.4;
    for spec in
        [&["fdk"][..], &["os-sart", "--steps", "5"], &["fista-tv", "--steps", "5"], &["gaussians", "--steps", "60"]]
    {
        let found = score(&scan, spec);
        println!("{spec:?}: {found:.2} dB, an empty volume {empty:.2} dB");
        assert!(found > empty + 6.0, "{spec:?}: {found}");
    }
    let field = score(&scan, &[&["fast"][..], &SMALL[..6], &["--steps", "150"]].concat());
    println!("a field: {field:.2} dB");
    assert!(field > empty + 4.0, "{field}");
    let e = refused(1, &["calibrate", &scan, "-o", &bench.at("calibrated")]);
    assert!(e.contains("a parallel beam"), "{e}");
    fs::write(bench.at("both.toml"), format!("dso = 500.0\n{protocol}")).unwrap();
    let e = refused(1, &["simulate", &truth, "-o", &bench.at("x"), "--protocol", &bench.at("both.toml")]);
    assert!(e.contains("dso: found 500") && e.contains("no source"), "{e}");
}
