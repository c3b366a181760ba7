//! A problem in terms of a basis: line integrals of coefficients.

use super::problem::{Problem, copy, norm2};
use conefield_core::basis::Expansion;
use conefield_core::error::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::place::{ADD, Array, Mask, Place};
use conefield_core::space::Space;
use ndarray::Array3;

/// Iterations that fit coefficients to a volume.
const FIT: usize = 20;

/// The matrix `A·B` of a problem's projector A and a basis B. If the coefficients are samples, it is `A` alone, on
/// their grid. If they are the voxels, nothing is copied. A basis works on the host: samples of a device are expanded
/// only for records and at the end, the coefficients of other bases in every pass.
pub(super) struct Model {
    expansion: Box<dyn Expansion>,
    /// The voxels of the coefficients, unless the coefficients are voxels.
    voxels: Option<Array>,
    /// The coefficients inside the object's support; `None` if all are, or if the problem's mask applies.
    inside: Option<Mask>,
    /// Buffer for the adjoint on the voxels, unless the coefficients are samples.
    adjoint: Option<Array>,
}

/// The grid of the problem's projector: that of the coefficients if they are samples, else `voxels`.
pub(super) fn projected(expansion: &dyn Expansion, voxels: VoxelGrid) -> VoxelGrid {
    if expansion.are_samples() { expansion.coefficients() } else { voxels }
}

/// Overwrites `voxels` with `B·x`.
fn expand(place: &dyn Place, basis: &dyn Expansion, x: &Array, voxels: &mut Array) -> Result<()> {
    let x = place.read(x)?;
    place.overwrite(voxels, &mut |voxels| basis.operator().expand(x.view(), voxels.view_mut()))
}

/// Overwrites `x` with `Bᵀ·voxels`.
fn gather(place: &dyn Place, basis: &dyn Expansion, voxels: &Array, x: &mut Array) -> Result<()> {
    let voxels = place.read(voxels)?;
    place.overwrite(x, &mut |x| basis.operator().adjoint(voxels.view(), x.view_mut()))
}

impl Model {
    /// The model with its buffers, and the coefficients of `start`, a volume on the grid `voxels`.
    pub(super) fn new(
        expansion: Box<dyn Expansion>,
        voxels: &VoxelGrid,
        space: &Space,
        start: Array,
    ) -> Result<(Self, Array)> {
        if expansion.coefficients() == *voxels && expansion.are_samples() {
            return Ok((Self { expansion, voxels: None, inside: None, adjoint: None }, start));
        }
        let coefficients = || space.array(expansion.coefficients().shape);
        let (x, adjoint) = (coefficients()?, (!expansion.are_samples()).then(coefficients).transpose()?);
        space.pass(expansion.scratch());
        let mut model = Self { expansion, voxels: Some(start), inside: None, adjoint };
        let x = space.briefly(|space| model.fit(x, space))?;
        Ok((model, x))
    }

    /// Determines which coefficients can be nonzero.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, work: &mut Array) -> Result<()> {
        if self.expansion.are_samples() {
            return Ok(());
        }
        if let (Some(voxels), Some(_)) = (&mut self.voxels, problem.inside) {
            problem.ones(voxels)?;
            gather(problem.place, self.expansion.as_ref(), voxels, work)?;
            let inside: Array3<bool> = problem.place.read(work)?.mapv(|reached| reached > 0.0);
            self.inside = Some(problem.place.mask(inside)?);
        }
        Ok(())
    }

    /// An error of the basis since the last call.
    pub(super) fn fault(&self) -> Result<()> {
        self.expansion.fault()
    }

    /// Whether the basis takes part in every pass, on the host.
    pub(super) fn expands(&self) -> bool {
        !self.expansion.are_samples()
    }

    /// The grid of the coefficients.
    pub(super) fn grid(&self) -> VoxelGrid {
        self.expansion.coefficients()
    }

    /// The volume of coefficients: clipped where samples overshoot the bounds, and 0 outside the object's support.
    pub(super) fn volume<'a>(&'a mut self, problem: &Problem<'_>, x: &'a Array) -> Result<&'a Array> {
        let Some(voxels) = &mut self.voxels else { return Ok(x) };
        expand(problem.place, self.expansion.as_ref(), x, voxels)?;
        if self.expansion.are_samples() {
            problem.clip(voxels, problem.bounds)?;
        } else {
            problem.outside(voxels, 0.0)?;
        }
        Ok(voxels)
    }

    /// The volume of coefficients that are no longer needed.
    pub(super) fn take(mut self, problem: &Problem<'_>, x: Array) -> Result<Array> {
        self.volume(problem, &x)?;
        Ok(self.voxels.unwrap_or(x))
    }

    /// Like [`Problem::forward`].
    pub(super) fn forward(&mut self, problem: &Problem<'_>, views: &[usize], x: &Array, out: &mut Array) -> Result<()> {
        // The projector takes samples as they are.
        let x = if self.expands() { self.volume(problem, x)? } else { x };
        problem.forward(views, x, out)
    }

    /// Adds `(A·B)ᵀ·y` for some views to `out`.
    pub(super) fn back(&mut self, problem: &Problem<'_>, views: &[usize], y: &Array, out: &mut Array) -> Result<()> {
        let (Some(voxels), Some(adjoint)) = (&mut self.voxels, &mut self.adjoint) else {
            return problem.add_back(views, y, out);
        };
        problem.back(views, y, voxels)?;
        gather(problem.place, self.expansion.as_ref(), voxels, adjoint)?;
        problem.place.map(&ADD, [1.0, 1.0], out, &[adjoint])
    }

    /// Which coefficients can be nonzero, if not all.
    pub(super) fn inside<'a>(&'a self, problem: &Problem<'a>) -> Option<&'a Mask> {
        if self.expands() { self.inside.as_ref() } else { problem.inside }
    }

    /// Sets the coefficients that must stay 0 to `value`.
    pub(super) fn outside(&self, problem: &Problem<'_>, x: &mut Array, value: f32) -> Result<()> {
        self.inside(problem).map_or(Ok(()), |inside| problem.place.keep(x, inside, value))
    }

    /// The coefficients whose volume is closest to `voxels`, from `x = 0` by a few conjugate gradient steps.
    fn fit(&mut self, mut x: Array, space: &Space) -> Result<Array> {
        let Some(residual) = &mut self.voxels else { return Ok(x) };
        let (basis, place) = (self.expansion.as_ref(), space.place().as_ref());
        let shape = basis.coefficients().shape;
        let (mut gradient, mut direction) = (space.array(shape)?, space.array(shape)?);
        let mut ahead = space.volume()?;
        if norm2(place, residual)? == 0.0 {
            return Ok(x);
        }
        gather(place, basis, residual, &mut gradient)?;
        copy(place, &gradient, &mut direction)?;
        let mut gamma = norm2(place, &gradient)?;
        let enough = 1e-4 * gamma;
        for _ in 0..FIT {
            expand(place, basis, &direction, &mut ahead)?;
            let square = norm2(place, &ahead)?;
            if gamma <= enough || square == 0.0 {
                break;
            }
            let alpha = f64::from((gamma / square) as f32);
            place.map(&ADD, [alpha, 1.0], &mut x, &[&direction])?;
            place.map(&ADD, [-alpha, 1.0], residual, &[&ahead])?;
            gather(place, basis, residual, &mut gradient)?;
            let next = norm2(place, &gradient)?;
            place.map(&ADD, [1.0, next / gamma], &mut direction, &[&gradient])?;
            gamma = next;
        }
        Ok(x)
    }
}
