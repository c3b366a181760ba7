//! A clean scan gives no warning, and each problem gives its own.

use super::*;
use crate::diagnosis::WarningKind;
use crate::diagnosis::arc::scan_arc;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::scan::Unit;
use ndarray::Array3;
use std::f64::consts::TAU;

/// A cylinder of water about the axis (or about `at`), seen by `views` on a circle.
struct Setting {
    angles: Vec<f64>,
    dso: f64,
    dsd: f64,
    pixel: [f64; 2],
    offset: [f64; 2],
    detector: [usize; 2],
    volume: VoxelGrid,
    radius: f64,
    at: [f64; 2],
    mu: f64,
    /// Movement along the axis from view to view.
    rise: f64,
}

fn even(n: usize, range: f64) -> Vec<f64> {
    (0..n).map(|i| range * i as f64 / n as f64).collect()
}

/// Rows and columns, pixels and voxels all differ.
fn clean() -> Setting {
    Setting {
        angles: even(60, TAU),
        dso: 500.0,
        dsd: 800.0,
        pixel: [2.0, 1.6],
        offset: [0.0, 0.0],
        detector: [40, 100],
        volume: VoxelGrid { shape: [48, 48, 24], spacing: [1.2, 1.2, 1.5], center: [0.0; 3] },
        radius: 24.0,
        at: [0.0, 0.0],
        mu: 0.02,
        rise: 0.0,
    }
}

impl Setting {
    fn views(&self) -> Vec<View> {
        let mm = |x: [f64; 2]| x.map(Millimetres);
        let view = |a: &f64| {
            View::circular(Radians(*a), Millimetres(self.dso), Millimetres(self.dsd), mm(self.pixel), mm(self.offset))
        };
        let mut views: Vec<View> = self.angles.iter().map(view).collect();
        let middle = (views.len() - 1) as f64 / 2.0;
        for (i, view) in views.iter_mut().enumerate() {
            let z = self.rise * (i as f64 - middle);
            (view.source[2], view.detector[2]) = (view.source[2] + z, view.detector[2] + z);
        }
        views
    }

    fn scan(&self) -> Scan {
        let geometry = Geometry { detector: self.detector, views: self.views(), volume: self.volume };
        let shape = [geometry.views.len(), self.detector[0], self.detector[1]];
        let half = self.volume.size()[2] / 2.0;
        let projections = Array3::from_shape_fn(shape, |(view, row, column)| {
            let ray = geometry.ray(view, row, column);
            let (mut o, d) = (ray.origin, ray.direction);
            (o[0], o[1]) = (o[0] - self.at[0], o[1] - self.at[1]);
            let a = d[0] * d[0] + d[1] * d[1];
            let b = o[0] * d[0] + o[1] * d[1];
            let under = b * b - a * (o[0] * o[0] + o[1] * o[1] - self.radius * self.radius);
            // Inside the cylinder's height, as judged by the middle of the chord.
            let z = o[2] - b / a * d[2];
            if under > 0.0 && z.abs() < half { (self.mu * 2.0 * under.sqrt() / a) as f32 } else { 0.0 }
        });
        Scan { geometry, projections, unit: Unit::default(), provenance: serde_json::Value::Null }
    }

    fn kinds(&self) -> Vec<WarningKind> {
        kinds(&survey(&self.scan()).warnings)
    }

    /// Asserts a single warning, of the given kind, that contains all of `words`.
    fn warns(&self, kind: WarningKind, words: &[&str]) {
        let found = survey(&self.scan()).warnings;
        let text: Vec<String> = found.iter().map(ToString::to_string).collect();
        assert!(found.len() == 1 && found[0].kind == kind, "{kind:?}: {text:?}");
        assert!(words.iter().all(|w| text[0].contains(w)), "{words:?}: {text:?}");
    }
}

fn kinds(warnings: &[Warning]) -> Vec<WarningKind> {
    warnings.iter().map(|w| w.kind).collect()
}

#[test]
fn a_clean_scan_gives_no_warning_and_the_right_figures() {
    let s = survey(&clean().scan());
    assert!(s.warnings.is_empty(), "{:?}", s.warnings);
    let g = &s.setup;
    assert!(g.circle && g.angles.full_circle && !g.half_is_enough());
    for (found, want) in [
        (g.source_to_axis_mm, 500.0),
        (g.source_to_detector_mm, 800.0),
        (g.magnification, 1.6),
        (g.pixel_mm[0], 2.0),
        (g.pixel_mm[1], 1.6),
        (g.detector_mm[0], 80.0),
        (g.detector_mm[1], 160.0),
        (g.supported_voxel_mm[0], 1.0),
        (g.supported_voxel_mm[2], 1.25),
        // The ray to the detector's side, 80 mm off-axis after 800 mm, passes the axis at this distance.
        (g.field_of_view.radius_mm, 500.0 * (0.1f64).atan().sin()),
        (g.field_of_view.height_mm, 50.0),
        (g.angles.mean_gap_deg, 6.0),
        (g.angles.largest_gap_deg, 6.0),
        (g.angles.step_deg, 6.0),
    ] {
        assert!((found - want).abs() < 1e-6, "{found} is not {want}: {g:?}");
    }
    assert_eq!((s.coverage.complete, s.coverage.unseen, s.coverage.least), (1.0, 0.0, 1.0));
    assert_eq!(s.truncation.views, 0.0);
}

#[test]
fn source_and_detector_that_turn_as_one_body_are_on_a_circle() {
    let geometry = clean().scan().geometry;
    let changed = |change: &dyn Fn(usize, &mut View)| {
        let mut geometry = geometry.clone();
        geometry.views.iter_mut().enumerate().for_each(|(i, view)| change(i, view));
        setup(&geometry).circle
    };
    assert!(changed(&|_, _| {}));
    // Columns the other way, as on Nikon's scanners; a tilted detector; an axis beside the central ray.
    assert!(changed(&|_, v| v.u = v.u.map(|x| -x)));
    assert!(changed(&|_, v| *v = v.tilted([0.02, -0.01, 0.03].map(Radians))));
    assert!(changed(&|_, v| {
        let aside = v.u;
        (0..3).for_each(|k| (v.source[k], v.detector[k]) = (v.source[k] + aside[k], v.detector[k] + aside[k]));
    }));
    assert!(!changed(&|i, v| v.source[2] += 1e-3 * i as f64));
    assert!(!changed(&|i, v| v.detector[0] += if i == 7 { 1e-3 } else { 0.0 }));
}

#[test]
fn unusual_but_complete_scans_give_no_warning() {
    // A half-offset detector with a full circle; a short scan of 180° and more; irregular angles; noise.
    let offset = Setting { offset: [0.0, 30.0], detector: [40, 80], ..clean() };
    assert_eq!(offset.kinds(), []);
    assert!(survey(&offset.scan()).setup.half_is_enough());
    let other_side = Setting { offset: [0.0, -30.0], detector: [40, 80], ..clean() };
    assert_eq!(other_side.kinds(), []);
    assert_eq!(Setting { angles: even(60, 3.5), ..clean() }.kinds(), []);
    let jittered = (0..60).map(|i| TAU * (f64::from(i) + 0.4 * f64::from(i * 7 % 5) / 5.0) / 60.0).collect();
    assert_eq!(Setting { angles: jittered, ..clean() }.kinds(), []);
    for n in [150, 151] {
        let golden = (0..n).map(|i| f64::from(i) * 2.399_963_229_728_653).collect();
        assert_eq!(Setting { angles: golden, ..clean() }.kinds(), [], "golden angle, {n}");
    }
    for n in 4..400 {
        assert!(!scan_arc(&Setting { angles: even(n, TAU), ..clean() }.views()).like_degrees, "{n}");
    }
    let mut noisy = clean().scan();
    let noise = |i: usize| 0.04 * (((i * 7919) % 101) as f32 / 50.0 - 1.0);
    noisy.projections.iter_mut().enumerate().for_each(|(i, x)| *x += noise(i));
    assert_eq!(survey(&noisy).warnings, []);
}

#[test]
fn a_helix_covers_what_no_view_sees_as_a_whole() {
    let tall = |n: usize| VoxelGrid { shape: [48, 48, n], ..clean().volume };
    let helix = |n: usize, turns: f64| Setting {
        angles: even((60.0 * turns) as usize, turns * TAU),
        rise: 100.0 / (60.0 * turns),
        volume: tall(n),
        ..clean()
    };
    for turns in [4.0, 2.0] {
        assert_eq!(helix(48, turns).kinds(), [], "{turns}");
    }
    // The ends of a volume that is longer than the helix.
    let words = ["the views of half a turn see ", "no view sees", "moves along the axis", "smaller"];
    helix(160, 4.0).warns(WarningKind::Coverage, &words);
}

#[test]
fn each_fault_gives_its_own_warning() {
    use WarningKind as W;
    // As wide as the field of view, and wider.
    Setting { radius: 60.0, ..clean() }.warns(W::Truncated, &["100.0 % of the views", "mm at the axis", "air"]);
    let tall = VoxelGrid { shape: [48, 48, 48], spacing: [1.2, 1.2, 1.5], center: [0.0; 3] };
    Setting { volume: tall, radius: 10.0, ..clean() }.warns(W::Coverage, &["72.0 mm", "height 50.0 mm", "smaller"]);
    let aside = VoxelGrid { center: [30.0, 0.0, 0.0], ..clean().volume };
    Setting { volume: aside, radius: 10.0, at: [20.0, 0.0], ..clean() }.warns(W::Coverage, &["radius 49.8 mm"]);
    assert_eq!(Setting { volume: aside, ..clean() }.kinds(), [W::Outside, W::Coverage]);
    let few = VoxelGrid { shape: [48, 48, 4], ..clean().volume };
    let slices = Setting { volume: few, ..clean() };
    assert_eq!(slices.kinds(), [], "the object is no longer than the slices");
    Setting { offset: [0.0, 75.0], ..clean() }.warns(W::Offset, &["75.00 mm", "nearly", "5.00 mm"]);
    let off = Setting { offset: [0.0, 100.0], ..clean() };
    let warnings = survey(&off.scan()).warnings;
    assert!(
        warnings.iter().any(|w| w.kind == W::Offset && w.advice.contains("no ray crosses the axis")),
        "{warnings:?}"
    );
    Setting { angles: even(60, 2.5), ..clean() }.warns(W::Arc, &["143.2°", "180°"]);
    let half = Setting { offset: [0.0, 30.0], detector: [40, 80], angles: even(60, 3.6), ..clean() };
    assert!(half.kinds().contains(&W::Arc), "{:?}", half.kinds());
    let mut gap = even(60, TAU);
    gap.drain(20..25);
    Setting { angles: gap, ..clean() }.warns(W::Gap, &["114.0° and 150.0°", "36.0°"]);
    for (n, range) in [(50, 360.0), (60, 180.0), (360, 360.0), (720, 360.0)] {
        Setting { angles: even(n, range), ..clean() }.warns(W::Degrees, &["convert"]);
    }
    Setting { volume: VoxelGrid { shape: [160, 160, 80], spacing: [0.36, 0.36, 0.45], ..clean().volume }, ..clean() }
        .warns(W::VoxelSize, &["finer", "[58, 58, 29]"]);
    Setting { volume: VoxelGrid { shape: [16, 16, 8], spacing: [3.6, 3.6, 4.5], ..clean().volume }, ..clean() }
        .warns(W::VoxelSize, &["lost", "[58, 58, 29]"]);
    Setting { mu: 2e-5, ..clean() }.warns(W::Scale, &["/mm", "water"]);
}

#[test]
fn metres_read_as_millimetres_give_a_warning_unless_the_unit_has_no_size() {
    let mut scan = clean().scan();
    scan.geometry = scan.geometry.scaled(1e-3);
    let warnings = survey(&scan).warnings;
    assert_eq!(kinds(&warnings), [WarningKind::Scale; 2], "{warnings:?}");
    assert!(warnings[0].to_string().contains("not metres"), "{warnings:?}");
    scan.unit.name = "cube half side".into();
    assert_eq!(survey(&scan).warnings, []);
}

#[test]
fn values_that_are_not_line_integrals_give_one_warning() {
    let mut scan = clean().scan();
    scan.projections.mapv_inplace(|a| 20000.0 * (-a).exp());
    let warnings = survey(&scan).warnings;
    assert_eq!(kinds(&warnings), [WarningKind::Values], "{warnings:?}");
}

#[test]
fn one_view_and_one_pixel_are_accepted() {
    let one = Setting { angles: vec![0.3], detector: [1, 1], ..clean() };
    assert!(survey(&one.scan()).setup.angles.covered_deg.is_finite());
}

/// The images of `n` views over a full turn with both ends, but with the geometry of `angles`.
fn with_both_ends(n: usize, angles: Vec<f64>) -> Scan {
    let off_axis = Setting { radius: 10.0, at: [8.0, 5.0], ..clean() };
    let images = Setting { angles: even(n, TAU * n as f64 / (n - 1) as f64), ..off_axis }.scan();
    Scan { geometry: Geometry { views: Setting { angles, ..clean() }.views(), ..images.geometry }, ..images }
}

#[test]
fn a_last_view_that_repeats_the_first_gives_a_warning_with_the_right_options() {
    let noise = |i: usize| 0.004 * (((i * 7919) % 101) as f32 / 50.0 - 1.0);
    for (n, step) in [(13, "step_deg = 30 "), (61, "step_deg = 6 "), (361, "step_deg = 1 ")] {
        for angles in [even(n, TAU), even(n, -TAU)] {
            let mut scan = with_both_ends(n, angles);
            scan.projections.iter_mut().enumerate().for_each(|(i, x)| *x += noise(i));
            let warnings = survey(&scan).warnings;
            assert_eq!(kinds(&warnings), [WarningKind::Repeated], "{n}: {warnings:?}");
            let (advice, views) = (&warnings[0].advice, format!("--views 0-{}", n - 2));
            assert!(advice.contains(step) && advice.ends_with(&views), "{warnings:?}");
        }
        // Angles with both ends agree with the images.
        let right = with_both_ends(n, even(n, TAU * n as f64 / (n - 1) as f64));
        assert_eq!(survey(&right).warnings, [], "{n}");
    }
}

#[test]
fn similar_views_are_not_reported_as_repeated() {
    // Off the axis; on the axis, where all views are equal; and with both sides of the seam alike.
    for n in [12, 60, 360] {
        let half_step = 0.5 * TAU / n as f64;
        let seam = [8.0 * half_step.cos(), -8.0 * half_step.sin()];
        for at in [[8.0, 5.0], [0.0, 0.0], [0.0, 8.0], [8.0, 0.0], seam] {
            let setting = Setting { angles: even(n, TAU), radius: 10.0, at, ..clean() };
            assert_eq!(setting.kinds(), [], "{n}, {at:?}");
        }
    }
}
