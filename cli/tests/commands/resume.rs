//! A killed or interrupted run resumes to the same bits.
use crate::common::{done, refused, signal, started, text, wait_for};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const SETTINGS: [&str; 4] =
    ["encoder.levels=2", "encoder.log2_table_size=10", "training.rays=48", "training.report_every=7"];

/// A scan of 8 views, made once per test.
fn scan(dir: &Path) -> PathBuf {
    let path = dir.join("scan");
    done(&["simulate", "phantom:head:16", "-o", &text(&path), "--views", "8", "--detector", "16x16"]);
    path
}

fn arguments(scan: &Path, run: &Path, steps: u64, more: &[&str]) -> Vec<String> {
    let mut all: Vec<String> =
        ["reconstruct", &text(scan), "--spec", "ni-naf", "-o", &text(run)].map(Into::into).into();
    // The mask removes channels during the run: its decision must be restored too.
    all.extend(["--steps".into(), steps.to_string(), "--set".into(), "projector.samples=16".into()]);
    all.extend(["--set".into(), "callbacks.1.epoch=3".into()]);
    for s in SETTINGS {
        all.extend(["--set".into(), s.into()]);
    }
    all.extend(more.iter().map(|&m| m.into()));
    all
}

fn finish(arguments: &[String]) {
    done(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
}

fn same_results(a: &Path, b: &Path) {
    for file in ["volume.nii.gz", "weights.safetensors"] {
        assert!(std::fs::read(a.join(file)).unwrap() == std::fs::read(b.join(file)).unwrap(), "{file} differs");
    }
    assert_eq!(losses(a), losses(b));
    assert!(!b.join("checkpoint.safetensors").exists());
}

/// Steps and losses of all records.
fn losses(run: &Path) -> Vec<(u64, u64)> {
    let lines = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let number = |line: &str| {
        let r: serde_json::Value = serde_json::from_str(line).unwrap();
        (r["step"].as_u64().unwrap(), r["loss"].as_f64().unwrap().to_bits())
    };
    lines.lines().map(number).collect()
}

#[test]
fn ten_kills_at_random_moments_change_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    let (whole, killed) = (dir.path().join("whole"), dir.path().join("killed"));
    let begin = Instant::now();
    let steps = 600;
    finish(&arguments(&scan, &whole, steps, &[]));
    let length = begin.elapsed();
    let mut random = 0x2545_f491_4f6c_dd1du64;
    let (mut kills, mut resumed) = (0, 0);
    while kills < 10 {
        let mode = if killed.join("checkpoint.safetensors").exists() { "--resume" } else { "--force" };
        resumed += usize::from(mode == "--resume");
        let mut child = started(&arguments(&scan, &killed, steps, &[mode, "--checkpoint-every", "0.02s"]));
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        std::thread::sleep(length.mul_f64((random % 1000) as f64 / 1000.0 * 0.3));
        child.kill().unwrap();
        let ended = child.wait().unwrap();
        if ended.success() {
            // The run finished before the kill: repeat from the start.
            same_results(&whole, &killed);
        } else {
            kills += 1;
        }
        assert!(!killed.join("volume.nii.gz").exists() || ended.success() || killed.join("metrics.jsonl").exists());
    }
    let mode = if killed.join("checkpoint.safetensors").exists() { "--resume" } else { "--force" };
    finish(&arguments(&scan, &killed, steps, &[mode]));
    same_results(&whole, &killed);
    assert!(resumed > 0, "no kill came after a checkpoint");
}

#[test]
fn a_signal_ends_the_step_keeps_a_checkpoint_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    let whole = dir.path().join("whole");
    let steps = 500;
    finish(&arguments(&scan, &whole, steps, &[]));
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        let run = dir.path().join(name);
        let child = started(&arguments(&scan, &run, steps, &["--checkpoint-every", "1h"]));
        wait_for(&run.join("metrics.jsonl"));
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert!(said.contains("interrupted") && said.contains("--resume"), "{said}");
        assert!(run.join("checkpoint.safetensors").exists() && !run.join("volume.nii.gz").exists());
        finish(&arguments(&scan, &run, steps, &["--resume"]));
        same_results(&whole, &run);
    }
}

/// Three methods with the mean of the last two volumes: a field with 140 steps and 20 records, then twice 300 passes.
const THREE: &str = r#"
type = "chain"
name = "three"
mean = 2

[[methods]]
extends = "fast"
encoder = { levels = 2, log2_table_size = 10 }
projector.samples = 16
training = { steps = 140, rays = 48, report_every = 7 }

[[methods]]
type = "fista"
prior = "total-variation"
subsets = 2
stop = { passes = 300 }

[[methods]]
type = "fista"
prior = "total-variation"
basis = { type = "cubic", samples = 12 }
subsets = 2
pull = 0.01
stop = { passes = 300 }
"#;

/// The same for passes over voxels, alone and in each method of a chain: no record is lost or repeated.
#[test]
fn interrupted_passes_lose_no_record() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    let three = dir.path().join("three.toml");
    std::fs::write(&three, THREE).unwrap();
    for (name, spec, passes, afters) in
        [("sirt", "sirt", Some("stop.passes=900"), &[50][..]), ("three", three.to_str().unwrap(), None, &[9, 40, 340])]
    {
        let arguments = |run: &Path, more: &[&str]| -> Vec<String> {
            let mut all = vec!["reconstruct", scan.to_str().unwrap(), "--spec", spec, "-o", run.to_str().unwrap()];
            all.extend(passes.iter().flat_map(|s| ["--set", *s]));
            [&all[..], more].concat().into_iter().map(str::to_owned).collect()
        };
        let whole = dir.path().join(format!("{name}-whole"));
        finish(&arguments(&whole, &[]));
        for &after in afters {
            let run = dir.path().join(format!("{name}-{after}"));
            let mut child = started(&arguments(&run, &["--checkpoint-every", "1h"]));
            let lines = || std::fs::read_to_string(run.join("metrics.jsonl")).map_or(0, |text| text.lines().count());
            while lines() < after && child.try_wait().unwrap().is_none() {
                std::thread::sleep(Duration::from_millis(1));
            }
            signal(&child, "INT");
            assert_eq!(child.wait().unwrap().code(), Some(130), "{name}");
            let before = lines();
            finish(&arguments(&run, &["--resume"]));
            let files = ["volume.nii.gz", "weights.safetensors"].into_iter().filter(|file| whole.join(file).exists());
            for file in files {
                let read = |run: &Path| std::fs::read(run.join(file)).unwrap();
                assert!(read(&whole) == read(&run), "{name} after {after} records: {file} differs");
            }
            assert_eq!(losses(&whole), losses(&run), "{name} after {after} records");
            // The run continued where it stopped: existing records were not made again.
            assert!(before >= after && lines() > before, "{before} records, then {}", lines());
            let record = |run: &Path| -> serde_json::Value {
                serde_json::from_str(&std::fs::read_to_string(run.join("record.json")).unwrap()).unwrap()
            };
            let [whole, run] = [&whole, &run].map(|run| record(run));
            for key in ["steps", "samples"] {
                assert_eq!(whole[key], run[key], "{name}: {key}");
            }
        }
    }
}

#[test]
fn another_run_s_checkpoint_and_none_are_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path());
    let run = dir.path().join("run");
    let resume = |steps: u64, more: &[&str]| {
        let all = arguments(&scan, &run, steps, &[&["--resume"], more].concat());
        refused(1, &all.iter().map(String::as_str).collect::<Vec<_>>())
    };
    assert!(resume(9, &[]).contains("no checkpoint"));
    let mut child = started(&arguments(&scan, &run, 100_000, &["--checkpoint-every", "0.001s"]));
    let file = run.join("checkpoint.safetensors");
    wait_for(&file);
    child.kill().unwrap();
    child.wait().unwrap();
    let said = resume(100_000, &["--seed", "1"]);
    assert!(said.contains("seed") && said.contains("found 1"), "{said}");
    let said = resume(100_000, &["--set", "optimizer.lr=0.5"]);
    assert!(said.contains("spec") && said.contains("lr = 0.5"), "{said}");
    let said = resume(9, &[]);
    assert!(said.contains("limits"), "{said}");
    // The same projections in another geometry.
    let place = scan.join("scan.toml");
    let original = std::fs::read_to_string(&place).unwrap();
    let moved = original.replace("\ndso = ", "\ndso = 1");
    assert_ne!(original, moved);
    std::fs::write(&place, moved).unwrap();
    let said = resume(100_000, &[]);
    assert!(said.contains("--resume: geometry"), "{said}");
    std::fs::write(&place, original).unwrap();
    // A damaged file.
    let mut raw = std::fs::read(&file).unwrap();
    let last = raw.len() - 3;
    raw[last] ^= 0x10;
    std::fs::write(&file, raw).unwrap();
    assert!(resume(100_000, &[]).contains("crc32"));
}
