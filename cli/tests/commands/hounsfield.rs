//! Hounsfield units and DICOM series, from a volume to the files.

use crate::common::{Folder, SCAN, number};
use conefield_core::scan::Volume;
use conefield_io::{read_volume, write_volume};
use ndarray::Array3;
use std::fs;

/// Attenuation of water in 1/mm.
const WATER: f32 = 0.0206;

/// A ball of water in air, 24³ voxels of 4 mm, in `a.mha`.
fn ball() -> Folder {
    let inside = |(x, y, z): (usize, usize, usize)| {
        [x, y, z].iter().map(|i| (4.0 * *i as f64 - 46.0).powi(2)).sum::<f64>() <= 34.0f64.powi(2)
    };
    let data = Array3::from_shape_fn((24, 24, 24), |at| if inside(at) { WATER } else { 0.0 });
    let d = Folder::new();
    write_volume(d.at("a.mha"), &Volume::centered(data, [4.0; 3])).unwrap();
    d
}

/// The mean of 4³ voxels from `first` on.
fn mean(volume: &Volume, first: [usize; 3]) -> f32 {
    let [x, y, z] = first.map(|i| i..i + 4);
    volume.data.slice(ndarray::s![x, y, z]).mean().unwrap()
}

/// Water in the middle is 0 HU and air in a corner -1000 HU, to `tolerance`.
fn is_hu(d: &Folder, name: &str, tolerance: f32) {
    let volume = read_volume(d.at(name)).unwrap();
    let [water, air] = [[11, 9, 10], [0, 0, 0]].map(|first| mean(&volume, first));
    assert!(water.abs() <= tolerance && (air + 1000.0).abs() <= tolerance, "{name}: {water} {air}");
}

#[test]
fn a_known_volume_becomes_hounsfield_units_in_every_format() {
    let d = ball();
    d.put("scanner.toml", "water = 0.0206\nair = 0.0\nenergy_kev = 60.0\n");
    for (name, how, tolerance) in [
        ("a.dicom", "water=0.0206,air=0", 0.02),
        ("b.nii.gz", "water=sphere:0,0,0,20,air=box:30,30,30,50,50,50", 1e-3),
        ("c.mha", "scanner.toml", 1e-3),
        // The table has 0.02059/mm.
        ("d.nrrd", "60keV", 0.6),
    ] {
        d.done(&format!("convert a.mha {name} --hu {how}"));
        is_hu(&d, name, tolerance);
    }
    let head = |name: &str| String::from_utf8_lossy(&d.bytes(name)[..400]).into_owned();
    assert!(head("c.mha").contains("Comment = HU: water 0.0206, air 0 per mm at 60 keV\n"));
    assert!(head("d.nrrd").contains("# HU: water 0.02059, air 0 per mm at 60 keV\n"));
    // Values that are Hounsfield units already stay.
    d.done("convert b.nii.gz e.dicom --hu as-is");
    is_hu(&d, "e.dicom", 0.02);
    // A series as a template for another one.
    let template = "--dicom-template a.dicom/0001.dcm";
    d.done(&format!("convert a.mha f.dicom {template}"));
    d.refuses(
        "g.nii",
        &[
            // Without `as-is` they are no attenuation.
            ("convert b.nii.gz g.nii --hu 60keV", "expected attenuation"),
            ("convert b.nii.gz g.nii --values hu:0.02 --hu as-is", "these values are attenuation"),
            // Clipped values have no unit.
            ("convert a.mha g.nii --values clip:0,0.02 --hu 60keV", "a unit of length"),
            (&format!("convert a.mha g.nii {template}"), "template"),
            (&format!("convert a.mha a.dicom --force {template}"), "which this command reads"),
        ],
    );
}

#[test]
fn a_reconstruction_is_within_one_hounsfield_unit() {
    let d = ball();
    d.done("simulate a.mha -o scan --dso 500 --dsd 800 --pixel 4 --detector 64x64 --views 40");
    // Water is measured beside the place where it is checked.
    let hu = "water=sphere:-12,0,0,10,air=box:-46,-46,-46,-38,-38,-38";
    let record = d.json(&format!("reconstruct scan --spec fista-tv -o run --hu {hu} --json"));
    let water = number(&record["hounsfield"]["water"]);
    assert!((water / f64::from(WATER) - 1.0).abs() < 0.01, "{record}");
    assert_eq!(record["scan"]["unit"]["name"], "mm");
    assert!(read_volume(d.at("run/volume.nii.gz")).unwrap().data.iter().all(|x| *x < 0.03));
    d.done("convert run/volume-hu.nii.gz hu.dicom --hu as-is");
    is_hu(&d, "hu.dicom", 1.0);
    d.refuses("x.dicom", &[("convert run/volume.nii.gz x.dicom --hu as-is", "these values are attenuation")]);
    // A finished run with Hounsfield units is still a run.
    assert!(d.refused(1, "reconstruct scan --spec fdk -o run").contains("--force"));
    d.done("reconstruct scan --spec fdk -o run --force");
    assert!(!d.has("run/volume-hu.nii.gz"));
}

#[test]
fn hounsfield_units_without_a_unit_or_a_calibration_are_refused() {
    let d = Folder::after(&[SCAN]);
    // A record of another program beside the volume matters for Hounsfield units only.
    fs::create_dir(d.at("other")).unwrap();
    d.put("other/a.nii.gz", d.bytes("scan/truth.nii.gz"));
    d.put("other/record.json", "{\"spec\": \"mine\"}");
    d.done("convert other/a.nii.gz a.nii");
    d.refused_with(1, "reconstruct scan --spec fdk -o run --hu 60keV", &["unit: found \"cube half side\"", "regions"]);
    let empty = "reconstruct scan --spec fdk -o run --hu water=box:90,90,90,99,99,99,air=0";
    d.refuses("run", &[(empty, "found box:90,90,90,99,99,99 without a voxel")]);
    let convert = |hu: &str| format!("convert scan/truth.nii.gz b.nii --hu {hu}");
    d.refuses(
        "b.nii",
        &[
            (&convert("water=0.02,air=0"), "cube half side"),
            (&convert("none.toml"), "none.toml"),
            ("convert other/a.nii.gz b.nii --hu water=0.02,air=0", "record.json"),
            ("convert scan b.nii --to r2 --hu 60keV", "a volume"),
        ],
    );
    for (hu, words) in [("water=0.02", "such as water=0.0206,air=0"), ("2keV", "5 to 1250 keV")] {
        d.refused_with(2, &convert(hu), &[words]);
    }
}

#[test]
fn a_field_is_exported_as_a_series() {
    let d = ball();
    d.done("simulate a.mha -o scan --dso 500 --dsd 800 --pixel 4 --detector 48x48 --views 10");
    d.done("reconstruct scan --spec fast --steps 3 -o run");
    let said = d.json("export run --voxels 12 -o hu.dicom --hu water=0.0206,air=0 --json");
    assert_eq!(said["hounsfield"]["water"], 0.0206);
    assert_eq!(read_volume(d.at("hu.dicom")).unwrap().grid.spacing, [8.0; 3]);
    // Weights alone do not say whether the unit is a length.
    d.put("w.safetensors", d.bytes("run/weights.safetensors"));
    d.refuses("b.nii", &[("export w.safetensors -o b.nii --hu 60keV", "no record.json")]);
}

#[test]
fn a_set_up_by_options_is_the_one_of_a_protocol() {
    let d = ball();
    let protocol = "dso = 500.0\ndsd = 800.0\ndetector = [6, 8]\nextent = { pixel = [4.0, 3.0] }\n\
                    angles = { even = { views = 50 } }\n";
    d.put("p.toml", protocol);
    d.done("simulate a.mha -o options --dso 500 --dsd 800 --pixel 4,3 --detector 6x8");
    d.done("simulate a.mha -o protocol --protocol p.toml");
    for file in ["scan.toml", "projections.npy"] {
        assert!(d.bytes(format!("options/{file}")) == d.bytes(format!("protocol/{file}")), "{file}");
    }
    for (args, words) in [
        ("--dso 500 --dsd 800 --pixel 4 --detector 6x8 --protocol r2", "--protocol"),
        ("--dso 500 --pixel 4 --detector 6x8", "--dsd"),
        ("--dsd 500", "--dso"),
        ("--dso 500 --dsd 800 --pixel 0 --detector 6x8", "above 0"),
    ] {
        let said = d.refused(2, &format!("simulate a.mha -o no {args}"));
        assert!(said.contains(words), "{args}: {said}");
    }
}
