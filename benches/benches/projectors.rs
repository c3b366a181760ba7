//! Speed of the voxel projectors on 50 views of 512² pixels and 256³ voxels: Joseph forward, its adjoint and the
//! voxel-driven back-projection, against what the machine allows in the same run.
//!
//! `cargo bench -p conefield-benches --bench projectors`; `benches/peers/classical.sh` puts RTK beside it.

use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::voxel::VoxelOperator;
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::backproject::backproject;
use conefield_projectors::voxel::layout::ColumnMajor;
use ndarray::Array3;
use rayon::prelude::*;
use std::time::Instant;

const RUNS: usize = 5;

fn main() {
    let geometry = geometry();
    let views: Vec<usize> = (0..geometry.views.len()).collect();
    let [rows, columns] = geometry.detector;
    let volume = Array3::from_shape_fn(geometry.volume.shape, |(x, y, z)| ((x * 7 + y * 3 + z) % 11) as f32 / 11.0);
    let mut projections = Array3::<f32>::zeros((views.len(), rows, columns));
    let mut back = Array3::<f32>::zeros(geometry.volume.shape);
    // Every pixel whose ray meets the box, in each of about 256 planes; every voxel in every view.
    let forward = times(|| Joseph {}.forward(&geometry, &views, volume.view(), projections.view_mut()));
    let samples = projections.iter().filter(|x| **x > 0.0).count() as f64 * 256.0;
    let adjoint = times(|| Joseph {}.adjoint(&geometry, &views, projections.view(), back.view_mut()));
    let updates = (volume.len() * views.len()) as f64;
    let scales = vec![1.0; views.len()];
    let driven = times(|| {
        for part in views.chunks(8) {
            let images = projections.slice(ndarray::s![part[0]..part[0] + part.len(), .., ..]);
            let pixels = ColumnMajor::new(&geometry, part, images, |_, _, _, x| x);
            backproject(&geometry, part, &pixels, &scales, back.view_mut());
        }
    });
    report("joseph forward", forward, samples, "samples");
    report("joseph adjoint", adjoint, samples, "samples");
    report("voxel-driven back", driven, updates, "updates");
    println!("limits of this machine, measured now:");
    println!("  memory read        {:.1} GB/s", bandwidth() / 1e9);
}

fn geometry() -> Geometry {
    let mm = Millimetres;
    let angle = |i: usize| Radians(std::f64::consts::TAU * i as f64 / 50.0);
    let view = |i| View::circular(angle(i), mm(640.0), mm(896.0), [mm(1.0); 2], [mm(0.0); 2]);
    Geometry {
        detector: [512, 512],
        views: (0..50).map(view).collect(),
        volume: VoxelGrid { shape: [256; 3], spacing: [1.0; 3], center: [0.0; 3] },
    }
}

fn report(name: &str, [low, median, high]: [f64; 3], work: f64, unit: &str) {
    println!("{name:<20} {median:.3} s ({low:.3} to {high:.3}), {:.2} G {unit}/s", work / median / 1e9);
}
