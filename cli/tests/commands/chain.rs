//! From a phantom to scores, on a scan that is small enough for every test run.

use crate::common::{done, json, simulated, text};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::{TempDir, tempdir};

/// Settings so small that a few steps take no time.
const SMALL: [&str; 8] = [
    "--set", "encoder.levels=3", "--set", "encoder.log2_table_size=10", "--set", "projector.samples=24", "--steps",
    "12",
];

/// A small scan in a folder of its own.
fn scan() -> (TempDir, PathBuf) {
    simulated(16, 8)
}

/// Reconstructs with `spec`; returns the record.
fn reconstruct(scan: &Path, run: &Path, spec: &str, more: &[&str]) -> Value {
    let (scan, run) = (text(scan), text(run));
    let mut args = vec!["reconstruct", &scan, "--spec", spec, "-o", &run, "--json"];
    args.extend(SMALL);
    args.extend(more);
    json(&args)
}

#[test]
fn a_scan_becomes_a_volume_and_its_scores() {
    let (dir, scan) = scan();
    let run = dir.path().join("run");
    let record = reconstruct(&scan, &run, "naf", &["--reference", "truth", "--hold-out", "every:4", "--seed", "5"]);
    assert_eq!(record["steps"], 12);
    assert_eq!(record["seed"], 5);
    assert_eq!(record["held_out_views"].as_array().unwrap().len(), 2);
    assert!(record["held_out"].as_f64().unwrap().is_finite());
    let psnr = record["scores"]["psnr"].as_f64().unwrap();
    assert!(psnr.is_finite());
    for file in ["volume.nii.gz", "metrics.jsonl", "spec.toml", "record.json", "slices.png", "weights.safetensors"] {
        assert!(run.join(file).is_file(), "{file}");
    }
    let on_disk: Value = serde_json::from_str(&fs::read_to_string(run.join("record.json")).unwrap()).unwrap();
    assert_eq!(on_disk, record);
    let lines = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let last: Value = serde_json::from_str(lines.lines().last().expect("a record")).unwrap();
    assert_eq!(last["step"], 12);

    // `evaluate` finds the same, up to NIfTI's precision.
    let truth = dir.path().join("truth.nii.gz");
    let info = json(&["info", &text(&scan), "--json"]);
    assert_eq!(info["truth"], true);
    assert_eq!(info["views"], 8);
    done(&["convert", "--help"]);
    let copied = find_truth(&scan);
    done(&["convert", &text(&copied), &text(&truth)]);
    let png = dir.path().join("e.png");
    let volume = text(&run.join("volume.nii.gz"));
    let scores = json(&["evaluate", &volume, &text(&truth), "--json", "--png", &text(&png)]);
    assert!((scores["psnr"].as_f64().unwrap() - psnr).abs() < 1e-6);
    for key in ["ssim_2d", "ssim_3d", "ssim_skimage", "rmse"] {
        assert!(scores[key].is_number(), "{key}: {scores}");
    }
    assert!(png.is_file());
    assert!(done(&["evaluate", &volume, &text(&truth)]).starts_with("psnr "));
    assert_eq!(json(&["info", &volume, "--json"])["kind"], "volume");
    let weights = json(&["info", &text(&run.join("weights.safetensors")), "--json"]);
    assert!(weights["notes"]["spec"].as_str().unwrap().contains("hash-grid"));
}

/// The truth's file within a scan.
fn find_truth(scan: &Path) -> PathBuf {
    let files = fs::read_dir(scan).unwrap().map(|e| e.unwrap().path());
    files.into_iter().find(|p| p.to_string_lossy().contains("truth")).expect("a scan keeps its truth")
}

#[test]
fn the_written_spec_repeats_the_run_to_the_bit() {
    let (dir, scan) = scan();
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    reconstruct(&scan, &first, "ni-naf", &["--seed", "3"]);
    let spec = text(&first.join("spec.toml"));
    json(&[
        "reconstruct",
        &text(&scan),
        "--spec",
        &spec,
        "-o",
        &text(&second),
        "--steps",
        "12",
        "--seed",
        "3",
        "--json",
    ]);
    let bytes = |run: &Path| fs::read(run.join("weights.safetensors")).unwrap();
    assert!(bytes(&first) == bytes(&second));
    assert_eq!(fs::read(first.join("spec.toml")).unwrap(), fs::read(second.join("spec.toml")).unwrap());
}

#[test]
fn threads_do_not_change_a_bit() {
    let (dir, scan) = scan();
    let volumes = ["1", "2"].map(|threads| {
        let run = dir.path().join(threads);
        let record = reconstruct(&scan, &run, "ni-naf", &["--threads", threads]);
        assert_eq!(record["threads"].to_string(), threads);
        fs::read(run.join("weights.safetensors")).unwrap()
    });
    assert!(volumes[0] == volumes[1]);
}

#[test]
fn every_shipped_spec_reconstructs() {
    let (dir, scan) = scan();
    let single = ["naf", "ni-naf", "ni-naf-published", "nerf", "sax-nerf", "dense", "accurate", "balanced", "fast"];
    // The passes of a second method continue the count.
    let chains = [("field-tv", 4), ("accurate-tv", 6)];
    for (spec, passes) in single.map(|spec| (spec, 0)).into_iter().chain(chains) {
        let run = text(&dir.path().join(spec));
        let samples = format!("{}projector.samples=16", if passes > 0 { "methods.0." } else { "" });
        let record = json(&[
            "reconstruct",
            &text(&scan),
            "--spec",
            spec,
            "-o",
            &run,
            "--json",
            "--steps",
            "2",
            "--set",
            &samples,
        ]);
        assert_eq!(record["steps"], 2 + passes, "{spec}");
    }
}

/// One method starts from the volume of another and is pulled towards it.
#[test]
fn a_volume_starts_another_run() {
    let (dir, scan) = scan();
    let (scan, place) = (text(&scan), |name: &str| text(&dir.path().join(name)));
    let run = |spec: &str, name: &str, more: &[&str]| {
        json(&[&["reconstruct", &scan, "--spec", spec, "-o", &place(name), "--json", "--steps", "1"], more].concat())
    };
    run("sirt", "first", &[]);
    let volume = place("first/volume.nii.gz");
    let record = run("fista-tv", "held", &["--init", &volume, "--set", "pull=1e6"]);
    assert_eq!(record["init"], volume.as_str());
    let scores = json(&["evaluate", &place("held/volume.nii.gz"), &volume, "--json"]);
    assert!(scores["psnr"].as_f64().unwrap() > 40.0, "{scores}");
    let spec = fs::read_to_string(dir.path().join("held/spec.toml")).unwrap();
    assert!(spec.contains("start = "), "{spec}");
    let alone = ["reconstruct", &scan, "--spec", "fista-tv", "-o", &place("alone"), "--set", "pull=0.1"];
    let said = crate::common::refused(1, &alone);
    assert!(said.contains("pull"), "{said}");
}

#[test]
fn pretrained_weights_start_another_run() {
    let (dir, scan) = scan();
    let weights = text(&dir.path().join("w.safetensors"));
    let mut args = vec!["pretrain", "phantom:abdomen:16", "--spec", "fast", "-o", &weights, "--json"];
    args.extend(SMALL);
    let made = json(&args);
    let names: Vec<&str> = made["tensors"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert!(names.iter().any(|n| n.starts_with("field.")), "{names:?}");
    assert!(names.iter().all(|n| !n.starts_with("encoder.")), "{names:?}");
    let record = reconstruct(&scan, &dir.path().join("run"), "fast", &["--init", &weights]);
    assert_eq!(record["init"], weights.as_str());
    let spec = fs::read_to_string(dir.path().join("run/spec.toml")).unwrap();
    assert!(spec.contains("type = \"mci\""), "{spec}");
    // A field of another shape cannot start from them.
    let said = crate::common::refused(
        1,
        &[
            "reconstruct",
            &text(&scan),
            "--spec",
            "fast",
            "-o",
            &text(&dir.path().join("other")),
            "--init",
            &weights,
            "--set",
            "field.width=48",
            "--set",
            "encoder.levels=3",
            "--steps",
            "1",
        ],
    );
    assert!(said.contains("field.") && said.contains("shape"), "{said}");
}

#[test]
fn scans_convert_there_and_back() {
    let (dir, scan) = scan();
    let (r2, back) = (text(&dir.path().join("r2")), text(&dir.path().join("back")));
    done(&["convert", &text(&scan), &r2, "--to", "r2"]);
    done(&["convert", &r2, &back]);
    let (a, b) = (json(&["info", &text(&scan), "--json"]), json(&["info", &back, "--json"]));
    for key in ["views", "detector", "truth"] {
        assert_eq!(a[key], b[key], "{key}");
    }
    let largest = |v: &Value| v["line_integrals"]["max"].as_f64().unwrap();
    assert!((largest(&a) / largest(&b) - 1.0).abs() < 1e-5);
}

#[test]
fn simulation_takes_noise_offset_and_angles() {
    let dir = tempdir().unwrap();
    let angles = dir.path().join("angles.txt");
    fs::write(&angles, "# degrees\n0\n45.5\n-90\n").unwrap();
    let made = |name: &str, more: &[&str]| {
        let path = text(&dir.path().join(name));
        let mut args = vec!["simulate", "phantom:head:32", "-o", &path, "--detector", "12x20", "--downsample", "2"];
        args.extend(more);
        done(&args);
        json(&["info", &path, "--json"])
    };
    let listed = made("listed", &["--angles", &text(&angles), "--offset", "-3,4"]);
    assert_eq!(listed["views"], 3);
    assert_eq!(listed["volume"]["shape"], serde_json::json!([16, 16, 16]));
    let arc = made("arc", &["--angles", "-90:180", "--views", "5", "--noise", "poisson:1e3"]);
    assert_eq!(arc["views"], 5);
    let again = made("again", &["--angles", "-90:180", "--views", "5", "--noise", "poisson:1e3"]);
    assert_eq!(arc["line_integrals"], again["line_integrals"], "the seed decides");
    let other = made("other", &["--angles", "-90:180", "--views", "5", "--noise", "poisson:1e3", "--seed", "1"]);
    assert_ne!(arc["line_integrals"], other["line_integrals"]);
    let protocol = dir.path().join("protocol.toml");
    let text_of = "dso = 5.0\ndsd = 7.0\ndetector = [12, 20]\nextent = { side = [4.0, 4.0] }\nnoise = \"poisson:1e3\"\nseed = 1\n\
                   angles = { even = { views = 5, start_deg = -90.0, arc_deg = 180.0 } }\nunit = { name = \"half\", mm = 300.0 }\n";
    fs::write(&protocol, text_of).unwrap();
    let protocol = text(&protocol);
    let seed = |more: &[&str]| {
        let out = text(&dir.path().join("seeded"));
        let line = ["simulate", "phantom:head:16", "-o", &out, "--protocol", &protocol, "--force", "--json"];
        json(&[&line[..], more].concat())["seed"].clone()
    };
    assert_eq!(
        (seed(&[]), seed(&["--seed", "0"])),
        (1.into(), 0.into()),
        "the protocol's seed, unless another is asked for"
    );
}

#[test]
fn the_demonstration_compares_three_ways() {
    let dir = tempdir().unwrap();
    let out = text(&dir.path().join("demo"));
    let found = json(&["demo", "-o", &out, "--seconds", "1s", "--size", "24", "--views", "8", "--json"]);
    let results = found["results"].as_array().unwrap();
    assert_eq!(results.len(), 3);
    assert!(results.iter().all(|r| r["scores"]["psnr"].as_f64().is_some_and(f64::is_finite)));
    assert!(dir.path().join("demo/compare.png").is_file());
    // Both fields make the same number of steps.
    assert_eq!(results[1]["steps"], results[2]["steps"]);
    let page = text(&dir.path().join("page.html"));
    let said = done(&["report", &out, "-o", &page]);
    assert!(said.contains("3 runs, 4 volumes"), "{said}");
}
