//! LSQR: least squares by Golub and Kahan's bidiagonalization (Paige and Saunders, ACM Trans. Math. Softw. 8(1), 1982).
//! Its volumes are those of conjugate gradients, with less rounding, and it takes a pull: it minimizes
//! `‖p − A·x‖² + λ²‖x − x₀‖²`.

use super::plan::OnVoxels;
use super::problem::{copy, distance, norm2};
use super::shared::{Shared, settings};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::error::{Result, ensure};
use conefield_core::method::Method;
use conefield_core::place::{ADD, Array, StatePart};
use conefield_core::space::Space;

settings! {
    /// Settings of `lsqr`.
    Lsqr {
        /// File of a known volume to start from.
        start,
        stop: Stop::after(15),
        /// Strength of the pull towards the start volume, or towards 0 without one: the weight λ² of `‖x − x₀‖²`,
        /// relative to `‖Aᵀr‖²/‖r‖²` for the residual r of the start, which is close to the largest eigenvalue of AᵀA.
        pull: f64 = 0.0,
        /// Raise attenuation to `scene.bounds.low`, by default 0, at the end.
        nonnegative: bool = true,
    }
}

conefield_core::stage_type!(Method, "lsqr", Lsqr, "least squares by bidiagonalization, with a pull towards a volume");

impl Lsqr {
    fn built(&self) -> Result<OnVoxels> {
        let pull = self.pull;
        ensure(pull.is_finite() && pull >= 0.0, "spec", "pull", pull, "a finite number, 0 or more")?;
        let held = if pull > 0.0 { format!(", pull {pull}") } else { String::new() };
        let text = format!("lsqr: Golub and Kahan's bidiagonalization{held}");
        let shared = Shared { text, ..self.shared()? };
        let method = OnVoxels::new(shared, move |space, x, _| Ok(Box::new(LsqrIterate::new(space, x, pull)?)));
        Ok(OnVoxels { nonnegative: Some(self.nonnegative), ..method })
    }
}

/// The vectors u and v of the bidiagonalization are kept unnormalized: normalization is a factor of later sums.
struct LsqrIterate {
    x: Array,
    /// `β·u`.
    left: Array,
    /// A multiple of v.
    right: Array,
    /// The search direction w.
    direction: Array,
    /// Working memory, free between passes.
    pixels: Array,
    /// The start volume, if there is a pull.
    towards: Option<Array>,
    pull: f64,
    /// λ.
    damping: f64,
    /// The last elements of the bidiagonal matrix.
    alpha: f64,
    beta: f64,
    /// `‖right‖`.
    scale: f64,
    /// ρ̄ and φ̄: the last element of the triangular matrix and of its right-hand side.
    rho: f64,
    phi: f64,
    /// What the rotations for λ have taken from `φ̄²`.
    taken: f64,
}

impl LsqrIterate {
    fn new(space: &Space, x: Array, pull: f64) -> Result<Self> {
        let views = space.header().views;
        Ok(Self {
            x,
            left: space.projections(views)?,
            right: space.volume()?,
            direction: space.volume()?,
            pixels: space.projections(views)?,
            towards: (pull > 0.0).then(|| space.volume()).transpose()?,
            pull,
            damping: 0.0,
            alpha: 0.0,
            beta: 0.0,
            scale: 0.0,
            rho: 0.0,
            phi: 0.0,
            taken: 0.0,
        })
    }

    /// Makes a step; returns its length.
    fn step(&mut self, problem: &Problem<'_>, within: &mut dyn FnMut(f64)) -> Result<f64> {
        let (views, place) = (problem.views(), problem.place);
        let Self { x, left, right, direction, pixels, .. } = self;
        problem.forward(&views, right, pixels)?;
        within(0.5);
        place.map(&ADD, [1.0 / self.scale, -self.alpha / self.beta], left, &[pixels])?;
        let beta = norm2(place, left)?.sqrt();
        // One rotation for λ, and one for the element below the diagonal.
        let damped = self.rho.hypot(self.damping);
        self.taken += (self.damping / damped * self.phi).powi(2);
        self.phi *= self.rho / damped;
        let rho = damped.hypot(beta);
        let step = damped / rho * self.phi / rho;
        self.phi *= beta / rho;
        let length = step.abs() * norm2(place, direction)?.sqrt();
        place.map(&ADD, [step, 1.0], x, &[direction])?;
        // `right` becomes `β·α·v`.
        place.map(&ADD, [0.0, -beta * beta / self.scale], right, &[x])?;
        problem.add_back(&views, left, right)?;
        problem.outside(right, 0.0)?;
        (self.beta, self.scale) = (beta, norm2(place, right)?.sqrt());
        self.alpha = if beta > 0.0 { self.scale / beta } else { 0.0 };
        self.rho = -damped / rho * self.alpha;
        if self.alpha > 0.0 {
            place.map(&ADD, [1.0 / self.scale, -beta * self.alpha / (rho * rho)], direction, &[right])?;
        }
        Ok(length)
    }
}

impl Iteration for LsqrIterate {
    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
        let views = problem.views();
        self.beta = problem.residual(&views, &self.x, None, &mut self.left)?.sqrt();
        if let Some(towards) = &mut self.towards {
            copy(problem.place, &self.x, towards)?;
        }
        problem.back(&views, &self.left, &mut self.right)?;
        self.scale = norm2(problem.place, &self.right)?.sqrt();
        if self.scale > 0.0 {
            self.alpha = self.scale / self.beta;
            problem.place.map(&ADD, [1.0 / self.scale, 0.0], &mut self.direction, &[&self.right])?;
        }
        self.damping = self.pull.sqrt() * self.alpha;
        (self.rho, self.phi) = (self.alpha, self.beta);
        Ok(())
    }

    fn pass(&mut self, problem: &Problem<'_>, _: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        let place = problem.place;
        // An α of 0: the volume solves the problem.
        let length = if self.alpha > 0.0 { self.step(problem, within)? } else { 0.0 };
        let change = Some(length / norm2(place, &self.x)?.max(1e-300).sqrt());
        let all = self.phi.powi(2) + self.taken;
        let Some(towards) = &self.towards else { return Ok(Pass { residual: all, change, prior: None }) };
        let prior = (self.damping * distance(place, &self.x, towards)?).powi(2);
        Ok(Pass { residual: (all - prior).max(0.0), change, prior: Some(prior) })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.x
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        let Self { x, left, right, direction, .. } = self;
        let all = [("x", x), ("left", left), ("right", right), ("direction", direction)];
        all.map(|(name, x)| (name.to_owned(), StatePart::Placed(x))).into()
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        let Self { alpha, beta, scale, rho, phi, taken, .. } = self;
        vec![alpha, beta, scale, rho, phi, taken]
    }
}
