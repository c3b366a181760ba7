//! A killed or interrupted run resumes to the same bits.

use crate::common::{Folder, SCAN};
use std::time::Instant;

/// The mask removes channels during the run: its decision must be restored too.
fn line(run: &str, steps: u64, more: &str) -> String {
    let small = "--set projector.samples=16 --set callbacks.1.epoch=3 --set encoder.levels=2 \
                 --set encoder.log2_table_size=10 --set training.rays=48 --set training.report_every=7";
    format!("reconstruct scan --spec ni-naf -o {run} --steps {steps} {small} {more}")
}

/// Whether two finished runs are the same, to the bit.
fn same_results(d: &Folder, a: &str, b: &str) {
    assert!(d.at(a).join("volume.nii.gz").exists(), "{a}");
    for file in ["volume.nii.gz", "weights.safetensors"].into_iter().filter(|file| d.at(a).join(file).exists()) {
        assert!(d.bytes(format!("{a}/{file}")) == d.bytes(format!("{b}/{file}")), "{file} of {b} differs");
    }
    assert_eq!(losses(d, a), losses(d, b), "{b}");
    assert!(!d.at(b).join("checkpoint.safetensors").exists());
}

/// Steps and losses of all records.
fn losses(d: &Folder, run: &str) -> Vec<(u64, u64)> {
    let number = |line: &str| {
        let r: serde_json::Value = serde_json::from_str(line).unwrap();
        (r["step"].as_u64().unwrap(), r["loss"].as_f64().unwrap().to_bits())
    };
    d.text(format!("{run}/metrics.jsonl")).lines().map(number).collect()
}

#[test]
fn a_mask_that_has_changed_is_noticed() {
    let d = Folder::after(&[SCAN]);
    d.done("convert scan/truth.nii.gz mask.nii");
    let line = "reconstruct scan --spec sirt -o run --steps 1000000 --set 'scene.support={file=\"mask.nii\"}'";
    d.killed_at_a_checkpoint("run", &format!("{line} --checkpoint-every 0.01s"));
    let mut bytes = d.bytes("mask.nii");
    let last = bytes.len() - 2;
    bytes[last] ^= 1;
    d.put("mask.nii", &bytes);
    d.refused_with(1, &format!("{line} --resume"), &["--resume: file mask.nii"]);
}

#[test]
fn the_metrics_of_a_run_are_there_before_its_spec() {
    let d = Folder::after(&[SCAN]);
    d.done("reconstruct scan --spec sirt -o run --steps 1");
    // A folder with a spec and no metrics is taken for the user's.
    let made = |file: &str| d.at("run").join(file).metadata().unwrap().created().unwrap();
    assert!(made("metrics.jsonl") <= made("spec.toml"));
}

#[test]
fn ten_kills_at_random_moments_change_nothing() {
    let d = Folder::after(&[SCAN]);
    let (begin, steps) = (Instant::now(), 600);
    d.done(&line("whole", steps, ""));
    let length = begin.elapsed();
    let mode = || if d.has("killed/checkpoint.safetensors") { "--resume" } else { "--force" };
    let mut random = 0x2545_f491_4f6c_dd1du64;
    let (mut kills, mut resumed) = (0, 0);
    while kills < 10 {
        let mode = mode();
        resumed += usize::from(mode == "--resume");
        let mut child = d.started(&line("killed", steps, &format!("{mode} --checkpoint-every 0.02s")));
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        std::thread::sleep(length.mul_f64((random % 1000) as f64 / 1000.0 * 0.3));
        child.kill().unwrap();
        let ended = child.wait().unwrap();
        if ended.success() {
            // The run finished before the kill: repeat from the start.
            same_results(&d, "whole", "killed");
        } else {
            kills += 1;
        }
        assert!(!d.has("killed/volume.nii.gz") || ended.success() || d.has("killed/metrics.jsonl"));
    }
    d.done(&line("killed", steps, mode()));
    same_results(&d, "whole", "killed");
    assert!(resumed > 0, "no kill came after a checkpoint");
}

#[test]
fn a_signal_ends_the_step_keeps_a_checkpoint_and_says_so() {
    let d = Folder::after(&[SCAN]);
    let steps = 500;
    d.done(&line("whole", steps, ""));
    for name in ["INT", "TERM"] {
        let begun = || d.filled(&format!("{name}/metrics.jsonl"));
        let said = d.interrupted(&line(name, steps, "--checkpoint-every 1h --threads 2"), name, &begun);
        assert!(said.contains("interrupted") && said.contains("--resume"), "{said}");
        let run = d.at(name);
        assert!(run.join("checkpoint.safetensors").exists() && !run.join("volume.nii.gz").exists());
        d.done(&line(name, steps, "--resume --threads 1"));
        same_results(&d, "whole", name);
        let record = d.read(format!("{name}/record.json"));
        let [before, after] = [0, 1].map(|i| &record["backends"][i]);
        assert!(before["from_step"] == 0 && before["backend"].as_str().unwrap().ends_with(" 2 threads"), "{record}");
        assert!(after["from_step"].as_u64() > Some(0) && after["backend"] == record["backend"]["backend"], "{record}");
    }
    assert!(d.read("whole/record.json").get("backends").is_none());
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

/// The same in the first and the last method of a chain: no record is lost or repeated.
#[test]
fn interrupted_methods_lose_no_record() {
    let d = Folder::after(&[SCAN]);
    d.put("three.toml", THREE);
    let line = |run: &str, more: &str| format!("reconstruct scan --spec three.toml -o {run} {more}");
    d.done(&line("whole", ""));
    for (run, after) in [("first", 9), ("last", 340)] {
        let metrics = d.at(run).join("metrics.jsonl");
        let lines = || std::fs::read_to_string(&metrics).map_or(0, |text| text.lines().count());
        d.interrupted(&line(run, "--checkpoint-every 1h"), "INT", &|| lines() >= after);
        let before = lines();
        d.done(&line(run, "--resume"));
        same_results(&d, "whole", run);
        // The run continued where it stopped: existing records were not made again.
        assert!(before >= after && lines() > before, "{before} records, then {}", lines());
        let records = ["whole", run].map(|run| d.read(format!("{run}/record.json")));
        for key in ["steps", "samples"] {
            assert_eq!(records[0][key], records[1][key], "{run}: {key}");
        }
    }
}

#[test]
fn another_run_s_checkpoint_and_none_are_refused_in_words() {
    let d = Folder::after(&[SCAN]);
    let resume = |steps: u64, more: &str| d.refused(1, &line("run", steps, &format!("--resume {more}")));
    assert!(resume(9, "").contains("no checkpoint"));
    d.killed_at_a_checkpoint("run", &line("run", 100_000, "--checkpoint-every 0.001s"));
    for (steps, more, words) in [
        (100_000, "--seed 1", "--resume: seed: found 1"),
        (100_000, "--set optimizer.lr=0.5", "lr = 0.5"),
        (9, "", "--resume: limits"),
    ] {
        let said = resume(steps, more);
        assert!(said.contains(words), "{said}");
    }
    // The same projections in another geometry.
    let original = d.text("scan/scan.toml");
    let moved = original.replace("\ndso = ", "\ndso = 1");
    assert_ne!(original, moved);
    d.put("scan/scan.toml", moved);
    let said = resume(100_000, "");
    assert!(said.contains("--resume: geometry"), "{said}");
}
