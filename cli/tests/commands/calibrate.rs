//! `conefield calibrate`: a wrong geometry is corrected, and a right one is unchanged.

use crate::common::{Folder, number};
use conefield_core::geometry::{norm, sub};
use conefield_core::orbit::CircularOrbit;
use conefield_evaluation::report::Pixels;
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use serde_json::Value;
use std::fs;

/// A noisy scan of a phantom.
const RIGHT: &str = "simulate phantom:head:32 -o right --views 30 --detector 48x48 --noise poisson:1e5";

/// Writes that scan as `wrong`, with a changed orbit.
fn described_wrongly(d: &Folder, change: impl Fn(&mut CircularOrbit)) {
    let mut scan = conefield_scans::read_scan(d.at("right")).unwrap();
    let mut orbit = CircularOrbit::fit(&scan.geometry.views).unwrap();
    change(&mut orbit);
    scan.geometry.views = orbit.views();
    conefield_io::write_scan(d.at("wrong"), &scan, None).unwrap();
}

/// The result for a parameter.
fn of<'a>(found: &'a Value, parameter: &str) -> &'a Value {
    let all = found["parameters"].as_array().unwrap();
    all.iter().find(|f| f["parameter"] == parameter).unwrap()
}

#[test]
fn a_shifted_detector_is_found_and_a_right_one_is_left_alone() {
    let d = Folder::after(&[RIGHT]);
    described_wrongly(&d, |orbit| orbit.offset[1] -= 3.0 * orbit.pixel[1]);
    let before = d.bytes("wrong/scan.toml");

    let found = d.json("calibrate wrong -o out --png curves.png --pixels 24 --parameters offset-u,rotation --json");
    let u = of(&found, "offset-u");
    assert_eq!((&u["verdict"], &u["unit"]), (&"corrected".into(), &"mm".into()), "{found}");
    let change = number(&u["change"]);
    let [pixels, deviation] = [0, 1].map(|k| number(&u["pixels"][k]));
    assert!((pixels - 3.0).abs() < 0.1 && deviation < 0.1, "{pixels} ± {deviation}");
    let held_out = &found["held_out"];
    assert!(number(&held_out["after"]) < 0.5 * number(&held_out["before"]), "{held_out}");
    assert!(Pixels::open(d.at("curves.png")).unwrap().width > 1000);
    // The curve has its minimum at the estimate.
    let curve = u["curve"].as_array().unwrap();
    let lowest = curve.iter().min_by(|a, b| number(&a[1]).total_cmp(&number(&b[1]))).unwrap();
    assert!((number(&lowest[0]) - change).abs() < 1e-9, "{lowest} {change}");

    // The input scan is unchanged, and the new one has the estimated geometry.
    assert_eq!(d.bytes("wrong/scan.toml"), before);
    let [corrected, right] = ["out", "right"].map(|name| conefield_scans::read_scan(d.at(name)).unwrap());
    assert_eq!(corrected.projections, right.projections);
    // The first source is on the axis x, so u is along y.
    let moved = corrected.geometry.views[0].detector[1] - right.geometry.views[0].detector[1];
    assert!(moved.abs() < 0.1 * norm(right.geometry.views[0].u), "{moved}");
    let note = &corrected.provenance["calibrated"]["corrected"]["offset-u"];
    assert!((number(&note["change"]) - change).abs() < 1e-9, "{note}");

    // Calibrated again, nothing is left to correct along u, nor in the scan whose geometry was right from the start.
    let again = d.json("calibrate out --pixels 24 --parameters offset-u --json");
    assert_eq!(of(&again, "offset-u")["verdict"], "kept", "{again}");
    assert_eq!(again["output"], Value::Null);
    let said = d.done("calibrate right -o same --pixels 24 --parameters offset-u --jitter");
    for words in ["right: unchanged", "held-out error", "shifts of single views", "not clear: unchanged"] {
        assert!(said.contains(words), "{said}");
    }
    let same = conefield_scans::read_scan(d.at("same")).unwrap();
    for (a, b) in same.geometry.views.iter().zip(&right.geometry.views) {
        assert!(norm(sub(a.detector, b.detector)) < 1e-9 * norm(b.detector), "{a:?} {b:?}");
    }

    // `info` warns about the wrong geometry and not about the right one.
    let warned = d.done("info wrong");
    assert!(warned.contains("conefield calibrate"), "{warned}");
    assert!(!d.done("info right").contains("conefield calibrate"));
}

#[test]
fn a_wrong_direction_of_rotation_is_reported() {
    let d = Folder::after(&[RIGHT]);
    described_wrongly(&d, |orbit| orbit.angles.iter_mut().for_each(|a| *a = -*a));
    let printed = |name: &str| d.done(&format!("calibrate {name} --pixels 24 --parameters offset-u"));
    let said = printed("wrong");
    assert!(said.contains("the other `direction`") && said.contains("--flip-columns"), "{said}");
    assert!(!printed("right").contains("direction"));
    let found = d.json("calibrate wrong --pixels 24 --parameters offset-u --json");
    let [given, reversed] = ["given", "reversed"].map(|k| number(&found["direction"][k]));
    assert!(reversed < 0.7 * given, "{found}");
}

/// A ball on the axis: with a detector rotated in its plane or a wider step, every view is the same.
#[test]
fn undetermined_parameters_are_unchanged() {
    let d = Folder::after(&[RIGHT]);
    let geometry = conefield_scans::read_scan(d.at("right")).unwrap().geometry;
    let side = geometry.volume.size()[0];
    let ball = Ellipsoid { center: [0.0; 3], axes: [0.2 * side; 3], value: 0.5 / side };
    conefield_io::write_scan(d.at("ball"), &scan_ellipsoids(&[ball], geometry), None).unwrap();
    let found = d.json("calibrate ball --pixels 24 --parameters offset-u,rotation,step --json");
    for (parameter, verdict) in [("rotation", "not-determined"), ("step", "not-determined"), ("offset-u", "kept")] {
        assert_eq!(of(&found, parameter)["verdict"], verdict, "{found}");
    }
}

#[test]
fn what_cannot_be_calibrated_is_refused() {
    let d = Folder::after(&[RIGHT, "convert right few --views 0-6"]);
    fs::create_dir(d.at("there")).unwrap();
    d.put("there/notes.txt", "mine");
    d.refuses(
        "out",
        &[
            ("calibrate right -o right --force", "that this command reads"),
            ("calibrate right -o there", "--force"),
            ("calibrate few -o out", "found 7"),
        ],
    );
}
