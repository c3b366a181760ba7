//! `conefield project`: predicted views of a volume, and their residuals.

use crate::common::{done, json, refused, text};
use conefield_core::geometry::View;
use conefield_io::{read_volume, write_volume};
use conefield_scans::read_scan;
use std::fs;
use std::path::Path;
use tempfile::tempdir;

/// A scan without noise, in a unit other than the millimetre.
fn simulate(folder: &Path) -> String {
    let scan = text(&folder.join("scan"));
    done(&["simulate", "phantom:head:24", "-o", &scan, "--views", "7", "--detector", "20x28", "--offset", "0,3"]);
    scan
}

/// Whether the views are equal up to rounding: a file stores the numbers of an orbit.
fn alike(a: &[View], b: &[View]) -> bool {
    let numbers = |v: &View| [v.source, v.detector, v.u, v.v].concat();
    let near = |(a, b): (&View, &View)| numbers(a).iter().zip(numbers(b)).all(|(a, b)| (a - b).abs() < 1e-9);
    a.len() == b.len() && a.iter().zip(b).all(near)
}

#[test]
fn the_truth_explains_its_scan_and_nothing_else_does() {
    let dir = tempdir().unwrap();
    let scan = simulate(dir.path());
    let at = |name: &str| text(&dir.path().join(name));
    let project = |volume: &str, name: &str| {
        let (out, residual) = (at(name), at(&format!("{name}-residual")));
        json(&["project", volume, "--like", &scan, "-o", &out, "--residual", &residual, "--json"])
    };
    let truth = format!("{scan}/truth.nii.gz");
    let found = project(&truth, "true");
    let left = found["residual_relative"].as_f64().unwrap();
    // The simulation samples twice per voxel; Joseph interpolates from plane to plane.
    assert!(left > 0.0 && left < 0.02, "{found}");
    assert_eq!(found["views"], 7);
    assert_eq!(found["residual_rms_of_views"].as_array().unwrap().len(), 7);

    let [measured, predicted, residual] =
        [&scan, &at("true"), &at("true-residual")].map(|folder| read_scan(folder).unwrap());
    assert!(alike(&predicted.geometry.views, &measured.geometry.views));
    assert_eq!((predicted.geometry.volume, &predicted.unit), (measured.geometry.volume, &measured.unit));
    assert!(residual.projections == &measured.projections - &predicted.projections);
    let rms = (residual.projections.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>()
        / residual.projections.len() as f64)
        .sqrt();
    assert!((rms / found["residual_rms"].as_f64().unwrap() - 1.0).abs() < 1e-6);

    // Half the density leaves half of the line integrals, almost exactly.
    let mut half = read_volume(&truth).unwrap();
    half.data.mapv_inplace(|x| 0.5 * x);
    write_volume(at("half.nii.gz"), &half).unwrap();
    project(&at("half.nii.gz"), "half");
    let half = read_scan(at("half")).unwrap().projections;
    assert!(half.iter().zip(&predicted.projections).all(|(a, b)| (a - 0.5 * b).abs() <= 1e-5 * b.abs()));

    // An array without voxel sizes fills the same box.
    write_volume(at("array.npy"), &read_volume(&truth).unwrap()).unwrap();
    project(&at("array.npy"), "array");
    assert!(read_scan(at("array")).unwrap().projections == predicted.projections);

    // Another projector and some views.
    let two = ["--views", "1,4", "--projector", "siddon", "--json"];
    let out = at("two");
    let said = json(&[&["project", &truth, "--like", &scan, "-o", &out][..], &two].concat());
    assert!(said["views"] == 2 && said["residual_relative"].as_f64().unwrap() < 0.05, "{said}");
    let two = read_scan(&out).unwrap();
    assert!(alike(&two.geometry.views, &[1, 4].map(|v| measured.geometry.views[v])));

    // The residual is also printed as text, and the result is a scan for every command.
    let said = done(&["project", &truth, "--like", &scan, "-o", &out, "--force"]);
    assert!(said.contains("measured minus predicted"), "{said}");
    assert_eq!(json(&["info", &out, "--json"])["views"], 7);
}

#[test]
fn bad_input_is_refused_before_anything_is_written() {
    let dir = tempdir().unwrap();
    let scan = simulate(dir.path());
    let truth = format!("{scan}/truth.nii.gz");
    let at = |name: &str| text(&dir.path().join(name));
    fs::write(at("text.nii"), "no volume").unwrap();
    let out = at("out");
    let run = |volume: &str, like: &str, more: &[&str]| {
        let said = refused(1, &[&["project", volume, "--like", like, "-o", &out][..], more].concat());
        assert!(!Path::new(&out).exists(), "{said}");
        said
    };
    for (volume, like, more, want) in [
        (&at("none.nii"), &scan, &[][..], "none.nii"),
        (&at("text.nii"), &scan, &[], "text.nii"),
        (&truth, &at("none"), &[], "none"),
        (&truth, &truth, &[], "a folder with scan.toml"),
        (&truth, &scan, &["--views", "9"], "below 7"),
        (&truth, &scan, &["--projector", "magic"], "joseph, siddon, trilinear"),
        (&truth, &scan, &["--residual", &out], "another folder"),
        (&truth, &scan, &["--residual", &scan], "--force"),
    ] {
        let said = run(volume, like, more);
        assert!(said.contains(want), "{more:?}: {said}");
    }
    // An input is never replaced, even with --force.
    let said = refused(1, &["project", &truth, "--like", &scan, "-o", &scan, "--force"]);
    assert!(said.contains("this command reads"), "{said}");
    let said = refused(1, &["--memory", "1MiB", "project", &truth, "--like", &scan, "-o", &out]);
    assert!(said.contains("--memory allows 1.0 MiB"), "{said}");
}
