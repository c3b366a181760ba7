//! Output of `explain`.

use crate::common::Folder;
use serde_json::json;

/// The words of the line that begins with `head`.
fn line(all: &str, head: &str) -> String {
    let found = all.lines().find(|l| l.split_whitespace().next() == Some(head));
    found.unwrap_or_else(|| panic!("no line {head} in\n{all}")).split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn stages_are_listed_with_widths_and_parameters() {
    let d = Folder::new();
    let all = d.done("explain naf");
    assert!(all.starts_with("naf (shipped)\n"), "{all}");
    let masked = d.done("explain ni-naf");
    for (all, head, begin) in [
        (&all, "encoder", "encoder hash-grid 3 -> 32 "),
        (&all, "field", "field mlp 32 -> 1 4 225 16.5 KiB 4 128 dense "),
        (&all, "projector", "projector ray-march "),
        (&all, "method", "method neural-field "),
        (&masked, "callbacks.1", "callbacks.1 fft-mask "),
        (&masked, "normalizers.0", "normalizers.0 layer-norm 20 -> 20 40 "),
    ] {
        assert!(line(all, head).starts_with(begin), "{all}");
    }
}

#[test]
fn sets_and_json() {
    let e = Folder::new().json("explain ni-naf --set encoder.levels=4 --set normalizers=[] --json");
    let stages = e["stages"].as_array().unwrap();
    assert_eq!(stages.len(), 2);
    assert_eq!([&stages[0]["output"], &stages[1]["input"]], [8, 8]);
    let sum: u64 = stages.iter().map(|s| s["parameters"].as_u64().unwrap()).sum();
    assert_eq!([&e["parameters"], &e["model_bytes"]], [sum, 16 * sum]);
    assert!(e["compiled"]["backend"].as_str().unwrap().starts_with("cpu"));
}

/// A key that excludes another one replaces it in nested stages, too.
#[test]
fn the_uppermost_layer_decides_in_stages_of_stages() {
    let d = Folder::new();
    let said = d.done("explain field-tv --set 'methods.0.optimizer.decay={ exponential = 0.1 }'");
    assert!(said.contains("field-tv"), "{said}");
    let methods = "[[methods]]\nextends = \"balanced\"\noptimizer.decay = { exponential = 0.1 }\n[[methods]]\nextends = \"fista-tv\"\n";
    d.put("mine.toml", format!("extends = \"field-tv\"\nname = \"mine\"\n{methods}"));
    d.done("explain mine.toml");
}

#[test]
fn a_description_is_that_of_its_own_file() {
    let d = Folder::new();
    d.put("mine.toml", "extends = \"fast\"\nname = \"mine\"\n");
    let said = d.json("explain mine.toml --json");
    assert_eq!((&said["description"], &said["extends"][0]), (&json!(""), &json!("fast (shipped)")));
    assert_ne!(d.json("explain fast --json")["description"], "");
}

#[test]
fn callbacks_that_an_encoder_cannot_serve_are_refused_with_file_and_line() {
    let d = Folder::new();
    let encoder = "[encoder]\ntype = \"concat\"\nencoders = [\"hash-grid\", \"dense-grid\"]\n";
    for (callback, remedy) in [("coarse-to-fine", "callbacks without coarse-to-fine"), ("fft-mask", "\"channel\"")] {
        d.put("two.toml", format!("extends = \"fast\"\ncallbacks = [\"{callback}\"]\n{encoder}"));
        d.refused_with(1, "explain two.toml", &["two.toml:2", "callbacks.0", remedy]);
    }
}

#[test]
fn a_scan_adds_its_memory() {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 4 --detector 8x12"]);
    let e = d.json("explain naf --scan scan --json");
    let m = &e["scan"]["memory"];
    // Half of the 16 bytes per parameter are moments; the last good state takes 12 more. The volume is written while it is
    // evaluated.
    let all = e["model_bytes"].as_u64().unwrap();
    let parts = ["scan", "model", "optimizer", "volume"].map(|part| m[part].as_u64().unwrap());
    assert_eq!(parts, [4 * 4 * 8 * 12, all / 2, all / 2 + 12 * all / 16, 0]);
    assert_eq!(e["scan"]["samples"], 320);
    // Training that ends by held-out views also keeps the best parameters.
    let patient = "--set 'callbacks=[\"rollback\", {type=\"patience\", records=3}]'";
    let e = d.json(&format!("explain naf --scan scan --json {patient}"));
    assert_eq!(e["scan"]["memory"]["optimizer"].as_u64().unwrap(), all / 2 + 16 * all / 16);
    let beside = e["beside"].as_array().unwrap();
    let said = beside.iter().find(|l| l["stage"] == "callbacks.1").unwrap()["what"].as_str().unwrap();
    assert!(said.contains("ends after 3 records"), "{said}");
    let all = d.done("explain naf --scan scan");
    assert!(all.contains("this scan: 4 views of 8 x 12, volume 16 x 16 x 16, 320 samples"), "{all}");
}

#[test]
fn the_surround_of_the_volume_is_reported_and_removed() {
    let d = Folder::new();
    // A detector with a quarter of the published width.
    let narrow = "dso = 5.0\ndsd = 7.0\ndetector = [32, 8]\nextent = { side = [4.0, 1.0] }\nangles = { even = { views = 12 } }\n";
    d.put("p.toml", format!("{narrow}unit = {{ name = \"half side\", mm = 128.0 }}\n"));
    d.done("simulate phantom:head:16 -o scan --protocol p.toml");
    let set = "--set scene.surround.coarse.cells=8";
    for spec in ["fdk", "fast"] {
        assert!(!d.done(&format!("explain {spec} --scan scan")).contains("surround"));
        let all = d.done(&format!("explain {spec} --scan scan {set}"));
        assert!(all.contains("surround: the object reaches the sides of 12 of 12 views: "), "{all}");
    }
    let run = |more: &str| {
        let record = d.json(&format!("reconstruct scan --spec os-sart -o run --force --json {more}"));
        (record["memory"]["total"].as_u64().unwrap(), d.bytes("run/volume.nii.gz"))
    };
    let (without, with) = (run(""), run(set));
    assert!(with.0 >= without.0 && with.1 != without.1);
    assert!(with == run(set), "it is found the same again");
}

#[test]
fn carving_serves_methods_on_voxels() {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 12 --detector 64x64"]);
    let all = d.done("explain sirt --scan scan --set scene.support=\"carve\"");
    assert!(all.contains("support: ") && all.contains("from the air in 12 of 12 views"), "{all}");
}

#[test]
fn methods_on_voxels_are_listed_without_a_field() {
    let d = Folder::new();
    let all = d.done("explain fdk");
    assert!(all.starts_with("fdk (shipped)\n"), "{all}");
    assert_eq!(line(&all, "method"), "method fdk hann window to 1 of the highest frequency");
    for absent in ["encoder", "parameters", "projector"] {
        assert!(!all.contains(absent), "{absent:?} is in: {all}");
    }
    assert!(all.contains("\n\nbackend: cpu, ") && d.json("explain fdk --json")["backend"].is_string(), "{all}");
    let all = d.done("explain os-sart --set subsets=4");
    assert_eq!(line(&all, "projector"), "projector joseph bilinear from plane to plane");
    assert!(line(&all, "method").starts_with("method sart 4 subsets, relaxation 1 times 0.9"), "{all}");
    for (spec, kind) in
        [("sart", "sart"), ("sirt", "sart"), ("cgls", "cgls"), ("asd-pocs", "asd-pocs"), ("fista-tv", "fista")]
    {
        let all = d.done(&format!("explain {spec}"));
        assert!(line(&all, "method").starts_with(&format!("method {kind} ")), "{spec}");
    }
    d.refused_with(1, "explain sart --set projector.type=ray-march", &["no voxel-projector type \"ray-march\""]);
}

#[test]
fn the_plan_of_a_voxel_method_for_a_scan_is_reported() {
    let d = Folder::after(&["simulate phantom:head:16 -o scan --views 6 --detector 8x12"]);
    let with = |spec: &str, set: &str| d.done(&format!("explain {spec} --scan scan --set {set}"));
    let all = with("fdk", "cutoff=0.5");
    assert!(line(&all, "method").contains("hann window to 0.5"), "{all}");
    assert!(all.contains("this scan: 6 views of 8 x 12, volume 16 x 16 x 16\n"), "{all}");
    assert!(all.contains("full turn: each ray is measured twice and weighted by one half"), "{all}");
    assert!(all.contains("memory for this scan: ") && all.contains("volume 16.0 KiB"), "{all}");
    assert!(with("os-sart", "subsets=4").contains("  4 subsets of 1 or 2 views\n"));
    assert!(with("asd-pocs", "subsets=2").contains("  noise of "));
    let e = d.json("explain sart --scan scan --json");
    assert_eq!((&e["stages"], &e["scan"]["lines"][0]), (&json!([]), &json!("6 subsets of 1 view")));
    assert!(e["compiled"].is_null() && e["scan"]["samples"].is_null());
    let parts = ["scan", "volume", "model"].map(|part| e["scan"]["memory"][part].as_u64().unwrap());
    assert_eq!(parts, [4 * 6 * 8 * 12, 4 * 16 * 16 * 16, 0]);
}
