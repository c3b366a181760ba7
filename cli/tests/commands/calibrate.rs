//! `conefield calibrate`: a wrong geometry is corrected, and a right one is unchanged.

use crate::common::{conefield, done, json, refused, text};
use conefield_core::geometry::{norm, sub};
use conefield_core::orbit::CircularOrbit;
use conefield_evaluation::report::Pixels;
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use serde_json::Value;
use std::fs;
use std::path::Path;
use tempfile::tempdir;

/// A noisy scan of a phantom in `folder`.
fn scanned(folder: &Path) {
    let size = ["--views", "30", "--detector", "48x48", "--noise", "poisson:1e5"];
    done(&[&["simulate", "phantom:head:32", "-o", &text(folder)], &size[..]].concat());
}

/// The same scan in `folder`, described with its detector shifted along u.
fn shifted(scan: &Path, folder: &Path, pixels: f64) {
    let mut scan = conefield_scans::read_scan(scan).unwrap();
    let mut orbit = CircularOrbit::fit(&scan.geometry.views).unwrap();
    orbit.offset[1] += pixels * orbit.pixel[1];
    scan.geometry.views = orbit.views();
    conefield_io::write_scan(folder, &scan, None).unwrap();
}

/// The result for a parameter.
fn of<'a>(found: &'a Value, parameter: &str) -> &'a Value {
    let all = found["parameters"].as_array().unwrap();
    all.iter().find(|f| f["parameter"] == parameter).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

#[test]
fn a_shifted_detector_is_found_and_a_right_one_is_left_alone() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("right"));
    shifted(&at("right"), &at("wrong"), -3.0);
    let before = fs::read(at("wrong/scan.toml")).unwrap();

    let (wrong, out, png) = (text(&at("wrong")), text(&at("out")), text(&at("curves.png")));
    let found = json(&[
        "calibrate", &wrong, "-o", &out, "--png", &png, "--pixels", "24", "--parameters", "offset-u,rotation", "--json",
    ]);
    let u = of(&found, "offset-u");
    assert_eq!((&u["verdict"], &u["unit"]), (&"corrected".into(), &"mm".into()), "{found}");
    let change = number(&u["change"]);
    let [pixels, deviation] = [0, 1].map(|k| number(&u["pixels"][k]));
    assert!((pixels - 3.0).abs() < 0.1 && deviation < 0.1, "{pixels} ± {deviation}");
    let held_out = &found["held_out"];
    assert!(number(&held_out["after"]) < 0.5 * number(&held_out["before"]), "{held_out}");
    assert!(Pixels::open(at("curves.png")).unwrap().width > 1000);
    // The curve has its minimum at the estimate.
    let curve = u["curve"].as_array().unwrap();
    let lowest = curve.iter().min_by(|a, b| number(&a[1]).total_cmp(&number(&b[1]))).unwrap();
    assert!((number(&lowest[0]) - change).abs() < 1e-9, "{lowest} {change}");

    // The input scan is unchanged, and the new one has the estimated geometry.
    assert_eq!(fs::read(at("wrong/scan.toml")).unwrap(), before);
    let corrected = conefield_scans::read_scan(at("out")).unwrap();
    let right = conefield_scans::read_scan(at("right")).unwrap();
    assert_eq!(corrected.projections, right.projections);
    // The first source is on the axis x, so u is along y.
    let moved = corrected.geometry.views[0].detector[1] - right.geometry.views[0].detector[1];
    assert!(moved.abs() < 0.1 * norm(right.geometry.views[0].u), "{moved}");
    let note = &corrected.provenance["calibrated"]["corrected"]["offset-u"];
    assert!((number(&note["change"]) - change).abs() < 1e-9, "{note}");

    // Calibrated again, nothing is left to correct along u, nor in the scan whose geometry was right from the start.
    for scan in [&out, &text(&at("right"))] {
        let again = json(&["calibrate", scan, "--pixels", "24", "--parameters", "offset-u", "--json"]);
        assert_eq!(of(&again, "offset-u")["verdict"], "kept", "{again}");
        assert_eq!(again["output"], Value::Null);
    }
    let said = done(&["calibrate", &text(&at("right")), "--pixels", "24", "--parameters", "offset-u"]);
    assert!(said.contains("right: unchanged") && said.contains("held-out error"), "{said}");

    // `info` warns about the wrong geometry and not about the right one.
    let warned = done(&["info", &wrong]);
    assert!(warned.contains("conefield calibrate"), "{warned}");
    assert!(!done(&["info", &text(&at("right"))]).contains("conefield calibrate"));
}

/// Views that are shifted alternately along u and v.
#[test]
fn shifts_of_single_views_are_corrected_and_steady_views_are_unchanged() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("right"));
    let mut scan = conefield_scans::read_scan(at("right")).unwrap();
    for (i, view) in scan.geometry.views.iter_mut().enumerate() {
        let [along_v, along_u] = [[1.0, -0.5], [-1.0, 0.0], [0.0, 1.5], [0.0, -1.0]][i % 4];
        view.detector = std::array::from_fn(|k| view.detector[k] + along_v * view.v[k] + along_u * view.u[k]);
    }
    conefield_io::write_scan(at("wrong"), &scan, None).unwrap();
    let calibrate = |name: &str, out: &str| {
        let [scan, out] = [name, out].map(|n| text(&at(n)));
        json(&["calibrate", &scan, "-o", &out, "--pixels", "48", "--parameters", "offset-u", "--jitter", "--json"])
    };
    let found = calibrate("wrong", "corrected");
    assert_eq!(found["jitter"]["verdict"], "corrected", "{found}");
    let [before, after] = [0, 1].map(|i| number(&found["jitter"]["held_out"][i]));
    assert!(after < 0.8 * before, "{found}");
    let provenance = conefield_scans::read_scan(at("corrected")).unwrap().provenance;
    assert!(number(&provenance["jitter"]["rms_pixels"]["u"]) > 0.5, "{provenance}");

    assert_eq!(calibrate("right", "same")["jitter"]["verdict"], "kept");
    let [same, right] = ["same", "right"].map(|n| conefield_scans::read_scan(at(n)).unwrap().geometry);
    for (a, b) in same.views.iter().zip(&right.views) {
        assert!(norm(sub(a.detector, b.detector)) < 1e-9 * norm(b.detector), "{a:?} {b:?}");
    }
    assert!(done(&["calibrate", &text(&at("wrong")), "--pixels", "32", "--jitter"]).contains("shifts of single views"));
}

#[test]
fn a_wrong_direction_of_rotation_is_reported() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("right"));
    let mut scan = conefield_scans::read_scan(at("right")).unwrap();
    let mut orbit = CircularOrbit::fit(&scan.geometry.views).unwrap();
    orbit.angles.iter_mut().for_each(|a| *a = -*a);
    scan.geometry.views = orbit.views();
    conefield_io::write_scan(at("wrong"), &scan, None).unwrap();
    let calibrate = ["--pixels", "24", "--parameters", "offset-u"];
    let printed = |name: &str| done(&[&["calibrate", &text(&at(name))], &calibrate[..]].concat());
    let said = printed("wrong");
    assert!(said.contains("the other `direction`") && said.contains("--flip-columns"), "{said}");
    assert!(!printed("right").contains("direction"));
    let found = json(&[&["calibrate", &text(&at("wrong"))], &calibrate[..], &["--json"]].concat());
    let [given, reversed] = ["given", "reversed"].map(|k| number(&found["direction"][k]));
    assert!(reversed < 0.7 * given, "{found}");
}

/// A ball on the axis: with a detector rotated in its plane or a wider step, every view is the same.
#[test]
fn undetermined_parameters_are_unchanged() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("right"));
    let geometry = conefield_scans::read_scan(at("right")).unwrap().geometry;
    let ball = Ellipsoid {
        center: [0.0; 3],
        axes: [0.2 * geometry.volume.size()[0]; 3],
        value: 0.5 / geometry.volume.size()[0],
    };
    conefield_io::write_scan(at("ball"), &scan_ellipsoids(&[ball], geometry), None).unwrap();
    let found =
        json(&["calibrate", &text(&at("ball")), "--pixels", "24", "--parameters", "offset-u,rotation,step", "--json"]);
    assert_eq!(of(&found, "rotation")["verdict"], "not-determined", "{found}");
    assert_eq!(of(&found, "step")["verdict"], "not-determined", "{found}");
    assert_eq!(of(&found, "offset-u")["verdict"], "kept", "{found}");
}

#[test]
fn what_cannot_be_calibrated_is_refused() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("scan"));
    let scan = text(&at("scan"));
    let said = refused(1, &["calibrate", &scan, "-o", &scan, "--force"]);
    assert!(said.contains("that this command reads"), "{said}");
    fs::create_dir(at("there")).unwrap();
    fs::write(at("there/notes.txt"), "mine").unwrap();
    assert!(refused(1, &["calibrate", &scan, "-o", &text(&at("there"))]).contains("--force"));
    let few = text(&at("few"));
    done(&["convert", &scan, &few, "--views", "0-6"]);
    let said = refused(1, &["calibrate", &few, "-o", &text(&at("out"))]);
    assert!(said.contains("views") && said.contains("found 7") && !at("out").exists(), "{said}");
    let output = conefield(&["calibrate", &scan, "--parameters", "dso"]).assert().code(2).get_output().clone();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("object's size") && said.contains("offset-u"), "{said}");
}
