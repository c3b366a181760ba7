//! Properties of a basis: a linear map without negative entries, and its exact adjoint.

use crate::call::{differing, no_fault, on_threads, require, settle, skipped};
use crate::gradients::no_double;
use crate::voxels::{apart, flat, mismatch, noise, nonlinear};
use crate::{Outcome, Report};
use conefield_core::basis::{Basis, BasisOperator, Expansion};
use conefield_core::geometry::VoxelGrid;
use conefield_core::simd::Real;
use ndarray::Array3;

/// Largest mismatch of `<Bx, y>` and `<x, Bᵀy>` relative to `‖Bx‖·‖y‖`, in double and in single precision.
const ADJOINT: [f64; 2] = [1e-12, 1e-5];
/// Largest error of single against double precision, relative to the largest number.
const SINGLE: f64 = 1e-5;

/// Checks all properties of a basis.
pub fn check_basis(basis: &dyn Basis) -> Report {
    let mut report = Report::of(basis.describe());
    report.holds("builds", "for every grid", || builds(basis));
    let made: Result<Vec<_>, _> = grids().iter().map(|grid| basis.on(grid).map(|b| (*grid, b))).collect();
    let Ok(all) = made else { return report };
    let double = all.iter().all(|(_, basis)| basis.reference().is_some());
    report.add("adjoint: double precision", || if double { adjoint(&all, reference, ADJOINT[0]) } else { no_double() });
    report.add("adjoint: single precision", || adjoint(&all, |b| b.operator(), ADJOINT[1]));
    report.add("single precision", || if double { single_precision(&all) } else { no_double() });
    report.holds("linear", "sums and multiples go through", || linear(&all, if double { 1e-12 } else { SINGLE }));
    report.holds("overwrites", "over NaN as over 0", || all.iter().find_map(overwrites));
    report.add("no negative entries", || no_negative_entries(&all));
    report.add("samples", || samples(&all, if double { 1e-6 } else { SINGLE }));
    report.holds("threads", "1 and 3 threads", || threads(&all));
    report.add("no fault", || no_fault(all.iter().try_for_each(|(_, basis)| basis.fault())));
    report
}

/// The operator in double precision, if the basis has one.
fn reference(basis: &dyn Expansion) -> &dyn BasisOperator<f64> {
    basis.reference().unwrap_or_else(|| unreachable!("only asked of what has one"))
}

/// Expands coefficients to voxels, in double precision if there is such an operator.
fn exact(basis: &dyn Expansion, voxels: [usize; 3], x: &Array3<f64>) -> Array3<f64> {
    match basis.reference() {
        Some(of) => expand(of, voxels, x),
        None => expand(basis.operator(), voxels, &x.mapv(|x| x as f32)).mapv(f64::from),
    }
}

type Made = [(VoxelGrid, Box<dyn Expansion>)];

/// Non-cubic voxels, odd sides, lines and planes of voxels.
fn grids() -> Vec<VoxelGrid> {
    let grid = |shape, spacing| VoxelGrid { shape, spacing, center: [1.0, -2.0, 3.0] };
    vec![
        grid([8, 6, 10], [1.0; 3]),
        grid([7, 5, 9], [1.5, 0.7, 2.0]),
        grid([1, 12, 1], [1.0; 3]),
        grid([11, 1, 4], [0.5; 3]),
    ]
}

/// The basis exists for every grid, and the number of coefficients depends on the grid's shape only.
fn builds(basis: &dyn Basis) -> Option<String> {
    grids().into_iter().find_map(|grid| {
        let made = match basis.on(&grid) {
            Ok(made) => made.coefficients(),
            Err(e) => return Some(format!("for {grid:?}: {e}")),
        };
        let positive = made.shape.iter().all(|n| *n > 0) && made.spacing.iter().all(|s| s.is_finite() && *s > 0.0);
        let other = VoxelGrid { spacing: grid.spacing.map(|s| 3.0 * s), center: [0.0; 3], ..grid };
        let shape = basis.on(&other).map(|b| b.coefficients().shape).ok();
        (!positive || shape != Some(made.shape))
            .then(|| format!("for {grid:?}: {made:?}, with larger voxels {shape:?}"))
    })
}

fn expand<R: Real>(of: &dyn BasisOperator<R>, voxels: [usize; 3], x: &Array3<R>) -> Array3<R> {
    let mut out = Array3::from_elem(voxels, R::ZERO);
    of.expand(x.view(), out.view_mut());
    out
}

fn back<R: Real>(of: &dyn BasisOperator<R>, coefficients: [usize; 3], y: &Array3<R>) -> Array3<R> {
    let mut out = Array3::from_elem(coefficients, R::ZERO);
    of.adjoint(y.view(), out.view_mut());
    out
}

fn adjoint<R: Real>(all: &Made, of: impl Fn(&dyn Expansion) -> &dyn BasisOperator<R>, most: f64) -> Outcome {
    let mut worst = 0.0f64;
    for (grid, basis) in all {
        let (op, shape) = (of(basis.as_ref()), basis.coefficients().shape);
        let (x, y) = (noise::<R>(shape, 7), noise::<R>(grid.shape, 107));
        let (bx, bty) = (expand(op, grid.shape, &x), back(op, shape, &y));
        let off = mismatch([&x, &bty], [&bx, &y]);
        require(off <= most, || format!("{:?}: <Bx, y> and <x, Bᵀy> differ by {off:.1e}", grid.shape))?;
        worst = worst.max(off);
    }
    Ok(format!("off by {worst:.1e} at most"))
}

fn single_precision(all: &Made) -> Outcome {
    let wide = |a: &Array3<f32>| a.mapv(f64::from);
    let complaint = all.iter().find_map(|(grid, basis)| {
        let shape = basis.coefficients().shape;
        let (x, y) = (noise::<f32>(shape, 3), noise::<f32>(grid.shape, 4));
        let voxels = expand(basis.operator(), grid.shape, &x);
        let coefficients = back(basis.operator(), shape, &y);
        apart("voxels", &voxels, &expand(reference(basis.as_ref()), grid.shape, &wide(&x)), SINGLE).or_else(|| {
            apart("coefficients", &coefficients, &back(reference(basis.as_ref()), shape, &wide(&y)), SINGLE)
        })
    });
    settle(complaint, &format!("within {SINGLE:.0e} of double precision"))
}

fn linear(all: &Made, close: f64) -> Option<String> {
    all.iter().find_map(|(grid, basis)| {
        let voxels = |x: &_| exact(basis.as_ref(), grid.shape, x);
        nonlinear("voxels of a sum", voxels, basis.coefficients().shape, [1, 2], close)
    })
}

/// Both directions overwrite their output, whether it holds NaN or 0.
fn overwrites((grid, basis): &(VoxelGrid, Box<dyn Expansion>)) -> Option<String> {
    let (op, shape) = (basis.operator(), basis.coefficients().shape);
    let (x, y) = (noise::<f32>(shape, 5), noise::<f32>(grid.shape, 6));
    let mut voxels = Array3::from_elem(grid.shape, f32::NAN);
    op.expand(x.view(), voxels.view_mut());
    let mut coefficients = Array3::from_elem(shape, f32::NAN);
    op.adjoint(y.view(), coefficients.view_mut());
    differing("voxel", &flat(&voxels), &flat(&expand(op, grid.shape, &x)))
        .or_else(|| differing("coefficient", &flat(&coefficients), &flat(&back(op, shape, &y))))
}

fn no_negative_entries(all: &Made) -> Outcome {
    let mut coefficients = 0;
    if all.iter().any(|(_, basis)| basis.are_samples()) {
        return skipped("coefficients are samples");
    }
    let complaint = all.iter().find_map(|(grid, basis)| {
        let shape = basis.coefficients().shape;
        let one = |i: usize| {
            let mut x = Array3::zeros(shape);
            x.as_slice_mut()?[i] = 1.0;
            // This also finds NaN.
            let all = exact(basis.as_ref(), grid.shape, &x);
            let least = all.into_iter().find(|v| v.is_nan() || *v < 0.0).unwrap_or(0.0);
            (least.is_nan() || least < 0.0).then(|| format!("{:?}: coefficient {i} gives {least:e}", grid.shape))
        };
        let count = shape.iter().product::<usize>();
        coefficients += count;
        (0..count).find_map(one)
    });
    settle(complaint, &format!("in {coefficients} columns"))
}

/// Coefficients that are samples fill the same box, preserve constants, and change nothing if the grids are equal.
fn samples(all: &Made, close: f64) -> Outcome {
    if !all.iter().any(|(_, basis)| basis.are_samples()) {
        return skipped("coefficients are none");
    }
    let complaint = all.iter().find_map(|(grid, basis)| {
        let at = basis.coefficients();
        let far = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).any(|k| (a[k] - b[k]).abs() > 1e-9 * grid.size()[k]);
        if at.bounds().iter().zip(&grid.bounds()).any(far) {
            return Some(format!("its samples fill {:?}, the voxels {:?}", at.bounds(), grid.bounds()));
        }
        let [one, ones] = [at.shape, grid.shape].map(Array3::<f64>::ones);
        let constant = apart("voxels of a constant", &exact(basis.as_ref(), grid.shape, &one), &ones, close);
        let same = (at.shape == grid.shape).then(|| {
            let x = noise::<f64>(grid.shape, 9);
            apart("voxels", &exact(basis.as_ref(), grid.shape, &x), &x, close)
        });
        constant.or(same.flatten())
    });
    settle(complaint, "coefficients are values of the volume")
}

fn threads(all: &Made) -> Option<String> {
    let both = || -> Vec<f32> {
        let of = |(grid, basis): &(VoxelGrid, Box<dyn Expansion>)| {
            let shape = basis.coefficients().shape;
            let (x, y) = (noise::<f32>(shape, 1), noise::<f32>(grid.shape, 2));
            [flat(&expand(basis.operator(), grid.shape, &x)), flat(&back(basis.operator(), shape, &y))].concat()
        };
        all.iter().flat_map(of).collect()
    };
    on_threads(both, |n, a, b| differing(&format!("{n}, number"), a, b))
}
