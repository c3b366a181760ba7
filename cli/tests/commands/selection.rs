//! Part of a scan, by `import` and by `convert`: bit-identical to slicing the arrays, with the geometry of that part.

use crate::common::Folder;
use conefield_core::scan::Scan;
use ndarray::{Array2, Array3, s};

const SCANNER: &str = "format = \"conefield-scanner\"\nversion = 1\nfiles.projections = \"counts.npy\"\nvalues.i0 = 10000.0\n\
    volume = { shape = [8, 8, 8], spacing = [2.0, 2.0, 2.0] }\n[circle]\ndso = 100.0\ndsd = 150.0\n\
    pixel = { u = 2.0, v = 3.0 }\noffset = { u = 1.0, v = 0.5 }\nrange_deg = 360.0\ndirection = \"clockwise\"\n";

/// A folder with counts of 12 views of 10 rows and 16 columns, each pixel with its own number, and their scan `whole`.
fn described() -> Folder {
    let d = Folder::new();
    let counts = Array3::from_shape_fn((12, 10, 16), |(v, r, c)| (2000 + 131 * v + 17 * r + 3 * c * c) as u16);
    ndarray_npy::write_npy(d.at("counts.npy"), &counts).unwrap();
    d.put("s.toml", SCANNER);
    d.done("import s.toml -o whole");
    d
}

fn read(d: &Folder, name: &str) -> Scan {
    conefield_scans::read_scan(d.at(name)).unwrap()
}

/// The same part by both commands.
const COMMANDS: [&str; 2] = ["import s.toml -o", "convert whole"];

#[test]
fn import_and_convert_take_the_same_part() {
    let d = described();
    let all = read(&d, "whole");
    for (name, command) in ["imported", "converted"].into_iter().zip(COMMANDS) {
        d.done(&format!("{command} {name} --views 0-11:3 --rows 1:9 --columns -14:"));
        let found = read(&d, name);
        assert_eq!(found.projections, all.projections.slice(s![0..12;3, 1..9, 2..16]), "{name}");
        let (a, b) = (&found.geometry, &all.geometry);
        assert_eq!((a.detector, a.views.len(), a.volume), ([8, 14], 4, b.volume));
        // Still a circle about the axis: the crop is an offset of the detector.
        assert!(d.text(format!("{name}/scan.toml")).contains("[orbit]"), "{name}");
    }

    // Larger pixels: for counts the mean light, for line integrals their mean.
    d.done("import s.toml -o light --bin 2");
    d.done("convert whole mean --bin 2");
    let [light, mean] = ["light", "mean"].map(|name| read(&d, name));
    assert_eq!((light.geometry.detector, mean.geometry.detector), ([5, 8], [5, 8]));
    let block = all.projections.slice(s![3, 4..6, 6..8]);
    let want = -(block.iter().map(|a| (-a).exp()).sum::<f32>() / 4.0).ln();
    assert!((light.projections[[3, 2, 3]] - want).abs() < 1e-6);
    assert_eq!(mean.projections[[3, 2, 3]], block.sum() / 4.0);

    // Rotated images: two quarter turns equal both flips.
    d.done("convert whole half --turns 2");
    d.done("import s.toml -o flips --flip-rows --flip-columns");
    let [half, flips] = ["half", "flips"].map(|name| read(&d, name));
    assert_eq!(half.projections, flips.projections);
    assert_eq!(half.projections, all.projections.slice(s![.., ..;-1, ..;-1]));

    d.refuses(
        "none",
        &[
            ("import s.toml -o none --views 0-12", "numbers below 12"),
            ("convert whole none --views 1,1", "repeats view 1"),
            ("convert whole none --rows 4:20", "the 10"),
            ("convert whole none --columns 5:5", "at least one"),
            ("convert whole none --columns 5:9999", "none beyond the"),
            ("convert whole none --bin 99", "the detector's longer side"),
        ],
    );
    d.done("simulate phantom:head:16 -o head --views 4 --detector 8x8");
    d.refused_with(1, "convert head/truth.nii.gz v.npy --bin 2", &["--bin", "a volume"]);
    d.refused_with(1, "convert head/truth.nii.gz v.npy --to r2", &["--to", "a volume"]);
    d.refused_with(1, "convert head v --values hu:0.02", &["--values", "a scan"]);
}

#[test]
fn angles_and_vectors_come_from_files() {
    let d = described();
    let want = read(&d, "whole");
    let angles: Vec<f64> = (0..12).map(|i| 30.0 * f64::from(i)).collect();
    let lines: String = angles.iter().map(|a| format!("{a}\n")).collect();
    d.put("angles.txt", &lines);
    let table: String = angles.iter().enumerate().map(|(i, a)| format!("v{i};{a}\n")).collect();
    d.put("log.csv", format!("view;angle\n{table}"));
    ndarray_npy::write_npy(d.at("angles.npy"), &ndarray::Array1::from(angles)).unwrap();
    let vectors = Array2::from_shape_fn((12, 12), |(i, k)| {
        let w = &want.geometry.views[i];
        [w.source, w.detector, w.u, w.v].concat()[k]
    });
    ndarray_npy::write_npy(d.at("vectors.npy"), &vectors).unwrap();
    let rows: Vec<String> =
        vectors.outer_iter().map(|r| r.iter().map(f64::to_string).collect::<Vec<_>>().join(",")).collect();
    d.put("vectors.csv", rows.join("\n"));

    let circle = &SCANNER[SCANNER.find("[circle]").unwrap()..];
    let angles = |name: &str| SCANNER.replace("range_deg = 360.0", &format!("angles_deg = \"{name}\""));
    let vectors = |name: &str| SCANNER.replace(circle, &format!("[vectors]\ncone_vec = \"{name}\"\n"));
    let tilted = |tilt: &str| SCANNER.replace("dsd = 150.0", &format!("dsd = 150.0\ntilt_deg = {tilt}"));
    let import = |toml: &str| {
        d.put("f.toml", toml);
        d.done("import f.toml -o out --force");
        read(&d, "out").geometry.views
    };
    for toml in [
        angles("angles.txt"),
        angles("log.csv:angle"),
        angles("angles.npy"),
        vectors("vectors.npy"),
        vectors("vectors.csv"),
    ] {
        for (a, b) in import(&toml).iter().zip(&want.geometry.views) {
            for (x, y) in [(a.source, b.source), (a.detector, b.detector), (a.u, b.u), (a.v, b.v)] {
                assert!((0..3).all(|k| (x[k] - y[k]).abs() < 1e-9), "{toml}: {a:?} {b:?}");
            }
        }
    }
    // A tilted detector: the description matches the library.
    let turns = [0.5f64, 0.0, -2.0].map(|a| conefield_core::geometry::Radians(a.to_radians()));
    for (a, b) in import(&tilted("{ u = 0.5, normal = -2.0 }")).iter().zip(&want.geometry.views) {
        let b = b.tilted(turns);
        assert!((0..3).all(|k| (a.u[k] - b.u[k]).abs() < 1e-9 && (a.v[k] - b.v[k]).abs() < 1e-9), "{a:?} {b:?}");
    }

    for (toml, words) in [(vectors("angles.npy"), "[views, 12]"), (tilted("{ w = 1 }"), "u, v, normal")] {
        d.put("f.toml", &toml);
        d.refuses("none", &[("import f.toml -o none", words)]);
    }
}
