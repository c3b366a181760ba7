//! ASD-POCS (Sidky and Pan, Phys. Med. Biol. 53(17), 2008): a pass of ordered-subset SART towards the data, then steps
//! of steepest descent on total variation, whose length is tied to what the data pass changed.

use super::algebraic::{Algebraic, Sweep};
use super::noise::{self, Noise};
use super::order::{Order, subsets, told};
use super::tv::{anisotropy, descend};
use super::{Method, Opened, Pass, Problem, Stop, change, distance, drive, flat_mut, norm2, refuse_others};
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use conefield_core::solver::{Job, Observer, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use ndarray::Array3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `asd-pocs`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AsdPocs {
    /// When it ends.
    pub stop: Stop,
    /// Subsets of the views.
    pub subsets: usize,
    /// Relaxation of the data passes.
    pub relaxation: f64,
    /// What the relaxation is multiplied with after each pass.
    pub decay: f64,
    /// Length of the first descent steps against what the first data pass changed.
    pub alpha: f64,
    /// What the descent steps are multiplied with when they change more than `ratio` of the data pass.
    pub alpha_decay: f64,
    /// See `alpha_decay`.
    pub ratio: f64,
    /// Descent steps a pass.
    pub descents: usize,
    /// Residual, in standard deviations of the scan's noise, down to which descent steps are shortened.
    pub tolerance: f64,
}

impl Default for AsdPocs {
    fn default() -> Self {
        Self {
            stop: Stop { passes: Some(20), ..Stop::default() },
            subsets: 50,
            relaxation: 1.0,
            decay: 0.97,
            alpha: 0.05,
            alpha_decay: 0.95,
            ratio: 0.95,
            descents: 20,
            tolerance: 1.0,
        }
    }
}

conefield_core::stage_type!(Solver, "asd-pocs", AsdPocs, "data passes in turn with descent on total variation");

#[typetag::serde(name = "asd-pocs")]
impl SolverSpec for AsdPocs {
    fn build(&self) -> Result<Box<dyn Solver>> {
        self.data().validate()?;
        ensure(self.subsets > 0, "spec", "solver.subsets", 0, "at least 1")?;
        for (name, x) in [("alpha", self.alpha), ("alpha_decay", self.alpha_decay), ("ratio", self.ratio)] {
            ensure(x.is_finite() && x > 0.0, "spec", &format!("solver.{name}"), x, "a positive finite number")?;
        }
        ensure(self.tolerance >= 0.0, "spec", "solver.tolerance", self.tolerance, "0 or more")?;
        Ok(Box::new(self.clone()))
    }
}

impl AsdPocs {
    fn data(&self) -> Algebraic {
        Algebraic {
            name: "asd-pocs",
            subsets: self.subsets,
            stop: self.stop.clone(),
            relaxation: self.relaxation,
            decay: self.decay,
            order: Order::Golden,
            nonnegative: true,
        }
    }
}

impl Solver for AsdPocs {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = Opened::of(&self.describe(), job, observer)?;
        let job = &opened.job(job);
        let problem = opened.problem(job);
        let sigma = Noise::of(job.scan, false).sigma;
        let mut iterate = Iterate {
            settings: self.clone(),
            sweep: Sweep::new(&self.data(), &problem, problem.start(job)?),
            target: self.tolerance * sigma * (job.scan.projections.len() as f64).sqrt(),
            length: 0.0,
            work: problem.zeros(),
        };
        drive(job, &self.stop, begun, &problem, &mut iterate, observer)
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        refuse_others(spec)?;
        Ok(false)
    }

    fn plan(&self, scan: &Scan) -> Vec<String> {
        let noise = Noise::of(scan, false).to_string();
        vec![told(&subsets(scan.geometry.views.len(), self.subsets)), noise]
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.stop.needs_held_out()
    }

    /// Beside a sweep's there are the volume before it and the descent's direction; after it, one more copy instead of
    /// inverse column sums. The noise is read from differences of all pixels before that.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        let sweeping = Sweep::memory(self.subsets, pixels, voxels) + 2 * 4 * voxels;
        sweeping.max(noise::memory(pixels)) + self.stop.kept(voxels)
    }

    fn describe(&self) -> String {
        format!("asd-pocs: {} subsets, {} descents a pass, alpha {}", self.subsets, self.descents, self.alpha)
    }
}

struct Iterate {
    settings: AsdPocs,
    sweep: Sweep,
    /// The residual's norm that noise alone explains.
    target: f64,
    /// Length of a descent step.
    length: f64,
    work: Array3<f32>,
}

impl Method for Iterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        let s = &self.settings;
        let grid = &problem.scan.geometry.volume;
        let before = self.sweep.x.clone();
        let residual = self.sweep.sweep(problem, pass);
        let data = distance(&self.sweep.x, &before);
        if pass == 0 {
            self.length = s.alpha * data / s.descents.max(1) as f64;
        }
        let fitted = self.sweep.x.clone();
        let mean = (norm2(&fitted) / fitted.len() as f64).sqrt();
        for _ in 0..s.descents {
            let x = flat_mut(&mut self.sweep.x);
            descend(x, grid.shape, anisotropy(grid), self.length, 1e-3 * mean as f32, flat_mut(&mut self.work));
            problem.outside(&mut self.sweep.x, 0.0);
        }
        let prior = distance(&self.sweep.x, &fitted);
        if prior > s.ratio * data && residual.sqrt() > self.target {
            self.length *= s.alpha_decay;
        }
        Ok(Pass { residual, change: Some(change(&self.sweep.x, &before)), prior: None })
    }

    fn volume(&self) -> &Array3<f32> {
        &self.sweep.x
    }

    fn take(&mut self) -> Array3<f32> {
        std::mem::take(&mut self.sweep.x)
    }

    fn state(&mut self) -> Vec<(&'static str, &mut [f32])> {
        vec![("x", flat_mut(&mut self.sweep.x))]
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.length]
    }
}
