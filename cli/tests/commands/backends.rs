//! The wgpu backend in the command: listed, explained, and used for runs.

use crate::common::{Folder, SCAN, number};
use conefield_evaluation::report::text::bytes;
use serde_json::Value;

fn listed() -> Value {
    Folder::new().json("backends --json")
}

/// Whether there is an adapter, including a software one; reports a missing one on stderr.
fn adapter(what: &str) -> bool {
    let there = !listed()["backends"][1]["adapters"].as_array().unwrap().is_empty();
    if !there {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    there
}

/// Reconstructs `scan` on a backend; returns the record.
fn reconstruct(d: &Folder, run: &str, spec: &str, backend: &str, more: &str) -> Value {
    let line = format!("reconstruct scan --spec {spec} -o {run} --backend {backend} --reference truth --json {more}");
    let record = d.json(&line);
    assert!(record["backend"]["backend"].as_str().unwrap().starts_with(backend), "{record}");
    record
}

#[test]
fn adapters_are_listed_with_their_limits() {
    let listed = listed();
    assert_eq!(listed["backends"][0]["name"], "cpu");
    assert!(listed["backends"][0]["pass_s"].as_f64().is_some_and(|s| s > 0.0 && s < 60.0), "{listed}");
    for (i, a) in listed["backends"][1]["adapters"].as_array().unwrap().iter().enumerate() {
        assert_eq!(a["index"], i);
        assert!(a["binding_bytes"].as_u64().unwrap() >= 1 << 20, "{a}");
        assert!(a["name"].is_string() && a["atomics"].is_string());
    }
    let words = Folder::new().done("backends");
    assert!(words.contains("cpu") && words.contains("wgpu"), "{words}");
}

#[test]
fn explain_says_what_a_gpu_makes_of_a_spec() {
    if !adapter("explain") {
        return;
    }
    let d = Folder::new();
    let said = d.done("explain ni-naf --backend wgpu");
    for words in ["wgpu", "encoder (hash-grid): fused, gradients by", "split: forward and backward"] {
        assert!(said.contains(words), "{said} lacks {words:?}");
    }
    if listed()["backends"][1]["adapters"][0]["subgroups"].is_array() {
        assert!(said.contains("summed in subgroups first"), "{said}");
    }
    assert!(d.done("explain fdk --backend wgpu").contains("\nbackend: wgpu, "));
    let auto = d.done("explain ni-naf");
    assert!(auto.contains("chosen by --backend auto"), "{auto}");
    for (code, backend, words) in [
        (2, "cpu:1", "wgpu:N with the number of an adapter"),
        (2, "cuda", "auto, cpu, wgpu"),
        (1, "wgpu:99", "conefield backends"),
        (1, "wgpu:0,0", "one adapter"),
    ] {
        d.refused_with(code, &format!("explain ni-naf --backend {backend}"), &[words]);
    }
}

#[test]
fn the_log_counts_the_bytes_of_the_record() {
    if !adapter("bytes") {
        return;
    }
    let d = Folder::after(&[SCAN]);
    let line = "reconstruct scan --spec fast --steps 2 --set training.rays=16 -o run --backend wgpu";
    let said = String::from_utf8(d.loud(line).output().unwrap().stderr).unwrap();
    let moved = &d.read("run/record.json")["moved"];
    let [to, from] = ["to_device", "from_device"].map(|way| bytes(moved[way].as_u64().unwrap()));
    assert!(said.contains(&format!("moved {to} to the device and {from} from it")), "{moved}: {said}");
}

/// Both specs of Gaussians, the published one with its prior and its density control, end at the same PSNR.
#[test]
fn gaussians_end_where_the_cpu_ends() {
    if !adapter("runs of Gaussians") {
        return;
    }
    let d = Folder::after(&["simulate phantom:head:32 -o scan --views 20 --detector 32x32"]);
    for (spec, more) in
        [("gaussians", ""), ("gaussians-published", "--set=density_control.every=20 --set=density_control.from=0")]
    {
        let psnr = ["cpu", "wgpu"].map(|backend| {
            let fixed = format!("--set=start.count=800 --set=most=1200 --steps=50 {more}");
            number(&reconstruct(&d, &format!("{spec}-{backend}"), spec, backend, &fixed)["scores"]["psnr"])
        });
        println!("{spec}: {psnr:?} dB");
        assert!((psnr[0] - psnr[1]).abs() < 0.01 && psnr[0] > 15.0, "{spec}: {psnr:?} dB");
    }
}

const TINY: &str = "--set=encoder.levels=2 --set=encoder.log2_table_size=10 --set=training.rays=48 \
                    --set=projector.samples=16 --set=field.width=8";

/// Checkpoints and weights of finished runs can be exchanged between backends.
#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_on_the_other_backend() {
    if !adapter("an interrupted run") {
        return;
    }
    let d = Folder::after(&[SCAN]);
    let few = "--set=start.count=300 --set=most=400 --set=density_control.every=50";
    for (spec, steps, settings) in [("ni-naf", 400, TINY), ("gaussians", 120, few)] {
        let of = |name: &str| format!("{spec}-{name}");
        for (first, second) in [("wgpu", "cpu"), ("cpu", "wgpu")] {
            let (run, more) = (of(first), format!("--steps={steps} --checkpoint-every=0.01s {settings}"));
            let begun = format!("reconstruct scan --spec {spec} -o {run} --reference truth --backend {first} {more}");
            d.killed_at_a_checkpoint(&run, &begun);
            let record = reconstruct(&d, &run, spec, second, &format!("{more} --resume"));
            assert_eq!(record["steps"], steps);
            let named = [0, 1].map(|i| record["backends"][i]["backend"].as_str().unwrap().split(',').next().unwrap());
            assert_eq!(named, [first, second]);
        }
        for backend in ["cpu", "wgpu"] {
            d.done(&format!("export {} -o {backend}.npy --backend {backend} --force", of("wgpu")));
        }
        // Relative to the volume's largest value: single precision.
        let scores = d.json("evaluate cpu.npy wgpu.npy --json");
        assert!(number(&scores["psnr"]) > 80.0, "{spec}: {scores}");
    }
}

/// Several adapters share a volume, of which one checkpoint is whole; here it is the same adapter twice.
#[cfg(unix)]
#[test]
fn several_adapters_share_a_volume() {
    if !adapter("a volume that adapters share") {
        return;
    }
    let d = Folder::after(&["simulate phantom:head:24 -o scan --views 12 --detector 24x24"]);
    let run = |name: &str, backend: &str| {
        let fixed = "--set=stop.passes=40 --checkpoint-every=0.01s";
        format!("reconstruct scan --spec fista-tv -o {name} --backend={backend} {fixed}")
    };
    d.killed_at_a_checkpoint("run", &run("run", "wgpu:0,0"));
    d.done(&run("cpu", "cpu"));
    d.done(&format!("{} --resume", run("run", "wgpu:0,0,0")));
    let scores = d.json("evaluate run/volume.nii.gz cpu/volume.nii.gz --json");
    assert!(number(&scores["psnr"]) > 80.0, "{scores}");

    d.refuses(
        "other/spec.toml",
        &[
            ("reconstruct scan --backend wgpu:0,0 --budget 9s -o other", "one adapter within a budget"),
            ("reconstruct scan --backend wgpu:0,0 --spec fast -o other", "a field is trained by one"),
            ("reconstruct scan --backend wgpu:0,0 --spec gaussians -o other", "a field is trained by one"),
        ],
    );
}
