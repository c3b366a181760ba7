//! `reconstruct --budget`: the plan, refusals, and the record.

use crate::common::{Folder, number};
use serde_json::Value;

const SCAN: &str = "simulate phantom:head:16 -o scan --views 12 --detector 16x16";

#[test]
fn a_plan_names_every_part_and_the_record_holds_them_against_it() {
    let d = Folder::after(&[SCAN]);
    for spec in ["fast", "sirt", "fdk", "field-tv"] {
        let small = ["encoder.log2_table_size=10", "training.rays=64", "projector.samples=16", "priors.0.blocks=4"];
        // In a chain the field's settings are one level deeper.
        let small: String = match spec {
            "fast" => small.iter().map(|s| format!(" --set {s}")).collect(),
            "field-tv" => small.iter().map(|s| format!(" --set methods.0.{s}")).collect(),
            _ => String::new(),
        };
        let asked = format!("--reference truth --budget 3s --json{small}");
        let record = d.json(&format!("reconstruct scan --spec {spec} -o {spec} {asked}"));
        let parts = ["load_s", "prepare_s", "train_s", "export_s", "picture_s", "score_s"].map(|k| number(&record[k]));
        let total = number(&record["total_s"]);
        assert!(parts.iter().all(|p| *p >= 0.0) && parts.iter().sum::<f64>() <= total + 1e-3, "{parts:?} of {total}");
        assert_eq!((&record["budget_s"], &record["limits"]["seconds"]), (&Value::from(3.0), &Value::Null));
        // Also methods without a field say where they ran.
        assert!(record["backend"]["backend"].as_str().unwrap().starts_with("cpu, "), "{spec}: {}", record["backend"]);
        assert_eq!(record["processes"], 1, "{spec}");
        let plan = &record["plan"];
        assert!(plan["point"].is_null() && plan["why"].as_str().unwrap().contains("requested"), "{plan}");
        assert!(number(&plan["train_s"]) > 0.0 && number(&plan["steps"]) > 0.0, "{plan}");
        assert!(number(&plan["expected"]["step_s"]) > 0.0, "{plan}");
        let then = number(&plan["expected"]["then_s"]);
        assert_eq!(then > 0.0, spec == "field-tv", "{spec}: {then}");
        if spec == "field-tv" {
            // Five passes more than the minimum take longer than the reporting interval of a pass.
            let least = number(&plan["expected"]["then_least_s"]);
            assert!(then - least > 1e-4, "{then} after {least}");
        }
        // A quiet machine stays within a tenth; tests run in parallel.
        assert!(total < 4.0, "{spec}: {total}");
        let steps = record["steps"].as_u64().unwrap();
        // FDK makes one pass, whatever the time.
        assert!(if spec == "fdk" { steps == 1 } else { steps > 1 }, "{spec}: {steps}");
    }
}

/// More steps than the spec of Gaussians allows would fit the noise. In a chain they start from the previous method's volume,
/// and cannot be measured from an empty one.
#[test]
fn gaussians_end_after_their_own_steps_with_time_left() {
    let d = Folder::after(&[SCAN]);
    for (spec, at, steps) in [("gaussians", "", 30..=30), ("smooth-gaussians", "methods.3.", 30..=59)] {
        let small = ["start.count=200", "most=400", "training.steps=30"].map(|s| format!(" --set {at}{s}")).concat();
        let asked = format!("--reference truth --budget 20s --json{small}");
        let record = d.json(&format!("reconstruct scan --spec {spec} -o {spec} {asked}"));
        // The three methods before make a few more passes.
        assert!(steps.contains(&record["steps"].as_u64().unwrap()), "{record}");
        let plan = &record["plan"];
        let (planned, within) = match at {
            "" => (plan["steps"] == 30, 15.0),
            _ => (number(&plan["expected"]["then_s"]) > 0.0, 20.0),
        };
        assert!(planned && number(&record["total_s"]) < within, "{record}");
    }
}

#[test]
fn without_a_spec_the_best_of_the_shipped_front_is_taken() {
    let d = Folder::after(&[SCAN]);
    let record = d.json("reconstruct scan -o run --budget 5s --json");
    let plan = &record["plan"];
    assert!(plan["point"].is_string() && plan["why"].as_str().unwrap().contains("front"), "{plan}");
    // The run can be repeated from its spec.
    assert!(d.has("run/spec.toml"));
}

#[test]
fn a_budget_that_is_too_short_is_refused_with_what_would_do() {
    let d = Folder::after(&[SCAN]);
    for spec in ["--spec fast", "--spec sart", ""] {
        let said = d.refused(1, &format!("reconstruct scan -o run --budget 1e-4s {spec}"));
        assert!(said.starts_with("error: the budget: time: found 0.00 s, expected at least "), "{said}");
        assert!(said.contains("to write and compare") && !d.has("run"), "{said}");
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_with_what_it_chose() {
    let d = Folder::after(&[SCAN]);
    d.put(
        "front.toml",
        "made = \"test\"\n[[scans]]\nname = \"a\"\nviews = 12\ndetector = [16, 16]\nvolume = [16, 16, 16]\n\
         [[points]]\nname = \"p\"\nkind = \"voxels\"\nspec = \"sirt\"\nsets = [\"relaxation=1.5\"]\nbudget_s = 1.0\n\
         [[points.runs]]\nsteps = 10\ntrain_s = 0.1\ntotal_s = 0.2\npsnr = 20.0\n",
    );
    let begun = || d.filled("run/metrics.jsonl");
    d.interrupted("reconstruct scan -o run --budget 6s --front front.toml", "INT", &begun);
    for (other, want) in
        [("--budget 7s", "budget"), ("--spec run/spec.toml", "budget"), ("--budget 6s --set relaxation=1.2", "spec")]
    {
        let said = d.refused(1, &format!("reconstruct scan -o run --resume {other}"));
        assert!(said.contains(&format!("--resume: {want}")), "{said}");
    }
    let record = d.json("reconstruct scan -o run --budget 6s --resume --json");
    let spec = d.text("run/spec.toml");
    assert!(spec.contains("type = \"sart\"") && spec.contains("relaxation = 1.5"), "{spec}");
    assert!(record["steps"].as_u64().unwrap() > 1 && !d.has("run/checkpoint.safetensors"));
    let (point, why) = (&record["plan"]["point"], record["plan"]["why"].as_str().unwrap());
    assert!(*point == "p" && why.starts_with("the best of the front"), "{why}");
}
