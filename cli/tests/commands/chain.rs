//! From a phantom to scores, on a scan that is small enough for every test run.

use crate::common::{Folder, SCAN, number};
use serde_json::{Value, json};

/// Settings so small that a few steps take no time.
const SMALL: &str = "--set encoder.levels=3 --set encoder.log2_table_size=10 --set projector.samples=24 --steps 12";

#[test]
fn a_scan_becomes_a_volume_and_its_scores() {
    let d = Folder::after(&[SCAN]);
    // The truth is that of the scan, whatever is called so here.
    d.put("truth", "mine");
    let asked = "--reference truth --hold-out every:4 --seed 5";
    let record = d.json(&format!("reconstruct scan --spec naf -o run {SMALL} {asked} --json"));
    assert_eq!((&record["steps"], &record["seed"]), (&json!(12), &json!(5)));
    assert_eq!(record["held_out_views"].as_array().unwrap().len(), 2);
    assert!(number(&record["held_out"]).is_finite());
    let psnr = number(&record["scores"]["psnr"]);
    assert!(psnr.is_finite());
    for file in ["volume.nii.gz", "metrics.jsonl", "spec.toml", "record.json", "slices.png", "weights.safetensors"] {
        assert!(d.at("run").join(file).is_file(), "{file}");
    }
    assert_eq!(d.read("run/record.json"), record);
    let last: Value = serde_json::from_str(d.text("run/metrics.jsonl").lines().last().expect("a record")).unwrap();
    assert_eq!(last["step"], 12);

    // `evaluate` finds the same, up to NIfTI's precision.
    let info = d.json("info scan --json");
    assert_eq!((&info["truth"], &info["views"]), (&json!(true), &json!(8)));
    d.done("convert scan/truth.nii.gz truth.nii.gz");
    let scores = d.json("evaluate run/volume.nii.gz truth.nii.gz --json --png e.png");
    assert!((number(&scores["psnr"]) - psnr).abs() < 1e-6);
    for key in ["ssim_2d", "ssim_3d", "ssim_skimage", "rmse"] {
        assert!(scores[key].is_number(), "{key}: {scores}");
    }
    assert!(d.has("e.png"));
    assert!(d.done("evaluate run/volume.nii.gz truth.nii.gz").starts_with("psnr "));
    assert_eq!(d.json("info run/volume.nii.gz --json")["kind"], "volume");
    let weights = d.json("info run/weights.safetensors --json");
    assert!(weights["notes"]["spec"].as_str().unwrap().contains("hash-grid"));
}

#[test]
fn the_written_spec_repeats_the_run_to_the_bit_on_any_number_of_threads() {
    let d = Folder::after(&[SCAN]);
    let record = d.json(&format!("reconstruct scan --spec ni-naf -o first {SMALL} --seed 3 --threads 1 --json"));
    assert_eq!(record["threads"], 1);
    d.done("reconstruct scan --spec first/spec.toml -o second --steps 12 --seed 3 --threads 2");
    for file in ["weights.safetensors", "spec.toml"] {
        assert!(d.bytes(format!("first/{file}")) == d.bytes(format!("second/{file}")), "{file}");
    }
}

/// One method starts from the volume of another and is pulled towards it.
#[test]
fn a_volume_starts_another_run() {
    let d = Folder::after(&[SCAN, "reconstruct scan --spec sirt -o first --steps 1"]);
    let start = "--init first/volume.nii.gz --set pull=1e6";
    let record = d.json(&format!("reconstruct scan --spec fista-tv -o held --steps 1 {start} --json"));
    assert_eq!(record["init"], "first/volume.nii.gz");
    let scores = d.json("evaluate held/volume.nii.gz first/volume.nii.gz --json");
    assert!(number(&scores["psnr"]) > 40.0, "{scores}");
    let spec = d.text("held/spec.toml");
    assert!(spec.contains("start = "), "{spec}");
    assert!(d.refused(1, "reconstruct scan --spec fista-tv -o alone --set pull=0.1").contains("pull"));
}

#[test]
fn pretrained_weights_start_another_run() {
    let d = Folder::after(&[SCAN]);
    let made = d.json(&format!("pretrain phantom:abdomen:16 --spec fast -o w.safetensors {SMALL} --json"));
    let names: Vec<&str> = made["tensors"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert!(names.iter().any(|n| n.starts_with("field.")), "{names:?}");
    assert!(names.iter().all(|n| !n.starts_with("encoder.")), "{names:?}");
    let record = d.json(&format!("reconstruct scan --spec fast -o run {SMALL} --init w.safetensors --json"));
    assert_eq!(record["init"], "w.safetensors");
    let spec = d.text("run/spec.toml");
    assert!(spec.contains("type = \"mci\""), "{spec}");
    // A field of another shape cannot start from them.
    let other = "--init w.safetensors --set field.width=48 --set encoder.levels=3 --steps 1";
    d.refused_with(1, &format!("reconstruct scan --spec fast -o other {other}"), &["field.", "shape"]);
}

#[test]
fn simulation_takes_noise_offset_and_angles() {
    let d = Folder::new();
    d.put("angles.txt", "# degrees\n0\n45.5\n-90\n");
    let made = |more: &str| {
        d.done(&format!("simulate phantom:head:32 -o scan --detector 12x20 --downsample 2 --force {more}"));
        d.json("info scan --json")
    };
    let listed = made("--angles angles.txt --offset -3,4");
    assert_eq!((&listed["views"], &listed["volume"]["shape"]), (&json!(3), &json!([16, 16, 16])));
    let noisy = "--angles -90:180 --views 5 --noise poisson:1e3";
    let [arc, again, other] = ["", "--seed 0", "--seed 1"].map(|seed| made(&format!("{noisy} {seed}")));
    assert_eq!(arc["views"], 5);
    assert_eq!(arc["line_integrals"], again["line_integrals"], "the seed decides");
    assert_ne!(arc["line_integrals"], other["line_integrals"]);
    let protocol = "dso = 5.0\ndsd = 7.0\ndetector = [12, 20]\nextent = { side = [4.0, 4.0] }\nnoise = \"poisson:1e3\"\nseed = 1\n\
                    angles = { even = { views = 5, start_deg = -90.0, arc_deg = 180.0 } }\nunit = { name = \"half\", mm = 300.0 }\n";
    d.put("p.toml", protocol);
    let seed = |more: &str| {
        d.json(&format!("simulate phantom:head:16 -o scan --protocol p.toml --force --json {more}"))["seed"].clone()
    };
    let seeds = (seed(""), seed("--seed 0"));
    assert_eq!(seeds, (1.into(), 0.into()), "the protocol's seed, unless another is asked for");
}

#[test]
fn the_demonstration_compares_three_ways() {
    let d = Folder::new();
    let found = d.json("demo -o demo --seconds 1s --size 24 --views 8 --json");
    let results = found["results"].as_array().unwrap();
    assert_eq!(results.len(), 3);
    assert!(results.iter().all(|r| number(&r["scores"]["psnr"]).is_finite()));
    assert!(d.at("demo/compare.png").is_file());
    assert!(!d.has("demo/fast/checkpoint.safetensors"));
    assert_eq!(d.read("demo/fast/record.json")["init"], "demo/fast.safetensors");
    // Both fields make the same number of steps.
    assert_eq!(results[1]["steps"], results[2]["steps"]);
    let said = d.done("report demo -o page.html");
    assert!(said.contains("3 runs, 4 volumes"), "{said}");
}
