//! Hounsfield units and DICOM series, from a volume to the files.

use crate::common::{conefield, done, json, refused, text};
use conefield_core::scan::Volume;
use conefield_io::{read_volume, write_volume};
use ndarray::Array3;
use std::fs;
use std::path::Path;
use tempfile::tempdir;

/// Attenuation of water in 1/mm.
const WATER: f32 = 0.0206;

/// A ball of water in air, 24³ voxels of 4 mm.
fn ball() -> Volume {
    let inside = |(x, y, z): (usize, usize, usize)| {
        [x, y, z].iter().map(|i| (4.0 * *i as f64 - 46.0).powi(2)).sum::<f64>() <= 34.0f64.powi(2)
    };
    Volume::centered(Array3::from_shape_fn((24, 24, 24), |at| if inside(at) { WATER } else { 0.0 }), [4.0; 3])
}

/// The mean of 4³ voxels from `first` on.
fn mean(volume: &Volume, first: [usize; 3]) -> f32 {
    let [x, y, z] = first.map(|i| i..i + 4);
    volume.data.slice(ndarray::s![x, y, z]).mean().unwrap()
}

/// Water in the middle is 0 HU and air in a corner -1000 HU, to `tolerance`.
fn is_hu(path: &Path, tolerance: f32) {
    let volume = read_volume(path).unwrap();
    let [water, air] = [[11, 9, 10], [0, 0, 0]].map(|first| mean(&volume, first));
    assert!(water.abs() <= tolerance && (air + 1000.0).abs() <= tolerance, "{}: {water} {air}", path.display());
}

#[test]
fn a_known_volume_becomes_hounsfield_units_in_every_format() {
    let dir = tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write_volume(at("a.mha"), &ball()).unwrap();
    fs::write(at("scanner.toml"), "water = 0.0206\nair = 0.0\nenergy_kev = 60.0\n").unwrap();
    let file = text(&at("scanner.toml"));
    let cases = [
        ("a.dicom", "water=0.0206,air=0", 0.02),
        ("b.nii.gz", "water=sphere:0,0,0,20,air=box:30,30,30,50,50,50", 1e-3),
        ("c.mha", &file[..], 1e-3),
        // The table has 0.02059/mm.
        ("d.nrrd", "60keV", 0.6),
    ];
    for (name, how, tolerance) in cases {
        done(&["convert", &text(&at("a.mha")), &text(&at(name)), "--hu", how]);
        is_hu(&at(name), tolerance);
    }
    let head = |name: &str, bytes: usize| String::from_utf8_lossy(&fs::read(at(name)).unwrap()[..bytes]).into_owned();
    assert!(head("c.mha", 400).contains("Comment = HU: water 0.0206, air 0 per mm at 60 keV\n"));
    assert!(head("d.nrrd", 400).contains("# HU: water 0.02059, air 0 per mm at 60 keV\n"));
    // Values that are Hounsfield units already stay.
    done(&["convert", &text(&at("b.nii.gz")), &text(&at("e.dicom")), "--hu", "as-is"]);
    is_hu(&at("e.dicom"), 0.02);
    // Without that they are no attenuation.
    let said = refused(1, &["convert", &text(&at("b.nii.gz")), &text(&at("g.nii")), "--hu", "60keV"]);
    assert!(said.contains("expected attenuation"), "{said}");
    // A series as a template for another one.
    let [template, other] = [at("a.dicom/0001.dcm"), at("f.dicom")].map(|p| text(&p));
    done(&["convert", &text(&at("a.mha")), &other, "--dicom-template", &template]);
    let said = refused(1, &["convert", &text(&at("a.mha")), &text(&at("f.nii")), "--dicom-template", &template]);
    assert!(said.contains("f.nii") && said.contains("template"), "{said}");
    assert!(!at("f.nii").exists());
    let said =
        refused(1, &["convert", &text(&at("a.mha")), &text(&at("a.dicom")), "--force", "--dicom-template", &template]);
    assert!(said.contains("which this command reads"), "{said}");
}

#[test]
fn a_reconstruction_is_within_one_hounsfield_unit() {
    let dir = tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let [truth, scan, run] = ["a.mha", "scan", "run"].map(|n| text(&at(n)));
    write_volume(&truth, &ball()).unwrap();
    let set_up = ["--dso", "500", "--dsd", "800", "--pixel", "4", "--detector", "64x64", "--views", "40"];
    done(&[&["simulate", &truth, "-o", &scan][..], &set_up].concat());
    // Water is measured beside the place where it is checked.
    let hu = "water=sphere:-12,0,0,10,air=box:-46,-46,-46,-38,-38,-38";
    let record = json(&["reconstruct", &scan, "--spec", "fista-tv", "-o", &run, "--hu", hu, "--json"]);
    let water = record["hounsfield"]["water"].as_f64().unwrap();
    assert!((water / f64::from(WATER) - 1.0).abs() < 0.01, "{record}");
    assert_eq!(record["scan"]["unit"]["name"], "mm");
    assert!(read_volume(at("run/volume.nii.gz")).unwrap().data.iter().all(|x| *x < 0.03));
    let series = text(&at("hu.dicom"));
    done(&["convert", &text(&at("run/volume-hu.nii.gz")), &series, "--hu", "as-is"]);
    is_hu(&at("hu.dicom"), 1.0);
    // A finished run with Hounsfield units is still a run.
    assert!(refused(1, &["reconstruct", &scan, "--spec", "fdk", "-o", &run]).contains("--force"));
    done(&["reconstruct", &scan, "--spec", "fdk", "-o", &run, "--force"]);
    assert!(!at("run/volume-hu.nii.gz").exists());
}

#[test]
fn hounsfield_units_without_a_unit_or_a_calibration_are_refused() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:16", "-o", &at("scan"), "--views", "8", "--detector", "16x16"]);
    let run = |hu: &str| refused(1, &["reconstruct", &at("scan"), "--spec", "fdk", "-o", &at("run"), "--hu", hu]);
    let said = run("60keV");
    assert!(said.contains("unit: found \"cube half side\"") && said.contains("regions"), "{said}");
    assert!(!dir.path().join("run").exists());
    assert!(run("water=box:90,90,90,99,99,99,air=0").contains("without a voxel"));
    let convert = |hu: &str| refused(1, &["convert", &at("scan/truth.nii.gz"), &at("a.nii"), "--hu", hu]);
    assert!(convert("water=0.02,air=0").contains("cube half side"));
    assert!(convert(&at("none.toml")).contains("none.toml"));
    assert!(refused(1, &["convert", &at("scan"), &at("r2"), "--to", "r2", "--hu", "60keV"]).contains("a volume"));
    let wrong = |hu: &str| {
        let args = ["convert", &at("scan/truth.nii.gz"), &at("a.nii"), "--hu", hu];
        let output = conefield(&args).assert().code(2).get_output().clone();
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(wrong("water=0.02").contains("such as water=0.0206,air=0"));
    assert!(wrong("2keV").contains("5 to 1250 keV"));
    // A record of another program beside the volume matters for Hounsfield units only.
    std::fs::create_dir(dir.path().join("other")).unwrap();
    std::fs::copy(dir.path().join("scan/truth.nii.gz"), dir.path().join("other/a.nii.gz")).unwrap();
    std::fs::write(dir.path().join("other/record.json"), "{\"spec\": \"mine\"}").unwrap();
    done(&["convert", &at("other/a.nii.gz"), &at("a.nii")]);
    let said = refused(1, &["convert", &at("other/a.nii.gz"), &at("b.nii"), "--hu", "water=0.02,air=0"]);
    assert!(said.contains("record.json"), "{said}");
}

#[test]
fn a_field_is_exported_as_a_series() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    write_volume(at("a.mha"), &ball()).unwrap();
    let set_up = ["--dso", "500", "--dsd", "800", "--pixel", "4", "--detector", "48x48", "--views", "10"];
    done(&[&["simulate", &at("a.mha"), "-o", &at("scan")][..], &set_up].concat());
    done(&["reconstruct", &at("scan"), "--spec", "fast", "--steps", "3", "-o", &at("run")]);
    let hu = ["--hu", "water=0.0206,air=0", "--json"];
    let said = json(&[&["export", &at("run"), "--voxels", "12", "-o", &at("hu.dicom")][..], &hu].concat());
    assert_eq!(said["hounsfield"]["water"], 0.0206);
    assert_eq!(read_volume(at("hu.dicom")).unwrap().grid.spacing, [8.0; 3]);
    // Weights alone do not say whether the unit is a length.
    fs::copy(at("run/weights.safetensors"), at("w.safetensors")).unwrap();
    let said = refused(1, &["export", &at("w.safetensors"), "-o", &at("b.nii"), "--hu", "60keV"]);
    assert!(said.contains("no record.json"), "{said}");
}

#[test]
fn a_set_up_by_options_is_the_one_of_a_protocol() {
    let dir = tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    write_volume(at("a.mha"), &ball()).unwrap();
    let protocol = "dso = 500.0\ndsd = 800.0\ndetector = [6, 8]\nextent = { pixel = [4.0, 3.0] }\n\
                    angles = { even = { views = 50 } }\n";
    fs::write(at("p.toml"), protocol).unwrap();
    let options = ["--dso", "500", "--dsd", "800", "--pixel", "4,3", "--detector", "6x8"];
    done(&[&["simulate", &at("a.mha"), "-o", &at("options")][..], &options].concat());
    done(&["simulate", &at("a.mha"), "-o", &at("protocol"), "--protocol", &at("p.toml")]);
    for file in ["scan.toml", "projections.npy"] {
        let [a, b] = ["options", "protocol"].map(|folder| fs::read(dir.path().join(folder).join(file)).unwrap());
        assert!(a == b, "{file}");
    }
    let [volume, no] = ["a.mha", "no"].map(at);
    for (args, words) in [
        (&["--dso", "500", "--dsd", "800", "--pixel", "4", "--detector", "6x8", "--protocol", "r2"][..], "--protocol"),
        (&["--dso", "500", "--pixel", "4", "--detector", "6x8"], "--dsd"),
        (&["--dsd", "500"], "--dso"),
        (&["--dso", "500", "--dsd", "800", "--pixel", "0", "--detector", "6x8"], "above 0"),
    ] {
        let all = [&["simulate", &volume, "-o", &no][..], args].concat();
        let output = conefield(&all).assert().code(2).get_output().clone();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(said.contains(words), "{args:?}: {said}");
    }
}
