//! Bounds of attenuation by region.

use crate::common::{scan, truth, voxels};
use conefield_backend_cpu::Cpu;
use conefield_core::scan::Scan;
use ndarray::Array3;
use serde_json::{Value, json};

/// The denser box of the test object, in mm.
const BOX: [[f64; 3]; 2] = [[-30.0, -20.0, -30.0], [10.0, 30.0, 20.0]];

fn within(mut method: Value, regions: &Value) -> Value {
    method["scene"] = json!({"bounds": {"regions": regions}});
    method
}

fn volume(method: &Value, scan: &Scan) -> Array3<f32> {
    voxels(&Cpu::new(), method, scan).unwrap()
}

/// Sum of squares of the difference to the object.
fn error(volume: &Array3<f32>) -> f32 {
    (volume - &truth().data).iter().map(|x| x * x).sum()
}

fn methods() -> Vec<Value> {
    let fista = |prior: Value| json!({"type": "fista", "prior": prior, "stop": {"passes": 5}});
    let mut samples = fista(json!("directional-total-variation"));
    samples["basis"] = json!({"type": "cubic", "spacing": 1, "samples": 13});
    vec![
        json!({"type": "sart", "stop": {"passes": 3}}),
        json!({"type": "sart", "nonnegative": false, "stop": {"passes": 3}}),
        json!({"type": "mlem", "stop": {"passes": 5}}),
        json!({"type": "cgls", "stop": {"passes": 4}}),
        json!({"type": "lsqr", "stop": {"passes": 4}}),
        json!({"type": "asd-pocs", "stop": {"passes": 3}}),
        fista(json!("none")),
        fista(json!("total-variation")),
        fista(json!("patches")),
        fista(json!({"type": "sum", "priors": ["total-variation", "directional-total-variation"]})),
        samples,
    ]
}

#[test]
fn a_region_of_known_attenuation_has_it_and_the_rest_gains() {
    let known = json!([{"within": {"cuboid": {"low": BOX[0], "high": BOX[1]}}, "low": 0.02, "high": 0.02}]);
    let scan = scan();
    let inside = |x: usize, y: usize, z: usize| truth().data[[x, y, z]] == 0.02;
    for method in methods() {
        let (plain, found) = (volume(&method, &scan), volume(&within(method.clone(), &known), &scan));
        // Differences of single precision come from lengths in mm.
        let wrong =
            found.indexed_iter().filter(|((x, y, z), v)| inside(*x, *y, *z) && (**v - 0.02).abs() > 1e-8).count();
        assert_eq!(wrong, 0, "{method}");
        let (before, after) = (error(&plain), error(&found));
        println!("{}: {before:.2e} without, {after:.2e} with the region", method["type"]);
        assert!(after < 0.95 * before, "{method}: {before} without, {after} with the region");
    }
}

/// A region may admit more than the rest, the last of two counts, and what is outside the support stays 0.
#[test]
fn regions_overlap_and_end_at_the_support() {
    let regions = json!([
        {"within": {"cylinder": {"radius": 60.0}}, "low": 0.015, "high": 0.03},
        {"within": {"cuboid": {"low": [-20, -20, -80], "high": [20, 20, 80]}}, "high": 0.001},
    ]);
    let scan = scan();
    for method in methods() {
        let mut method = within(method, &regions);
        method["scene"]["support"] = json!({"cylinder": {"radius": 40.0}});
        method["scene"]["bounds"]["high"] = json!(0.002);
        let found = volume(&method, &scan);
        for ((x, y, z), v) in found.indexed_iter() {
            let [px, py] = [x, y].map(|i| 10.0 * (i as f64 - 7.5));
            let [low, high] = match px.hypot(py) {
                // Voxels between samples inside and outside.
                r if r > 40.0 && method["basis"].is_object() => [0.0, 0.03],
                r if r > 40.0 => [0.0, 0.0],
                _ if px.abs() < 20.0 && py.abs() < 20.0 => [0.0, 0.001],
                _ => [0.015, 0.03],
            };
            let within = (low - 1e-8..=high + 1e-8).contains(v);
            assert!(within, "{method}: voxel {:?} is {v}, bounds {low} to {high}", [x, y, z]);
        }
    }
}

/// A region that admits less than 0 ends at the support, too.
#[test]
fn negative_bounds_end_at_the_support() {
    let regions = json!([{"within": {"cylinder": {"radius": 60.0}}, "low": -0.03, "high": 0.03}]);
    let scan = scan();
    for prior in [json!("none"), json!("total-variation"), json!("patches")] {
        let mut method = within(json!({"type": "fista", "prior": prior, "stop": {"passes": 2}}), &regions);
        method["scene"]["support"] = json!({"cylinder": {"radius": 40.0}});
        let found = volume(&method, &scan);
        let outside =
            |x: usize, y: usize| [x, y].map(|i| 10.0 * (i as f64 - 7.5)).iter().map(|p| p * p).sum::<f64>() > 1600.0;
        let wrong = found.indexed_iter().filter(|((x, y, _), v)| outside(*x, *y) && **v != 0.0).count();
        assert_eq!(wrong, 0, "{prior}");
        assert!(found.iter().any(|v| *v > 0.0), "{prior}");
    }
}

#[test]
fn regions_that_make_no_sense_are_refused() {
    let cuboid = json!({"cuboid": {"low": BOX[0], "high": BOX[1]}});
    let scan = scan();
    for (region, said) in [
        (json!({"within": "carve"}), "scene.bounds.regions.0.within"),
        (json!({"within": {"cylinder": {"radius": -1.0}}}), "scene.bounds.regions.0.within.cylinder.radius"),
        (json!({"within": cuboid, "low": 2.0, "high": 1.0}), "high not below low"),
        (
            json!({"within": {"cuboid": {"low": [900, 900, 900], "high": [990, 990, 990]}}}),
            "a region that meets the volume",
        ),
        (json!({"within": {"file": "mask.nii.gz"}}), "mask.nii.gz"),
    ] {
        let method = within(json!({"type": "sart", "stop": {"passes": 1}}), &json!([region]));
        let error = voxels(&Cpu::new(), &method, &scan).unwrap_err();
        assert!(error.to_string().contains(said), "{region}: {error}");
    }
}
