//! Conjugate gradients on the normal equations `AᵀA·x = Aᵀp` (Hestenes and Stiefel 1952; Björck, Numerical Methods for
//! Least Squares Problems, algorithm 7.4.1). Early passes find what is smooth; noise comes with more of them.

use super::{Method, Opened, Pass, Problem, Stop, drive, flat_mut, norm2, projecting, refuse_others};
use conefield_core::error::Result;
use conefield_core::solver::{Job, Observer, Reconstruction, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use ndarray::{Array3, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `cgls`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cgls {
    /// When it ends.
    pub stop: Stop,
    /// Set negative attenuation to 0 in the end.
    pub nonnegative: bool,
}

impl Default for Cgls {
    fn default() -> Self {
        Self { stop: Stop { passes: Some(15), ..Stop::default() }, nonnegative: true }
    }
}

conefield_core::stage_type!(Solver, "cgls", Cgls, "conjugate gradients for least squares");

#[typetag::serde(name = "cgls")]
impl SolverSpec for Cgls {
    fn build(&self) -> Result<Box<dyn Solver>> {
        self.stop.validate()?;
        Ok(Box::new(self.clone()))
    }
}

impl Solver for Cgls {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = Opened::of(&self.describe(), job, observer)?;
        let job = &opened.job(job);
        let problem = opened.problem(job);
        let mut iterate = Iterate::new(&problem, problem.start(job)?);
        let mut solution = drive(job, &self.stop, begun, &problem, &mut iterate, observer)?;
        if let (true, Reconstruction::Volume(volume)) = (self.nonnegative, &mut solution.result) {
            volume.data.par_mapv_inplace(|x| x.max(0.0));
        }
        Ok(solution)
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        refuse_others(spec)?;
        Ok(false)
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.stop.needs_held_out()
    }

    /// Direction and gradient, the residual and the direction's projections.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        2 * 4 * (pixels + voxels) + projecting(pixels) + self.stop.kept(voxels)
    }

    fn describe(&self) -> String {
        "cgls: conjugate gradients on the normal equations".into()
    }
}

struct Iterate {
    x: Array3<f32>,
    /// `p − A·x`.
    residual: Array3<f32>,
    /// The search direction.
    direction: Array3<f32>,
    /// `Aᵀ·residual`.
    gradient: Array3<f32>,
    /// `‖gradient‖²`.
    gamma: f64,
}

impl Iterate {
    fn new(problem: &Problem<'_>, x: Array3<f32>) -> Self {
        let residual = problem.residual(&problem.views(), &x);
        let mut gradient = problem.zeros();
        problem.back(&problem.views(), &residual, &mut gradient);
        let gamma = norm2(&gradient);
        Self { x, residual, direction: gradient.clone(), gradient, gamma }
    }
}

impl Method for Iterate {
    fn pass(&mut self, problem: &Problem<'_>, _: u64) -> Result<Pass> {
        let views = problem.views();
        let ahead = problem.forward(&views, &self.direction);
        let square = norm2(&ahead);
        if square == 0.0 {
            return Ok(Pass { residual: norm2(&self.residual), change: Some(0.0), prior: None });
        }
        let alpha = (self.gamma / square) as f32;
        Zip::from(&mut self.x).and(&self.direction).par_for_each(|x, d| *x += alpha * d);
        Zip::from(&mut self.residual).and(&ahead).par_for_each(|r, q| *r -= alpha * q);
        problem.back(&views, &self.residual, &mut self.gradient);
        let gamma = norm2(&self.gradient);
        let beta = (gamma / self.gamma) as f32;
        self.gamma = gamma;
        let change = f64::from(alpha) * (norm2(&self.direction) / norm2(&self.x).max(1e-300)).sqrt();
        Zip::from(&mut self.direction).and(&self.gradient).par_for_each(|d, s| *d = s + beta * *d);
        Ok(Pass { residual: norm2(&self.residual), change: Some(change), prior: None })
    }

    fn volume(&self) -> &Array3<f32> {
        &self.x
    }

    fn take(&mut self) -> Array3<f32> {
        std::mem::take(&mut self.x)
    }

    fn state(&mut self) -> Vec<(&'static str, &mut [f32])> {
        vec![
            ("x", flat_mut(&mut self.x)),
            ("residual", flat_mut(&mut self.residual)),
            ("direction", flat_mut(&mut self.direction)),
        ]
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.gamma]
    }
}
