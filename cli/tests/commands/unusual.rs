//! A geometry with nothing square, even or centred, through every command.

use crate::common::{Folder, number};
use conefield_core::geometry::{VoxelGrid, norm};
use conefield_core::scan::Volume;
use conefield_evaluation::report::Pixels;
use conefield_io::{Parts, read_volume, write_r2, write_scan, write_volume};
use conefield_scans::{read_data_set, read_scan};
use ndarray::{Array3, s};
use serde_json::{Value, json};

const SMALL: &str = "--set encoder.levels=3 --set encoder.log2_table_size=10 --set projector.samples=24";

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

/// A folder with the volume and a scan of it with a shifted detector of 14 × 22 pixels.
fn bench() -> Folder {
    let d = Folder::new();
    write_volume(d.at("truth.mha"), &volume()).unwrap();
    d.put("angles.txt", ANGLES.map(|a| a.to_string()).join("\n"));
    d.done("simulate truth.mha -o scan --angles angles.txt --detector 14x22 --offset -3,4.5");
    d
}

fn info(d: &Folder, name: &str) -> Value {
    d.json(&format!("info {name} --json"))
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
    let d = bench();
    let found = info(&d, "scan");
    let pixel = [0, 1].map(|k| number(&found["pixel_mm"][k]));
    let m = number(&found["magnification"]);
    for (key, want) in [
        ("views", json!(13)),
        ("detector", json!([14, 22])),
        ("offset_mm", json!([-3.0, 4.5])),
        ("supported_voxel_mm", json!([pixel[1] / m, pixel[1] / m, pixel[0] / m])),
    ] {
        near(&found[key], &want, key);
    }
    near(&found["angles"]["first_deg"], &json!(340.0), "first");
    near(&found["angles"]["step_deg"], &json!(17.5), "step");
    assert_eq!(found["angles"]["full_circle"], false);
    near(&found["volume"]["size_mm"], &json!([48.0, 54.0, 35.0]), "size");
    for file in ["scan", "truth.mha"] {
        d.done(&format!("info {file} --png {file}.png"));
        let image = Pixels::open(d.at(format!("{file}.png"))).unwrap();
        assert!(image.width > 900 && image.colours().any(|p| p.0 != [255; 3]));
    }
}

#[test]
fn every_format_keeps_the_geometry() {
    let d = bench();
    let want = info(&d, "scan");
    // A pickle is recognized by its content.
    for (to, name) in [("r2", "r2"), ("naf", "scan.data"), ("rtk", "rtk")] {
        d.done(&format!("convert scan {name} --to {to}"));
        d.done(&format!("convert {name} back-{to}"));
        for found in [info(&d, name), info(&d, &format!("back-{to}"))] {
            KEPT.iter().for_each(|key| near(&found[key], &want[key], &format!("{to}: {key}")));
            assert_eq!(found["truth"], to != "rtk", "{to}");
        }
    }
    let from = info(&d, "scan.data")["provenance"].clone();
    assert_eq!((&from["format"], &from["unit_from"]), (&json!("naf"), &json!("the file")));
    d.done("import rtk/scanner.toml -o imported");
    let found = info(&d, "imported");
    KEPT.iter().for_each(|key| near(&found[key], &want[key], &format!("import: {key}")));
    assert_eq!(info(&d, "rtk/geometry.xml")["views"], 13);
    assert_eq!(read_scan(d.at("rtk")).unwrap().projections, read_scan(d.at("scan")).unwrap().projections);
}

#[test]
fn test_views_are_kept_or_their_loss_is_reported() {
    let d = bench();
    let whole = read_data_set(d.at("scan"), Parts::ALL).unwrap();
    let (train, test) = whole.train.split(&[1, 4, 5]).unwrap();
    write_r2(d.at("r2"), &train, Some(&test), whole.volume.as_ref()).unwrap();
    for (from, to, name) in [("r2", "naf", "a.pickle"), ("a.pickle", "r2", "again")] {
        d.done(&format!("convert {from} {name} --to {to}"));
        assert_eq!(info(&d, name)["test_views"], 3);
        assert_eq!(read_data_set(d.at(name), Parts::ALL).unwrap().test.unwrap().projections, test.projections);
    }
    for to in ["conefield", "rtk"] {
        let output = d.loud(&format!("convert r2 {to} --to {to}")).assert().success().get_output().clone();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(said.contains("left out: 3 test views"), "{said}");
    }
    // Columns are added to the views of an object that reaches their sides.
    let (mut cut, mut test) = (train, test);
    cut.projections += 1.0;
    test.projections.slice_mut(s![.., .., ..2]).fill(0.0);
    test.projections.slice_mut(s![.., .., 20..]).fill(0.0);
    write_r2(d.at("cut"), &cut, Some(&test), whole.volume.as_ref()).unwrap();
    let words = "--correct truncation: found training views of [14, 44] pixels and test views of [14, 22]";
    let asked = ["r2", "naf"].map(|to| format!("convert cut none --to {to} --correct truncation"));
    d.refuses("none", &asked.each_ref().map(|line| (&line[..], words)));
}

#[test]
fn what_lies_beyond_the_volume_is_no_warning_where_the_spec_models_it() {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 12 --detector 32x32"]);
    let mut scan = read_scan(d.at("scan")).unwrap();
    scan.geometry.volume.shape = [10; 3];
    write_scan(d.at("part"), &scan, None).unwrap();
    for line in ["explain fast --scan part", "reconstruct part --spec sirt --steps 1 -o run --force"] {
        for (set, warned) in [("", true), (" --set scene.surround.coarse.cells=8", false)] {
            let output = d.loud(&format!("{line}{set}")).assert().success().get_output().clone();
            let said = String::from_utf8(output.stderr).unwrap();
            assert_eq!(said.contains("the object extends beyond it along"), warned, "{line}{set}: {said}");
        }
    }
}

#[test]
fn one_view_and_one_step_take_no_s() {
    let d = Folder::new();
    let said = d.done("simulate phantom:head:16 -o scan --views 1 --detector 16x16");
    assert!(said.starts_with("scan: 1 view of 16 x 16"), "{said}");
    let said = d.done("reconstruct scan --spec sirt -o run --steps 1");
    assert!(said.starts_with("16 x 16 x 16 voxels from 1 view: 1 step in "), "{said}");
}

#[test]
fn reconstruction_pretraining_and_scores_take_it() {
    let d = bench();
    d.done("convert scan rtk --to rtk");
    let explained = d.json("explain fast --scan rtk --json");
    assert_eq!([&explained["scan"]["detector"], &explained["scan"]["volume"]], [&json!([14, 22]), &json!([12, 9, 7])]);
    let small = format!("--spec fast {SMALL} --steps 8 --seed 2");
    d.done(&format!("pretrain truth.mha -o w.safetensors {small}"));
    let asked = "--reference truth --hold-out every:5 --init w.safetensors --json";
    let record = d.json(&format!("reconstruct scan -o run {small} {asked}"));
    assert!(number(&record["scores"]["psnr"]).is_finite(), "{record}");
    let found = info(&d, "run/volume.nii.gz");
    assert_eq!(found["shape"], json!([12, 9, 7]));
    near(&found["spacing_mm"], &json!([4.0, 6.0, 5.0]), "spacing");
    let scores = d.json("evaluate run/volume.nii.gz truth.mha --json --png e.png");
    near(&scores["psnr"], &record["scores"]["psnr"], "psnr");
    // A scan converted through RTK is the same scan.
    let volumes = ["scan", "rtk"].map(|name| {
        d.done(&format!("reconstruct {name} -o run-{name} {small}"));
        read_volume(d.at(format!("run-{name}/volume.nii.gz"))).unwrap()
    });
    // One is written in the data set's own unit, the other in 1/mm.
    let unit = number(&info(&d, "scan")["unit"]["mm"]) as f32;
    let highest = volumes[0].data.iter().copied().fold(0.0, f32::max);
    for (a, b) in volumes[0].data.iter().zip(&volumes[1].data) {
        assert!((a - b * unit).abs() <= 1e-3 * highest, "{a} {b}");
    }
}

#[test]
fn views_that_are_no_circle_are_read_drawn_and_reconstructed() {
    let d = bench();
    let mut scan = read_scan(d.at("scan")).unwrap();
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
    write_scan(d.at("free"), &scan, None).unwrap();
    let want = info(&d, "free");
    assert_eq!(want["circle"], false);
    d.done("info free --png free.png");
    d.done("convert free rtk --to rtk");
    let found = info(&d, "rtk");
    // RTK's rows run up: the same pixels, counted from below.
    for key in KEPT.iter().filter(|k| **k != "offset_mm") {
        near(&found[key], &want[key], key);
    }
    d.refuses("r2", &[("convert free r2 --to r2", "circle")]);
    // Too far from a circle for the start from FDK.
    for (i, view) in scan.geometry.views.iter_mut().enumerate() {
        (view.source[2], view.detector[2]) = (view.source[2] + 40.0 * i as f64, view.detector[2] + 40.0 * i as f64);
    }
    write_scan(d.at("helix"), &scan, None).unwrap();
    d.refuses("g", &[("reconstruct helix --spec gaussians -o g", "gaussians start from fdk")]);
    d.done(&format!("reconstruct rtk --spec fast -o run {SMALL} --steps 8"));
}

/// A parallel beam over half a turn, through simulation, scan folder, R2-Gaussian's format and back, and every kind of
/// method.
#[test]
fn a_parallel_beam_goes_through_every_command() {
    let d = bench();
    let protocol = "beam = 'parallel'\ndetector = [16, 24]\nextent = { pixel = [4.0, 4.0] }\n\
                    angles = { even = { views = 30, arc_deg = 180.0 } }\n";
    d.put("beam.toml", protocol);
    d.done("simulate truth.mha -o beam --protocol beam.toml");
    let said = d.done("info beam");
    assert!(said.contains("none: a parallel beam"), "{said}");
    d.done("convert beam r2 --to r2");
    let score = |scan: &str, spec: &str| {
        d.done(&format!("reconstruct {scan} -o run --force --spec {spec}"));
        number(&d.json("evaluate run/volume.nii.gz truth.mha --json")["psnr"])
    };
    let [own, back] = ["beam", "r2"].map(|scan| score(scan, "fdk"));
    assert!((own - back).abs() < 0.01, "{own} and {back} dB");
    let empty =
        20.0 * (volume().data.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / 756.0).sqrt().recip().log10() - 4.4;
    let field = format!("fast {SMALL} --steps 150");
    for (spec, more) in [
        ("fdk", 6.0),
        ("os-sart --steps 5", 6.0),
        ("fista-tv --steps 5", 6.0),
        ("gaussians --steps 60", 6.0),
        (&field, 4.0),
    ] {
        let found = score("beam", spec);
        println!("{spec}: {found:.2} dB, an empty volume {empty:.2} dB");
        assert!(found > empty + more, "{spec}: {found}");
    }
    d.refused_with(1, "calibrate beam -o calibrated", &["a parallel beam"]);
    d.put("both.toml", format!("dso = 500.0\n{protocol}"));
    d.refused_with(1, "simulate truth.mha -o x --protocol both.toml", &["dso: found 500", "no source"]);
}
