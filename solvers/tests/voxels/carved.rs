//! Voxel methods with a support of the object.

use crate::kit::{Case, Heard, bodies, geometry, method, psnr, volume};
use conefield_core::scan::Volume;
use conefield_projectors::simulate::{DetectorNoise, ellipsoids, scan_ellipsoids};
use conefield_solvers::support::carve;
use ndarray::Array3;

/// Volumes of a noisy scan, without and with the support, and the support itself.
fn solved(kind: &str, start: Option<&Volume>) -> [Volume; 2] {
    let scan = noisy();
    let start_line = start.map_or("", |_| "start = \"earlier.nii\"\n");
    ["box", "carve"].map(|support| {
        let text = method(kind, &format!("{start_line}scene.support = \"{support}\"\nstop = {{ passes = 6 }}"));
        Case { file: start, ..Case::of(&scan) }.volume(&text).0
    })
}

fn noisy() -> conefield_core::scan::Scan {
    let mut scan = scan_ellipsoids(&bodies(), geometry(24));
    let noise: DetectorNoise = "poisson:1e4".parse().unwrap();
    noise.add(&mut scan.projections, 5);
    scan
}

#[test]
fn voxels_outside_stay_empty_and_those_inside_are_as_good() {
    let truth = ellipsoids(&bodies(), &geometry(1).volume);
    let support = carve(&noisy()).support.unwrap();
    let outside = |v: &Volume| {
        let there = |((x, y, z), _): &((usize, usize, usize), &f32)| !support.holds(v.grid.voxel([*x, *y, *z]));
        v.data.indexed_iter().filter(there).map(|(_, x)| f64::from(x.abs())).sum::<f64>()
    };
    for kind in ["sart", "os-sart", "sirt", "mlem", "cgls", "lsqr", "asd-pocs", "fista-tv"] {
        let [without, with] = solved(kind, None);
        let (before, after) = (psnr(&without, &truth), psnr(&with, &truth));
        println!("{kind}: {before:.2} to {after:.2} dB, {:.4} outside before", outside(&without));
        assert!(outside(&without) > 0.0 && outside(&with) == 0.0, "{kind}");
        // Rays that are shorter inside correct more: algebraic methods reach the noise in fewer passes.
        assert!(after > before - 0.5, "{kind}: {before} to {after}");
    }
}

/// The voxels above 0 of a volume in a file are the support; a volume of other voxels, or an empty one, is refused.
#[test]
fn a_file_marks_the_support() {
    let scan = noisy();
    let grid = scan.geometry.volume;
    let half = Array3::from_shape_fn(grid.shape, |(x, y, _)| if x < 12 && y > 3 { 0.5 } else { 0.0 });
    let with = |data: Array3<f32>, kind: &str| {
        let file = Volume { grid, data, affine: None };
        let text = method(kind, "scene.support = { file = \"mask.nii\" }\nstop = { passes = 2 }");
        let mut heard = Heard::default();
        let solution = Case { file: Some(&file), ..Case::of(&scan) }.run(&text, &mut heard);
        solution.map(|solution| (volume(solution), heard))
    };
    for kind in ["os-sart", "mlem", "fista-tv"] {
        let (found, heard) = with(half.clone(), kind).unwrap();
        assert!(heard.said("support: the voxels above 0 in mask.nii"), "{:?}", heard.notes);
        let outside = found.data.indexed_iter().filter(|((x, y, _), v)| (*x >= 12 || *y <= 3) && **v != 0.0).count();
        assert!(outside == 0 && found.data.iter().any(|v| *v > 0.0), "{kind}: {outside} voxels");
    }
    for (data, says) in [
        (Array3::zeros(grid.shape), "mask.nii: voxels: found none above 0"),
        (Array3::ones([3, 4, 5]), "mask.nii: shape: found [3, 4, 5], expected [24, 24, 24]"),
    ] {
        let e = with(data, "os-sart").err().unwrap().to_string();
        assert!(e.contains(says), "{e}");
    }
}

/// The part of a start volume outside the support is removed.
#[test]
fn a_start_is_cut_to_the_support() {
    let full = Volume { data: ndarray::Array3::from_elem([24; 3], 0.01), ..ellipsoids(&[], &geometry(1).volume) };
    let support = carve(&noisy()).support.unwrap();
    let ([_, with], [_, without]) = (solved("cgls", Some(&full)), solved("cgls", None));
    assert!(with.data != without.data && with.data.iter().any(|v| *v > 0.0));
    let outside = with.data.indexed_iter().filter(|((x, y, z), _)| !support.holds(with.grid.voxel([*x, *y, *z])));
    assert!(outside.map(|(_, v)| *v).all(|v| v == 0.0));
}
