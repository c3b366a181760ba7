//! Part of a scan, by `import` and by `convert`: bit-identical to slicing the arrays, with the geometry of that part.

use crate::common::{done, refused, text};
use ndarray::{Array2, Array3, s};
use std::fs;
use std::path::Path;
use tempfile::tempdir;

const SCANNER: &str = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\nvalues.i0 = 10000.0\n\
    volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
    pixel = { u = 2.0, v = 3.0 }\noffset = { u = 1.0, v = 0.5 }\nrange_deg = 360.0\ndirection = \"clockwise\"\n";

/// Counts of 12 views of 10 rows and 16 columns, each pixel with its own number.
fn described(dir: &Path) {
    let counts = Array3::from_shape_fn((12, 10, 16), |(v, r, c)| (2000 + 131 * v + 17 * r + 3 * c * c) as u16);
    ndarray_npy::write_npy(dir.join("counts.npy"), &counts).unwrap();
    fs::write(dir.join("s.toml"), SCANNER).unwrap();
}

#[test]
fn import_and_convert_take_the_same_part() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    described(dir.path());
    let (scanner, whole) = (text(&at("s.toml")), text(&at("whole")));
    done(&["import", &scanner, "-o", &whole]);
    let all = conefield_scans::read_scan(&whole).unwrap();

    let part = ["--views", "0-11:3", "--rows", "1:9", "--columns", "-14:"];
    for (name, command) in [("imported", vec!["import", &scanner, "-o"]), ("converted", vec!["convert", &whole])] {
        let out = text(&at(name));
        done(&[&command[..], &[&out], &part].concat());
        let found = conefield_scans::read_scan(&out).unwrap();
        assert_eq!(found.projections, all.projections.slice(s![0..12;3, 1..9, 2..16]), "{name}");
        let (a, b) = (&found.geometry, &all.geometry);
        assert_eq!((a.detector, a.views.len(), a.volume), ([8, 14], 4, b.volume));
        // The remaining pixels keep their positions.
        for (row, column) in [(0.0, 0.0), (7.0, 13.0)] {
            let here = a.views[2].pixel(a.detector, row, column);
            let there = b.views[6].pixel(b.detector, row + 1.0, column + 2.0);
            assert!((0..3).all(|k| (here[k] - there[k]).abs() < 1e-9), "{name}: {here:?} {there:?}");
        }
        // Still a circle about the axis: the crop is an offset of the detector.
        assert!(fs::read_to_string(at(name).join("scan.toml")).unwrap().contains("[orbit]"), "{name}");
    }

    // Larger pixels: for counts the mean light, for line integrals their mean.
    let (light, mean) = (text(&at("light")), text(&at("mean")));
    done(&["import", &scanner, "-o", &light, "--bin", "2"]);
    done(&["convert", &whole, &mean, "--bin", "2"]);
    let (light, mean) = (conefield_scans::read_scan(&light).unwrap(), conefield_scans::read_scan(&mean).unwrap());
    assert_eq!((light.geometry.detector, mean.geometry.detector), ([5, 8], [5, 8]));
    let block = all.projections.slice(s![3, 4..6, 6..8]);
    let want = -(block.iter().map(|a| (-a).exp()).sum::<f32>() / 4.0).ln();
    assert!((light.projections[[3, 2, 3]] - want).abs() < 1e-6);
    assert_eq!(mean.projections[[3, 2, 3]], block.sum() / 4.0);

    // Rotated images: two quarter turns equal both flips.
    let (half, flips) = (text(&at("half")), text(&at("flips")));
    done(&["convert", &whole, &half, "--turns", "2"]);
    done(&["import", &scanner, "-o", &flips, "--flip-rows", "--flip-columns"]);
    let (half, flips) = (conefield_scans::read_scan(&half).unwrap(), conefield_scans::read_scan(&flips).unwrap());
    assert_eq!(half.projections, flips.projections);
    assert_eq!(half.projections, all.projections.slice(s![.., ..;-1, ..;-1]));

    for (options, words) in [
        (["--views", "0-12"], ["--views", "numbers below 12"]),
        (["--views", "1,1"], ["--views", "repeats view 1"]),
        (["--rows", "4:20"], ["--rows", "the 10"]),
        (["--columns", "5:5"], ["--columns", "at least one"]),
        (["--bin", "99"], ["--bin", "the detector's longer side"]),
    ] {
        for command in [vec!["import", &scanner, "-o"], vec!["convert", &whole]] {
            let said = refused(1, &[&command[..], &[&text(&at("none"))], &options].concat());
            assert!(words.iter().all(|w| said.contains(w)) && !at("none").exists(), "{said}");
        }
    }
    done(&["simulate", "phantom:head:16", "-o", &text(&at("head")), "--views", "4", "--detector", "8x8"]);
    let volume = text(&at("head/truth.nii.gz"));
    let said = refused(1, &["convert", &volume, &text(&at("v.npy")), "--bin", "2"]);
    assert!(said.contains("--bin") && said.contains("a volume"), "{said}");
}

#[test]
fn angles_and_vectors_come_from_files() {
    let dir = tempdir().unwrap();
    let at = |n: &str| dir.path().join(n);
    described(dir.path());
    done(&["import", &text(&at("s.toml")), "-o", &text(&at("whole"))]);
    let want = conefield_scans::read_scan(at("whole")).unwrap();
    let angles: Vec<f64> = (0..12).map(|i| 30.0 * f64::from(i)).collect();
    let lines: String = angles.iter().map(|a| format!("{a}\n")).collect();
    fs::write(at("angles.txt"), &lines).unwrap();
    let table: String = angles.iter().enumerate().map(|(i, a)| format!("v{i};{a}\n")).collect();
    fs::write(at("log.csv"), format!("view;angle\n{table}")).unwrap();
    ndarray_npy::write_npy(at("angles.npy"), &ndarray::Array1::from(angles)).unwrap();
    let vectors = Array2::from_shape_fn((12, 12), |(i, k)| {
        let w = &want.geometry.views[i];
        [w.source, w.detector, w.u, w.v].concat()[k]
    });
    ndarray_npy::write_npy(at("vectors.npy"), &vectors).unwrap();
    let rows: Vec<String> =
        vectors.outer_iter().map(|r| r.iter().map(f64::to_string).collect::<Vec<_>>().join(",")).collect();
    fs::write(at("vectors.csv"), rows.join("\n")).unwrap();

    let circle = &SCANNER[SCANNER.find("[circle]").unwrap()..];
    let angles = |name: &str| SCANNER.replace("range_deg = 360.0", &format!("angles_deg = \"{name}\""));
    let vectors = |name: &str| SCANNER.replace(circle, &format!("[vectors]\ncone_vec = \"{name}\"\n"));
    for toml in [
        angles("angles.txt"),
        angles("log.csv:angle"),
        angles("angles.npy"),
        vectors("vectors.npy"),
        vectors("vectors.csv"),
    ] {
        fs::write(at("f.toml"), &toml).unwrap();
        done(&["import", &text(&at("f.toml")), "-o", &text(&at("out")), "--force"]);
        let found = conefield_scans::read_scan(at("out")).unwrap();
        for (a, b) in found.geometry.views.iter().zip(&want.geometry.views) {
            for (x, y) in [(a.source, b.source), (a.detector, b.detector), (a.u, b.u), (a.v, b.v)] {
                assert!((0..3).all(|k| (x[k] - y[k]).abs() < 1e-9), "{toml}: {a:?} {b:?}");
            }
        }
    }
    let refuse = |toml: &str, words: &[&str]| {
        fs::write(at("f.toml"), toml).unwrap();
        let said = refused(1, &["import", &text(&at("f.toml")), "-o", &text(&at("none"))]);
        assert!(words.iter().all(|w| said.contains(w)), "{words:?} are not all in: {said}");
    };
    fs::write(at("short.txt"), "0\n30\n").unwrap();
    refuse(&angles("short.txt"), &["circle.angles_deg", "2 of them", "12, one for each view"]);
    fs::write(at("word.csv"), "0\n30\nsixty\n").unwrap();
    refuse(&angles("word.csv"), &["word.csv: line 3", "\"sixty\"", "a number"]);
    refuse(&angles("none.txt"), &["circle.angles_deg", "none.txt"]);
    refuse(&angles("../angles.txt"), &["circle.angles_deg", "without \"..\""]);
    refuse(&vectors("angles.npy"), &["angles.npy", "shape", "[12]", "[views, 12]"]);

    // A tilted detector: the description matches the library.
    fs::write(at("f.toml"), SCANNER.replace("dsd = 150.0", "dsd = 150.0\ntilt_deg = { u = 0.5, normal = -2.0 }"))
        .unwrap();
    done(&["import", &text(&at("f.toml")), "-o", &text(&at("out")), "--force"]);
    let found = conefield_scans::read_scan(at("out")).unwrap();
    let angles = [0.5f64, 0.0, -2.0].map(|a| conefield_core::geometry::Radians(a.to_radians()));
    for (a, b) in found.geometry.views.iter().zip(&want.geometry.views) {
        let b = b.tilted(angles);
        assert!((0..3).all(|k| (a.u[k] - b.u[k]).abs() < 1e-9 && (a.v[k] - b.v[k]).abs() < 1e-9), "{a:?} {b:?}");
    }
    refuse(&SCANNER.replace("dsd = 150.0", "dsd = 150.0\ntilt_deg = { u = nan }"), &["circle.tilt_deg.u", "nan"]);
    refuse(&SCANNER.replace("dsd = 150.0", "dsd = 150.0\ntilt_deg = { w = 1 }"), &["found a key", "u, v, normal"]);
}
