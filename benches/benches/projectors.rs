//! Speed of what iterates and of FDK on 50 views of 512² pixels and 256³ voxels: Joseph forward and its adjoint and the
//! voxel-driven back-projection, upright and with a tilted detector, total variation, and a pass of FISTA that all of them
//! make up, against what the machine allows in the same run.
//!
//! `cargo bench -p conefield-benches --bench projectors`; `benches/peers/classical.sh` puts RTK beside it.

use conefield_backend_cpu::Cpu;
use conefield_benches::{bandwidth, multiply_adds, times};
use conefield_core::Result;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid, norm};
use conefield_core::method::{Context, Job, Silent};
use conefield_core::place::Host;
use conefield_core::regularizer::{Penalty, Update};
use conefield_core::scan::{Scan, ScanHeader, Unit};
use conefield_core::space::Space;
use conefield_core::spec::load::parse;
use conefield_core::voxel::VoxelOperator;
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::backproject::backproject;
use conefield_projectors::voxel::layout::ColumnMajor;
use conefield_solvers::iterative::tv::{TvProx, total_variation};
use ndarray::Array3;

const RUNS: usize = 5;
/// Dual steps of a proximal map.
const STEPS: usize = 4;

/// What a machine does at most in a second.
struct Limit {
    multiply_adds: f64,
    bytes: f64,
}

fn main() -> Result<()> {
    let geometry = geometry();
    let views: Vec<usize> = (0..geometry.views.len()).collect();
    let [rows, columns] = geometry.detector;
    let volume = Array3::from_shape_fn(geometry.volume.shape, |(x, y, z)| ((x * 7 + y * 3 + z) % 11) as f32 / 11.0);
    let mut projections = Array3::<f32>::zeros((views.len(), rows, columns));
    let mut back = Array3::<f32>::zeros(geometry.volume.shape);
    let forward = times(RUNS, || Joseph {}.forward(&geometry, &views, volume.view(), projections.view_mut()));
    // Every pixel whose ray meets the box, in each of about 256 planes; every voxel in every view.
    let samples = projections.iter().filter(|x| **x > 0.0).count() as f64 * 256.0;
    let updates = (volume.len() * views.len()) as f64;
    let adjoint = times(RUNS, || Joseph {}.adjoint(&geometry, &views, projections.view(), back.view_mut()));
    // The same orbit on a detector that is turned in its plane by half a degree.
    let mut turned = geometry.clone();
    for v in &mut turned.views {
        (v.u[2], v.v[2]) = (0.5f64.to_radians().sin() * norm(v.u), v.v[2] * 0.5f64.to_radians().cos());
    }
    let tilted = times(RUNS, || Joseph {}.forward(&turned, &views, volume.view(), projections.view_mut()));
    let tilted_back = times(RUNS, || Joseph {}.adjoint(&turned, &views, projections.view(), back.view_mut()));
    let scales = vec![1.0; views.len()];
    let mut drive = |geometry: &Geometry| {
        times(RUNS, || {
            for part in views.chunks(8) {
                let images = projections.slice(ndarray::s![part[0]..part[0] + part.len(), .., ..]);
                let pixels = ColumnMajor::new(geometry, part, images);
                backproject(geometry, part, &pixels, &scales[part[0]..], back.view_mut(), 0);
            }
        })
    };
    let (driven, driven_tilted) = (drive(&geometry), drive(&turned));
    let header = ScanHeader { views: 0, detector: [0; 2], volume: geometry.volume.shape };
    let mut prox =
        TvProx::new(geometry.volume.shape, [1.0; 3], STEPS, 1.0, &Space::new(header, std::sync::Arc::new(Host)))
            .unwrap();
    let (noisy, mut smooth) = (volume.as_slice().unwrap_or_default(), vec![0.0; volume.len()]);
    let dual = times(RUNS, || prox.prox(noisy, 0.1, &mut smooth));
    let mut arrays: [Vec<f32>; 3] = std::array::from_fn(|_| noisy.to_vec());
    let update = times(RUNS, || {
        let [gradient, ahead, x] = &mut arrays;
        let update = Update { gradient, ahead, x, step: -0.1, momentum: 0.5, towards: None, inside: None };
        prox.update(update, 0.1);
    });
    let value = times(RUNS, || assert!(total_variation(volume.view(), [1.0; 3], None, None) > 0.0));
    let scan = Scan { geometry, projections, unit: Unit::default(), provenance: serde_json::Value::Null };
    let fdk = solver(&scan, "type = \"fdk\"\n", RUNS)?;
    // What two passes more take, and what comes before the first.
    let [one, three] = [1, 3].map(|n| {
        let spec = format!("type = \"fista\"\nprior = \"total-variation\"\nstop = {{ passes = {n} }}\n");
        solver(&scan, &spec, 3)
    });
    let (one, three) = (one?, three?);
    let pass: [f64; 3] = std::array::from_fn(|k| (three[k] - one[k]) / 2.0);
    let limit = Limit { multiply_adds: multiply_adds(), bytes: bandwidth() };
    println!(
        "limits of this machine, measured now: {:.0} G multiply-adds/s, {:.1} GB/s from memory",
        limit.multiply_adds / 1e9,
        limit.bytes / 1e9
    );
    // A volume is read (and written) once for a batch of views, not once a view.
    let (voxels, volume) = (volume.len() as f64, 4.0 * volume.len() as f64);
    report("joseph forward", forward, samples, volume, &limit);
    report("joseph adjoint", adjoint, samples, 2.0 * volume, &limit);
    report("tilted forward", tilted, samples, volume, &limit);
    report("tilted adjoint", tilted_back, samples, 2.0 * volume, &limit);
    report("voxel-driven back", driven, updates, 2.0 * volume * views.len().div_ceil(8) as f64, &limit);
    report("tilted back", driven_tilted, updates, 2.0 * volume * views.len().div_ceil(8) as f64, &limit);
    report("fdk", fdk, updates, 2.0 * volume * views.len().div_ceil(8) as f64, &limit);
    // The dual is read and written, the volume is read, its proximal map is written. A step is 16 multiply-adds a voxel.
    report("tv, 4 dual steps", dual, 4.0 * STEPS as f64 * voxels, 8.0 * volume, &limit);
    // The gradient is read besides, and two volumes are read and written instead.
    report("tv, a whole update", update, 4.0 * STEPS as f64 * voxels, 11.0 * volume, &limit);
    report("tv, its value", value, 2.0 * voxels, volume, &limit);
    // Both directions of all views, and an update and a volume's gradient, cleared and filled, for each of ten subsets.
    report("fista-tv, a pass", pass, 2.0 * samples + 10.0 * 4.0 * STEPS as f64 * voxels, 10.0 * 15.0 * volume, &limit);
    println!("fista-tv, before the first pass: {:.2} s", one[1] - pass[1]);
    Ok(())
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

/// A whole method with all that comes before it.
fn solver(scan: &Scan, method: &str, runs: usize) -> Result<[f64; 3]> {
    let spec = parse(&format!("name = \"bench\"\n{method}"), "bench", &[], &[])?.spec;
    let backend = Cpu::new();
    let mut plan = spec.method.plan(&Context::new(&backend))?;
    let job = Job::new(scan, &backend);
    let mut failed = None;
    let spent = times(runs, || failed = plan.run(&job, &mut Silent).err());
    failed.map_or(Ok(spent), Err)
}

/// A sample or update is an interpolation between four numbers: 4 multiply-adds at least, of which two are shared by the
/// numbers along a line. `bytes` come from memory and go there at least.
fn report(name: &str, [low, median, high]: [f64; 3], work: f64, bytes: f64, limit: &Limit) {
    let (by_math, by_memory) = (4.0 * work / limit.multiply_adds, bytes / limit.bytes);
    println!(
        "{name:<20} {median:.3} s ({low:.3} to {high:.3}), {:.2} G updates/s, {:.0} % of the multiply-adds, {:.0} % of the \
         memory's rate",
        work / median / 1e9,
        100.0 * by_math / median,
        100.0 * by_memory / median
    );
}
