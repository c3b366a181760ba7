//! Bases and their expansions on a grid.

use super::*;

table! {
    ConefieldBasis: on info expand adjoint expand_f64 adjoint_f64;
    basis(keys, _) { Box::new(settings::<dyn BasisSpec>(keys)?.build()?) };
    dyn Basis: "basis", On: "basis on a grid"
}

/// What a basis makes for one grid.
type On = OnGrid<dyn Expansion>;

shims! {
    fn on(basis: dyn Basis, voxels: *const ConefieldGrid, expansion: *mut *mut c_void; error) {
        let grid = grid(voxels);
        *expansion = hand_over(Box::new(OnGrid { shape: grid.shape, part: basis.on(&grid)? }));
    }

    fn info(on: On, out: *mut ConefieldExpansion) {
        let VoxelGrid { shape, spacing, center } = on.part.coefficients();
        *out = ConefieldExpansion {
            coefficients: ConefieldGrid { shape, spacing, center },
            scratch: on.part.scratch(),
            samples: on.part.are_samples().into(),
            double_precision: on.part.reference().is_some().into(),
        };
    }

    fn expand(on: On, coefficients: *const f32, voxels: *mut f32; error) {
        run_expand(on, on.part.operator(), coefficients, voxels)?;
    }

    fn adjoint(on: On, voxels: *const f32, coefficients: *mut f32; error) {
        run_adjoint(on, on.part.operator(), voxels, coefficients)?;
    }

    fn expand_f64(on: On, coefficients: *const f64, voxels: *mut f64; error) {
        run_expand(on, double(on)?, coefficients, voxels)?;
    }

    fn adjoint_f64(on: On, voxels: *const f64, coefficients: *mut f64; error) {
        run_adjoint(on, double(on)?, voxels, coefficients)?;
    }
}

fn double(on: &On) -> Result<&dyn BasisOperator<f64>> {
    on.part.reference().ok_or_else(|| Error::unsupported("this basis", "it does not work in double precision"))
}

unsafe fn run_expand<R: Real>(
    on: &On,
    operator: &dyn BasisOperator<R>,
    coefficients: *const R,
    voxels: *mut R,
) -> Result<()> {
    // SAFETY: see `shims/mod.rs`.
    let (from, to) = unsafe { (array(on.part.coefficients().shape, coefficients)?, array_mut(on.shape, voxels)?) };
    operator.expand(from, to);
    on.part.fault()
}

unsafe fn run_adjoint<R: Real>(
    on: &On,
    operator: &dyn BasisOperator<R>,
    voxels: *const R,
    coefficients: *mut R,
) -> Result<()> {
    // SAFETY: see `shims/mod.rs`.
    let (from, to) = unsafe { (array(on.shape, voxels)?, array_mut(on.part.coefficients().shape, coefficients)?) };
    operator.adjoint(from, to);
    on.part.fault()
}
