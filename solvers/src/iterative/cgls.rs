//! Conjugate gradients on the normal equations `AᵀA·x = Aᵀp` (Hestenes and Stiefel 1952; Björck, Numerical Methods for
//! Least Squares Problems, algorithm 7.4.1). Early passes recover smooth structure; later ones also fit noise.

use super::plan::OnVoxels;
use super::problem::{copy, norm2};
use super::shared::{Shared, settings};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::error::Result;
use conefield_core::method::Method;
use conefield_core::place::{ADD, Array, StatePart};
use conefield_core::space::Space;

settings! {
    /// Settings of `cgls`.
    Cgls {
        /// File of a known volume to start from.
        start,
        stop: Stop::after(15),
        /// Raise attenuation to `scene.bounds.low`, by default 0, at the end.
        nonnegative: bool = true,
    }
}

conefield_core::stage_type!(Method, "cgls", Cgls, "conjugate gradients for least squares");

impl Cgls {
    fn built(&self) -> Result<OnVoxels> {
        let text = "cgls: conjugate gradients on the normal equations".into();
        let shared = Shared { text, ..self.shared()? };
        let method = OnVoxels::new(shared, |space, x, _| Ok(Box::new(CglsIterate::new(space, x)?)));
        Ok(OnVoxels { nonnegative: Some(self.nonnegative), ..method })
    }
}

struct CglsIterate {
    x: Array,
    /// `p − A·x`.
    residual: Array,
    /// The search direction.
    direction: Array,
    /// `A·direction`.
    ahead: Array,
    /// `Aᵀ·residual`.
    gradient: Array,
    /// `‖gradient‖²`.
    gamma: f64,
}

impl CglsIterate {
    fn new(space: &Space, x: Array) -> Result<Self> {
        let views = space.header().views;
        Ok(Self {
            x,
            residual: space.projections(views)?,
            direction: space.volume()?,
            ahead: space.projections(views)?,
            gradient: space.volume()?,
            gamma: 0.0,
        })
    }
}

impl Iteration for CglsIterate {
    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
        let views = problem.views();
        problem.residual(&views, &self.x, None, &mut self.residual)?;
        problem.back(&views, &self.residual, &mut self.gradient)?;
        copy(problem.place, &self.gradient, &mut self.direction)?;
        self.gamma = norm2(problem.place, &self.gradient)?;
        Ok(())
    }

    fn pass(&mut self, problem: &Problem<'_>, _: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        let (views, place) = (problem.views(), problem.place);
        let Self { x, residual, direction, ahead, gradient, gamma } = self;
        problem.forward(&views, direction, ahead)?;
        let square = norm2(place, ahead)?;
        if square == 0.0 {
            return Ok(Pass { residual: norm2(place, residual)?, change: Some(0.0), prior: None });
        }
        let alpha = f64::from((*gamma / square) as f32);
        place.map(&ADD, [alpha, 1.0], x, &[direction])?;
        place.map(&ADD, [-alpha, 1.0], residual, &[ahead])?;
        within(0.5);
        problem.back(&views, residual, gradient)?;
        let next = norm2(place, gradient)?;
        let beta = next / *gamma;
        *gamma = next;
        let change = alpha * (norm2(place, direction)? / norm2(place, x)?.max(1e-300)).sqrt();
        place.map(&ADD, [1.0, beta], direction, &[gradient])?;
        Ok(Pass { residual: norm2(place, residual)?, change: Some(change), prior: None })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.x
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        let Self { x, residual, direction, .. } = self;
        let all = [("x", x), ("residual", residual), ("direction", direction)];
        all.map(|(name, x)| (name.to_owned(), StatePart::Placed(x))).into()
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.gamma]
    }
}
