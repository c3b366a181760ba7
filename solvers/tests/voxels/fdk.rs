//! FDK's scale: means within homogeneous bodies, for every kind of orbit with weights.
//!
//! A circular orbit gives too little information off its plane: there FDK is an approximation and loses attenuation
//! with the square of the cone angle. The voxels are therefore a thin slab in the orbit's plane, where FDK is exact.

use crate::kit::{Case, Heard, mean, view};
use conefield_core::geometry::{Geometry, Radians, Vec3, View, VoxelGrid};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_projectors::simulate::{Ellipsoid, ellipsoids, scan_ellipsoids};
use conefield_solvers::fdk::weights::{Disc, FdkOrbit, lean, place};
use std::f64::consts::{PI, TAU};

/// Half width of the field of view at the axis, mm.
const REACH: f64 = 26.4;
/// Column pitch at the axis, mm.
const PITCH: f64 = 0.8;
/// Tolerance of a mean.
const EXACT: f64 = 0.005;

/// Settings of a scan.
#[derive(Debug, Clone, Copy)]
struct Orbiting {
    /// Source to axis, mm.
    radius: f64,
    magnification: f64,
    /// Extent of the detector on its shorter side, mm at the axis; the other side extends to [`REACH`].
    short_side: f64,
    /// Whether the longer side is towards +u.
    along_u: bool,
    /// Arc in radians, signed.
    arc: f64,
    views: usize,
}

const CENTRED: Orbiting =
    Orbiting { radius: 100.0, magnification: 1.5, short_side: REACH, along_u: true, arc: TAU, views: 720 };

impl Orbiting {
    /// The arc of a short scan plus `more` fan angles.
    fn short(self, more: f64) -> Self {
        let fan = 2.0 * (REACH / self.radius).atan();
        Self { arc: PI + (1.0 + more) * fan, ..self }
    }

    /// The opposite direction.
    fn backwards(self) -> Self {
        Self { arc: -self.arc, ..self }
    }

    /// With a detector that extends `short_side` mm past the axis on its shorter side (negative: short of the axis).
    fn aside(self, short_side: f64, along_u: bool) -> Self {
        Self { short_side, along_u, ..self }
    }
}

fn bodies() -> [Ellipsoid; 2] {
    [
        Ellipsoid { center: [1.0, -1.5, 0.0], axes: [19.0, 15.0, 20.0], value: 0.02 },
        Ellipsoid { center: [-6.0, 4.0, 0.0], axes: [8.0, 7.0, 16.0], value: 0.015 },
    ]
}

fn geometry(o: Orbiting) -> Geometry {
    let columns = ((REACH + o.short_side) / PITCH).round() as usize;
    let side = if o.along_u { 0.5 } else { -0.5 };
    let offset = side * (REACH - o.short_side) * o.magnification;
    let pixel = [1.0, PITCH].map(|p| p * o.magnification);
    let at = |i: usize| 0.2 + o.arc * i as f64 / o.views as f64;
    Geometry {
        detector: [14, columns],
        views: (0..o.views)
            .map(|i| view(at(i), [o.radius, o.magnification * o.radius], pixel, [0.0, offset]))
            .collect(),
        volume: VoxelGrid { shape: [48, 48, 8], spacing: [1.0; 3], center: [0.0; 3] },
    }
}

fn scan(o: Orbiting) -> Scan {
    scan_ellipsoids(&bodies(), geometry(o))
}

/// Measured means within the two bodies, divided by the true ones. Excludes 3 mm at every edge, which the pixels' width
/// and windows blur.
fn means(volume: &Volume) -> [f64; 2] {
    let [large, small] = bodies();
    let within = |p: [f64; 3]| p[2].abs() < 2.0 && large.grown(-3.0).contains(p);
    let around = mean(volume, |p| within(p) && !small.grown(3.0).contains(p));
    let inside = mean(volume, |p| within(p) && small.grown(-3.0).contains(p));
    [around / large.value, inside / (large.value + small.value)]
}

/// Deviation of the worse of the two means.
fn off(volume: &Volume) -> f64 {
    means(volume).iter().fold(0.0, |w, m| w.max((m - 1.0).abs()))
}

fn fdk(scan: &Scan, settings: &str) -> (Volume, Heard) {
    Case::of(scan).volume(&format!("type = \"fdk\"\n{settings}"))
}

/// Whether FDK takes each orbit for what it is, and the means are right.
fn are_right<const N: usize>(orbits: [(&str, Orbiting); N]) {
    for (kind, orbit) in orbits {
        let scan = scan(orbit);
        assert_eq!(scan.geometry.is_parallel(0), orbit.radius > 1e6);
        let (volume, heard) = fdk(&scan, "");
        println!("{orbit:?}: {:?}", means(&volume));
        assert!(heard.said(kind), "{orbit:?}: {:?}", heard.notes);
        assert!(off(&volume) < EXACT, "{orbit:?}: {:?}", means(&volume));
    }
}

#[test]
fn means_are_right_for_every_orbit_magnification_and_detector() {
    for (radius, magnification) in [(80.0, 1.2), (100.0, 1.5), (200.0, 3.0)] {
        let full = Orbiting { radius, magnification, ..CENTRED };
        are_right([
            ("full turn", full),
            ("full turn", full.backwards()),
            ("offset detector", full.aside(5.2, true)),
            ("offset detector", full.aside(5.2, false)),
            ("offset detector", full.aside(5.2, true).backwards()),
            ("offset detector", full.aside(16.0, false)),
            ("short scan", full.short(0.0)),
            ("short scan", full.short(0.0).backwards()),
            ("short scan", full.short(1.0)),
        ]);
    }
}

/// In a parallel beam, half a turn measures every line once. A detector that is offset by half sees each in one of two
/// views.
#[test]
fn a_parallel_beam_is_backprojected_with_its_scale() {
    let full = Orbiting { radius: 1e7, magnification: 1.00001, ..CENTRED };
    are_right([
        ("full turn", full),
        ("full turn", full.backwards()),
        ("offset detector", full.aside(5.2, true)),
        ("offset detector", full.aside(5.2, false).backwards()),
        ("short scan", Orbiting { arc: PI, views: 360, ..full }),
        ("short scan", Orbiting { arc: -PI, views: 360, ..full }),
        ("short scan", Orbiting { arc: 1.2 * PI, ..full }),
    ]);
}

/// A detector from the axis outwards measures every line once: half weights would give half the density.
#[test]
fn a_detector_on_one_side_of_the_axis_counts_whole() {
    for along_u in [true, false] {
        let (volume, heard) = fdk(&scan(CENTRED.aside(0.0, along_u)), "");
        println!("{:?}: {:?}", means(&volume), heard.notes);
        assert!(!heard.said("counts half"), "{:?}", heard.notes);
        assert!(off(&volume) < 0.05, "{:?}", means(&volume));
    }
}

#[test]
fn the_scale_does_not_depend_on_the_number_of_views() {
    let of = |views| fdk(&scan(Orbiting { views, ..CENTRED }), "");
    let all: Vec<[f64; 2]> = [720, 360, 180].map(|n| means(&of(n).0)).to_vec();
    for m in &all {
        let apart = [0, 1].map(|k| (m[k] - all[0][k]).abs());
        assert!(apart.iter().all(|a| *a < 0.002), "{all:?}");
    }
    // So few views leave streaks, but they are a full turn: no gap counts as the end of a short scan.
    let (sparse, heard) = of(50);
    assert!(heard.said("full turn") && !heard.said("Parker"), "{:?}", heard.notes);
    assert!(off(&sparse) < 0.02, "{:?}", means(&sparse));
}

#[test]
fn every_window_keeps_the_mean() {
    let scan = scan(Orbiting { views: 360, ..CENTRED });
    for window in ["ramp", "shepp-logan", "cosine", "hamming", "hann"] {
        for cutoff in [1.0, 0.6] {
            let (volume, _) = fdk(&scan, &format!("window = \"{window}\"\ncutoff = {cutoff}"));
            assert!(off(&volume) < EXACT, "{window} to {cutoff}: {:?}", means(&volume));
        }
    }
}

#[test]
fn units_rows_and_signs_are_kept() {
    let mut scan = scan(Orbiting { views: 180, ..CENTRED });
    let (plain, _) = fdk(&scan, "");
    // Rows that run upwards, with flipped images.
    let mut turned = scan.clone();
    turned.geometry.views.iter_mut().for_each(|v| v.v[2] *= -1.0);
    turned.projections.invert_axis(ndarray::Axis(1));
    let (volume, _) = fdk(&turned, "");
    let apart = plain.data.iter().zip(&volume.data).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(apart < 1e-6, "{apart}");
    scan.unit = Unit { name: "cm".into(), mm: 10.0 };
    let (volume, _) = fdk(&scan, "");
    let apart = plain.data.iter().zip(&volume.data).fold(0.0f32, |m, (a, b)| m.max((10.0 * a - b).abs()));
    assert!(apart < 1e-7, "{apart}");
    assert!(plain.data.iter().any(|x| *x < 0.0), "what lies outside the bodies swings around 0");
    let (volume, _) = fdk(&scan, "nonnegative = true");
    assert!(volume.data.iter().all(|x| *x >= 0.0));
}

/// The scan without weights of rays that are measured twice: FDK counts every ray half.
fn unweighted(scan: &Scan) -> Scan {
    let mut scan = scan.clone();
    let orbit = FdkOrbit::of(&scan.geometry);
    for ((view, _, column), p) in scan.projections.indexed_iter_mut() {
        let radius = orbit.radius[view];
        let weight = orbit.weight(view, place(&scan.geometry, view, column as f64, radius));
        *p = if weight > 1e-6 { *p * (0.5 / weight) as f32 } else { 0.0 };
    }
    scan
}

/// The means above detect a scale that is 1 % wrong, and weights for the other side.
#[test]
fn wrong_scales_and_sides_are_seen() {
    let views = 360;
    let mut scaled = scan(Orbiting { views, ..CENTRED });
    assert!(off(&fdk(&scaled, "").0) < EXACT);
    scaled.projections.par_mapv_inplace(|x| 1.01 * x);
    assert!(off(&fdk(&scaled, "").0) > EXACT);
    // The detector's side confused with the other one.
    let mut bad = scan(Orbiting { views, ..CENTRED.aside(5.2, true) });
    bad.geometry = geometry(Orbiting { views, ..CENTRED.aside(5.2, false) });
    assert!(off(&fdk(&bad, "").0) > 4.0 * EXACT);
}

/// Half a detector over part of a turn leaves unmeasured lines: no weights can replace them.
#[test]
fn what_cannot_be_completed_is_said() {
    let part = Orbiting { arc: 2.5, ..CENTRED };
    for orbit in [part, CENTRED.short(0.0).aside(5.2, true), CENTRED.short(1.0).aside(5.2, false)] {
        let orbit = Orbiting { views: 90, ..orbit };
        let object = Disc { center: [1.0, -1.5], radius: 19.0 };
        assert!(FdkOrbit::of(&geometry(orbit)).missing(object) > 0.01, "{orbit:?}");
        let (volume, heard) = fdk(&scan(orbit), "");
        assert!(heard.said("expect streaks") && heard.said("iterative"), "{:?}", heard.notes);
        assert!(volume.data.iter().all(|x| x.is_finite()));
    }
}

/// PSNR in dB of the slab's inner voxels against the bodies, with the largest value as peak.
fn decibels(volume: &Volume) -> f64 {
    let truth = ellipsoids(&bodies(), &volume.grid);
    let peak = truth.data.iter().copied().fold(0.0, f32::max);
    let slab = |((_, _, z), _): &((usize, usize, usize), &f32)| (2..6).contains(z);
    let squares = volume.data.indexed_iter().filter(slab).map(|(at, x)| f64::from(x - truth.data[at]).powi(2));
    let mean = squares.sum::<f64>() / (volume.data.len() / 2) as f64;
    10.0 * (f64::from(peak).powi(2) / mean).log10()
}

/// Part of a turn, or a detector that sees little more than half, gives the same volume as a full turn with equally
/// dense views: within 0.3 dB with the orbit's weights, 6 dB worse without.
#[test]
fn part_of_a_turn_is_as_good_as_all_of_it() {
    let full = decibels(&fdk(&scan(CENTRED), "").0);
    assert!(full > 25.0, "{full}");
    for orbit in [
        CENTRED.short(0.0),
        CENTRED.short(0.0).backwards(),
        CENTRED.short(0.4),
        CENTRED.short(1.0),
        CENTRED.aside(5.2, true),
        CENTRED.aside(16.0, false),
    ] {
        let views = (720.0 * orbit.arc.abs() / TAU).round() as usize;
        let scan = scan(Orbiting { views, ..orbit });
        let (with, without) = (decibels(&fdk(&scan, "").0), decibels(&fdk(&unweighted(&scan), "").0));
        println!("{full:.2} dB full, {with:.2} dB weighted, {without:.2} dB unweighted: {orbit:?}");
        assert!(with > full - 0.3, "{orbit:?}: {with} dB, {full} dB of a full turn");
        assert!(without < full - 6.0, "{orbit:?}: {without} dB without weights");
    }
}

/// A detector rotated about its columns has other rays with other weights. Measured over a short scan, in which no
/// opposite ray compensates.
#[test]
fn a_detector_need_not_face_the_axis() {
    for degrees in [-12.0f64, 12.0] {
        let mut geometry = geometry(Orbiting { views: 360, ..CENTRED.short(0.3) });
        geometry.detector[1] += 16;
        let slant = [Radians(0.0), Radians(degrees.to_radians()), Radians(0.0)];
        geometry.views.iter_mut().for_each(|v| *v = v.tilted(slant));
        let scan = scan_ellipsoids(&bodies(), geometry);
        let (volume, heard) = fdk(&scan, "");
        println!("{degrees}: {:?}, {:.2} dB", means(&volume), decibels(&volume));
        assert!(heard.said("short scan"), "{:?}", heard.notes);
        assert!(off(&volume) < EXACT && decibels(&volume) > 25.0, "{degrees}: {:?}", means(&volume));
        // As if the detector faced the axis.
        let mut facing = scan.clone();
        let radius = FdkOrbit::of(&scan.geometry).radius[0];
        for ((view, _, column), p) in facing.projections.indexed_iter_mut() {
            *p /= lean(&scan.geometry, view, column as f64, radius) as f32;
        }
        let facing = fdk(&facing, "").0;
        println!("as if it faced the axis: {:?}, {:.2} dB", means(&facing), decibels(&facing));
        assert!(off(&facing) > 2.0 * EXACT, "{degrees}: {:?}", means(&facing));
    }
}

/// A circle around an axis other than z that does not meet the volume's centre: balls look the same from everywhere.
#[test]
fn a_circle_lies_anywhere() {
    let balls = [
        Ellipsoid { center: [1.0, -1.5, 0.0], axes: [17.0; 3], value: 0.02 },
        Ellipsoid { center: [-4.0, 3.0, 1.0], axes: [7.0; 3], value: 0.015 },
    ];
    let middle: Vec3 = [3.0, -2.0, 1.0];
    for (degrees, orbit) in
        [(25.0f64, CENTRED), (25.0, CENTRED.short(0.5)), (-70.0, CENTRED), (0.0, CENTRED.aside(5.2, true))]
    {
        let mut geometry = geometry(Orbiting { views: 240, ..orbit });
        geometry.detector[0] = 56;
        geometry.volume.shape = [44; 3];
        let (s, c) = degrees.to_radians().sin_cos();
        let turned = |a: Vec3| [a[0], c * a[1] - s * a[2], s * a[1] + c * a[2]];
        let moved = |a: Vec3| -> Vec3 { std::array::from_fn(|k| turned(a)[k] + middle[k]) };
        for v in &mut geometry.views {
            *v = View { source: moved(v.source), detector: moved(v.detector), u: turned(v.u), v: turned(v.v) };
        }
        let (volume, heard) = fdk(&scan_ellipsoids(&balls, geometry), "");
        // Near the orbit's plane, where FDK is exact.
        let near = |p: Vec3| ((p[2] - middle[2]) * c - (p[1] - middle[1]) * s).abs() < 2.5;
        let [large, small] = balls;
        let around = |p| near(p) && large.grown(-3.0).contains(p) && !small.grown(3.0).contains(p);
        let inside = |p| near(p) && small.grown(-3.0).contains(p);
        let found = [mean(&volume, around) / large.value, mean(&volume, inside) / (large.value + small.value)];
        println!("{degrees}: {found:?} {:?}", heard.notes);
        assert!(heard.said("circle around (3.0, -2.0, 1.0) mm"), "{:?}", heard.notes);
        assert!(heard.said(&format!("tilted by {:.1} degrees", degrees.abs())), "{:?}", heard.notes);
        assert!(found.iter().all(|m| (m - 1.0).abs() < 2.0 * EXACT), "{degrees}, {orbit:?}: {found:?}");
    }
}
