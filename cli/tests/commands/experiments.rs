//! Further analyses: features as colours, label maps, an end by held-out views, live slices.

use crate::common::{Folder, number, program, signal};
use conefield_evaluation::report::Pixels;
use ndarray::Array3;
use serde_json::{Value, json};
use std::fs;

const SCAN: &str = "simulate phantom:head:24 -o scan --views 8 --detector 24x24";

/// A short run of a small field with LayerNorm.
const RUN: &str = "reconstruct scan --spec fast -o run --steps 60 --set encoder.levels=3 --set encoder.log2_table_size=10 \
                   --set projector.samples=24";

/// That run, and the same as `other` with more options.
fn beside(more: &str) -> Folder {
    let d = Folder::after(&[SCAN, RUN]);
    d.done(&format!("{} {more}", RUN.replace("-o run", "-o other")));
    d
}

fn records(d: &Folder, run: &str) -> Vec<Value> {
    d.text(format!("{run}/metrics.jsonl")).lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

#[test]
fn the_state_of_the_best_record_is_returned_and_reported() {
    // Every step is evaluated, and steps are so long that some increase the error.
    let d = beside(
        "--hold-out every:4 --set 'callbacks.1={type=\"patience\", records=2}' --set training.report_every=1 \
         --set optimizer.decay=none --set optimizer.lr=0.1",
    );
    let (all, record) = (records(&d, "other"), d.read("other/record.json"));
    let error = |r: &Value| number(&r["held_out"]);
    let best = all.iter().min_by(|a, b| error(a).total_cmp(&error(b))).unwrap();
    assert_eq!((&record["best_step"], &record["held_out"]), (&best["step"], &best["held_out"]), "{all:?}");
    let (steps, after) = (record["steps"].as_u64().unwrap(), best["step"].as_u64().unwrap() + 2);
    assert!(steps == after && steps < 60, "{all:?}");
    assert!(all.last().unwrap()["events"][0].as_str().unwrap().contains("stopping rule"));
}

#[test]
fn live_slices_are_drawn_and_change_nothing() {
    let d = beside("--live 0.001s --tensorboard");
    let events = "events.out.tfevents.conefield";
    assert!(!d.has("run/live.png") && !d.at("run").join(events).exists());
    let events = d.bytes(format!("other/{events}"));
    let count = |word: &str| events.windows(word.len()).filter(|w| *w == word.as_bytes()).count();
    assert_eq!(count("loss"), records(&d, "other").len());
    // The last live picture and the final one.
    assert!(count("\x04live") > 0 && count("slices") == 1 && count("IHDR") == count("\x04live") + 1);
    let drawn = |run: &str| {
        let picture = Pixels::open(d.at(run).join("live.png")).unwrap();
        assert!(picture.width > 300 && picture.height > 300, "{run}");
    };
    drawn("other");
    assert!(d.bytes("run/volume.nii.gz") == d.bytes("other/volume.nii.gz"));
    // As of a field, of voxels in 1/mm or in the scan's own unit.
    for method in ["sart", "cgls", "fista"] {
        d.done(&format!("reconstruct scan --spec {method} --steps 4 -o plain --force"));
        d.done(&format!("reconstruct scan --spec {method} --steps 4 -o live --force --live 0.001s"));
        drawn("live");
        assert!(d.bytes("plain/volume.nii.gz") == d.bytes("live/volume.nii.gz"), "{method}");
    }
}

#[test]
fn features_are_drawn_and_their_variance_reported() {
    let d = Folder::after(&[SCAN, RUN]);
    let found = d.json("features run --out f.png --json");
    let shares: Vec<f64> = found["explained"].as_array().unwrap().iter().map(number).collect();
    assert_eq!((shares.len(), &found["channels"], &found["after"]), (3, &Value::from(6), &Value::from("encoder")));
    assert!(shares.windows(2).all(|w| w[0] >= w[1]) && shares.iter().sum::<f64>() <= 1.0 + 1e-12, "{shares:?}");
    assert_eq!(found["points"], 3 * 24 * 24);
    let image = Pixels::open(d.at("f.png")).unwrap();
    let coloured = image.colours().filter(|p| p.0.iter().max().unwrap() - p.0.iter().min().unwrap() > 60).count();
    assert!(coloured > 10_000, "{coloured}");
    // Existing output is kept unless --force is given.
    assert!(d.refused(1, "features run --out f.png").contains("--force"));
    let normalized = d.json("features run --out n.png --json --after normalizers");
    assert_ne!(normalized["explained"], found["explained"]);
    let said = d.done("features run/weights.safetensors --out n.png --voxels 12 --force");
    assert!(said.contains("red") && said.contains("432 points"), "{said}");
    // A repetition gives the same bits.
    d.done("features run --out again.png --threads 1");
    assert_eq!(d.bytes("f.png"), d.bytes("again.png"));
    // Pre-trained weights have no field to show.
    d.done("pretrain phantom:head:16 --spec fast -o w.safetensors --steps 1");
    d.refused_with(1, "features w.safetensors --out w.png", &["w.safetensors", "reconstruct"]);
}

/// Label maps with bars of two labels, the first of which starts at 2 in `a.npy` and at 4 in `b.npy`, and one without.
fn labels() -> Folder {
    let d = Folder::new();
    let write = |name: &str, label: &dyn Fn(usize, usize) -> f32| {
        ndarray_npy::write_npy(d.at(name), &Array3::from_shape_fn((12, 12, 12), |(x, y, _)| label(x, y))).unwrap();
    };
    for (name, from) in [("a.npy", 2), ("b.npy", 4)] {
        write(name, &|x, y| match (x, y) {
            (x, 0..4) if (from..from + 4).contains(&x) => 1.0,
            (_, 8..12) => 5.0,
            _ => 0.0,
        });
    }
    write("empty.npy", &|_, _| 0.0);
    d
}

#[test]
fn material_is_scored_by_its_place_and_an_empty_volume_scores_0() {
    let d = labels();
    let found = d.json("evaluate a.npy b.npy --threshold 0.5 --json");
    // Of 1728 voxels 672 are material in both, 96 each in one, 864 in none: (672·864 − 96·96)/(768·960) and 1344/1536.
    let material = &found["material"];
    assert_eq!([&material["mcc"], &material["dice"]], [0.775, 0.875], "{found}");
    assert_eq!(material["voxels"], 768);
    assert!(d.done("evaluate a.npy b.npy --threshold 0.5").starts_with("mcc        0.7750"));
    let found = d.json("evaluate empty.npy a.npy --threshold otsu --json");
    assert_eq!([&found["material"]["mcc"], &found["material"]["dice"]], [0.0, 0.0], "{found}");
}

#[test]
fn label_maps_are_scored_by_dice() {
    let d = labels();
    let found = d.json("evaluate --labels a.npy b.npy --json");
    // The first label shares two of four planes; the other label is equal in both.
    let first = json!({ "label": 1, "dice": 0.5, "voxels": 192, "reference_voxels": 192 });
    assert_eq!(found["dice"]["labels"][0], first);
    assert_eq!(found["dice"]["labels"][1]["dice"], 1.0);
    assert_eq!(found["dice"]["mean"], 0.75);
    assert!(found.get("psnr").is_none());
    let said = d.done("evaluate --labels a.npy b.npy");
    assert!(said.contains("mean dice of 2 labels  0.7500"), "{said}");
    // A label missing in the other map.
    let found = d.json("evaluate --labels empty.npy a.npy --json");
    assert_eq!((&found["dice"]["mean"], &found["dice"]["only_in_reference"]), (&json!(0.0), &json!([1, 5])));
    assert!(d.done("evaluate --labels a.npy empty.npy").contains("only in the volume, counted as 0: 1, 5"));
    let none = d.json("evaluate --labels empty.npy empty.npy --json");
    assert_eq!(none["dice"]["mean"], Value::Null);
    assert!(d.done("evaluate --labels empty.npy empty.npy").contains("not defined"));
}

/// An `sh` program.
#[cfg(unix)]
fn tool(d: &Folder, name: &str, script: &str) {
    use std::os::unix::fs::PermissionsExt;
    d.put(name, format!("#!/bin/sh\n{script}\n"));
    fs::set_permissions(d.at(name), fs::Permissions::from_mode(0o755)).unwrap();
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
    let d = Folder::new();
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
        ndarray_npy::write_npy(d.at(name), &v).unwrap();
        v.iter().filter(|v| **v > 0.6).count()
    };
    let (small, large) = (ball("a.npy", 6.0), ball("b.npy", 8.0));
    let me = std::env::current_exe().unwrap();
    let script = format!(
        "printf x >> calls\n{THRESHOLD}=\"$(printf '%s\\t%s\\t%s' \"$2\" \"$4\" \"$5\")\" exec '{}' --exact experiments::threshold",
        me.display()
    );
    tool(&d, "my tool", &script);
    fs::create_dir(d.at("tmp")).unwrap();
    let expected = 2.0 * small as f64 / (small + large) as f64;
    // The second time in Hounsfield units: 0.6 of the way from -1000 to 2000.
    for (calls, level, more) in [("xx", "0.6", ""), ("xxxx", "800", "--hu -1000,2000")] {
        let segmenter = format!("--segmenter '\"./my tool\" -i {{in}} -o {{out}} {level}'");
        let mut command = d.command(&format!("evaluate a.npy b.npy --json {segmenter} {more}"));
        let output = command.env("TMPDIR", d.at("tmp")).assert().success().get_output().clone();
        assert_eq!(d.names("tmp"), [""; 0], "something was left behind");
        let found: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!((number(&found["dice"]["mean"]) - expected).abs() < 1e-12, "{found}");
        assert!(number(&found["psnr"]) > 10.0);
        assert_eq!(d.text("calls"), calls);
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_segmenter_is_ended_and_its_files_go() {
    use std::process::{Command, Stdio};
    let d = labels();
    fs::create_dir(d.at("tmp")).unwrap();
    tool(&d, "slow", "echo $$ > new; mv new begun; exec sleep 60");
    let child = Command::new(program())
        .current_dir(d.at(""))
        .args(["--quiet", "evaluate", "a.npy", "a.npy", "--segmenter", "./slow {in} {out}"])
        .env("TMPDIR", d.at("tmp"))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    d.wait_for("begun");
    let segmenter = d.text("begun");
    signal(&child, "TERM");
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(143), "{said}");
    assert!(said.contains("interrupted during the segmentation"), "{said}");
    assert_eq!(d.names("tmp"), [""; 0]);
    let alive = Command::new("sh").arg("-c").arg(format!("kill -0 {} 2>/dev/null", segmenter.trim())).status().unwrap();
    assert!(!alive.success(), "the segmenter runs on");
}
