//! Corrections requested of `import` and `convert`.

use crate::common::{done, json, refused, text};
use ndarray::Array3;
use std::fs;
use tempfile::tempdir;

const SCANNER: &str = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\nvalues.i0 = 10000.0\n\
    volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
    pixel = { u = 2.0, v = 2.0 }\nrange_deg = 360.0\ndirection = \"counterclockwise\"\n";

/// Counts behind a block, from a tube that is brighter in each view, on pixels with different gains.
fn counts() -> Array3<u16> {
    Array3::from_shape_fn((18, 16, 24), |(v, r, c)| {
        let block = if (4..12).contains(&r) && (6..18).contains(&c) { 0.5 } else { 1.0 };
        let gain = if (r, c) == (7, 11) { 1.1 } else { 1.0 };
        (10000.0 * block * gain * (1.0 + 0.01 * v as f64)) as u16
    })
}

#[test]
fn both_commands_mend_alike_and_keep_what_they_did() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    ndarray_npy::write_npy(at("counts.npy"), &counts()).unwrap();
    fs::write(at("s.toml"), SCANNER).unwrap();
    let [scanner, whole, here, there] = ["s.toml", "whole", "here", "there"].map(|n| text(&at(n)));
    done(&["import", &scanner, "-o", &whole]);
    let asked = ["--correct", "rings.window=5", "--correct", "flux"];
    // Corrections run before a part is selected, because the part's border need not show air.
    let part = ["--rows", "5:11", "--columns", "8:16"];
    let found = json(&[&["import", &scanner, "-o", &here, "--json"], &asked[..], &part].concat());
    done(&[&["convert", &whole, &there], &asked[..], &part].concat());
    let [here, there] = [&here, &there].map(|p| conefield_scans::read_scan(p).unwrap());
    assert_eq!(here.projections, there.projections);
    assert!(here.projections.iter().all(|a| (a - 2f32.ln()).abs() < 1e-3), "{}", here.projections);
    for (list, name) in [(&found["corrections"], "printed"), (&there.provenance["corrections"], "kept")] {
        let names: Vec<_> = list.as_array().unwrap().iter().map(|c| c["name"].as_str().unwrap()).collect();
        assert_eq!(names, ["flux", "rings"], "{name}");
        assert_eq!(list[1]["settings"]["window"], 5, "{name}");
    }

    for (asked, words) in [
        ("ring", ["corrections", "ring"]),
        ("rings.window=4", ["rings.window", "odd"]),
        ("scatter.share=0", ["scatter.share", "above 0"]),
        ("flux={ rows = [5, 11], columns = [7, 17] }", ["flux", "in air"]),
    ] {
        for command in [vec!["import", &scanner, "-o"], vec!["convert", &whole]] {
            let none = text(&at("none"));
            let said = refused(1, &[&command[..], &[&none, "--correct", asked]].concat());
            assert!(words.iter().all(|w| said.contains(w)) && !at("none").exists(), "{said}");
        }
    }
    done(&["simulate", "phantom:head:16", "-o", &text(&at("head")), "--views", "4", "--detector", "8x8"]);
    let volume = text(&at("head/truth.nii.gz"));
    assert!(refused(1, &["convert", &volume, &text(&at("v.npy")), "--correct", "flux"]).contains("--correct"));
}
