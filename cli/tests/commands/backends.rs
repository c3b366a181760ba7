//! The wgpu backend in the command: listed, explained, and used for runs.

use crate::common::{done, refused, started, text};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn listed() -> Value {
    serde_json::from_str(&done(&["backends", "--json"])).unwrap()
}

/// Whether there is an adapter, including a software one; reports a missing one on stderr.
fn adapter(what: &str) -> bool {
    let there = !listed()["backends"][1]["adapters"].as_array().unwrap().is_empty();
    if !there {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    there
}

fn scan(dir: &Path, voxels: usize, views: usize) -> PathBuf {
    let (path, phantom, detector) = (dir.join("scan"), format!("phantom:head:{voxels}"), format!("{voxels}x{voxels}"));
    done(&["simulate", &phantom, "-o", &text(&path), "--views", &views.to_string(), "--detector", &detector]);
    path
}

fn reconstruct(scan: &Path, run: &Path, spec: &str, more: &[&str]) -> Value {
    let (scan, run) = (text(scan), text(run));
    let all = ["reconstruct", &scan, "--spec", spec, "-o", &run, "--reference", "truth", "--json"];
    serde_json::from_str(&done(&[&all[..], more].concat())).unwrap()
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
    let words = done(&["backends"]);
    assert!(words.contains("cpu") && words.contains("wgpu"), "{words}");
}

#[test]
fn explain_says_what_a_gpu_makes_of_a_spec() {
    if !adapter("explain") {
        return;
    }
    let said = done(&["explain", "ni-naf", "--backend", "wgpu"]);
    for words in ["wgpu", "encoder (hash-grid): fused, gradients by", "split: forward and backward"] {
        assert!(said.contains(words), "{said} lacks {words:?}");
    }
    if listed()["backends"][1]["adapters"][0]["subgroups"].is_array() {
        assert!(said.contains("summed in subgroups first"), "{said}");
    }
    let e = refused(2, &["explain", "ni-naf", "--backend", "cpu:1"]);
    assert!(e.contains("wgpu:N with the number of an adapter"), "{e}");
    let auto = done(&["explain", "ni-naf"]);
    assert!(auto.contains("chosen by --backend auto"), "{auto}");
    let e = refused(1, &["explain", "ni-naf", "--backend", "wgpu:99"]);
    assert!(e.contains("99") && e.contains("conefield backends"), "{e}");
    let e = refused(2, &["explain", "ni-naf", "--backend", "cuda"]);
    assert!(e.contains("auto, cpu, wgpu"), "{e}");
}

/// The published method, including its mask (after 250 steps), ends at the same PSNR.
#[test]
fn ni_naf_ends_where_the_cpu_ends() {
    if !adapter("a run of ni-naf") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path(), 64, 25);
    let run = |backend: &str| {
        let settings = ["--steps=320", "--set=training.rays=64", "--set=projector.samples=48"];
        let tables = ["--set=encoder.log2_table_size=14", "--backend", backend];
        let record = reconstruct(&scan, &dir.path().join(backend), "ni-naf", &[&settings[..], &tables].concat());
        assert!(record["backend"]["backend"].as_str().unwrap().starts_with(backend));
        let psnr = record["scores"]["psnr"].as_f64().unwrap();
        println!("{backend}: {psnr:.3} dB, {} parameters", record["parameters"]);
        (psnr, record["parameters"].as_u64().unwrap())
    };
    let ((cpu, parameters), (gpu, on_gpu)) = (run("cpu"), run("wgpu"));
    assert!((cpu - gpu).abs() < 0.1, "CPU {cpu} dB, GPU {gpu} dB");
    assert_eq!(parameters, on_gpu, "the mask keeps the same channels");
    assert!(cpu > 15.0, "{cpu} dB is no reconstruction");
}

/// Both specs of Gaussians, the published one with its prior and its density control, end at the same PSNR.
#[test]
fn gaussians_end_where_the_cpu_ends() {
    if !adapter("runs of Gaussians") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path(), 32, 20);
    let control = ["--set=density_control.every=20", "--set=density_control.from=0"];
    for (spec, more) in [("gaussians", &[][..]), ("gaussians-published", &control)] {
        let psnr = ["cpu", "wgpu"].map(|backend| {
            let fixed = ["--set=start.count=800", "--set=most=1200", "--steps=50", "--backend", backend];
            let record = reconstruct(&scan, &dir.path().join(spec).join(backend), spec, &[&fixed, more].concat());
            assert!(record["backend"]["backend"].as_str().unwrap().starts_with(backend));
            record["scores"]["psnr"].as_f64().unwrap()
        });
        println!("{spec}: {psnr:?} dB");
        assert!((psnr[0] - psnr[1]).abs() < 0.01, "{spec}: {psnr:?} dB");
        assert!(psnr[0] > 15.0, "{psnr:?} dB is no reconstruction");
    }
}

const TINY: [&str; 5] = [
    "--set=encoder.levels=2",
    "--set=encoder.log2_table_size=10",
    "--set=training.rays=48",
    "--set=projector.samples=16",
    "--set=field.width=8",
];

/// Starts the command, and kills it once there is a checkpoint in its folder.
#[cfg(unix)]
fn killed_at_a_checkpoint(run: &Path, args: &[&str]) {
    let mut child = started(args);
    let checkpoint = run.join("checkpoint.safetensors");
    while !checkpoint.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(checkpoint.exists(), "{args:?} was too fast to be killed");
}

/// Checkpoints and weights of finished runs can be exchanged between backends.
#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_on_the_other_backend() {
    if !adapter("an interrupted run") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let scan = scan(dir.path(), 16, 8);
    let few = ["--set=start.count=300", "--set=most=400", "--set=density_control.every=50"];
    for (spec, steps, settings) in [("ni-naf", 400, &TINY[..]), ("gaussians", 120, &few)] {
        let of = |name: &str| dir.path().join(spec).join(name);
        for (first, second) in [("wgpu", "cpu"), ("cpu", "wgpu")] {
            let (run, end) = (of(first), format!("--steps={steps}"));
            let command = [&[&*end, "--checkpoint-every=0.01s"][..], settings].concat();
            let fixed = ["reconstruct", &text(&scan), "--spec", spec, "-o", &text(&run), "--reference", "truth"];
            killed_at_a_checkpoint(&run, &[&fixed[..], &["--backend", first], &command].concat());
            let record = reconstruct(&scan, &run, spec, &[&command[..], &["--backend", second, "--resume"]].concat());
            assert_eq!(record["steps"], steps);
            assert!(record["backend"]["backend"].as_str().unwrap().starts_with(second));
        }
        let volumes = ["cpu", "wgpu"].map(|backend| {
            let path = text(&of(backend).with_extension("npy"));
            done(&["export", &text(&of("wgpu")), "-o", &path, "--backend", backend]);
            path
        });
        let scores: Value = serde_json::from_str(&done(&["evaluate", &volumes[0], &volumes[1], "--json"])).unwrap();
        // Relative to the volume's largest value: single precision.
        assert!(scores["psnr"].as_f64().unwrap() > 80.0, "{spec}: {scores}");
    }
}

/// Several adapters share a volume, of which one checkpoint is whole; here it is the same adapter twice.
#[cfg(unix)]
#[test]
fn several_adapters_share_a_volume() {
    if !adapter("a volume that adapters share") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&scan(dir.path(), 24, 12));
    let at = |name: &str| text(&dir.path().join(name));
    let run = |name: &str, backend: &str, more: &[&str]| {
        let (out, backend) = (at(name), format!("--backend={backend}"));
        let fixed = ["--set=stop.passes=40", "--checkpoint-every=0.01s"];
        done(&[&["reconstruct", &scan, "--spec", "fista-tv", "-o", &out, &backend][..], &fixed, more].concat())
    };
    let of_run = ["reconstruct", &scan, "--spec", "fista-tv", "-o", &at("run"), "--backend=wgpu:0,0"];
    killed_at_a_checkpoint(
        &dir.path().join("run"),
        &[&of_run[..], &["--set=stop.passes=40", "--checkpoint-every=0.01s"]].concat(),
    );
    run("cpu", "cpu", &[]);
    run("run", "wgpu:0,0,0", &["--resume"]);
    let volume = |name: &str| text(&dir.path().join(name).join("volume.nii.gz"));
    let scores = done(&["evaluate", &volume("run"), &volume("cpu"), "--json"]);
    let scores: Value = serde_json::from_str(&scores).unwrap();
    assert!(scores["psnr"].as_f64().unwrap() > 80.0, "{scores}");

    let refused = |args: &[&str]| refused(1, &[args, &["--backend", "wgpu:0,0"]].concat());
    let e = refused(&["explain", "fista-tv"]);
    assert!(e.contains("wgpu:0,0") && e.contains("one adapter"), "{e}");
    let e = refused(&["reconstruct", &scan, "--budget", "9s", "-o", &at("timed")]);
    assert!(e.contains("one adapter within a budget"), "{e}");
    for spec in ["fast", "gaussians"] {
        let e = refused(&["reconstruct", &scan, "--spec", spec, "-o", &at("field")]);
        assert!(e.contains("a field is trained by one"), "{e}");
    }
    assert!(!dir.path().join("field").join("spec.toml").exists(), "nothing was begun");
}
