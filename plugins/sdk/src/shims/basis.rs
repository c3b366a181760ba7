//! Bases and their expansions on a grid.

use super::{array, array_mut, grid, guard, hand_over_on, shims, table};
use crate::built::Built;
use conefield_core::prelude::*;
use conefield_plugin_abi::*;
use std::ffi::c_void;

table! { ConefieldBasis: on info expand adjoint expand_f64 adjoint_f64 }

shims! {
    fn on(basis: basis, voxels: *const ConefieldGrid, expansion: *mut *mut c_void; error) {
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
