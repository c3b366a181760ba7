//! Tests the conventions of NAF's file and R2-Gaussian's folder with files that `fixtures/make.py` writes without this
//! program: closed-form integrals through ellipsoids, in pickles of NumPy 1 and 2 and in `.npy` files.

use conefield_core::geometry::{Vec3, dot, norm, sub};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_io::{DataSet, Parts, Stored, read_data_set, read_scan, read_truth};
use std::path::{Path, PathBuf};

/// Centre, half axes, rotation about z, attenuation, as in `make.py`.
const ELLIPSOIDS: [(Vec3, Vec3, f64, f64); 3] = [
    ([2.0, -3.0, 1.0], [24.0, 18.0, 20.0], 0.4, 0.020),
    ([9.0, 4.0, -6.0], [7.0, 6.0, 8.0], 1.1, 0.015),
    ([-8.0, 1.0, 7.0], [5.0, 8.0, 6.0], -0.5, -0.008),
];

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn data_set(name: &str) -> DataSet {
    let DataSet { train, test, volume } = read_data_set(file(name), Parts::ALL).unwrap();
    let Stored::Scan(train) = train else { panic!("{name}: counts") };
    DataSet { train, test, volume }
}

/// Transforms to the frame in which ellipsoid `e` is the unit ball.
fn turned(p: Vec3, e: usize) -> Vec3 {
    let (_, half, turn, _) = ELLIPSOIDS[e];
    let (s, c) = turn.sin_cos();
    [(c * p[0] + s * p[1]) / half[0], (c * p[1] - s * p[0]) / half[1], p[2] / half[2]]
}

/// The integral along the line through `from` and `to`.
fn integral(from: Vec3, to: Vec3) -> f64 {
    let way = sub(to, from);
    let way = way.map(|x| x / norm(way));
    let chord = |e: usize| {
        let (o, d) = (turned(sub(from, ELLIPSOIDS[e].0), e), turned(way, e));
        let (a, b, k) = (dot(d, d), dot(o, d), dot(o, o) - 1.0);
        2.0 * (b * b - a * k).max(0.0).sqrt() / a
    };
    (0..3).map(|e| ELLIPSOIDS[e].3 * chord(e)).sum()
}

fn views_are_right(scan: &Scan, count: usize, what: &str) {
    assert_eq!(scan.projections.dim(), (count, 14, 18), "{what}");
    let g = &scan.geometry;
    let mut shadowed = 0;
    for ((view, row, column), found) in scan.projections.indexed_iter() {
        let v = &g.views[view];
        let want = integral(v.source, v.pixel(g.detector, row as f64, column as f64));
        let off = (f64::from(*found) - want).abs();
        assert!(off < 1e-5, "{what}: view {view}, row {row}, column {column}: {found}, not {want}");
        shadowed += usize::from(want > 0.1);
    }
    assert!(shadowed > 20 * count, "{what}: {shadowed} pixels in the shadow say little");
}

fn volume_is_right(volume: &Volume, what: &str) {
    assert_eq!((volume.data.dim(), volume.grid.shape), ((16, 14, 12), [16, 14, 12]), "{what}");
    for (found, want) in volume.grid.spacing.iter().zip([4.0, 4.5, 5.0]) {
        assert!((found - want).abs() < 1e-6, "{what}: {:?}", volume.grid.spacing);
    }
    let (mut off, mut sum) = (0.0, 0.0);
    for ((x, y, z), found) in volume.data.indexed_iter() {
        let mut mean = 0.0;
        for part in 0..216 {
            let at = [part % 6, part / 6 % 6, part / 36];
            let p: Vec3 = std::array::from_fn(|k| {
                let n = volume.grid.shape[k] as f64;
                ([x, y, z][k] as f64 + (at[k] as f64 + 0.5) / 6.0 - n / 2.0) * volume.grid.spacing[k]
            });
            let inside = |e: &usize| {
                let q = turned(sub(p, ELLIPSOIDS[*e].0), *e);
                dot(q, q) <= 1.0
            };
            mean += (0..3).filter(inside).map(|e| ELLIPSOIDS[e].3).sum::<f64>() / 216.0;
        }
        off += (f64::from(*found) - mean).abs();
        sum += mean;
    }
    assert!(off < 0.02 * sum, "{what}: {off} off of {sum}");
}

fn data_is_right(data: &DataSet, what: &str) {
    views_are_right(&data.train, 6, what);
    views_are_right(data.test.as_ref().unwrap(), 2, what);
    volume_is_right(data.volume.as_ref().unwrap(), what);
    assert_eq!(data.train.unit, Unit::default(), "{what}");
    let Stored::Scan(scan) = read_scan(file(what)).unwrap() else { panic!("{what}: counts") };
    assert_eq!((&scan.geometry, &scan.projections), (&data.train.geometry, &data.train.projections), "{what}");
    assert_eq!(read_truth(file(what)).unwrap().unwrap().data, data.volume.as_ref().unwrap().data, "{what}");
}

#[test]
fn nafs_pickle_is_read_as_it_is_meant() {
    for name in ["ellipsoids_numpy1.pickle", "ellipsoids_numpy2.pickle"] {
        let data = data_set(name);
        data_is_right(&data, name);
        let found = data.train.provenance["unit_from"].as_str().unwrap();
        assert!(found.contains("1/mm"), "{found}");
        // [v, u], as TIGRE has it.
        assert_eq!(data.train.provenance.get("offset_from"), None);
    }
    // The two differ because NumPy 2 renamed its modules.
    let bytes = |name: &str| std::fs::read(file(name)).unwrap();
    let holds = |name: &str, part: &[u8]| bytes(name).windows(part.len()).any(|w| w == part);
    assert!(holds("ellipsoids_numpy2.pickle", b"numpy._core") && !holds("ellipsoids_numpy1.pickle", b"numpy._core"));
}

#[test]
fn r2s_folder_is_read_as_it_is_meant() {
    let data = data_set("ellipsoids_r2");
    data_is_right(&data, "ellipsoids_r2");
    let found = data.train.provenance["unit_from"].as_str().unwrap();
    assert!(found.contains("lengths in m"), "{found}");
}

/// Verifies that the comparison can fail.
#[test]
fn another_convention_is_found_out() {
    let data = data_set("ellipsoids_r2");
    let fails = |change: &dyn Fn(&mut Scan)| {
        let mut scan = data.train.clone();
        change(&mut scan);
        std::panic::catch_unwind(|| views_are_right(&scan, 6, "changed")).is_err()
    };
    assert!(!fails(&|_| {}));
    assert!(fails(&|s| s.projections.invert_axis(ndarray::Axis(1))));
    assert!(fails(&|s| s.projections.invert_axis(ndarray::Axis(2))));
    assert!(fails(&|s| s.geometry.views.iter_mut().for_each(|v| v.detector[2] += 1.0)));
    assert!(fails(&|s| s.geometry = s.geometry.scaled(1.01)));
}
