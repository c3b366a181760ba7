//! Calibration of random scans: right geometries stay, wrong ones are found, and what cannot be determined is said.
//!
//! All of them: `cargo test --release -p conefield-scans --test calibration -- --ignored --nocapture`.

use conefield_backend_cpu::Cpu;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::scan::Scan;
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use conefield_scans::calibration::{Correction, Parameter, Settings, Verdict, Watch, calibrate};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::fmt;

struct Nobody;

impl Watch for Nobody {}

/// What a scan is like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Kind {
    Arc,
    Short,
    Full,
    HalfFan,
    OneRow,
    Cut,
    Symmetric,
    /// On a detector that is rotated, and said to be.
    Small,
}

const KINDS: [Kind; 7] = [Kind::Arc, Kind::Short, Kind::Full, Kind::HalfFan, Kind::OneRow, Kind::Cut, Kind::Symmetric];

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Kind::Arc => "arc of 30 to 150 degrees",
            Kind::Short => "short scan",
            Kind::Full => "full turn",
            Kind::HalfFan => "half fan",
            Kind::OneRow => "one detector row",
            Kind::Cut => "object cut off",
            Kind::Symmetric => "symmetric object",
            Kind::Small => "small object, rotated detector",
        })
    }
}

/// A random scan of this kind, with noise. Its geometry is right.
fn scan(kind: Kind, seed: u64) -> Scan {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut within = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
    let arc: f64 = match kind {
        Kind::Arc => within(30.0, 150.0),
        Kind::Short => within(215.0, 280.0),
        _ => 360.0,
    };
    let (least, rows, columns) = match kind {
        Kind::OneRow => (24, 1, 32),
        Kind::Small => (40, 64, 72),
        _ => (24, 10, 32),
    };
    let views = least + 4 * within(0.0, 3.0) as usize;
    // The detector reaches this far on its short side, in mm at the axis; 27.5 mm are half of it.
    let shift = if kind == Kind::HalfFan { within(12.0, 22.0) } else { within(-0.5, 0.5) };
    let start = within(0.0, 360.0);
    let (dso, magnification, pixel) = (150.0, 1.4, 1.72 * 1.4 * 32.0 / columns as f64);
    let mm = Millimetres;
    let angle = |i: usize| Radians((start + arc * i as f64 / views as f64).to_radians());
    let view = |i| {
        View::circular(angle(i), mm(dso), mm(dso * magnification), [mm(pixel); 2], [mm(0.0), mm(shift * magnification)])
    };
    let mut all: Vec<View> = (0..views).map(view).collect();
    if kind == Kind::Small {
        all = Correction::default().with(Parameter::Rotation, 1.5f64.to_radians()).views(&all);
    }
    let body = |center, axes, value| Ellipsoid { center, axes, value };
    let size = match kind {
        Kind::Cut => 36.0,
        Kind::HalfFan => 30.0,
        Kind::Small => 14.0,
        _ => 20.0,
    };
    let mut bodies = vec![];
    if kind == Kind::Symmetric {
        bodies.push(body([0.0; 3], [size, size, 30.0], 0.02));
        bodies.push(body([0.0; 3], [0.5 * size, 0.5 * size, 30.0], 0.01));
    } else {
        bodies.push(body([within(-2.0, 2.0), within(-2.0, 2.0), 0.0], [size, within(0.7, 1.0) * size, 14.0], 0.02));
        for _ in 0..5 {
            let (r, a) = (0.8 * size * within(0.0, 1.0), within(0.0, std::f64::consts::TAU));
            let axes = [0, 1, 2].map(|_| within(2.0, 6.0));
            bodies.push(body([r * a.cos(), r * a.sin(), within(-8.0, 8.0)], axes, within(-0.01, 0.02)));
        }
    }
    let volume = VoxelGrid { shape: [40, 40, rows], spacing: [1.5, 1.5, 1.72], center: [0.0; 3] };
    let mut scan = scan_ellipsoids(&bodies, Geometry { detector: [rows, columns], views: all, volume });
    let noise = [0.0, 0.003, 0.01][within(0.0, 2.99) as usize];
    scan.projections.mapv_inplace(|p| p + (noise * (within(-1.7, 1.7) + within(-1.7, 1.7))) as f32);
    scan
}

/// The outcome for offset-u and rotation: verdict, change, deviation, and what the change should be.
struct Outcome {
    kind: Kind,
    wrong: bool,
    each: Vec<(Parameter, Verdict, f64, f64, f64)>,
}

fn outcome(kind: Kind, wrong: bool, seed: u64) -> Outcome {
    let mut scan = scan(kind, seed);
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
    let side = |x: f64| if x < 0.5 { -1.0 } else { 1.0 };
    let mut off = Correction::default();
    if wrong {
        let pixels = side(rng.random()) * (1.0 + 4.0 * rng.random::<f64>());
        off = off.with(Parameter::OffsetU, pixels * Parameter::OffsetU.pixel(&scan.geometry));
        if kind != Kind::OneRow && rng.random::<f64>() < 0.5 {
            off = off.with(Parameter::Rotation, (side(rng.random()) * (1.5 + 1.5 * rng.random::<f64>())).to_radians());
        }
    }
    scan.geometry.views = off.views(&scan.geometry.views);
    let width = if kind == Kind::Small { 64 } else { 32 };
    let settings = Settings { width, curves: false, ..Settings::default() };
    let found = calibrate(&scan, &settings, &Cpu::new(), &Nobody).unwrap();
    let each = found.found.iter().map(|f| {
        let truth = -off.get(f.parameter) * f.parameter.in_unit();
        (f.parameter, f.verdict, f.change, f.uncertainty, truth)
    });
    Outcome { kind, wrong, each: each.collect() }
}

/// Counts of a kind of scans.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    scans: usize,
    /// Right parameters that were changed.
    alarms: usize,
    /// Wrong ones that were found within three deviations, found elsewhere, and not determined or not seen.
    hits: usize,
    misled: usize,
    unseen: usize,
}

fn tally(outcomes: &[Outcome], kind: Kind, wrong: bool) -> Tally {
    let mut t = Tally::default();
    for o in outcomes.iter().filter(|o| o.kind == kind && o.wrong == wrong) {
        t.scans += 1;
        for &(_, verdict, change, deviation, truth) in &o.each {
            let off = (change - truth).abs() > 3.0 * deviation;
            match (verdict, truth == 0.0) {
                (Verdict::Corrected, true) if off => t.alarms += 1,
                (Verdict::Corrected, false) if off => t.misled += 1,
                (Verdict::Corrected, false) => t.hits += 1,
                (_, false) => t.unseen += 1,
                _ => (),
            }
        }
    }
    t
}

fn run(per_kind: usize) -> Vec<Outcome> {
    let cases: Vec<(Kind, bool, u64)> = KINDS
        .iter()
        .flat_map(|&k| {
            (0..per_kind as u64)
                .flat_map(move |i| [(k, false, 100 * k as u64 + i), (k, true, 7000 + 100 * k as u64 + i)])
        })
        .collect();
    cases.par_iter().map(|&(kind, wrong, seed)| outcome(kind, wrong, seed)).collect()
}

fn table(outcomes: &[Outcome]) -> Tally {
    for o in outcomes {
        for (p, verdict, change, deviation, truth) in &o.each {
            if *verdict == Verdict::Corrected && (change - truth).abs() > 3.0 * deviation {
                println!(
                    "{}, {}: {p} {change:.3} ± {deviation:.3}, true {truth:.3}",
                    o.kind,
                    if o.wrong { "wrong" } else { "right" }
                );
            }
        }
    }
    let mut all = Tally::default();
    println!("| scans | right | false alarms | wrong | found | found elsewhere | not determined or not seen |");
    println!("| --- | --- | --- | --- | --- | --- | --- |");
    for kind in KINDS {
        let (right, wrong) = (tally(outcomes, kind, false), tally(outcomes, kind, true));
        let alarms = right.alarms + wrong.alarms;
        println!(
            "| {kind} | {} | {alarms} | {} | {} | {} | {} |",
            right.scans, wrong.scans, wrong.hits, wrong.misled, wrong.unseen
        );
        all.alarms += alarms;
        all.hits += wrong.hits;
        all.misled += wrong.misled;
        all.unseen += wrong.unseen;
    }
    all
}

#[test]
fn random_geometries_raise_no_false_alarm_and_wrong_ones_are_found() {
    let all = table(&run(1));
    assert_eq!((all.alarms, all.misled), (0, 0), "{all:?}");
    assert!(all.hits >= 5, "{all:?}");
}

/// The rotation of the detector hardly changes the views. What changes with it by chance is no evidence.
#[test]
fn the_rotation_of_a_small_object_s_detector_stays() {
    let outcomes: Vec<Outcome> = [701, 711].into_par_iter().map(|seed| outcome(Kind::Small, false, seed)).collect();
    for (parameter, verdict, change, ..) in outcomes.iter().flat_map(|o| &o.each) {
        assert_ne!(*verdict, Verdict::Corrected, "{parameter}: {change}");
    }
}

#[test]
#[ignore = "minutes"]
fn two_hundred_right_and_two_hundred_wrong_geometries() {
    let outcomes = run(29);
    let all = table(&outcomes);
    assert!(all.alarms == 0, "{all:?}");
}
