//! Compares line integrals with closed forms and with an exact scan, and noise with its statistics.

use super::*;
use conefield_core::geometry::{Millimetres, Radians, Vec3, View, VoxelGrid};
use ndarray::{Array2, Array3};
use std::path::PathBuf;
use std::sync::Mutex;

fn on<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// A cube of side 2 mm.
fn grid(n: usize) -> VoxelGrid {
    VoxelGrid { shape: [n; 3], spacing: [2.0 / n as f64; 3], center: [0.0; 3] }
}

fn relative_error(found: &Array3<f32>, exact: &Array3<f32>) -> f64 {
    let square = |x: f32| f64::from(x) * f64::from(x);
    let error: f64 = found.iter().zip(exact).map(|(&a, &b)| square(a - b)).sum();
    (error / exact.iter().copied().map(square).sum::<f64>()).sqrt()
}

const BODIES: [Ellipsoid; 2] = [
    Ellipsoid { center: [0.1, -0.05, 0.0], axes: [0.6, 0.45, 0.7], value: 0.8 },
    Ellipsoid { center: [-0.2, 0.1, 0.25], axes: [0.2, 0.15, 0.25], value: -0.3 },
];

/// Relative error of the projections of the bodies in `n³` voxels, moved by `shift` voxels, relative to the chords.
fn chord_error(n: usize, shift: Vec3) -> f64 {
    let mut volume = ellipsoids(&BODIES, &grid(n));
    let geometry = Protocol::r2(&volume.grid).with_detector([40, 48]).with_views(5).geometry(&volume.grid).unwrap();
    volume.grid.center = shift.map(|s| s * volume.grid.spacing[0]);
    let found = project(&volume, &geometry, 2.0).unwrap();
    relative_error(&found, &scan_ellipsoids(&BODIES, geometry).projections)
}

#[test]
fn projections_of_ellipsoids_converge_to_their_chords() {
    // Voxels blur an edge over their size h: errors of √h in a band of width h, so an RMS error in proportion to h.
    let errors = [16, 32, 64].map(|n| chord_error(n, [0.0; 3]));
    assert!(errors[0] < 0.1 && errors[1] < 0.6 * errors[0] && errors[2] < 0.6 * errors[1], "{errors:?}");
    assert!(errors[2] < 0.03, "{errors:?}");
}

#[test]
fn voxels_are_where_the_grid_says() {
    let best = chord_error(32, [0.0; 3]);
    for axis in 0..3 {
        for side in [-0.3, 0.3] {
            let mut shift = [0.0; 3];
            shift[axis] = side;
            let moved = chord_error(32, shift);
            assert!(moved > 1.02 * best, "{moved} after {shift:?} voxels, {best} before");
        }
    }
}

#[test]
fn a_constant_box_gives_the_length_of_the_ray_in_it() {
    // The outer half voxel counts: the constant reaches the faces of the box.
    let grid = VoxelGrid { shape: [5, 9, 7], spacing: [0.5, 0.25, 0.3], center: [0.1, -0.2, 0.05] };
    let volume = Volume { data: Array3::from_elem(grid.shape, 2.0), grid, affine: None };
    let mm = Millimetres;
    let views =
        [0.0, 0.4, 1.9].map(|a| View::circular(Radians(a), mm(9.0), mm(13.0), [mm(0.13); 2], [mm(0.1), mm(0.2)]));
    let geometry = Geometry { detector: [31, 29], views: views.to_vec(), volume: grid };
    let found = project(&volume, &geometry, 3.0).unwrap();
    for ((v, r, c), &x) in found.indexed_iter() {
        let length = geometry.ray(v, r, c).clip(grid.bounds()).map_or(0.0, |[near, far]| far - near);
        assert!((f64::from(x) - 2.0 * length).abs() < 1e-5, "{x} for a length of {length}");
    }
}

#[test]
fn skipping_empty_blocks_changes_nothing() {
    // Single voxels at block boundaries, compared with the plain sum over all samples of a volume without empty blocks.
    let n = 40;
    let mut volume = Volume { data: Array3::zeros((n, n, n)), grid: grid(n), affine: None };
    for at in [[0, 0, 0], [7, 8, 15], [16, 23, 24], [31, 32, 39], [39, 39, 39], [6, 6, 6], [14, 22, 30]] {
        volume.data[at] = 1.0;
    }
    let geometry = Protocol::r2(&volume.grid).with_detector([60, 60]).with_views(7).geometry(&volume.grid).unwrap();
    let sparse = project(&volume, &geometry, 2.0).unwrap();
    let full = Volume { data: &volume.data + 1.0, ..volume.clone() };
    let ones = Volume { data: Array3::from_elem((n, n, n), 1.0), ..volume };
    let full = project(&full, &geometry, 2.0).unwrap() - project(&ones, &geometry, 2.0).unwrap();
    for (a, b) in sparse.iter().zip(&full) {
        assert!((a - b).abs() < 2e-5, "{a} {b}");
    }
}

#[test]
fn projection_is_the_same_on_any_number_of_threads() {
    let volume = phantom(32);
    let protocol = Protocol::r2(&volume.grid)
        .with_detector([50, 34])
        .with_views(6)
        .with_noise(DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 }, 5);
    let one = on(1, || simulate(&volume, &protocol).unwrap());
    let three = on(3, || simulate(&volume, &protocol).unwrap());
    assert_eq!(one.projections, three.projections);
    let shares = Mutex::new(vec![]);
    let heard = simulate_with(&volume, &protocol, &|share| shares.lock().unwrap().push(share)).unwrap();
    let shares = shares.into_inner().unwrap();
    assert!(heard.projections == one.projections && shares.len() == 6 && shares.contains(&1.0), "{shares:?}");
    assert_ne!(
        one.projections,
        simulate(&volume, &Protocol { seed: 6, ..protocol.clone() }).unwrap().projections,
        "another seed"
    );
    // A view's noise is independent: the same view of a scan with more views has the same noise.
    let noise = DetectorNoise::Poisson { i0: 1e3 };
    let mut few = Array3::from_elem((2, 8, 8), 0.5f32);
    let mut many = Array3::from_elem((5, 8, 8), 0.5f32);
    noise.add(&mut few, 1);
    noise.add(&mut many, 1);
    assert_eq!(few.index_axis(ndarray::Axis(0), 1), many.index_axis(ndarray::Axis(0), 1));
    assert_ne!(many.index_axis(ndarray::Axis(0), 0), many.index_axis(ndarray::Axis(0), 1));
}

#[test]
fn phantoms_are_the_same_on_any_number_of_threads() {
    for kind in [PhantomKind::Head, PhantomKind::Abdomen, PhantomKind::Random(7), PhantomKind::Random(u64::MAX)] {
        let one = on(1, || phantom_of(kind, 24));
        assert_eq!(one.data, on(3, || phantom_of(kind, 24)).data, "{kind}");
        assert!(one.data.iter().all(|x| (0.0..=1.0).contains(x)));
        let filled = one.data.iter().filter(|x| **x > 0.0).count() as f64 / one.data.len() as f64;
        assert!((0.05..0.9).contains(&filled), "{kind}: {filled} of the cube is not air");
    }
    assert_ne!(phantom_of(PhantomKind::Random(1), 16).data, phantom_of(PhantomKind::Random(2), 16).data);
    assert_eq!(phantom(0).data.len(), 0);
    // Bone around brain: along the middle of the head, dense tissue lies before and after soft tissue.
    let head = phantom(64);
    let line: Vec<f32> = (0..64).map(|i| head.data[[i, 32, 42]]).collect();
    assert!(
        (0.3..0.5).contains(&line[28]) && line[..28].iter().any(|x| *x > 0.6) && line[36..].iter().any(|x| *x > 0.6)
    );
}

/// Mean and variance of the counts of a constant line integral.
fn counts(noise: DetectorNoise, value: f32, scale: f64, i0: f64) -> (f64, f64) {
    let mut pixels = Array3::from_elem((2, 300, 300), value);
    noise.add(&mut pixels, 3);
    let counts: Vec<f64> = pixels.iter().map(|&a| i0 * (-f64::from(a) / scale).exp()).collect();
    let n = counts.len() as f64;
    let mean = counts.iter().sum::<f64>() / n;
    (mean, counts.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / (n - 1.0))
}

#[test]
fn noise_has_the_statistics_of_its_photons() {
    // The standard errors of mean and variance over 180 000 pixels are below 0.003 and 0.004 of the values.
    let (i0, a) = (1e4, 1.5f32);
    let expected = i0 * (-1.5f64).exp();
    let (mean, variance) = counts(DetectorNoise::Poisson { i0 }, a, 1.0, i0);
    assert!((mean / expected - 1.0).abs() < 2e-4, "{mean} {expected}");
    assert!((variance / expected - 1.0).abs() < 0.02, "{variance} {expected}");
    // The largest value is the scale: I = i0/e; read-out noise adds its variance.
    let expected = i0 * (-1f64).exp();
    let (mean, variance) = counts(DetectorNoise::Tigre { i0, sigma: 30.0 }, 7.0, 7.0, i0);
    assert!((mean / expected - 1.0).abs() < 2e-4, "{mean} {expected}");
    assert!((variance / (expected + 900.0) - 1.0).abs() < 0.02, "{variance}");
}

#[test]
fn noise_stays_finite_where_no_photon_arrives() {
    let mut dark = Array3::from_elem((1, 20, 20), 60f32);
    DetectorNoise::Poisson { i0: 100.0 }.add(&mut dark, 0);
    let floor = -(MIN_COUNT / 100.0).ln() as f32;
    assert!(dark.iter().all(|a| (a - floor).abs() < 1e-5));
    let mut noisy = Array3::from_elem((1, 50, 50), 1f32);
    noisy[[0, 0, 0]] = 0.0;
    DetectorNoise::Tigre { i0: 2.0, sigma: 5.0 }.add(&mut noisy, 0);
    assert!(noisy.iter().all(|a| a.is_finite() && *a >= 0.0));
    let mut empty = Array3::<f32>::zeros((1, 4, 4));
    DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 }.add(&mut empty, 0);
    assert!(empty.iter().all(|a| *a == 0.0));
}

#[test]
fn noise_is_written_as_it_is_read() {
    for (text, noise) in [
        ("none", DetectorNoise::None),
        ("tigre:1e4,10", DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 }),
        (" poisson:1e5", DetectorNoise::Poisson { i0: 1e5 }),
    ] {
        assert_eq!(text.parse::<DetectorNoise>().unwrap(), noise);
        assert_eq!(noise.to_string().parse::<DetectorNoise>().unwrap(), noise);
    }
    for text in ["", "tiger:1e4,10", "tigre", "tigre:1e4", "tigre:1e4,ten", "poisson:", "none:3"] {
        let e = text.parse::<DetectorNoise>().unwrap_err().to_string();
        assert!(e.contains(&format!("`{text}`")) && e.contains("tigre:1e4,10"), "{e}");
    }
    for text in ["poisson:0", "poisson:NaN", "poisson:-5", "tigre:1e30,1", "tigre:1e4,-1", "tigre:1e4,inf"] {
        let e = text.parse::<DetectorNoise>().unwrap_err().to_string();
        assert!(e.contains("noise") && e.contains("number"), "{e}");
    }
}

#[test]
fn phantoms_and_mappings_say_what_they_do_not_know() {
    for kind in [PhantomKind::Head, PhantomKind::Abdomen, PhantomKind::Random(12)] {
        assert_eq!(kind.to_string().parse::<PhantomKind>().unwrap(), kind);
    }
    for text in ["foot", "random", "random:-1"] {
        assert!(text.parse::<PhantomKind>().unwrap_err().to_string().contains("random:SEED"));
    }
    for text in ["mu:0.02", "clip:-1000,2000"] {
        assert_eq!(text.parse::<HuMapping>().unwrap().to_string(), text);
    }
    for text in ["mu", "mu:0", "mu:inf", "clip:5", "clip:2,1", "window:1,2"] {
        let e = text.parse::<HuMapping>().unwrap_err().to_string();
        assert!(e.contains(text), "{e}");
    }
}

#[test]
fn hounsfield_units_become_attenuation_or_a_fraction() {
    let mu: HuMapping = "mu:0.02".parse().unwrap();
    assert_eq!([-2000.0, -1000.0, 0.0, 1000.0].map(|hu| mu.value(hu)), [0.0, 0.0, 0.02, 0.04]);
    let clip: HuMapping = "clip:-1000,2000".parse().unwrap();
    assert_eq!([-3000.0, -1000.0, 500.0, 2000.0, 9000.0].map(|hu| clip.value(hu)), [0.0, 0.0, 0.5, 1.0, 1.0]);
    let mut volume = Volume::centered(Array3::zeros((2, 2, 2)), [1.0; 3]);
    volume.data[[1, 0, 1]] = f32::NAN;
    assert!(clip.apply(volume).unwrap_err().to_string().contains("volume[1, 0, 1]"));
}

#[test]
fn downsampling_averages_and_keeps_the_place() {
    let data = Array3::from_shape_fn((4, 5, 6), |(i, j, k)| (i + 10 * j + 100 * k) as f32);
    let mut volume = Volume::centered(data, [1.0, 2.0, 0.5]);
    volume.affine = Some([[1.0, 0.0, 0.0, 7.0], [0.0, -2.0, 0.0, 8.0], [0.0, 0.0, 0.5, 9.0], [0.0, 0.0, 0.0, 1.0]]);
    let half = downsample(&volume, 2).unwrap();
    assert_eq!(half.grid.shape, [2, 2, 3]);
    assert_eq!(half.data[[0, 0, 0]], 55.5);
    assert_eq!(half.grid.spacing, [2.0, 4.0, 1.0]);
    // A new voxel's centre is the mean of the old voxels' centres, in the grid and by the affine.
    let (a, b) = (volume.grid.voxel([2, 2, 4]), volume.grid.voxel([3, 3, 5]));
    assert_eq!(half.grid.voxel([1, 1, 2]), std::array::from_fn(|k| (a[k] + b[k]) / 2.0));
    let affine = half.affine.unwrap();
    assert_eq!(affine[1], [0.0, -4.0, 0.0, 7.0]);
    assert_eq!(affine[0][3], 7.5);
    assert_eq!(downsample(&volume, 1).unwrap().data, volume.data);
    for factor in [0, 5] {
        assert!(downsample(&volume, factor).unwrap_err().to_string().contains("factor"));
    }
}

#[test]
fn the_published_protocol_is_scaled_to_the_volume() {
    let grid = VoxelGrid { shape: [64, 32, 16], spacing: [2.0; 3], center: [0.0; 3] };
    let protocol = Protocol::r2(&grid).with_detector([128, 256]);
    let geometry = protocol.geometry(&grid).unwrap();
    assert_eq!((protocol.unit.mm, protocol.unit.name.as_str()), (64.0, "cube half side"));
    assert_eq!((geometry.views.len(), geometry.detector), (50, [128, 256]));
    assert_eq!(geometry.views[0].source, [320.0, 0.0, 0.0]);
    assert_eq!(geometry.views[0].detector, [-128.0, 0.0, 0.0]);
    assert_eq!((geometry.views[0].u, geometry.views[0].v), ([0.0, 1.0, 0.0], [0.0, 0.0, -2.0]));
    // The result has no unit: a volume twice as large with the same values gives the same projections.
    let data = phantom(16).data;
    let scan = |mm: f64| {
        let volume = Volume::centered(data.clone(), [mm; 3]);
        simulate(&volume, &Protocol::r2(&volume.grid).with_detector([20, 20]).with_views(3)).unwrap()
    };
    for (a, b) in scan(1.0).projections.iter().zip(&scan(1000.0).projections) {
        assert!((a - b).abs() < 1e-5);
    }
    assert_eq!(scan(2.0).provenance["simulated"]["protocol"]["dso"], 5.0);
    assert_eq!(scan(2.0).provenance["simulated"]["protocol"]["noise"], "none");
}

#[test]
fn a_protocol_is_read_from_a_file_and_refused_in_words() {
    let text = "dso = 500.0\ndsd = 800.0\ndetector = [96, 128]\nextent.pixel = [2.0, 1.0]\n\
                angles.even = { views = 25 }\nnoise = \"poisson:1e5\"\n";
    let protocol: Protocol = toml::from_str(text).unwrap();
    assert_eq!(protocol.side(), [192.0, 128.0]);
    assert_eq!(protocol.noise, DetectorNoise::Poisson { i0: 1e5 });
    assert_eq!(protocol.geometry(&grid(8)).unwrap().views.len(), 25);
    let json = serde_json::to_string(&protocol).unwrap();
    assert_eq!(serde_json::from_str::<Protocol>(&json).unwrap(), protocol);
    let bad = toml::from_str::<Protocol>(&text.replace("poisson:1e5", "rain")).unwrap_err().to_string();
    assert!(bad.contains("`rain`"), "{bad}");
    assert!(toml::from_str::<Protocol>(&text.replace("dso", "dos")).is_err());

    let refused = |change: &dyn Fn(&mut Protocol), word: &str| {
        let mut p = protocol.clone();
        change(&mut p);
        let e = p.geometry(&grid(8)).unwrap_err().to_string();
        assert!(e.contains(word), "{e}");
    };
    refused(&|p| p.dsd = 400.0, "dsd");
    refused(&|p| p.dso = 0.5, "inside the volume");
    refused(&|p| p.unit.mm = 0.0, "unit.mm");
    refused(&|p| p.detector = [0, 3], "detector");
    refused(&|p| p.extent = DetectorExtent::Side([1.0, f64::NAN]), "extent");
    refused(&|p| p.angles = Angles::ListDeg(vec![]), "at least one view");
    refused(&|p| p.angles = Angles::Even { views: usize::MAX, start_deg: 0.0, arc_deg: 360.0 }, "views");
    refused(&|p| p.offset = [f64::INFINITY, 0.0], "offset");

    let mut volume = Volume::centered(Array3::zeros((4, 4, 4)), [1.0; 3]);
    let geometry = protocol.geometry(&volume.grid).unwrap();
    assert!(project(&volume, &geometry, 1.0).unwrap_err().to_string().contains("samples per voxel"));
    volume.data[[1, 2, 3]] = f32::NAN;
    assert!(project(&volume, &geometry, 2.0).unwrap_err().to_string().contains("volume[1, 2, 3]"));
    volume.data = Array3::zeros((4, 4, 5));
    assert!(project(&volume, &geometry, 2.0).unwrap_err().to_string().contains("shape of its grid"));
}

/// The folder `shared/data`, if it exists.
fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("CONEFIELD_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    folder.is_dir().then_some(folder)
}

#[test]
fn an_exact_scan_is_reproduced_and_its_mirror_is_not() {
    let Some(folder) = data().map(|d| d.join("interop/ellipsoids_50_r2")).filter(|d| d.is_dir()) else {
        println!("skipped: no shared data (set CONEFIELD_DATA)");
        return;
    };
    let meta: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.join("meta_data.json")).unwrap()).unwrap();
    let scanner = &meta["scanner"];
    let metres = |x: &serde_json::Value| 1000.0 * x.as_f64().unwrap();
    let two = |x: &serde_json::Value| [0, 1].map(|k| metres(&x[k]));
    let data: Array3<f32> = ndarray_npy::read_npy(folder.join("vol_gt.npy")).unwrap();
    let volume = Volume::centered(data, [0, 1, 2].map(|k| metres(&scanner["sVoxel"][k]) / 64.0));
    let views = meta["proj_train"].as_array().unwrap();
    let protocol = |sign: f64| Protocol {
        beam: conefield_core::orbit::Beam::Cone,
        unit: Default::default(),
        dso: metres(&scanner["DSO"]),
        dsd: metres(&scanner["DSD"]),
        detector: [96, 96],
        extent: DetectorExtent::Side(two(&scanner["sDetector"])),
        offset: [0.0; 2],
        angles: Angles::ListDeg(views.iter().map(|v| sign * v["angle"].as_f64().unwrap().to_degrees()).collect()),
        noise: DetectorNoise::None,
        seed: 0,
        samples_per_voxel: 2.0,
    };
    let exact: Vec<Array2<f32>> =
        views.iter().map(|v| ndarray_npy::read_npy(folder.join(v["file_path"].as_str().unwrap())).unwrap()).collect();
    let exact = ndarray::stack(ndarray::Axis(0), &exact.iter().map(|a| a.view()).collect::<Vec<_>>()).unwrap();
    let error = |sign: f64| {
        let found = simulate(&volume, &protocol(sign)).unwrap().projections;
        let error = relative_error(&found, &exact);
        println!("rotation {sign:+}: relative RMS error {error:.4}");
        error
    };
    let (right, wrong) = (error(1.0), error(-1.0));
    assert!(right < 0.03 && wrong > 3.0 * right, "{right} {wrong}");
}
