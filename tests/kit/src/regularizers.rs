//! Properties of a regularizer: a convex penalty and its proximal map.

use crate::call::{differing, no_fault, none, on_threads, require, settle};
use crate::{Outcome, Report};
use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::place::Host;
use conefield_core::random::{mix, unit};
use conefield_core::regularizer::{Bounds, Penalty, Regularizer};
use conefield_core::scan::ScanHeader;
use conefield_core::space::Space;
use ndarray::{Array3, ArrayView3};
use std::sync::Arc;

/// Calls after which an iterative proximal map must have converged.
const CALLS: usize = 400;
/// Largest gain of a search in the proximal map's objective, relative to the map's gain over the start.
const GAIN: f64 = 1e-3;
/// Weights tested.
const TAUS: [f32; 3] = [0.01, 0.1, 1.0];

/// A complaint about a regularizer on a grid.
type OnGrid = fn(&dyn Regularizer, &VoxelGrid) -> Option<String>;

/// Checks all properties of a regularizer.
pub fn check_regularizer(regularizer: &dyn Regularizer) -> Report {
    let mut report = Report::of(regularizer.describe());
    let each = |property: OnGrid| move || grids().iter().find_map(|grid| property(regularizer, grid));
    report.holds("value", "finite, 0 or more", each(value));
    report.holds("convex", "between any two", each(convex));
    report.holds("weight", "finite, 0 or more, not less with more noise", each(weight));
    report.add("proximal map", || proximal(regularizer));
    report.holds("nonexpansive", "nothing comes further apart", || nonexpansive(regularizer));
    report.holds("not negative", "from the first call on", each(not_negative));
    report.add("bounds", || bounds(regularizer));
    report.holds("weight of 0", "only what is below 0 goes", each(no_weight));
    report.holds("overwrites", "over NaN as over 0", each(overwrites));
    report.holds("state", "handed over, it goes on to the same bits", each(state));
    report.holds("tally", "counts what is allocated", each(tally));
    report.holds("threads", "1 and 3 threads", || threads(regularizer));
    report.add("no fault", || no_fault(grids().iter().try_for_each(|grid| fault(regularizer, grid))));
    report
}

/// Few voxels, with unequal sides; a line and a plane.
fn grids() -> Vec<VoxelGrid> {
    let grid = |shape, spacing| VoxelGrid { shape, spacing, center: [0.0; 3] };
    vec![grid([3, 2, 4], [1.0, 0.7, 1.6]), grid([1, 1, 5], [1.0; 3]), grid([3, 4, 1], [0.5, 1.0, 2.0])]
}

/// Random numbers in [-0.4, 1).
fn noise(grid: &VoxelGrid, seed: u64) -> Vec<f32> {
    (0..grid.shape.iter().product::<usize>() as u64).map(|i| 1.4 * unit(mix(seed, i)) - 0.4).collect()
}

fn header(grid: &VoxelGrid) -> ScanHeader {
    ScanHeader { views: 0, detector: [0; 2], volume: grid.shape }
}

fn on(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Box<dyn Penalty> {
    regularizer.on(grid, &Space::new(header(grid), Arc::new(Host))).unwrap_or_else(|e| panic!("{e}"))
}

fn value_of(penalty: &dyn Penalty, grid: &VoxelGrid, x: &[f32]) -> f64 {
    ArrayView3::from_shape(grid.shape, x).map_or(f64::NAN, |x| penalty.value(x))
}

/// The proximal map after convergence.
fn prox(penalty: &mut dyn Penalty, v: &[f32], tau: f32) -> Vec<f32> {
    let mut u = vec![0.0; v.len()];
    (0..CALLS).for_each(|_| penalty.prox(v, tau, &mut u));
    u
}

/// `½‖u − v‖² + τ·R(u)`.
fn objective(penalty: &dyn Penalty, grid: &VoxelGrid, v: &[f32], tau: f32, u: &[f32]) -> f64 {
    let square: f64 = u.iter().zip(v).map(|(u, v)| f64::from(u - v).powi(2)).sum();
    0.5 * square + f64::from(tau) * value_of(penalty, grid, u)
}

fn value(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let penalty = on(regularizer, grid);
    [0.0, 1e-30, 1.0, 1e6].into_iter().find_map(|scale| {
        let x: Vec<f32> = noise(grid, 1).iter().map(|x| scale * x).collect();
        let value = value_of(penalty.as_ref(), grid, &x);
        (!value.is_finite() || value < 0.0).then(|| format!("{:?} times {scale:e}: {value:e}", grid.shape))
    })
}

fn convex(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let penalty = on(regularizer, grid);
    (0..20).find_map(|seed| {
        // Every other time towards 0: numbers of similar size say little about the growth of the penalty.
        let towards = if seed % 2 == 0 { 1.0 } else { 0.0 };
        let a = noise(grid, seed);
        let b: Vec<f32> = noise(grid, seed + 100).iter().map(|x| towards * x).collect();
        let middle: Vec<f32> = a.iter().zip(&b).map(|(a, b)| 0.5 * (a + b)).collect();
        let [a, b, middle] = [&a, &b, &middle].map(|x| value_of(penalty.as_ref(), grid, x));
        let most = 0.5 * (a + b);
        (middle > most + 1e-5 * most.abs()).then(|| format!("{middle} between {a} and {b}"))
    })
}

fn weight(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let of = |noise: f64| regularizer.weight(grid, &mut |k| k * noise).unwrap_or(f64::NAN);
    let [none, some, more] = [0.0, 0.01, 0.02].map(of);
    let fine = [none, some, more].iter().all(|w| w.is_finite() && *w >= 0.0) && none <= some && some <= more;
    (!fine).then(|| format!("{none}, {some}, {more} with no, some and twice the noise"))
}

/// No other coefficients have a smaller objective: a search from the map's result gains almost nothing.
fn proximal(regularizer: &dyn Regularizer) -> Outcome {
    least(regularizer, Bounds::default())
}

/// The same within bounds, unless the regularizer refuses them.
fn bounds(regularizer: &dyn Regularizer) -> Outcome {
    let bounds = Bounds { low: -0.15, high: 0.4 };
    if on(regularizer, &grids()[0]).confine(bounds).is_err() {
        return settle(None, "only 0 and none above, others are refused");
    }
    least(regularizer, bounds)
}

fn least(regularizer: &dyn Regularizer, bounds: Bounds) -> Outcome {
    let mut worst = 0.0f64;
    for grid in grids() {
        for tau in TAUS {
            let v = noise(&grid, 3);
            let mut penalty = on(regularizer, &grid);
            if bounds != Bounds::default() {
                penalty.confine(bounds)?;
            }
            let u = prox(penalty.as_mut(), &v, tau);
            let of = |x: &[f32]| objective(penalty.as_ref(), &grid, &v, tau, x);
            let clipped: Vec<f32> = v.iter().map(|v| bounds.clip(*v)).collect();
            let (found, start) = (of(&u), of(&clipped));
            let out = u.iter().find(|u| bounds.clip(**u) != **u);
            none(out.map(|out| format!("{:?}, weight {tau}: {out} is not {bounds}", grid.shape)))?;
            let least = search(&of, bounds, u).min(search(&of, bounds, clipped));
            let gain = (found - least) / start.max(1e-30);
            worst = worst.max(gain);
            let what = || format!("{:?}, weight {tau}: objective {found:.5}, a search finds {least:.5}", grid.shape);
            require(gain <= GAIN, what)?;
        }
    }
    Ok(format!("a search gains {worst:.1e} of the objective at most"))
}

/// The minimum found by steps along single coefficients, along all of them, and in random directions.
fn search(of: &dyn Fn(&[f32]) -> f64, bounds: Bounds, mut x: Vec<f32>) -> f64 {
    let mut least = of(&x);
    let mut seed = 0;
    for step in [0.3f32, 0.1, 0.03, 0.01, 3e-3, 1e-3] {
        for _ in 0..40 {
            let before = least;
            let n = x.len();
            for direction in 0..2 * n + 20 {
                seed += 1;
                let drawn = |i: usize| unit(mix(seed, i as u64)) - 0.5;
                let along = |i: usize| match direction {
                    d if d < 2 * n => f32::from(u8::from(i == d / 2)) * (1.0 - 2.0 * (d % 2) as f32),
                    d if d < 2 * n + 2 => 1.0 - 2.0 * (d % 2) as f32,
                    _ => drawn(i),
                };
                let moved = |(i, x): (usize, &f32)| bounds.clip(x + step * along(i));
                let other: Vec<f32> = x.iter().enumerate().map(moved).collect();
                let value = of(&other);
                if value < least {
                    (least, x) = (value, other);
                }
            }
            if before - least < 1e-9 {
                break;
            }
        }
    }
    least
}

fn nonexpansive(regularizer: &dyn Regularizer) -> Option<String> {
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt();
    grids().iter().find_map(|grid| {
        (0..4).find_map(|seed| {
            let (a, b) = (noise(grid, seed), noise(grid, seed + 50));
            let [u, w] = [&a, &b].map(|v| prox(on(regularizer, grid).as_mut(), v, 0.2));
            let (before, after) = (distance(&a, &b), distance(&u, &w));
            (after.is_nan() || after > 1.002 * before).then(|| format!("{before:.4} apart become {after:.4}"))
        })
    })
}

fn not_negative(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    TAUS.into_iter().find_map(|tau| {
        let mut u = vec![0.0; noise(grid, 4).len()];
        // From the first call on.
        on(regularizer, grid).prox(&noise(grid, 4), tau, &mut u);
        let bad = u.iter().find(|u| !u.is_finite() || **u < 0.0)?;
        Some(format!("{:?}, weight {tau}: {bad}", grid.shape))
    })
}

fn no_weight(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let v = noise(grid, 5);
    let mut u = vec![0.0; v.len()];
    on(regularizer, grid).prox(&v, 0.0, &mut u);
    differing("coefficient", &u, &v.iter().map(|v| v.max(0.0)).collect::<Vec<_>>())
}

fn overwrites(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let v = noise(grid, 6);
    let [mut clean, mut over] = [0.0, f32::NAN].map(|x| vec![x; v.len()]);
    on(regularizer, grid).prox(&v, 0.1, &mut clean);
    on(regularizer, grid).prox(&v, 0.1, &mut over);
    differing("coefficient", &over, &clean)
}

/// A pass depends only on the coefficients before it and the state in [`Penalty::state`].
fn state(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let v = noise(grid, 7);
    let [mut first, mut second] = [on(regularizer, grid), on(regularizer, grid)];
    let [mut a, mut b] = [vec![0.0; v.len()], vec![0.0; v.len()]];
    (0..5).for_each(|_| first.prox(&v, 0.1, &mut a));
    let (from, to) = (first.state(), second.state());
    let mut names: Vec<&str> = from.iter().map(|s| s.0).collect();
    names.sort_unstable();
    names.dedup();
    if names.len() != from.len() {
        return Some("two of a name".into());
    }
    for ((_, from), (_, mut to)) in from.into_iter().zip(to) {
        let moved = from.read(&Host).and_then(|from| to.load(&Host, &from));
        moved.unwrap_or_else(|e| panic!("{e}"));
    }
    let x = Array3::from_shape_vec(grid.shape, v.clone()).unwrap_or_else(|e| panic!("{e}"));
    for (penalty, u) in [(&mut first, &mut a), (&mut second, &mut b)] {
        if penalty.adapts() {
            penalty.adapt(x.view());
        }
        penalty.prox(&v, 0.1, u);
    }
    differing("coefficient after the state was handed over", &b, &a)
}

/// A tally counts exactly what is allocated.
fn tally(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Option<String> {
    let [real, tally] = [Space::new(header(grid), Arc::new(Host)), Space::tally(header(grid))].map(|space| {
        // The penalty's memory counts as long as it exists.
        regularizer.on(grid, &space).map_or(u64::MAX, |_| space.bytes())
    });
    let state = on(regularizer, grid).state().iter().map(|s| 4 * s.1.count() as u64).sum::<u64>();
    (real != tally || tally < state).then(|| format!("{tally} bytes, {real} allocated, {state} of state"))
}

fn threads(regularizer: &dyn Regularizer) -> Option<String> {
    let grid = VoxelGrid { shape: [13, 9, 21], spacing: [1.0, 0.7, 1.3], center: [0.0; 3] };
    let run = || {
        let (mut penalty, v) = (on(regularizer, &grid), noise(&grid, 8));
        let mut u = vec![0.0; v.len()];
        (0..5).for_each(|_| penalty.prox(&v, 0.1, &mut u));
        u
    };
    on_threads(run, |n, a, b| differing(&format!("{n}, coefficient"), a, b))
}

/// What a penalty reports after calls.
fn fault(regularizer: &dyn Regularizer, grid: &VoxelGrid) -> Result<()> {
    let (mut penalty, v) = (on(regularizer, grid), noise(grid, 10));
    let u = prox(penalty.as_mut(), &v, 0.1);
    value_of(penalty.as_ref(), grid, &u);
    penalty.fault()
}
