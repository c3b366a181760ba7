//! SART, its ordered-subset form and SIRT: `x ← x + λ·D·A_sᵀ·W·(p_s − A_s·x)` over subsets s of the views, with W the
//! inverse row sums of A and D the inverse column sums of the subset (Andersen and Kak, Ultrasonic Imaging 6, 1984).
//! SART takes one view at a time, SIRT all at once.

use super::order::{Order, subsets, told};
use super::{Method, Opened, Pass, Problem, Stop, change, drive, flat_mut, inverse, projecting, refuse_others};
use conefield_core::error::{Result, ensure};
use conefield_core::scan::Scan;
use conefield_core::solver::{Job, Observer, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use ndarray::{Array3, Axis, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `sart`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Sart {
    /// When it ends.
    pub stop: Stop,
    /// Relaxation λ of the first pass, above 0 and below 2.
    pub relaxation: f64,
    /// What λ is multiplied with after each pass.
    pub decay: f64,
    /// The order of the views.
    pub order: Order,
    /// Set negative attenuation to 0 after each update.
    pub nonnegative: bool,
}

/// Settings of `os-sart`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OsSart {
    /// When it ends.
    pub stop: Stop,
    /// Subsets of the views.
    pub subsets: usize,
    /// Relaxation λ of the first pass, above 0 and below 2.
    pub relaxation: f64,
    /// What λ is multiplied with after each pass.
    pub decay: f64,
    /// The order of the subsets.
    pub order: Order,
    /// Set negative attenuation to 0 after each update.
    pub nonnegative: bool,
}

/// Settings of `sirt`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Sirt {
    /// When it ends.
    pub stop: Stop,
    /// Relaxation λ, above 0 and below 2.
    pub relaxation: f64,
    /// Set negative attenuation to 0 after each update.
    pub nonnegative: bool,
}

impl Default for Sart {
    fn default() -> Self {
        let stop = Stop { passes: Some(15), ..Stop::default() };
        Self { stop, relaxation: 0.3, decay: 0.9, order: Order::Golden, nonnegative: true }
    }
}

impl Default for OsSart {
    fn default() -> Self {
        let stop = Stop { passes: Some(20), ..Stop::default() };
        Self { stop, subsets: 10, relaxation: 1.0, decay: 0.9, order: Order::Golden, nonnegative: true }
    }
}

impl Default for Sirt {
    fn default() -> Self {
        let stop = Stop { passes: Some(60), ..Stop::default() };
        Self { stop, relaxation: 1.9, nonnegative: true }
    }
}

conefield_core::stage_type!(Solver, "sart", Sart, "simultaneous algebraic reconstruction, view by view");
conefield_core::stage_type!(Solver, "os-sart", OsSart, "algebraic reconstruction by ordered subsets of the views");
conefield_core::stage_type!(Solver, "sirt", Sirt, "simultaneous iterative reconstruction, all views at once");

#[typetag::serde(name = "sart")]
impl SolverSpec for Sart {
    fn build(&self) -> Result<Box<dyn Solver>> {
        let s = self.clone();
        Algebraic {
            name: "sart",
            subsets: usize::MAX,
            stop: s.stop,
            relaxation: s.relaxation,
            decay: s.decay,
            order: s.order,
            nonnegative: s.nonnegative,
        }
        .build()
    }
}

#[typetag::serde(name = "os-sart")]
impl SolverSpec for OsSart {
    fn build(&self) -> Result<Box<dyn Solver>> {
        ensure(self.subsets > 0, "spec", "solver.subsets", 0, "at least 1")?;
        let s = self.clone();
        Algebraic {
            name: "os-sart",
            subsets: s.subsets,
            stop: s.stop,
            relaxation: s.relaxation,
            decay: s.decay,
            order: s.order,
            nonnegative: s.nonnegative,
        }
        .build()
    }
}

#[typetag::serde(name = "sirt")]
impl SolverSpec for Sirt {
    fn build(&self) -> Result<Box<dyn Solver>> {
        let s = self.clone();
        Algebraic {
            name: "sirt",
            subsets: 1,
            stop: s.stop,
            relaxation: s.relaxation,
            decay: 1.0,
            order: Order::Sequential,
            nonnegative: s.nonnegative,
        }
        .build()
    }
}

/// What the three have in common.
#[derive(Debug, Clone)]
pub(super) struct Algebraic {
    pub(super) name: &'static str,
    pub(super) subsets: usize,
    pub(super) stop: Stop,
    pub(super) relaxation: f64,
    pub(super) decay: f64,
    pub(super) order: Order,
    pub(super) nonnegative: bool,
}

impl Algebraic {
    fn build(self) -> Result<Box<dyn Solver>> {
        self.validate()?;
        Ok(Box::new(self))
    }

    pub(super) fn validate(&self) -> Result<()> {
        self.stop.validate()?;
        let r = self.relaxation;
        ensure(r > 0.0 && r < 2.0, "spec", "solver.relaxation", r, "a number above 0 and below 2")?;
        let d = self.decay;
        ensure(d > 0.0 && d <= 1.0, "spec", "solver.decay", d, "a number above 0 and at most 1")
    }
}

impl Solver for Algebraic {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = Opened::of(&self.describe(), job, observer)?;
        let job = &opened.job(job);
        let problem = opened.problem(job);
        let mut sweep = Sweep::new(self, &problem, problem.start(job)?);
        drive(job, &self.stop, begun, &problem, &mut sweep, observer)
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        refuse_others(spec)?;
        Ok(false)
    }

    fn plan(&self, scan: &Scan) -> Vec<String> {
        vec![told(&subsets(scan.geometry.views.len(), self.subsets))]
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.stop.needs_held_out()
    }

    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        let before = if self.stop.change.is_some() { 4 * voxels } else { 0 };
        Sweep::memory(self.subsets, pixels, voxels) + before + self.stop.kept(voxels)
    }

    fn describe(&self) -> String {
        let subsets = match self.subsets {
            usize::MAX => "a view at a time".into(),
            1 => "all views at once".into(),
            n => format!("{n} subsets"),
        };
        format!("{}: {subsets}, relaxation {} times {} a pass", self.name, self.relaxation, self.decay)
    }
}

/// The iterate with what its updates need.
pub(super) struct Sweep {
    settings: Algebraic,
    subsets: Vec<Vec<usize>>,
    pub(super) x: Array3<f32>,
    /// Inverse row sums, `[view, row, column]`.
    rows: Array3<f32>,
    /// Inverse column sums where all views are one subset; otherwise they are made anew for each.
    columns: Option<Array3<f32>>,
    update: Array3<f32>,
}

impl Sweep {
    pub(super) fn new(settings: &Algebraic, problem: &Problem<'_>, x: Array3<f32>) -> Self {
        let subsets = subsets(problem.scan.geometry.views.len(), settings.subsets);
        let rows = inverse(problem.forward(&problem.views(), &problem.ones()));
        let mut sweep = Self { settings: settings.clone(), subsets, x, rows, columns: None, update: problem.zeros() };
        if sweep.subsets.len() == 1 {
            sweep.columns = Some(column_sums(problem, &problem.views()));
        }
        sweep
    }

    /// Bytes beside the volume: inverse sums of rows and columns, an update, and a subset's residual or ones. How many
    /// views there are is not known: SART's one view may be all of them.
    pub(super) fn memory(subsets: usize, pixels: u64, voxels: u64) -> u64 {
        let subsets = if subsets == usize::MAX { 1 } else { subsets.max(1) as u64 };
        let subset = 4 * pixels / subsets;
        4 * pixels + 2 * 4 * voxels + subset + projecting(subset / 4)
    }

    /// Pass `pass`, counted from 0; returns `‖p − A·x‖²`.
    pub(super) fn sweep(&mut self, problem: &Problem<'_>, pass: u64) -> f64 {
        let relaxation = (self.settings.relaxation * self.settings.decay.powi(pass.min(1 << 20) as i32)) as f32;
        let floor = if self.settings.nonnegative { 0.0 } else { f32::NEG_INFINITY };
        let mut square = 0.0;
        for s in self.settings.order.of(self.subsets.len(), problem.seed, pass) {
            let views = &self.subsets[s];
            let mut residual = problem.residual(views, &self.x);
            square += super::norm2(&residual);
            for (mut image, &v) in residual.axis_iter_mut(Axis(0)).zip(views) {
                image.zip_mut_with(&self.rows.index_axis(Axis(0), v), |r, w| *r *= w);
            }
            problem.back(views, &residual, &mut self.update);
            drop(residual);
            let made;
            let columns = match &self.columns {
                Some(c) => c,
                None => {
                    made = column_sums(problem, views);
                    &made
                }
            };
            Zip::from(&mut self.x)
                .and(&self.update)
                .and(columns)
                .par_for_each(|x, u, d| *x = (*x + relaxation * d * u).max(floor));
        }
        square
    }
}

/// Inverse column sums of some views.
fn column_sums(problem: &Problem<'_>, views: &[usize]) -> Array3<f32> {
    let [rows, columns] = problem.scan.geometry.detector;
    let mut sums = problem.zeros();
    problem.back(views, &Array3::ones((views.len(), rows, columns)), &mut sums);
    inverse(sums)
}

impl Method for Sweep {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        let before = self.settings.stop.change.is_some().then(|| self.x.clone());
        let residual = self.sweep(problem, pass);
        let change = before.map(|before| change(&self.x, &before));
        Ok(Pass { residual, change, prior: None })
    }

    fn volume(&self) -> &Array3<f32> {
        &self.x
    }

    fn take(&mut self) -> Array3<f32> {
        std::mem::take(&mut self.x)
    }

    fn state(&mut self) -> Vec<(&'static str, &mut [f32])> {
        vec![("x", flat_mut(&mut self.x))]
    }
}
