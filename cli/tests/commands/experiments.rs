//! Further analyses: drift, features as colours, label maps, an end by held-out views, live slices.

use crate::common::{done, json, refused, signal, text, wait_for};
use conefield_evaluation::report::Pixels;
use ndarray::Array3;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::{TempDir, tempdir};

/// A short run of a small field with LayerNorm on a small scan.
fn run(more: &[&str]) -> (TempDir, PathBuf) {
    let dir = tempdir().unwrap();
    let (scan, run) = (text(&dir.path().join("scan")), dir.path().join("run"));
    done(&["simulate", "phantom:head:24", "-o", &scan, "--views", "8", "--detector", "24x24"]);
    let name = text(&run);
    let mut args = vec!["reconstruct", &scan, "--spec", "fast", "-o", &name, "--steps", "60"];
    args.extend(["--set", "encoder.levels=3", "--set", "encoder.log2_table_size=10", "--set", "projector.samples=24"]);
    args.extend(more);
    done(&args);
    (dir, run)
}

fn records(run: &Path) -> Vec<Value> {
    let lines = fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

#[test]
fn drift_stands_in_the_metrics_where_it_is_asked_for() {
    let (_first, plain) = run(&[]);
    assert!(records(&plain).iter().all(|r| r.get("drift").is_none()));
    let (_second, run) =
        run(&["--set", "callbacks.1={type='drift', every=2, points=200}", "--set", "training.report_every=20"]);
    let all: Vec<Value> = records(&run).iter().filter_map(|r| r["drift"].as_array().cloned()).flatten().collect();
    assert_eq!(all.iter().map(|d| d["step"].as_u64().unwrap()).collect::<Vec<_>>(), [16, 32, 48]);
    assert!(all.iter().all(|d| d["mean_l1"].as_f64().unwrap() > 0.0), "{all:?}");
    assert_eq!(all[0]["epoch"], 2.0);
    // Drift does not change the training.
    let volume = |run: &Path| fs::read(run.join("volume.nii.gz")).unwrap();
    assert!(volume(&plain) == volume(&run));
}

#[test]
fn the_state_of_the_best_record_is_returned_and_reported() {
    // Every step is evaluated, and steps are so long that some increase the error.
    let more = [
        "--hold-out",
        "every:4",
        "--set",
        "callbacks.1={type='patience', records=2}",
        "--set",
        "training.report_every=1",
    ];
    let (_dir, run) = run(&[&more[..], &["--set", "optimizer.decay=none", "--set", "optimizer.lr=0.1"]].concat());
    let (all, record) = (records(&run), fs::read_to_string(run.join("record.json")).unwrap());
    let record: Value = serde_json::from_str(&record).unwrap();
    let error = |r: &Value| r["held_out"].as_f64().unwrap();
    let best = all.iter().min_by(|a, b| error(a).total_cmp(&error(b))).unwrap();
    assert_eq!((&record["best_step"], &record["held_out"]), (&best["step"], &best["held_out"]), "{all:?}");
    let (steps, after) = (record["steps"].as_u64().unwrap(), best["step"].as_u64().unwrap() + 2);
    assert!(steps == after && steps < 60, "{all:?}");
    assert!(all.last().unwrap()["events"][0].as_str().unwrap().contains("stopping rule"));
}

#[test]
fn live_slices_are_drawn_and_change_nothing() {
    let (_first, plain) = run(&[]);
    let (_second, watched) = run(&["--live", "0.001s", "--tensorboard"]);
    let events = "events.out.tfevents.conefield";
    assert!(!plain.join("live.png").exists() && !plain.join(events).exists());
    let events = fs::read(watched.join(events)).unwrap();
    let count = |word: &str| events.windows(word.len()).filter(|w| *w == word.as_bytes()).count();
    assert_eq!(count("loss"), records(&watched).len());
    // The last live picture and the final one.
    assert!(count("\x04live") > 0 && count("slices") == 1 && count("IHDR") == count("\x04live") + 1);
    let picture = Pixels::open(watched.join("live.png")).unwrap();
    assert!(picture.width > 300 && picture.height > 300);
    let volume = |run: &Path| fs::read(run.join("volume.nii.gz")).unwrap();
    assert!(volume(&plain) == volume(&watched));
}

/// As of a field, of voxels in 1/mm or in the scan's own unit.
#[test]
fn live_slices_of_iterative_methods_change_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:24", "-o", &at("scan"), "--views", "8", "--detector", "24x24"]);
    for method in ["sart", "cgls", "fista"] {
        let small = ["--spec", method, "--steps", "4", "-o"];
        done(&[&["reconstruct", &at("scan")][..], &small, &[&at("plain")], &["--force"]].concat());
        done(&[&["reconstruct", &at("scan")][..], &small, &[&at("live")], &["--force", "--live", "0.001s"]].concat());
        let picture = Pixels::open(dir.path().join("live/live.png")).unwrap();
        assert!(picture.width > 300 && picture.height > 300);
        let volume = |run: &str| fs::read(dir.path().join(run).join("volume.nii.gz")).unwrap();
        assert!(volume("plain") == volume("live"), "{method}");
    }
}

#[test]
fn features_are_drawn_and_their_variance_reported() {
    let (dir, run) = run(&[]);
    let picture = dir.path().join("features.png");
    let (run, out) = (text(&run), text(&picture));
    let found = json(&["features", &run, "--out", &out, "--json"]);
    let shares: Vec<f64> = found["explained"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    assert_eq!((shares.len(), &found["channels"], &found["after"]), (3, &Value::from(6), &Value::from("encoder")));
    assert!(shares.windows(2).all(|w| w[0] >= w[1]) && shares.iter().sum::<f64>() <= 1.0 + 1e-12, "{shares:?}");
    assert_eq!(found["points"], 3 * 24 * 24);
    let image = Pixels::open(&picture).unwrap();
    let coloured = image.colours().filter(|p| p.0.iter().max().unwrap() - p.0.iter().min().unwrap() > 60).count();
    assert!(coloured > 10_000, "{coloured}");
    // Existing output is kept unless --force is given.
    assert!(refused(1, &["features", &run, "--out", &out]).contains("--force"));
    let normalized = json(&["features", &run, "--out", &out, "--json", "--after", "normalizers", "--force"]);
    assert_ne!(normalized["explained"], found["explained"]);
    let said = done(&["features", &format!("{run}/weights.safetensors"), "--out", &out, "--voxels", "12", "--force"]);
    assert!(said.contains("red") && said.contains("432 points"), "{said}");
    // A repetition gives the same bits.
    let again = text(&dir.path().join("again.png"));
    done(&["features", &run, "--out", &again]);
    let first = text(&dir.path().join("first.png"));
    done(&["features", &run, "--out", &first, "--threads", "1"]);
    assert_eq!(fs::read(again).unwrap(), fs::read(first).unwrap());
    // Pre-trained weights have no field to show.
    let weights = text(&dir.path().join("w.safetensors"));
    done(&["pretrain", "phantom:head:16", "--spec", "fast", "-o", &weights, "--steps", "1"]);
    let said = refused(1, &["features", &weights, "--out", &out, "--force"]);
    assert!(said.contains("w.safetensors") && said.contains("reconstruct"), "{said}");
}

/// A label map with bars of two labels, the first one starting at `from`.
fn labels(path: &Path, from: usize) -> String {
    let map = Array3::from_shape_fn((12, 12, 12), |(x, y, _)| match (x, y) {
        (x, 0..4) if (from..from + 4).contains(&x) => 1.0f32,
        (_, 8..12) => 5.0,
        _ => 0.0,
    });
    ndarray_npy::write_npy(path, &map).unwrap();
    text(path)
}

#[test]
fn material_is_scored_by_its_place_and_an_empty_volume_scores_0() {
    let dir = tempdir().unwrap();
    let (a, b) = (labels(&dir.path().join("a.npy"), 2), labels(&dir.path().join("b.npy"), 4));
    let found = json(&["evaluate", &a, &b, "--threshold", "0.5", "--json"]);
    // Of 1728 voxels 672 are material in both, 96 each in one, 864 in none: (672·864 − 96·96)/(768·960) and 1344/1536.
    let material = &found["material"];
    assert_eq!([&material["mcc"], &material["dice"]], [0.775, 0.875], "{found}");
    assert_eq!(material["voxels"], 768);
    assert!(done(&["evaluate", &a, &b, "--threshold", "0.5"]).starts_with("mcc        0.7750"));
    let empty = dir.path().join("empty.npy");
    ndarray_npy::write_npy(&empty, &Array3::<f32>::zeros((12, 12, 12))).unwrap();
    let found = json(&["evaluate", &text(&empty), &a, "--threshold", "otsu", "--json"]);
    assert_eq!([&found["material"]["mcc"], &found["material"]["dice"]], [0.0, 0.0], "{found}");
}

#[test]
fn label_maps_are_scored_by_dice() {
    let dir = tempdir().unwrap();
    let (a, b) = (labels(&dir.path().join("a.npy"), 2), labels(&dir.path().join("b.npy"), 4));
    let found = json(&["evaluate", "--labels", &a, &b, "--json"]);
    // The first label shares two of four planes; the other label is equal in both.
    assert_eq!(
        found["dice"]["labels"][0],
        serde_json::json!({
            "label": 1, "dice": 0.5, "voxels": 192, "reference_voxels": 192
        })
    );
    assert_eq!(found["dice"]["labels"][1]["dice"], 1.0);
    assert_eq!(found["dice"]["mean"], 0.75);
    assert!(found.get("psnr").is_none());
    let said = done(&["evaluate", "--labels", &a, &b]);
    assert!(said.contains("mean dice of 2 labels  0.7500"), "{said}");
    // A label missing in the other map.
    let empty = dir.path().join("empty.npy");
    ndarray_npy::write_npy(&empty, &Array3::<f32>::zeros((12, 12, 12))).unwrap();
    let empty = text(&empty);
    let found = json(&["evaluate", "--labels", &empty, &a, "--json"]);
    assert_eq!(found["dice"]["mean"], 0.0);
    assert_eq!(found["dice"]["only_in_reference"], serde_json::json!([1, 5]));
    assert!(done(&["evaluate", "--labels", &a, &empty]).contains("only in the volume, counted as 0: 1, 5"));
    let none = json(&["evaluate", "--labels", &empty, &empty, "--json"]);
    assert_eq!(none["dice"]["mean"], Value::Null);
    assert!(done(&["evaluate", "--labels", &empty, &empty]).contains("not defined"));
}

/// The file `name` of the shared data, if it exists; otherwise a test is skipped with a note.
fn data(name: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("CONEFIELD_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let path = folder.join(name);
    if !path.exists() {
        eprintln!("skipped: {} is not there; CONEFIELD_DATA names the folder of the shared data", path.display());
    }
    path.exists().then_some(path)
}

#[test]
fn clinical_labels_agree_with_themselves_and_less_when_shifted() {
    let Some(path) = data("clinical/abdomen_crop_seg.nii.gz") else { return };
    let path = text(&path);
    let same = json(&["evaluate", "--labels", &path, &path, "--json"]);
    let labels = same["dice"]["labels"].as_array().unwrap();
    assert!(labels.len() > 10 && labels.iter().all(|l| l["dice"] == 1.0 && l["label"].as_u64().unwrap() <= 117));
    assert_eq!(same["dice"]["mean"], 1.0);
    let dir = tempdir().unwrap();
    let copy = text(&dir.path().join("copy.npy"));
    done(&["convert", &path, &copy]);
    let map: Array3<f32> = ndarray_npy::read_npy(&copy).unwrap();
    let n = map.dim().0;
    let moved = Array3::from_shape_fn(map.dim(), |(x, y, z)| map[[(x + 1) % n, y, z]]);
    ndarray_npy::write_npy(&copy, &moved).unwrap();
    let mean = json(&["evaluate", "--labels", &copy, &path, "--json"])["dice"]["mean"].as_f64().unwrap();
    assert!(mean > 0.3 && mean < 0.98, "{mean}");
}

/// An `sh` program in `dir`.
#[cfg(unix)]
fn program(dir: &Path, name: &str, text: &str) -> String {
    use std::os::unix::fs::PermissionsExt;
    let path = dir.join(name);
    fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path.display().to_string()
}

/// A segmenter by threshold: this test's own program, started with files instead of test names.
const THRESHOLD: &str = "CONEFIELD_TEST_THRESHOLD";

/// Does nothing as a test; as a segmenter it reads `IN OUT LEVEL` and writes 1 where values are above the level.
#[test]
fn threshold() {
    let Ok(words) = std::env::var(THRESHOLD) else { return };
    let [input, output, level] = words.split('\t').collect::<Vec<_>>()[..] else { panic!("{words}") };
    let level: f32 = level.parse().unwrap();
    let labels = conefield_io::read_volume(input).unwrap().mapped(|x| f32::from(u8::from(x > level)));
    conefield_io::write_volume(output, &labels).unwrap();
}

#[cfg(unix)]
#[test]
fn a_segmenter_sees_both_volumes_and_leaves_nothing() {
    let dir = tempdir().unwrap();
    let place = |name: &str| text(&dir.path().join(name));
    // A ball of 0.8 in one of 0.4, and the same with a larger inner ball.
    let ball = |name: &str, inner: f64| {
        let v = Array3::from_shape_fn((24, 24, 24), |(x, y, z)| {
            let r = [x, y, z].iter().map(|&i| (i as f64 - 11.5).powi(2)).sum::<f64>().sqrt();
            if r < inner {
                0.8f32
            } else if r < 11.0 {
                0.4
            } else {
                0.0
            }
        });
        ndarray_npy::write_npy(dir.path().join(name), &v).unwrap();
        v.iter().filter(|v| **v > 0.6).count()
    };
    let (small, large) = (ball("a.npy", 6.0), ball("b.npy", 8.0));
    let me = std::env::current_exe().unwrap();
    let tool = program(
        dir.path(),
        "my tool",
        &format!(
            "printf x >> '{}'\n{THRESHOLD}=\"$(printf '%s\\t%s\\t%s' \"$2\" \"$4\" \"$5\")\" exec '{}' --exact experiments::threshold",
            place("calls"),
            me.display()
        ),
    );
    let temporary = dir.path().join("tmp");
    fs::create_dir(&temporary).unwrap();
    let evaluate = |more: &[&str]| {
        let mut args = vec!["evaluate".to_owned(), place("a.npy"), place("b.npy"), "--json".into()];
        args.extend(more.iter().map(|&m| m.to_owned()));
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let output = crate::common::conefield(&args).env("TMPDIR", &temporary).assert().success().get_output().clone();
        assert_eq!(fs::read_dir(&temporary).unwrap().count(), 0, "something was left behind");
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let expected = 2.0 * small as f64 / (small + large) as f64;
    let found = evaluate(&["--segmenter", &format!("'{tool}' -i {{in}} -o {{out}} 0.6")]);
    assert!((found["dice"]["mean"].as_f64().unwrap() - expected).abs() < 1e-12, "{found}");
    assert!(found["psnr"].as_f64().unwrap() > 10.0);
    assert_eq!(fs::read_to_string(place("calls")).unwrap(), "xx");
    // The same in Hounsfield units: 0.6 of the way from -1000 to 2000.
    let found = evaluate(&["--segmenter", &format!("'{tool}' -i {{in}} -o {{out}} 800"), "--hu", "-1000,2000"]);
    assert!((found["dice"]["mean"].as_f64().unwrap() - expected).abs() < 1e-12, "{found}");
}

#[cfg(unix)]
#[test]
fn an_interrupted_segmenter_is_ended_and_its_files_go() {
    use std::process::{Command, Stdio};
    let dir = tempdir().unwrap();
    let a = labels(&dir.path().join("a.npy"), 2);
    let (temporary, begun) = (dir.path().join("tmp"), dir.path().join("begun"));
    fs::create_dir(&temporary).unwrap();
    let slow = program(
        dir.path(),
        "slow",
        &format!("echo $$ > '{0}.new'; mv '{0}.new' '{0}'; exec sleep 60", begun.display()),
    );
    let child = Command::new(assert_cmd::cargo::cargo_bin("conefield"))
        .args(["--quiet", "evaluate", &a, &a, "--segmenter", &format!("{slow} {{in}} {{out}}")])
        .env("TMPDIR", &temporary)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    wait_for(&begun);
    let segmenter = fs::read_to_string(&begun).unwrap().trim().to_owned();
    signal(&child, "TERM");
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(143), "{said}");
    assert!(said.contains("interrupted during the segmentation"), "{said}");
    assert_eq!(fs::read_dir(&temporary).unwrap().count(), 0);
    let alive = Command::new("sh").arg("-c").arg(format!("kill -0 {segmenter} 2>/dev/null")).status().unwrap();
    assert!(!alive.success(), "the segmenter runs on");
}
