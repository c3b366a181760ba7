//! `reconstruct --budget`: the plan, refusals, and the record.

use crate::common::{json, refused, signal, simulated, started, text, wait_for};
use serde_json::Value;
use std::fs;
use std::path::PathBuf;
use tempfile::TempDir;

fn scan() -> (TempDir, PathBuf) {
    simulated(16, 12)
}

#[test]
fn a_plan_names_every_part_and_the_record_holds_them_against_it() {
    let (dir, scan) = scan();
    let scan = text(&scan);
    for spec in ["fast", "sirt", "fdk", "field-tv"] {
        let run = dir.path().join(spec);
        let all = ["reconstruct", &scan, "--spec", spec, "-o", &text(&run), "--reference", "truth", "--json"];
        let small = ["encoder.log2_table_size=10", "training.rays=64", "projector.samples=16", "priors.0.blocks=4"];
        // In a chain the field's settings are one level deeper.
        let deeper: Vec<String> = small.iter().map(|s| format!("methods.0.{s}")).collect();
        let small: Vec<&str> = match spec {
            "fast" => small.to_vec(),
            "field-tv" => deeper.iter().map(String::as_str).collect(),
            _ => vec![],
        };
        let small: Vec<&str> = small.into_iter().flat_map(|s| ["--set", s]).collect();
        let record = json(&[&all[..], &small, &["--budget", "3s"]].concat());
        let number = |key: &str| record[key].as_f64().unwrap_or_else(|| panic!("{spec}: {key}"));
        let parts = ["load_s", "prepare_s", "train_s", "export_s", "picture_s", "score_s"].map(number);
        let total = number("total_s");
        assert!(parts.iter().all(|p| *p >= 0.0) && parts.iter().sum::<f64>() <= total + 1e-3, "{parts:?} of {total}");
        assert_eq!((number("budget_s"), &record["limits"]["seconds"]), (3.0, &Value::Null));
        // Also methods without a field say where they ran.
        assert!(record["backend"]["backend"].as_str().unwrap().starts_with("cpu, "), "{spec}: {}", record["backend"]);
        assert_eq!(record["processes"], 1, "{spec}");
        let plan = &record["plan"];
        assert!(plan["point"].is_null() && plan["why"].as_str().unwrap().contains("requested"), "{plan}");
        assert!(plan["train_s"].as_f64().unwrap() > 0.0 && plan["steps"].as_u64().unwrap() > 0, "{plan}");
        assert!(plan["expected"]["step_s"].as_f64().unwrap() > 0.0, "{plan}");
        let then = plan["expected"]["then_s"].as_f64().unwrap();
        assert_eq!(then > 0.0, spec == "field-tv", "{spec}: {then}");
        if spec == "field-tv" {
            // Five passes more than the minimum take longer than the reporting interval of a pass.
            let least = plan["expected"]["then_least_s"].as_f64().unwrap();
            assert!(then - least > 1e-4, "{then} after {least}");
        }
        // A quiet machine stays within a tenth; tests run in parallel.
        assert!(total < 4.0, "{spec}: {total}");
        let steps = record["steps"].as_u64().unwrap();
        // FDK makes one pass, whatever the time.
        assert!(if spec == "fdk" { steps == 1 } else { steps > 1 }, "{spec}: {steps}");
    }
}

/// More steps than the spec of Gaussians allows would fit the noise.
#[test]
fn gaussians_end_after_their_own_steps_with_time_left() {
    let (dir, scan) = scan();
    let small = ["start.count=200", "most=400", "training.steps=30"].into_iter().flat_map(|s| ["--set", s]);
    let all = ["reconstruct", &text(&scan), "--spec", "gaussians", "-o", &text(&dir.path().join("run")), "--json"];
    let record = json(&[&all[..], &small.collect::<Vec<_>>(), &["--budget", "20s"]].concat());
    assert_eq!((&record["steps"], &record["plan"]["steps"]), (&Value::from(30), &Value::from(30)), "{record}");
    assert!(record["total_s"].as_f64().unwrap() < 15.0, "{record}");
}

/// Gaussians that start from the previous method's volume cannot be measured from an empty one.
#[test]
fn a_chain_that_ends_with_gaussians_has_a_plan() {
    let (dir, scan) = scan();
    let (scan, out) = (text(&scan), text(&dir.path().join("run")));
    let small = ["methods.3.start.count=200", "methods.3.most=400", "methods.3.training.steps=30"];
    let all = ["reconstruct", &scan, "--spec", "smooth-gaussians", "-o", &out, "--reference", "truth", "--json"];
    let small: Vec<&str> = small.into_iter().flat_map(|s| ["--set", s]).collect();
    let record = json(&[&all[..], &small, &["--budget", "20s"]].concat());
    assert!(record["plan"]["expected"]["then_s"].as_f64().unwrap() > 0.0, "{record}");
    // The three methods before make a few more passes.
    assert!((30..60).contains(&record["steps"].as_u64().unwrap()), "{record}");
    assert!(record["total_s"].as_f64().unwrap() < 20.0, "{record}");
}

#[test]
fn without_a_spec_the_best_of_the_shipped_front_is_taken() {
    let (dir, scan) = scan();
    let run = text(&dir.path().join("run"));
    let record = json(&["reconstruct", &text(&scan), "-o", &run, "--budget", "5s", "--json"]);
    let plan = &record["plan"];
    assert!(plan["point"].is_string() && plan["why"].as_str().unwrap().contains("front"), "{plan}");
    // The run can be repeated from its spec.
    assert!(dir.path().join("run/spec.toml").is_file());
}

#[test]
fn a_budget_that_is_too_short_is_refused_with_what_would_do() {
    let (dir, scan) = scan();
    let out = dir.path().join("run");
    let (scan, path) = (text(&scan), text(&out));
    for more in [&["--spec", "fast"][..], &["--spec", "sart"], &[]] {
        let all = [&["reconstruct", &scan, "-o", &path, "--budget", "1e-4s"], more].concat();
        let said = refused(1, &all);
        assert!(said.starts_with("error: the budget: time: found 0.00 s, expected at least "), "{said}");
        assert!(said.contains("to write and compare") && !out.exists(), "{said}");
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_with_what_it_chose() {
    let (dir, scan) = scan();
    let (front, out) = (dir.path().join("front.toml"), dir.path().join("run"));
    fs::write(
        &front,
        "made = \"test\"\n[[scans]]\nname = \"a\"\nviews = 12\ndetector = [16, 16]\nvolume = [16, 16, 16]\n\
         [[points]]\nname = \"p\"\nkind = \"voxels\"\nspec = \"sirt\"\nsets = [\"relaxation=1.5\"]\nbudget_s = 1.0\n\
         [[points.runs]]\nsteps = 10\ntrain_s = 0.1\ntotal_s = 0.2\npsnr = 20.0\n",
    )
    .unwrap();
    let (scan, front, path) = (text(&scan), text(&front), text(&out));
    let line = ["reconstruct", &scan, "-o", &path, "--budget", "6s", "--front", &front];
    let child = started(&line);
    wait_for(&out.join("metrics.jsonl"));
    signal(&child, "INT");
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8(output.stderr).unwrap());
    let said = refused(1, &[&line[..5], &["7s", "--resume"]].concat());
    assert!(said.contains("--resume: budget"), "{said}");
    let unplanned = ["reconstruct", &scan, "-o", &path, "--spec", &text(&out.join("spec.toml")), "--resume"];
    let said = refused(1, &unplanned);
    assert!(said.contains("--resume: budget"), "{said}");
    let record = json(&[&line[..6], &["--resume", "--json"]].concat());
    let spec = fs::read_to_string(out.join("spec.toml")).unwrap();
    assert!(spec.contains("type = \"sart\"") && spec.contains("relaxation = 1.5"), "{spec}");
    assert!(record["steps"].as_u64().unwrap() > 1 && !out.join("checkpoint.safetensors").exists());
}
