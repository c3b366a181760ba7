//! A problem in terms of a basis: line integrals of coefficients.

use super::flat_mut;
use super::norms::norm2;
use super::problem::Problem;
use conefield_core::basis::Expansion;
use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::space::Space;
use ndarray::{Array3, Zip};
use rayon::prelude::*;

/// Iterations that fit coefficients to a volume.
const FIT: usize = 20;

/// The matrix `A·B` of a problem's projector A and a basis B. If the coefficients are samples, it is `A` alone, on
/// their grid. If they are the voxels, nothing is copied.
pub(super) struct Model {
    expansion: Box<dyn Expansion>,
    /// The voxels of the coefficients, unless the coefficients are voxels.
    voxels: Option<Array3<f32>>,
    /// The coefficients inside the object's support; `None` if all are, or if the problem's mask applies.
    inside: Option<Array3<bool>>,
    /// Buffer for the adjoint on the voxels, unless the coefficients are samples.
    adjoint: Option<Array3<f32>>,
}

/// The grid of the problem's projector: that of the coefficients if they are samples, else `voxels`.
pub(super) fn projected(expansion: &dyn Expansion, voxels: VoxelGrid) -> VoxelGrid {
    if expansion.are_samples() { expansion.coefficients() } else { voxels }
}

impl Model {
    /// The model with its buffers, and the coefficients of `start`, a volume on the grid `voxels`.
    pub(super) fn new(
        expansion: Box<dyn Expansion>,
        voxels: &VoxelGrid,
        space: &Space,
        start: Array3<f32>,
    ) -> (Self, Array3<f32>) {
        if expansion.coefficients() == *voxels && expansion.are_samples() {
            return (Self { expansion, voxels: None, inside: None, adjoint: None }, start);
        }
        let coefficients = || space.array(expansion.coefficients().shape);
        let (x, adjoint) = (coefficients(), (!expansion.are_samples()).then(coefficients));
        space.pass(expansion.scratch());
        let mut model = Self { expansion, voxels: Some(start), inside: None, adjoint };
        let x = space.briefly(|space| model.fit(x, space));
        (model, x)
    }

    /// Determines which coefficients can be nonzero.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, work: &mut Array3<f32>) {
        if self.expansion.are_samples() {
            return;
        }
        if let (Some(voxels), Some(_)) = (&mut self.voxels, problem.inside) {
            problem.ones(voxels);
            self.expansion.operator().adjoint(voxels.view(), work.view_mut());
            self.inside = Some(work.mapv(|reached| reached > 0.0));
        }
    }

    /// An error of the basis since the last call.
    pub(super) fn fault(&self) -> Result<()> {
        self.expansion.fault()
    }

    /// Whether the projector takes the coefficients as they are.
    pub(super) fn projects_coefficients(&self) -> bool {
        self.expansion.are_samples()
    }

    /// The grid of the coefficients.
    pub(super) fn grid(&self) -> VoxelGrid {
        self.expansion.coefficients()
    }

    /// The volume of coefficients: 0 where samples overshoot below 0, and outside the object's support.
    pub(super) fn volume<'a>(&'a mut self, problem: &Problem<'_>, x: &'a Array3<f32>) -> &'a Array3<f32> {
        let Some(voxels) = &mut self.voxels else { return x };
        self.expansion.operator().expand(x.view(), voxels.view_mut());
        if self.expansion.are_samples() {
            voxels.par_mapv_inplace(|x| x.max(0.0));
        } else {
            problem.outside(voxels, 0.0);
        }
        voxels
    }

    /// The input of the problem's projector.
    fn projected<'a>(&'a mut self, problem: &Problem<'_>, x: &'a Array3<f32>) -> &'a Array3<f32> {
        if self.expansion.are_samples() { x } else { self.volume(problem, x) }
    }

    /// The volume of coefficients that are no longer needed.
    pub(super) fn take(&mut self, problem: &Problem<'_>, x: Array3<f32>) -> Array3<f32> {
        self.volume(problem, &x);
        self.voxels.take().unwrap_or(x)
    }

    /// Like [`Problem::forward`].
    pub(super) fn forward(&mut self, problem: &Problem<'_>, views: &[usize], x: &Array3<f32>, out: &mut Array3<f32>) {
        problem.forward(views, self.projected(problem, x), out);
    }

    /// Adds `(A·B)ᵀ·y` for some views to `out`.
    pub(super) fn back(&mut self, problem: &Problem<'_>, views: &[usize], y: &Array3<f32>, out: &mut Array3<f32>) {
        let (Some(voxels), Some(adjoint)) = (&mut self.voxels, &mut self.adjoint) else {
            return problem.add_back(views, y, out);
        };
        problem.back(views, y, voxels);
        self.expansion.operator().adjoint(voxels.view(), adjoint.view_mut());
        Zip::from(out).and(&*adjoint).par_for_each(|sum, x| *sum += x);
    }

    /// Which coefficients can be nonzero, if not all.
    pub(super) fn inside<'a>(&'a self, problem: &'a Problem<'_>) -> Option<&'a [bool]> {
        let inside = if self.expansion.are_samples() { problem.inside } else { self.inside.as_ref() };
        inside.map(|inside| inside.as_slice().unwrap_or_else(|| unreachable!("masks are contiguous")))
    }

    /// Sets the coefficients that must stay 0 to `value`.
    pub(super) fn outside(&self, problem: &Problem<'_>, x: &mut Array3<f32>, value: f32) {
        if let Some(inside) = self.inside(problem) {
            let all = flat_mut(x).par_iter_mut().zip(inside);
            all.for_each(|(x, inside)| *x = if *inside { *x } else { value });
        }
    }

    /// The coefficients whose volume is closest to `voxels`, from `x = 0` by a few conjugate gradient steps.
    fn fit(&mut self, mut x: Array3<f32>, space: &Space) -> Array3<f32> {
        let Some(residual) = &mut self.voxels else { return x };
        let operator = self.expansion.operator();
        let shape = self.expansion.coefficients().shape;
        let (mut gradient, mut direction) = (space.array(shape), space.array(shape));
        let mut ahead = space.volume();
        if norm2(residual) == 0.0 {
            return x;
        }
        operator.adjoint(residual.view(), gradient.view_mut());
        direction.assign(&gradient);
        let mut gamma = norm2(&gradient);
        let enough = 1e-4 * gamma;
        for _ in 0..FIT {
            operator.expand(direction.view(), ahead.view_mut());
            let square = norm2(&ahead);
            if gamma <= enough || square == 0.0 {
                break;
            }
            let alpha = (gamma / square) as f32;
            Zip::from(&mut x).and(&direction).par_for_each(|x, d| *x += alpha * d);
            Zip::from(&mut *residual).and(&ahead).par_for_each(|r, a| *r -= alpha * a);
            operator.adjoint(residual.view(), gradient.view_mut());
            let beta = (norm2(&gradient) / gamma) as f32;
            gamma = norm2(&gradient);
            Zip::from(&mut direction).and(&gradient).par_for_each(|d, g| *d = g + beta * *d);
        }
        x
    }
}
