//! What `explain` says.

mod common;
use common::{done, json, text};
use tempfile::tempdir;

/// Words of the line that begins with `head`.
fn line(all: &str, head: &str) -> String {
    let found = all.lines().find(|l| l.split_whitespace().next() == Some(head));
    found.unwrap_or_else(|| panic!("no line {head} in\n{all}")).split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn stages_are_told_with_widths_and_parameters() {
    let all = done(&["explain", "naf"]);
    assert!(all.starts_with("naf (shipped)\n"), "{all}");
    assert!(line(&all, "encoder").starts_with("encoder hash-grid 3 -> 32 "), "{all}");
    assert!(line(&all, "field").starts_with("field mlp 32 -> 1 4 225 16.5 KiB 4 128 dense "), "{all}");
    assert!(line(&all, "projector").starts_with("projector ray-march "), "{all}");
    assert!(line(&all, "solver").starts_with("solver gradient "), "{all}");
    let all = done(&["explain", "ni-naf"]);
    assert!(line(&all, "normalizers.0").starts_with("normalizers.0 fft-mask 20 -> 20 0 "), "{all}");
    assert!(line(&all, "normalizers.1").starts_with("normalizers.1 layer-norm 20 -> 20 40 "), "{all}");
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
    assert!(e["backend"]["backend"].as_str().unwrap().starts_with("cpu"));
}

#[test]
fn a_scan_adds_its_memory() {
    let dir = tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "4", "--detector", "8x12"]);
    let e = json(&["explain", "naf", "--scan", &scan, "--json"]);
    let m = &e["scan"]["memory"];
    assert_eq!(m["scan"], 4 * 4 * 8 * 12);
    assert_eq!([&m["model"], &m["optimizer"]].map(|n| n.as_u64()), [e["model_bytes"].as_u64().map(|n| n / 2); 2]);
    // The volume is written as it is evaluated.
    assert_eq!(m["volume"], 0);
    assert_eq!(e["scan"]["samples_per_ray"], 320);
    let all = done(&["explain", "naf", "--scan", &scan]);
    assert!(all.contains("this scan: 4 views of 8 x 12, volume 16 x 16 x 16, 320 samples"), "{all}");
}
