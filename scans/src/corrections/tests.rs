//! Tests each correction on projections with and without its fault. Line integrals are those of ellipsoids in closed
//! form.

use super::*;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_projectors::simulate::{DetectorNoise, Ellipsoid, scan_ellipsoids};
use ndarray::{Array2, Array3, Axis, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};
use std::f64::consts::TAU;

const VIEWS: usize = 40;

/// A body with a bone and a hole, with line integrals up to about 1.7, times `scale`.
fn exact(scale: f64) -> Scan {
    let body = |center, axes, value| Ellipsoid { center, axes, value: scale * value };
    let bodies = [
        body([0.0, 0.0, 0.0], [40.0, 30.0, 40.0], 0.02),
        body([15.0, 5.0, 0.0], [8.0, 6.0, 30.0], 0.03),
        body([-12.0, -6.0, 4.0], [7.0, 7.0, 7.0], -0.02),
    ];
    let mm = Millimetres;
    let at = |i: usize| Radians(TAU * i as f64 / VIEWS as f64);
    let view = |i| View::circular(at(i), mm(300.0), mm(450.0), [mm(2.5), mm(2.5)], [mm(0.0); 2]);
    let geometry = Geometry {
        detector: [60, 72],
        views: (0..VIEWS).map(view).collect(),
        volume: VoxelGrid { shape: [32; 3], spacing: [3.0; 3], center: [0.0; 3] },
    };
    scan_ellipsoids(&bodies, geometry)
}

/// The scan with the noise of counted photons.
fn counted(scan: &Scan, photons: f64) -> Scan {
    let mut scan = scan.clone();
    DetectorNoise::Poisson { i0: photons }.add(&mut scan.projections, 3);
    scan
}

fn changed(scan: &Scan, change: impl Fn(usize, usize, usize, f32) -> f32) -> Scan {
    let mut scan = scan.clone();
    scan.projections.indexed_iter_mut().for_each(|((v, r, c), a)| *a = change(v, r, c, *a));
    scan
}

/// Root mean square of the difference.
fn off(a: &Scan, b: &Scan) -> f64 {
    let squares = a.projections.iter().zip(&b.projections).map(|(x, y)| f64::from(x - y).powi(2));
    (squares.sum::<f64>() / a.projections.len() as f64).sqrt()
}

/// `a` differs from `exact` by less than `share` of what `b` does.
fn nearer(a: &Scan, share: f64, b: &Scan, exact: &Scan, what: &str) {
    let [a, b] = [a, b].map(|scan| off(scan, exact));
    assert!(a < share * b, "{what}: {a}, {b}");
}

/// As [`off`], for the mean over the views, which makes rings.
fn off_always(a: &Scan, b: &Scan) -> f64 {
    let mean: Array2<f32> = (&a.projections - &b.projections).mean_axis(Axis(0)).unwrap();
    (mean.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / mean.len() as f64).sqrt()
}

fn corrected(scan: &Scan, texts: &[&str]) -> (Scan, String) {
    let (scan, applied) = Corrections::parse(texts).unwrap().apply(scan.clone(), "test").unwrap();
    (scan, applied.into_iter().map(|a| a.found).collect::<Vec<_>>().join("; "))
}

fn refused(scan: &Scan, texts: &[&str]) -> String {
    Corrections::parse(texts).unwrap().apply(scan.clone(), "test").unwrap_err().to_string()
}

#[test]
fn constant_gains_are_removed() {
    let exact = exact(1.0);
    let noisy = counted(&exact, 3e4);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let gains = Array2::from_shape_simple_fn((60, 72), || Normal::new(0.0, 0.03f32).unwrap().sample(&mut random));
    let faulty = changed(&noisy, |_, r, c, a| a + gains[[r, c]]);
    for method in ["median", "sorting"] {
        let method = format!("rings={{ method = \"{method}\", window = 11 }}");
        let (mended, found) = corrected(&faulty, &[&method]);
        let before = off_always(&faulty, &exact);
        assert!(off_always(&mended, &exact) < 0.7 * before, "{method}: {} {before}", off_always(&mended, &exact));
        assert!(found.contains("gains differ"), "{found}");
        let (kept, _) = corrected(&noisy, &[&method]);
        nearer(&kept, 1.15, &noisy, &exact, &method);
    }
    assert!(refused(&noisy, &["rings.window=73"]).contains("rings.window: found 73, expected at most 72"));
}

#[test]
fn pixels_that_do_not_measure_are_filled_in() {
    let exact = exact(1.0);
    let noisy = counted(&exact, 3e4);
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let mut faulty = noisy.clone();
    let pixel = |random: &mut ChaCha8Rng| [random.random_range(4..56), random.random_range(4..68)];
    for _ in 0..8 {
        let [r, c] = pixel(&mut random);
        // Dead, with a value that the object could have.
        faulty.projections.slice_mut(s![.., r, c]).fill(0.5);
        let [r, c] = pixel(&mut random);
        // Flickers in half the views.
        faulty.projections.slice_mut(s![..;2, r, c]).mapv_inplace(|a| a + 0.6);
    }
    for v in 0..VIEWS {
        let [r, c] = pixel(&mut random);
        faulty.projections[[v, r, c]] -= 1.0;
    }
    let (mended, found) = corrected(&faulty, &["pixels"]);
    nearer(&mended, 1.4, &noisy, &exact, &found);
    assert!(off(&faulty, &exact) > 2.0 * off(&noisy, &exact));
    for clean in [&noisy, &exact] {
        let (kept, found) = corrected(clean, &["pixels"]);
        assert!(kept.projections == clean.projections, "{found}");
    }
    // Without a copy of the scan.
    assert_eq!(Corrections::parse(&["pixels"]).unwrap().bytes(1 << 30), 0);
}

#[test]
fn the_tube_s_brightness_is_read_from_air() {
    let exact = exact(1.0);
    let noisy = counted(&exact, 3e4);
    let faulty = changed(&noisy, |v, _, _, a| a + 0.1 * (v as f32).sin());
    for texts in [vec!["flux"], vec!["flux.rows=[0, 60]", "flux.columns=[0, 5]"]] {
        let (mended, found) = corrected(&faulty, &texts);
        nearer(&mended, 1.05, &noisy, &exact, &format!("{texts:?} {found}"));
        assert!(found.starts_with("views of 90."), "{found}");
        let (kept, _) = corrected(&noisy, &texts);
        nearer(&kept, 1.02, &noisy, &exact, &format!("{texts:?}"));
    }
    assert!(off(&faulty, &exact) > 5.0 * off(&noisy, &exact));
    // The body is not air.
    let said = refused(&noisy, &["flux.rows=[20, 40]", "flux.columns=[30, 40]"]);
    assert!(said.contains("flux.rows") && said.contains("in air") && said.contains("view 0"), "{said}");
    assert!(refused(&noisy, &["flux.columns=[0, 80]"]).contains("at most 72"));
}

#[test]
fn few_photons_keep_their_mean() {
    let dark = exact(4.0);
    let noisy = counted(&dark, 500.0);
    let (mended, found) = corrected(&noisy, &["low-counts.photons=500"]);
    nearer(&mended, 0.6, &noisy, &dark, &found);
    // With enough photons, nothing changes.
    let bright = counted(&exact(1.0), 1e4);
    let (kept, found) = corrected(&bright, &["low-counts.photons=1e4"]);
    assert!(kept.projections == bright.projections && found.starts_with("0.00 %"), "{found}");
}

#[test]
fn scattered_light_is_subtracted() {
    let exact = exact(1.5);
    // The scatter of the model, computed in another way: spread evenly over the whole detector.
    let mut faulty = exact.clone();
    for mut view in faulty.projections.outer_iter_mut() {
        let n = view.len() as f32;
        let even = 0.2 * view.iter().map(|a| (-a).exp() * a).sum::<f32>() / n;
        view.mapv_inplace(|a| -((-a).exp() + even).ln());
    }
    let (mended, found) = corrected(&faulty, &["scatter={ share = 0.2, width = 0.3 }"]);
    nearer(&mended, 0.6, &faulty, &exact, &found);
    // Air scatters nothing.
    let air = changed(&exact, |_, _, _, _| 0.0);
    let (kept, found) = corrected(&air, &["scatter.share=0.2"]);
    assert!(kept.projections == air.projections, "{found}");
}

#[test]
fn hardening_is_corrected_in_thick_paths() {
    let exact = exact(1.0);
    let spectrum = spectrum::Spectrum::of_tube(120.0, 2.5);
    let hardened = |a: f32| spectrum.measured(f64::from(a.max(0.0)) / spectrum.thin()) as f32;
    let faulty = changed(&exact, |_, _, _, a| hardened(a));
    let (mended, found) = corrected(&faulty, &["hardening.water.kvp=120"]);
    assert!(off(&mended, &exact) < 1e-4, "{found}: {}", off(&mended, &exact));
    // With a tube voltage that is 10 % wrong, most of the error is corrected.
    let (about, _) = corrected(&faulty, &["hardening.water.kvp=108"]);
    nearer(&about, 0.3, &faulty, &exact, "108 kV");
    // A parabola that meets the exact one at the thickest path.
    let most = exact.projections.iter().copied().fold(0.0, f32::max);
    let bend = f64::from(most - hardened(most)) / f64::from(hardened(most)).powi(2);
    let (about, _) = corrected(&faulty, &[&format!("hardening.polynomial=[1.0, {bend}]")]);
    nearer(&about, 0.2, &faulty, &exact, "parabola");
    let (kept, _) = corrected(&exact, &["hardening.polynomial=[1]"]);
    assert!(kept.projections == exact.projections);
    let said = refused(&exact, &["hardening.polynomial=[1, -0.5]"]);
    assert!(said.contains("hardening.polynomial") && said.contains("falls"), "{said}");
}

/// A detector that is shifted on purpose is extended on its far side only, and measured columns stay where they are.
#[test]
fn an_offset_detector_is_extended_on_its_far_side() {
    let whole = exact(1.0);
    for left in [false, true] {
        let mut cut = whole.clone();
        // 36 of 72 columns from near the middle on, of which the outer ones still show the object.
        let kept = if left { 14..50 } else { 22..58 };
        cut.projections = cut.projections.slice(s![.., .., kept.clone()]).to_owned();
        cut.geometry.detector[1] = kept.len();
        let aside = (kept.start + kept.end) as f64 / 2.0 - 36.0;
        for view in &mut cut.geometry.views {
            (0..3).for_each(|k| view.detector[k] += aside * view.u[k]);
        }
        let (wide, found) = corrected(&cut, &["truncation"]);
        assert!(found.contains("far side"), "{left}: {found}");
        let [_, columns] = wide.geometry.detector;
        let more = columns - kept.len();
        let before = if left { more } else { 0 };
        assert_eq!(wide.projections.slice(s![.., .., before..before + kept.len()]), cut.projections, "{left}");
        let place =
            |scan: &Scan, column: usize| scan.geometry.views[3].pixel(scan.geometry.detector, 5.0, column as f64);
        let [a, b] = [place(&wide, before), place(&cut, 0)];
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-9), "{left}: {a:?} {b:?}");
    }
}

#[test]
fn rows_are_extended_where_the_detector_cuts_the_object() {
    let exact = exact(1.0);
    let (kept, found) = corrected(&exact, &["truncation"]);
    assert!(kept.projections == exact.projections && found.contains("nothing is added"), "{found}");
    let mut cut = exact.clone();
    cut.projections = exact.projections.slice(s![.., .., 18..54]).to_owned();
    cut.geometry.detector[1] = 36;
    let (wide, found) = corrected(&cut, &["truncation"]);
    assert!(found.contains("18 columns"), "{found}");
    assert_eq!(wide.geometry.detector, [60, 72]);
    assert!(wide.projections.slice(s![.., .., 18..54]) == cut.projections);
    // Closer to the object than zeros.
    let mut padded = exact.clone();
    padded.projections.slice_mut(s![.., .., ..18]).fill(0.0);
    padded.projections.slice_mut(s![.., .., 54..]).fill(0.0);
    nearer(&wide, 0.85, &padded, &exact, "zeros");
    assert_eq!(wide.geometry.ray(3, 5, 20), exact.geometry.ray(3, 5, 20));
}

/// The order is fixed, all corrections are listed, and all values are finite.
#[test]
fn corrections_are_recorded_in_the_scan() {
    let scan = counted(&exact(1.0), 1e3);
    let (once, _) = corrected(&scan, &["hardening.polynomial=[1, 0.1]", "rings"]);
    let done = once.provenance["corrections"].as_array().unwrap();
    let names: Vec<&str> = done.iter().map(|d| d["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["rings", "hardening"]);
    assert_eq!(done[0]["settings"], json!({ "method": "median", "window": 5 }));
    assert_eq!(once.provenance["simulated"], scan.provenance["simulated"]);
    let (twice, _) = corrected(&once, &["flux"]);
    assert_eq!(twice.provenance["corrections"].as_array().unwrap().len(), 3);
    // Values that no correction expects.
    for value in [0.0, 80.0, 1e14, -1e14, 1e-30] {
        let odd = changed(&scan, |v, _, c, a| if (v + c) % 3 == 0 { value } else { a });
        for text in [
            "pixels", "flux", "rings", "low-counts.photons=1000", "scatter.share=0.5", "hardening.water.kvp=90",
            "truncation",
        ] {
            if let Ok((mended, _)) = Corrections::parse(&[text]).unwrap().apply(odd.clone(), "test") {
                assert!(mended.projections.iter().all(|x| x.is_finite()), "{text} of {value}");
            }
        }
    }
    // The smallest possible scan.
    let mut tiny = scan.clone();
    tiny.geometry.detector = [1, 1];
    tiny.geometry.views.truncate(1);
    tiny.projections = Array3::from_elem((1, 1, 1), 0.3);
    for text in
        ["pixels", "flux", "low-counts.photons=1000", "scatter.share=0.5", "hardening.water.kvp=90", "truncation"]
    {
        assert!(corrected(&tiny, &[text]).0.projections.iter().all(|x| x.is_finite()), "{text}");
    }
}
