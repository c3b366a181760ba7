//! `conefield calibrate`: a geometry that is told wrongly is found again, and a right one is left alone.

use crate::common::{conefield, done, json, refused, text};
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use serde_json::Value;
use std::fs;
use std::path::Path;
use tempfile::tempdir;

/// A noisy scan of a phantom in `folder`, with its detector 6 mm aside along u: 3 pixels.
fn scanned(folder: &Path) {
    let protocol = folder.with_extension("toml");
    let lines = "dso = 160.0\ndsd = 224.0\ndetector = [48, 48]\nextent = { pixel = [2.0, 2.0] }\noffset = [0.0, 6.0]\n\
                 angles = { even = { views = 30 } }\nnoise = \"poisson:1e5\"\n";
    fs::write(&protocol, lines).unwrap();
    let (folder, protocol) = (text(folder), text(&protocol));
    done(&["simulate", "phantom:head:32", "-o", &folder, "--protocol", &protocol]);
}

/// What came out for a parameter.
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
    // Told to stand straight. All files are new, so that nothing else differs.
    fs::create_dir(at("wrong")).unwrap();
    for file in ["projections.npy", "truth.nii.gz"] {
        fs::copy(at("right").join(file), at("wrong").join(file)).unwrap();
    }
    let toml = fs::read_to_string(at("right/scan.toml")).unwrap();
    assert!(toml.contains("offset = [0.0, 6.0]"), "{toml}");
    fs::write(at("wrong/scan.toml"), toml.replace("offset = [0.0, 6.0]", "offset = [0.0, 0.0]")).unwrap();
    let before = fs::read(at("wrong/scan.toml")).unwrap();

    let (wrong, out, png) = (text(&at("wrong")), text(&at("out")), text(&at("curves.png")));
    let found = json(&["calibrate", &wrong, "-o", &out, "--png", &png, "--json"]);
    let u = of(&found, "offset-u");
    assert_eq!((&u["verdict"], &u["unit"]), (&"corrected".into(), &"mm".into()), "{found}");
    let (change, deviation) = (number(&u["change"]), number(&u["uncertainty"]));
    assert!((change - 6.0).abs() < 0.2 && deviation < 0.2, "{change} ± {deviation}");
    let held_out = &found["held_out"];
    assert!(number(&held_out["after"]) < 0.5 * number(&held_out["before"]), "{held_out}");
    assert!(image::open(at("curves.png")).unwrap().width() > 1000);
    // The curve has its lowest point where the parameter was found.
    let curve = u["curve"].as_array().unwrap();
    let lowest = curve.iter().min_by(|a, b| number(&a[1]).total_cmp(&number(&b[1]))).unwrap();
    assert!((number(&lowest[0]) - change).abs() < 1e-9, "{lowest} {change}");

    // The scan is what it was, and the new one has the geometry that was found.
    assert_eq!(fs::read(at("wrong/scan.toml")).unwrap(), before);
    let corrected = conefield_io::read_scan(at("out")).unwrap();
    let right = conefield_io::read_scan(at("right")).unwrap();
    assert_eq!(corrected.projections, right.projections);
    assert!(at("out/truth.nii.gz").exists());
    let centre = corrected.geometry.views[0].detector;
    let moved = (0..3).map(|k| (centre[k] - right.geometry.views[0].detector[k]).powi(2)).sum::<f64>().sqrt();
    assert!(moved < 0.4, "{moved}");
    let note = &corrected.provenance["calibrated"]["corrected"]["offset-u"];
    assert!((number(&note["change"]) - change).abs() < 1e-9, "{note}");

    // Seen again there is nothing left to correct along u, nor in the scan whose geometry was right from the start.
    for scan in [&out, &text(&at("right"))] {
        let again = json(&["calibrate", scan, "--parameters", "offset-u", "--json"]);
        assert_eq!(of(&again, "offset-u")["verdict"], "kept", "{again}");
        assert_eq!(again["output"], Value::Null);
    }
    let said = done(&["calibrate", &text(&at("right")), "--parameters", "offset-u"]);
    assert!(said.contains("right as it is") && said.contains("held-out error"), "{said}");

    // `info` says that something is off, and does not where nothing is.
    let warned = done(&["info", &wrong]);
    assert!(warned.contains("conefield calibrate"), "{warned}");
    assert!(!done(&["info", &text(&at("right"))]).contains("conefield calibrate"));
}

/// A ball on the axis: turned in its plane or stepped on wider, every view is the same.
#[test]
fn what_the_views_do_not_tell_is_not_invented() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("right"));
    let mut geometry = conefield_io::read_scan(at("right")).unwrap().geometry;
    geometry.volume.center = [0.0; 3];
    let ball = Ellipsoid { center: [0.0; 3], axes: [12.0; 3], value: 0.02 };
    conefield_io::write_scan(at("ball"), &scan_ellipsoids(&[ball], geometry), None).unwrap();
    let found = json(&["calibrate", &text(&at("ball")), "--parameters", "offset-u,rotation,step", "--json"]);
    assert_eq!(of(&found, "rotation")["verdict"], "untold", "{found}");
    assert_eq!(of(&found, "step")["verdict"], "untold", "{found}");
    assert_eq!(of(&found, "offset-u")["verdict"], "kept", "{found}");
}

#[test]
fn what_cannot_be_calibrated_is_refused() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    scanned(&at("scan"));
    let scan = text(&at("scan"));
    let said = refused(1, &["calibrate", &scan, "-o", &scan, "--force"]);
    assert!(said.contains("which this command reads"), "{said}");
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
