//! `conefield import`: from files to a scan for the other commands.

use crate::common::{done, json, refused, text};
use ndarray::Array3;
use std::fs;
use tempfile::tempdir;

#[test]
fn counts_become_a_scan_that_the_other_commands_read() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    let block = |i: usize| (6..10).contains(&(i / 16 % 16)) && (6..10).contains(&(i % 16));
    let counts: Vec<u16> = (0..8 * 256).map(|i| if block(i) { 2500 } else { 10000 }).collect();
    let counts = Array3::from_shape_vec((8, 16, 16), counts).unwrap();
    ndarray_npy::write_npy(at("counts.npy"), &counts).unwrap();
    let toml = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\n\
        volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
        pixel = { u = 2.0, v = 2.0 }\nrange_deg = 360.0\ndirection = \"clockwise\"\n";
    fs::write(at("s.toml"), toml).unwrap();
    let (scanner, out) = (text(&at("s.toml")), text(&at("scan")));

    // Without an open beam the import is refused, and nothing is left behind.
    let said = refused(1, &["import", &scanner, "-o", &out]);
    assert!(said.contains("files.flat") && said.contains("--i0"), "{said}");
    assert!(!at("scan").exists());

    let found = json(&["import", &scanner, "-o", &out, "--i0", "10000", "--json"]);
    assert_eq!(found["views"], 8);
    assert_eq!(found["source_to_axis_mm"], 100.0);
    assert_eq!(found["counts"]["clamped"], 0.0);
    assert_eq!(found["line_integrals"]["complaints"], serde_json::json!([]));
    let top = found["line_integrals"]["range"][1].as_f64().unwrap();
    assert!((top - 4f64.ln()).abs() < 1e-5, "{top}");
    let info = json(&["info", &out, "--json"]);
    assert_eq!((&info["views"], &info["detector"]), (&found["views"], &found["detector"]));

    // An existing scan is replaced only with --force; air gives the same open beam as the number.
    assert!(refused(1, &["import", &scanner, "-o", &out, "--i0", "air"]).contains("--force"));
    let again = ["import", &scanner, "-o", &out, "--i0", "air", "--force"];
    let said = done(&again);
    let [views, source, arc, values, written] = said.trim().lines().collect::<Vec<_>>()[..] else { panic!("{said}") };
    assert!(views.ends_with("8 of 16 x 16 pixels (rows x columns), 2 x 2 mm each"), "{said}");
    assert!(source.ends_with("100 mm to the axis, 150 mm to the detector, magnification 1.5"), "{said}");
    assert!(arc.ends_with("360 degrees from 0 in steps of -45"), "{said}");
    assert!(
        values.contains("line integrals from 0 to 1.38629; open beam 10000, 0 % of the counts raised to 1,"),
        "{said}"
    );
    assert!(written.contains(&out), "{said}");
    // The rest is printed with -v.
    let all = done(&[&again[..], &["-v"]].concat());
    assert!(
        all.starts_with(said.trim()) && all.contains("source_to_detector_mm") && all.contains("counts.bad"),
        "{all}"
    );

    // Counts imported as line integrals cause a warning, also when the scan is read later.
    fs::write(at("s.toml"), format!("{toml}[values]\nkind = \"line-integrals\"\n")).unwrap();
    done(&["import", &scanner, "-o", &out, "--force"]);
    let complaint = "looks like intensities, not line integrals: pass --i0 or flat/dark";
    let printed = done(&["info", &out]);
    assert!(printed.contains(&format!("warning: {complaint}")), "{printed}");
    let log = assert_cmd::Command::cargo_bin("conefield").unwrap();
    let log = { log }.args(["explain", "fast", "--scan", &out]).output().unwrap();
    assert!(String::from_utf8(log.stderr).unwrap().contains(complaint));
}
