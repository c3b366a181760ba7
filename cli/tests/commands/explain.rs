//! Output of `explain`.

use crate::common::{done, json, refused, text};
use tempfile::tempdir;

/// The words of the line that begins with `head`.
fn line(all: &str, head: &str) -> String {
    let found = all.lines().find(|l| l.split_whitespace().next() == Some(head));
    found.unwrap_or_else(|| panic!("no line {head} in\n{all}")).split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn stages_are_listed_with_widths_and_parameters() {
    let all = done(&["explain", "naf"]);
    assert!(all.starts_with("naf (shipped)\n"), "{all}");
    assert!(line(&all, "encoder").starts_with("encoder hash-grid 3 -> 32 "), "{all}");
    assert!(line(&all, "field").starts_with("field mlp 32 -> 1 4 225 16.5 KiB 4 128 dense "), "{all}");
    assert!(line(&all, "projector").starts_with("projector ray-march "), "{all}");
    assert!(line(&all, "method").starts_with("method neural-field "), "{all}");
    let all = done(&["explain", "ni-naf"]);
    assert!(line(&all, "callbacks.1").starts_with("callbacks.1 fft-mask "), "{all}");
    assert!(line(&all, "normalizers.0").starts_with("normalizers.0 layer-norm 20 -> 20 40 "), "{all}");
}

#[test]
fn sets_and_json() {
    let e = json(&["explain", "ni-naf", "--set", "encoder.levels=4", "--set", "normalizers=[]", "--json"]);
    assert_eq!(e["stages"].as_array().unwrap().len(), 2);
    assert_eq!(e["stages"][0]["output"], 8);
    assert_eq!(e["stages"][1]["input"], 8);
    let sum: u64 = e["stages"].as_array().unwrap().iter().map(|s| s["parameters"].as_u64().unwrap()).sum();
    assert_eq!(e["parameters"], sum);
    assert_eq!(e["model_bytes"], 16 * sum);
    assert!(e["compiled"]["backend"].as_str().unwrap().starts_with("cpu"));
}

/// A key that excludes another one replaces it in nested stages, too.
#[test]
fn the_uppermost_layer_decides_in_stages_of_stages() {
    let said = done(&["explain", "field-tv", "--set", "methods.0.optimizer.decay={ exponential = 0.1 }"]);
    assert!(said.contains("field-tv"), "{said}");
    let dir = tempdir().unwrap();
    let path = dir.path().join("mine.toml");
    std::fs::write(&path, "extends = \"field-tv\"\nname = \"mine\"\n[[methods]]\nextends = \"balanced\"\noptimizer.decay = { exponential = 0.1 }\n[[methods]]\nextends = \"fista-tv\"\n")
        .unwrap();
    done(&["explain", &text(&path)]);
}

#[test]
fn a_description_is_that_of_its_own_file() {
    let dir = tempdir().unwrap();
    let path = dir.path().join("mine.toml");
    std::fs::write(&path, "extends = \"fast\"\nname = \"mine\"\n").unwrap();
    let said = json(&["explain", &text(&path), "--json"]);
    assert_eq!((said["description"].as_str(), said["extends"][0].as_str()), (Some(""), Some("fast (shipped)")));
    assert_ne!(json(&["explain", "fast", "--json"])["description"], "");
}

#[test]
fn callbacks_that_an_encoder_cannot_serve_are_refused_with_file_and_line() {
    let dir = tempdir().unwrap();
    let path = text(&dir.path().join("two.toml"));
    let encoder = "[encoder]\ntype = \"concat\"\nencoders = [\"hash-grid\", \"dense-grid\"]\n";
    for (callback, remedy) in [("coarse-to-fine", "callbacks without coarse-to-fine"), ("fft-mask", "\"channel\"")] {
        std::fs::write(&path, format!("extends = \"fast\"\ncallbacks = [\"{callback}\"]\n{encoder}")).unwrap();
        let said = refused(1, &["explain", &path]);
        assert!(said.contains("two.toml:2") && said.contains("callbacks.0") && said.contains(remedy), "{said}");
    }
}

#[test]
fn a_scan_adds_its_memory() {
    let dir = tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "8x12"]);
    let e = json(&["explain", "naf", "--scan", &scan, "--json"]);
    let m = &e["scan"]["memory"];
    assert_eq!(m["scan"], 4 * 4 * 8 * 12);
    // Half of the 16 bytes per parameter are moments; the last good state takes 12 more.
    let all = e["model_bytes"].as_u64().unwrap();
    assert_eq!([&m["model"], &m["optimizer"]].map(|n| n.as_u64().unwrap()), [all / 2, all / 2 + 12 * all / 16]);
    // The volume is written while it is evaluated.
    assert_eq!(m["volume"], 0);
    assert_eq!(e["scan"]["samples"], 320);
    // Training that ends by held-out views also keeps the best parameters.
    let patient = "callbacks=['rollback', {type='patience', records=3}]";
    let e = json(&["explain", "naf", "--scan", &scan, "--set", patient, "--json"]);
    assert_eq!(e["scan"]["memory"]["optimizer"].as_u64().unwrap(), all / 2 + 16 * all / 16);
    let beside = e["beside"].as_array().unwrap();
    let said = beside.iter().find(|l| l["stage"] == "callbacks.1").unwrap()["what"].as_str().unwrap();
    assert!(said.contains("ends after 3 records"), "{said}");
    let all = done(&["explain", "naf", "--scan", &scan]);
    assert!(all.contains("this scan: 4 views of 8 x 12, volume 16 x 16 x 16, 320 samples"), "{all}");
}

#[test]
fn the_surround_of_the_volume_is_reported_and_removed() {
    let dir = tempdir().unwrap();
    let (scan, protocol) = (text(&dir.path().join("scan")), dir.path().join("protocol.toml"));
    // A detector with a quarter of the published width.
    let narrow = "dso = 5.0\ndsd = 7.0\ndetector = [32, 8]\nextent = { side = [4.0, 1.0] }\nangles = { even = { views = 12 } }\n";
    std::fs::write(&protocol, format!("{narrow}unit = {{ name = \"half side\", mm = 128.0 }}\n")).unwrap();
    done(&["simulate", "phantom:head:16", "-o", &scan, "--protocol", &text(&protocol)]);
    let set = "scene.surround.coarse.cells=8";
    for spec in ["fdk", "fast"] {
        assert!(!done(&["explain", spec, "--scan", &scan]).contains("surround"));
        let all = done(&["explain", spec, "--scan", &scan, "--set", set]);
        assert!(all.contains("surround: the object reaches the sides of 12 of 12 views: "), "{all}");
    }
    let run = |name: &str, sets: &[&str]| {
        let out = text(&dir.path().join(name));
        let record = json(&[&["reconstruct", &scan, "--spec", "os-sart", "-o", &out, "--json"], sets].concat());
        (
            record["memory"]["total"].as_u64().unwrap(),
            std::fs::read(dir.path().join(name).join("volume.nii.gz")).unwrap(),
        )
    };
    let (without, with) = (run("without", &[]), run("with", &["--set", set]));
    assert!(with.0 >= without.0 && with.1 != without.1);
    assert_eq!(with, run("again", &["--set", set]), "it is found the same again");
}

#[test]
fn carving_serves_methods_on_voxels() {
    let dir = tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "12", "--detector", "64x64"]);
    let set = "scene.support=\"carve\"";
    let all = done(&["explain", "sirt", "--scan", &scan, "--set", set]);
    assert!(all.contains("support: ") && all.contains("from the air in 12 of 12 views"), "{all}");
}

#[test]
fn methods_on_voxels_are_listed_without_a_field() {
    let all = done(&["explain", "fdk"]);
    assert!(all.starts_with("fdk (shipped)\n"), "{all}");
    assert_eq!(line(&all, "method"), "method fdk hann window to 1 of the highest frequency");
    for absent in ["encoder", "parameters", "backend", "projector"] {
        assert!(!all.contains(absent), "{absent:?} is in: {all}");
    }
    let all = done(&["explain", "os-sart", "--set", "subsets=4"]);
    assert_eq!(line(&all, "projector"), "projector joseph bilinear from plane to plane");
    assert!(line(&all, "method").starts_with("method sart 4 subsets, relaxation 1 times 0.9"), "{all}");
    for (spec, kind) in
        [("sart", "sart"), ("sirt", "sart"), ("cgls", "cgls"), ("asd-pocs", "asd-pocs"), ("fista-tv", "fista")]
    {
        assert!(line(&done(&["explain", spec]), "method").starts_with(&format!("method {kind} ")), "{spec}");
    }
    let said = refused(1, &["explain", "sart", "--set", "projector.type=ray-march"]);
    assert!(said.contains("no voxel-projector type \"ray-march\""), "{said}");
}

#[test]
fn the_plan_of_a_voxel_method_for_a_scan_is_reported() {
    let dir = tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "8x12"]);
    let with = |spec: &str, set: &str| done(&["explain", spec, "--scan", &scan, "--set", set]);
    let all = with("fdk", "cutoff=0.5");
    assert!(line(&all, "method").contains("hann window to 0.5"), "{all}");
    assert!(all.contains("this scan: 6 views of 8 x 12, volume 16 x 16 x 16\n"), "{all}");
    assert!(all.contains("full turn: each ray is measured twice and weighted by one half"), "{all}");
    assert!(all.contains("memory for this scan: ") && all.contains("volume 16.0 KiB"), "{all}");
    assert!(with("sart", "name=\"x\"").contains("  6 subsets of 1 view\n"));
    assert!(with("os-sart", "subsets=4").contains("  4 subsets of 1 or 2 views\n"));
    assert!(with("asd-pocs", "subsets=2").contains("  noise of "));
    let e = json(&["explain", "sart", "--scan", &scan, "--json"]);
    assert_eq!(e["stages"], serde_json::json!([]));
    assert_eq!(e["scan"]["lines"][0], "6 subsets of 1 view");
    assert!(e["compiled"].is_null() && e["scan"]["samples"].is_null());
    let m = &e["scan"]["memory"];
    assert_eq!(
        [&m["scan"], &m["volume"], &m["model"]].map(|n| n.as_u64().unwrap()),
        [4 * 6 * 8 * 12, 4 * 16 * 16 * 16, 0]
    );
}
