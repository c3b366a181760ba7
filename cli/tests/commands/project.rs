//! `conefield project`: predicted views of a volume, and their residuals.

use crate::common::{Folder, number};
use conefield_core::geometry::View;
use conefield_io::{read_volume, write_volume};
use conefield_scans::read_scan;

/// A scan without noise, in a unit other than the millimetre.
const SCAN: &str = "simulate phantom:head:24 -o scan --views 7 --detector 20x28 --offset 0,3";

/// Whether the views are equal up to rounding: a file stores the numbers of an orbit.
fn alike(a: &[View], b: &[View]) -> bool {
    let numbers = |v: &View| [v.source, v.detector, v.u, v.v].concat();
    let near = |(a, b): (&View, &View)| numbers(a).iter().zip(numbers(b)).all(|(a, b)| (a - b).abs() < 1e-9);
    a.len() == b.len() && a.iter().zip(b).all(near)
}

#[test]
fn the_truth_explains_its_scan_and_nothing_else_does() {
    let d = Folder::after(&[SCAN]);
    let project = |volume: &str, name: &str| {
        d.json(&format!("project {volume} --like scan -o {name} --residual {name}-residual --json"))
    };
    let found = project("scan/truth.nii.gz", "true");
    let left = number(&found["residual_relative"]);
    // The simulation samples twice per voxel; Joseph interpolates from plane to plane.
    assert!(left > 0.0 && left < 0.02, "{found}");
    assert_eq!(found["views"], 7);
    assert_eq!(found["residual_rms_of_views"].as_array().unwrap().len(), 7);

    let read = |name: &str| read_scan(d.at(name)).unwrap();
    let [measured, predicted, residual] = ["scan", "true", "true-residual"].map(read);
    assert!(alike(&predicted.geometry.views, &measured.geometry.views));
    assert_eq!((predicted.geometry.volume, &predicted.unit), (measured.geometry.volume, &measured.unit));
    assert!(residual.projections == &measured.projections - &predicted.projections);
    let squares = residual.projections.mapv(|x| f64::from(x).powi(2));
    assert!((squares.mean().unwrap().sqrt() / number(&found["residual_rms"]) - 1.0).abs() < 1e-6);

    // Half the density leaves half of the line integrals, almost exactly.
    let truth = read_volume(d.at("scan/truth.nii.gz")).unwrap();
    write_volume(d.at("half.nii.gz"), &truth.clone().mapped(|x| 0.5 * x)).unwrap();
    project("half.nii.gz", "half");
    let half = read("half").projections;
    assert!(half.iter().zip(&predicted.projections).all(|(a, b)| (a - 0.5 * b).abs() <= 1e-5 * b.abs()));

    // An array without voxel sizes fills the same box.
    write_volume(d.at("array.npy"), &truth).unwrap();
    project("array.npy", "array");
    assert!(read("array").projections == predicted.projections);

    // Another projector and some views.
    let said = d.json("project scan/truth.nii.gz --like scan -o two --views 1,4 --projector siddon --json");
    assert!(said["views"] == 2 && number(&said["residual_relative"]) < 0.05, "{said}");
    assert_eq!(said["indices_of_views"], serde_json::json!([1, 4]));
    assert!(alike(&read("two").geometry.views, &[1, 4].map(|v| measured.geometry.views[v])));

    // The residual is also printed as text, and the result is a scan for every command.
    let said = d.done("project scan/truth.nii.gz --like scan -o two --force");
    assert!(said.contains("measured minus predicted"), "{said}");
    assert_eq!(d.json("info two --json")["views"], 7);
    let said = d.done("project scan/truth.nii.gz --like scan -o two --views 5,6 --force");
    assert!(said.contains("in view 5, the worst") || said.contains("in view 6, the worst"), "{said}");
}

#[test]
fn bad_input_is_refused_before_anything_is_written() {
    let d = Folder::after(&[SCAN]);
    d.put("text.nii", "no volume");
    d.refuses(
        "out",
        &[
            ("project none.nii --like scan -o out", "none.nii"),
            ("project text.nii --like scan -o out", "text.nii"),
            ("project scan/truth.nii.gz --like none -o out", "none"),
            ("project scan/truth.nii.gz --like scan/truth.nii.gz -o out", "a folder with scan.toml"),
            ("project scan/truth.nii.gz --like scan -o out --views 9", "below 7"),
            ("project scan/truth.nii.gz --like scan -o out --projector magic", "joseph, siddon, trilinear"),
            ("project scan/truth.nii.gz --like scan -o out --residual out", "another folder"),
            ("project scan/truth.nii.gz --like scan -o out --residual scan", "--force"),
            // An input is never replaced, even with --force.
            ("project scan/truth.nii.gz --like scan -o scan --force", "this command reads"),
            ("project scan/truth.nii.gz --like scan -o out --memory 1MiB", "--memory allows 1.0 MiB"),
        ],
    );
}
