//! Regularizers, data terms and bases.

use super::{built, guard, hand_over, hand_over_on, many, many_mut, shims};
use crate::built::Built;
use conefield_core::basis::{BasisOperator, Expansion};
use conefield_core::error::{Error, Result};
use conefield_core::geometry::VoxelGrid;
use conefield_core::place::{Host, StatePart};
use conefield_core::regularizer::Penalty;
use conefield_core::scan::ScanHeader;
use conefield_core::simd::Real;
use conefield_core::space::Space;
use conefield_plugin_abi::*;
use ndarray::{ArrayView3, ArrayViewMut3};
use std::ffi::c_void;
use std::ptr;
use std::sync::Arc;

pub static REGULARIZER: ConefieldRegularizer = ConefieldRegularizer {
    size: size_of::<ConefieldRegularizer>(),
    bytes: Some(penalty_bytes),
    on: Some(penalty_on),
    weight: Some(weight),
    value: Some(value),
    prox: Some(prox),
    state: Some(state),
    adapt: Some(adapt),
};

pub static DATA_TERM: ConefieldDataTerm = ConefieldDataTerm {
    size: size_of::<ConefieldDataTerm>(),
    bytes: Some(misfit_bytes),
    of: Some(misfit_of),
    noise: Some(noise),
    differentiate: Some(differentiate),
    curve: Some(curve),
    spread: Some(spread),
};

pub static BASIS: ConefieldBasis = ConefieldBasis {
    size: size_of::<ConefieldBasis>(),
    on: Some(expansion_on),
    info: Some(info),
    expand: Some(expand),
    adjoint: Some(adjoint),
    expand_f64: Some(expand_f64),
    adjoint_f64: Some(adjoint_f64),
};

unsafe fn grid(grid: *const ConefieldGrid) -> VoxelGrid {
    // SAFETY: see `shims/mod.rs`.
    let ConefieldGrid { shape, spacing, center } = unsafe { *grid };
    VoxelGrid { shape, spacing, center }
}

/// The size of a scan of which only the volume or only the views are known.
fn header(volume: [usize; 3], [views, rows, columns]: [usize; 3]) -> ScanHeader {
    ScanHeader { views, detector: [rows, columns], volume }
}

/// `shape` numbers at `data`.
unsafe fn array<'a, R: Real>(shape: [usize; 3], data: *const R) -> Result<ArrayView3<'a, R>> {
    // SAFETY: see `shims/mod.rs`.
    let data = unsafe { many(data, shape.iter().product()) };
    ArrayView3::from_shape(shape, data).map_err(|e| Error::unsupported("an array from the host", e.to_string()))
}

unsafe fn array_mut<'a, R: Real>(shape: [usize; 3], data: *mut R) -> Result<ArrayViewMut3<'a, R>> {
    // SAFETY: see `shims/mod.rs`.
    let data = unsafe { many_mut(data, shape.iter().product()) };
    ArrayViewMut3::from_shape(shape, data).map_err(|e| Error::unsupported("an array from the host", e.to_string()))
}

shims! {
    fn penalty_bytes(regularizer: regularizer, on: *const ConefieldGrid) -> u64, or 0, {
        let grid = grid(on);
        let space = Space::tally(header(grid.shape, [0; 3]));
        regularizer.on(&grid, &space)?;
        space.bytes()
    }

    fn penalty_on(regularizer: regularizer, on: *const ConefieldGrid, penalty: *mut *mut c_void; error) {
        let grid = grid(on);
        let space = Space::new(header(grid.shape, [0; 3]), Arc::new(Host));
        *penalty = hand_over_on(grid.shape, regularizer.on(&grid, &space)?);
    }

    fn weight(
        regularizer: regularizer, on: *const ConefieldGrid,
        noise: Option<unsafe extern "C" fn(*mut c_void, f64) -> f64>, context: *mut c_void, weight: *mut f64; error
    ) {
        let mut measured = |k| noise.map_or(0.0, |noise| noise(context, k));
        *weight = regularizer.weight(&grid(on), &mut measured)?;
    }

    fn value(built: any, x: *const f32, _count: usize, value: *mut f64; error) {
        let penalty = built.penalty()?;
        *value = penalty.value(array(built.shape, x)?);
        penalty.fault()?;
    }
}

unsafe fn penalty<'a>(stage: *mut c_void) -> Result<&'a mut dyn Penalty> {
    // SAFETY: see `shims/mod.rs`; nothing else uses the penalty meanwhile.
    unsafe { (*stage.cast::<Built>()).penalty_mut() }
}

unsafe extern "C" fn prox(
    stage: *mut c_void,
    v: *const f32,
    count: usize,
    tau: f32,
    u: *mut f32,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see `shims/mod.rs`.
        let (penalty, v, u) = unsafe { (penalty(stage)?, many(v, count), many_mut(u, count)) };
        penalty.prox(v, tau, u);
        penalty.fault()
    })
}

unsafe extern "C" fn adapt(
    stage: *mut c_void,
    x: *const f32,
    _: usize,
    value: *mut f64,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see `shims/mod.rs`; nothing else uses the penalty meanwhile.
        let (built, value) = unsafe { (&mut *stage.cast::<Built>(), &mut *value) };
        // SAFETY: as above.
        let x = unsafe { array(built.shape, x)? };
        let penalty = built.penalty_mut()?;
        let adapted = penalty.adapt(x);
        penalty.fault()?;
        *value = adapted.ok_or_else(|| Error::unsupported("adapt", "the penalty stays as it is"))?;
        Ok(())
    })
}

unsafe extern "C" fn state(stage: *mut c_void, index: usize, out: *mut ConefieldState) -> ConefieldStatus {
    guard(ptr::null_mut(), || {
        // SAFETY: see `shims/mod.rs`.
        let all = unsafe { penalty(stage)? }.state();
        let entry = all.into_iter().nth(index);
        let (name, values) = entry.ok_or_else(|| Error::unsupported("state", "the index is too large"))?;
        let values = match values {
            StatePart::Host(values) => values,
            StatePart::Placed(array) => array.slice_mut(),
        };
        let name = ConefieldStr { data: name.as_ptr(), length: name.len() };
        // SAFETY: see `shims/mod.rs`.
        unsafe { *out = ConefieldState { name, data: values.as_mut_ptr(), length: values.len() } };
        Ok(())
    })
}

unsafe extern "C" fn misfit_bytes(stage: *const c_void, shape: *const usize, held: *mut u64, brief: *mut u64) {
    guard(ptr::null_mut(), || {
        // SAFETY: see `shims/mod.rs`.
        unsafe {
            let (term, header) = (built(stage).data_term()?, header([0; 3], *shape.cast()));
            (*held, *brief) = (term.held(&header), term.scratch(&header));
        }
        Ok(())
    });
}

shims! {
    fn misfit_of(
        term: data_term, measured: *const f32, shape: *const usize, misfit: *mut *mut c_void; error
    ) {
        *misfit = hand_over(term.of(array(*shape.cast(), measured)?)?);
    }

    fn noise(misfit: misfit) -> f64, or f64::NAN, { misfit.noise() }

    fn differentiate(
        misfit: misfit, view: usize, measured: *const f32, count: usize, residuals: *mut f32, sum: *mut f64; error
    ) {
        *sum = misfit.differentiate(view, many(measured, count), many_mut(residuals, count));
        misfit.fault()?;
    }

    fn curve(misfit: misfit, view: usize, measured: *const f32, count: usize, values: *mut f32; error) {
        misfit.curve(view, many(measured, count), many_mut(values, count));
        misfit.fault()?;
    }

    fn spread(misfit: misfit, view: usize, measured: *const f32, count: usize, values: *mut f32; error) {
        misfit.spread(view, many(measured, count), many_mut(values, count));
        misfit.fault()?;
    }

    fn expansion_on(basis: basis, voxels: *const ConefieldGrid, expansion: *mut *mut c_void; error) {
        let grid = grid(voxels);
        *expansion = hand_over_on(grid.shape, basis.on(&grid)?);
    }

    fn info(expansion: expansion, out: *mut ConefieldExpansion) {
        let VoxelGrid { shape, spacing, center } = expansion.coefficients();
        *out = ConefieldExpansion {
            coefficients: ConefieldGrid { shape, spacing, center },
            scratch: expansion.scratch(),
            samples: expansion.are_samples().into(),
            double_precision: expansion.reference().is_some().into(),
        };
    }

    fn expand(built: any, coefficients: *const f32, voxels: *mut f32; error) {
        run_expand(built, built.expansion()?.operator(), coefficients, voxels)?;
    }

    fn adjoint(built: any, voxels: *const f32, coefficients: *mut f32; error) {
        run_adjoint(built, built.expansion()?.operator(), voxels, coefficients)?;
    }

    fn expand_f64(built: any, coefficients: *const f64, voxels: *mut f64; error) {
        run_expand(built, double(built.expansion()?)?, coefficients, voxels)?;
    }

    fn adjoint_f64(built: any, voxels: *const f64, coefficients: *mut f64; error) {
        run_adjoint(built, double(built.expansion()?)?, voxels, coefficients)?;
    }
}

fn double(expansion: &dyn Expansion) -> Result<&dyn BasisOperator<f64>> {
    expansion.reference().ok_or_else(|| Error::unsupported("this basis", "it does not work in double precision"))
}

unsafe fn run_expand<R: Real>(
    built: &Built,
    operator: &dyn BasisOperator<R>,
    coefficients: *const R,
    voxels: *mut R,
) -> Result<()> {
    let expansion = built.expansion()?;
    // SAFETY: see `shims/mod.rs`.
    let (from, to) = unsafe { (array(expansion.coefficients().shape, coefficients)?, array_mut(built.shape, voxels)?) };
    operator.expand(from, to);
    expansion.fault()
}

unsafe fn run_adjoint<R: Real>(
    built: &Built,
    operator: &dyn BasisOperator<R>,
    voxels: *const R,
    coefficients: *mut R,
) -> Result<()> {
    let expansion = built.expansion()?;
    // SAFETY: see `shims/mod.rs`.
    let (from, to) = unsafe { (array(built.shape, voxels)?, array_mut(expansion.coefficients().shape, coefficients)?) };
    operator.adjoint(from, to);
    expansion.fault()
}
