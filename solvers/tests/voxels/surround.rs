//! A body that extends beyond the volume and the detector: the outside is estimated on coarse cells and subtracted.

use crate::kit::{Case, Heard, mean, psnr, view};
use conefield_backend_cpu::Cpu;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::method::Job;
use conefield_core::scan::{Scan, Volume};
use conefield_core::scene::{CoarseSurround, SurroundRule};
use conefield_projectors::simulate::{Ellipsoid, ellipsoids, scan_ellipsoids};
use conefield_solvers::surround::found;

/// A body of ± 55 by 45 by 40 mm with details, within ± 20 mm of the centre and outside.
fn bodies() -> Vec<Ellipsoid> {
    let body = |center, axes, value| Ellipsoid { center, axes, value };
    vec![
        body([3.0, -2.0, 0.0], [55.0, 45.0, 40.0], 0.02),
        body([-6.0, 3.0, 1.0], [5.0, 4.0, 8.0], 0.01),
        body([8.0, -6.0, -5.0], [4.0, 6.0, 5.0], -0.015),
        body([42.0, 2.0, 0.0], [6.0, 8.0, 30.0], 0.02),
        body([-20.0, -28.0, 5.0], [12.0, 9.0, 10.0], -0.015),
    ]
}

/// Its central ± 20 mm, on a detector that sees ± 24 mm there (or ± 77 mm).
fn geometry(wide: bool) -> Geometry {
    let turn = |i: usize| std::f64::consts::TAU * i as f64 / 40.0;
    let side = if wide { 154 } else { 48 };
    Geometry {
        detector: [side; 2],
        views: (0..40).map(|i| view(0.1 + turn(i), [300.0, 420.0], [1.4; 2], [0.0; 2])).collect(),
        volume: VoxelGrid { shape: [40; 3], spacing: [1.0; 3], center: [0.0; 3] },
    }
}

fn scan() -> Scan {
    scan_ellipsoids(&bodies(), geometry(false))
}

/// Extent of the body.
const RULE: SurroundRule = SurroundRule::Coarse(CoarseSurround { margin: 1.0, cells: 32, passes: 16 });
/// The same in a spec.
const SURROUND: &str = "scene.surround = { coarse = { margin = 1.0, cells = 32 } }\n";

/// A method of ten passes with the setting `surround`, if any.
fn method(kind: &str, surround: &str) -> String {
    let stop = if kind == "fdk" { "" } else { "stop = { passes = 10 }\n" };
    crate::kit::method(kind, &format!("{surround}{stop}"))
}

#[test]
fn methods_lose_the_rim_that_the_outside_leaves() {
    let (scan, truth) = (scan(), ellipsoids(&bodies(), &geometry(false).volume));
    let rim = |p: [f64; 3]| (17.0..19.0).contains(&p[0].hypot(p[1])) && p[2].abs() < 15.0;
    // The others subtract it where `os-sart` and `cgls` do.
    for kind in ["fdk", "os-sart", "cgls", "fista-tv"] {
        let (without, _) = Case::of(&scan).volume(&method(kind, ""));
        let (with, heard) = Case::of(&scan).volume(&method(kind, SURROUND));
        assert!(heard.said("beyond the volume"), "{:?}", heard.notes);
        let error = |v| (mean(v, rim) - mean(&truth, rim)).abs() / mean(&truth, rim);
        let (before, after) = (psnr(&without, &truth), psnr(&with, &truth));
        println!(
            "{kind}: {before:.2} to {after:.2} dB, the rim is off by {:.3} to {:.3}",
            error(&without),
            error(&with)
        );
        assert!(after > before + 4.0 && error(&with) < 0.5 * error(&without), "{kind}");
    }
}

/// The remaining line integrals are those of the inside.
#[test]
fn what_is_left_is_the_inside() {
    let scan = scan();
    let backend = Cpu::new();
    let left = conefield_solvers::surround::subtracted(&Job::new(&scan, &backend), RULE, &mut Heard::default());
    let left = left.unwrap().unwrap();
    // In closed form: the chords minus the parts beyond the box.
    let inside = conefield_projectors::simulate::project(
        &ellipsoids(&bodies(), &VoxelGrid { shape: [160; 3], spacing: [0.25; 3], center: [0.0; 3] }),
        &geometry(false),
        2.0,
    );
    let inside = inside.unwrap();
    let rms =
        |f: &dyn Fn(usize) -> f64| ((0..inside.len()).map(|i| f(i).powi(2)).sum::<f64>() / inside.len() as f64).sqrt();
    let flat = |a: &ndarray::Array3<f32>| a.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
    let (left, inside, whole) = (flat(&left.projections), flat(&inside), flat(&scan.projections));
    let (error, outside) = (rms(&|i| left[i] - inside[i]), rms(&|i| whole[i] - inside[i]));
    println!("left of the outside: {error:.4} of {outside:.4}");
    assert!(error < 0.1 * outside, "{error} of {outside}");
}

#[test]
fn a_scan_that_shows_all_of_the_object_is_left_alone() {
    let volume = VoxelGrid { shape: [40; 3], spacing: [3.0; 3], center: [0.0; 3] };
    let scan = scan_ellipsoids(&bodies(), Geometry { volume, ..geometry(true) });
    let of = |surround: &str| {
        let text = crate::kit::method("os-sart", &format!("{surround}stop = {{ passes = 2 }}\n"));
        Case::of(&scan).volume(&text)
    };
    let ((without, _), (with, heard)) = (of(""), of(SURROUND));
    assert!(heard.said("surround: nothing, as the object reaches the sides of no view"), "{:?}", heard.notes);
    assert_eq!(with.data, without.data);
}

/// Views that show the whole body, and a volume of some of its slices: rays above and below the volume tell how much of
/// the attenuation is not its own.
#[test]
fn a_volume_of_some_slices_is_as_good_as_the_whole_one() {
    let slices = |shape, center| Geometry { volume: VoxelGrid { shape, spacing: [3.0; 3], center }, ..geometry(true) };
    let (few, all) = (slices([40, 40, 6], [0.0, 0.0, 12.0]), slices([40, 40, 32], [0.0; 3]));
    let scan = scan_ellipsoids(&bodies(), few.clone());
    let truth = ellipsoids(&bodies(), &few.volume);
    let whole = Case::of(&Scan { geometry: all, ..scan.clone() }).volume(&method("os-sart", "")).0;
    let part = whole.data.slice(ndarray::s![.., .., 17..23]).to_owned();
    let whole = psnr(&Volume { data: part, grid: few.volume, affine: None }, &truth);
    let (without, _) = Case::of(&scan).volume(&method("os-sart", ""));
    let (with, heard) =
        Case::of(&scan).volume(&method("os-sart", "scene.surround = { coarse = { margin = 1.0, cells = 40 } }\n"));
    assert!(heard.said("as rays beside it are attenuated too"), "{:?}", heard.notes);
    let [without, with] = [without, with].map(|v| psnr(&v, &truth));
    println!("{without:.2} to {with:.2} dB, {whole:.2} dB in the whole volume");
    assert!(with > whole - 2.0 && with > without + 20.0, "{without} to {with} dB, {whole} dB in the whole volume");
}

#[test]
fn the_surround_is_reported_before_a_run() {
    let near = SurroundRule::Coarse(CoarseSurround { cells: 20, margin: 0.5, ..CoarseSurround::default() });
    let far = SurroundRule::Coarse(CoarseSurround { cells: 20, margin: 2.0, ..CoarseSurround::default() });
    assert!(found(&scan(), SurroundRule::None).unwrap().is_empty());
    let said = |scan: &Scan, rule: SurroundRule| found(scan, rule).unwrap().concat();
    let all = said(&scan(), near);
    assert!(all.contains("40 of 40 views: 40 x 40 x 40 cells of 2.000 mm"), "{all}");
    // Limited by the room that sources and detectors leave.
    let mut close = scan();
    close.geometry.views.iter_mut().for_each(|v| v.source = v.source.map(|x| x * 0.13));
    let all = said(&close, far);
    let side: usize = all.split(" views: ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!((22..46).contains(&side), "{all}");
    // For a body that is only longer than the detector, the cells extend only above and below.
    let long = [Ellipsoid { center: [0.0; 3], axes: [15.0, 15.0, 60.0], value: 0.02 }];
    let all = said(&scan_ellipsoids(&long, geometry(false)), near);
    assert!(all.contains("20 x 20 x 40 cells"), "{all}");
}

#[test]
fn settings_that_mean_nothing_are_refused() {
    for (text, says) in
        [("margin = 0.0", "margin"), ("margin = 5.0", "at most 4"), ("cells = 2", "4 to 256"), ("passes = 0", "passes")]
    {
        let text = method("sirt", &format!("scene.surround = {{ coarse = {{ {text} }} }}\n"));
        let e = Case::of(&scan()).run(&text, &mut Heard::default()).err().unwrap().to_string();
        assert!(e.contains("scene.surround.coarse") && e.contains(says), "{e}");
    }
    let many = method("sirt", "scene.surround = { coarse = { cells = 256, margin = 4.0 } }\n");
    let e = Case::of(&scan()).run(&many, &mut Heard::default()).err().unwrap().to_string();
    assert!(e.contains("cells in all, expected at most 16777216"), "{e}");
    assert_eq!(SurroundRule::default(), SurroundRule::None);
}
