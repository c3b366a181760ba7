//! SART: `x ← x + λ·D·A_sᵀ·W·(p_s − A_s·x)` over subsets s of the views, with W the inverse row sums of A and D the
//! inverse column sums of the subset (Andersen and Kak, Ultrasonic Imaging 6, 1984). One view per subset is SART, all
//! views at once are SIRT, anything in between is OS-SART.

use super::order::{Order, Subsets};
use super::plan::OnVoxels;
use super::problem::{invert, room};
use super::shared::{Shared, settings};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::error::{Result, ensure};
use conefield_core::method::Method;
use conefield_core::place::{Array, Bounds, RELAX};
use conefield_core::space::Space;

settings! {
    /// Settings of `sart`.
    Sart {
        /// File of a known volume to start from.
        start,
        stop: Stop::after(15),
        /// Number of ordered subsets of the views, or "views" for one view at a time. 1 uses all views at once.
        subsets: Subsets = Subsets::VIEWS,
        /// Relaxation λ of the first pass, above 0 and below 2.
        relaxation: f64 = 0.3,
        /// Factor of λ after each pass.
        decay: f64 = 0.9,
        /// Order of the subsets.
        order: Order = Order::Golden,
        /// Raise attenuation to `scene.bounds.low`, by default 0, after each update.
        nonnegative: bool = true,
    }
}

conefield_core::stage_type!(Method, "sart", Sart, "simultaneous algebraic reconstruction by subsets of the views");

impl Sart {
    fn built(&self) -> Result<OnVoxels> {
        let Self { subsets, relaxation, decay, order, nonnegative, .. } = *self;
        let updates = Updates { subsets, relaxation, decay, order, nonnegative };
        updates.validate()?;
        let text = format!("sart: {subsets}, relaxation {relaxation} times {decay} per pass");
        let shared = Shared { text, subsets, ..self.shared()? };
        Ok(OnVoxels::new(shared, move |space, x, _| Ok(Box::new(Sweep::new(updates, space, x)?))))
    }
}

/// The update rule of a [`Sweep`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Updates {
    pub(super) subsets: Subsets,
    pub(super) relaxation: f64,
    pub(super) decay: f64,
    pub(super) order: Order,
    pub(super) nonnegative: bool,
}

impl Updates {
    pub(super) fn validate(&self) -> Result<()> {
        self.subsets.validate()?;
        let r = self.relaxation;
        ensure(r > 0.0 && r < 2.0, "spec", "relaxation", r, "a number above 0 and below 2")?;
        let d = self.decay;
        ensure(d > 0.0 && d <= 1.0, "spec", "decay", d, "a number above 0 and at most 1")
    }
}

/// The iterate with its buffers.
pub(super) struct Sweep {
    updates: Updates,
    subsets: Vec<Vec<usize>>,
    pub(super) x: Array,
    /// Inverse row sums, `[view, row, column]`.
    rows: Array,
    /// Inverse column sums of the current subset.
    columns: Array,
    /// Working memory, free between sweeps.
    pub(super) work: Array,
    /// The pixels of a subset.
    pixels: Array,
}

impl Sweep {
    /// The buffers of a sweep that starts from `x`.
    pub(super) fn new(updates: Updates, space: &Space, x: Array) -> Result<Self> {
        let views = space.header().views;
        Ok(Self {
            updates,
            subsets: updates.subsets.of(views),
            x,
            rows: space.projections(views)?,
            columns: space.volume()?,
            work: space.volume()?,
            pixels: room(space, updates.subsets.count(views))?,
        })
    }

    /// Makes pass `pass`, counted from 0; returns `‖p − A·x‖²`.
    pub(super) fn sweep(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<f64> {
        let Updates { relaxation, decay, order, .. } = self.updates;
        let relaxation = f64::from((relaxation * decay.powi(pass.min(1 << 20) as i32)) as f32);
        // A region may admit less.
        let floor = f64::from(problem.regions.widest(self.bounds(problem)).low);
        let mut square = 0.0;
        for (i, s) in order.of(self.subsets.len(), problem.seed, pass).into_iter().enumerate() {
            let views = &self.subsets[s];
            square += problem.residual(views, &self.x, Some(&self.rows), &mut self.pixels)?;
            problem.back(views, &self.pixels, &mut self.work)?;
            if self.subsets.len() > 1 {
                column_sums(problem, views, &mut self.pixels, &mut self.columns)?;
            }
            problem.place.map(&RELAX, [relaxation, floor], &mut self.x, &[&self.columns, &self.work])?;
            self.confine(problem)?;
            within((i + 1) as f64 / self.subsets.len() as f64);
        }
        Ok(square)
    }

    pub(super) fn bounds(&self, problem: &Problem<'_>) -> Bounds {
        Bounds { low: if self.updates.nonnegative { problem.bounds.low } else { f32::MIN }, ..problem.bounds }
    }

    /// Clips the volume to what an update does not keep to by itself: the upper bound, and bounds of regions.
    fn confine(&mut self, problem: &Problem<'_>) -> Result<()> {
        let bounds = self.bounds(problem);
        if bounds.high < f32::INFINITY || !problem.regions.is_empty() {
            problem.clip(&mut self.x, bounds)?;
        }
        Ok(())
    }
}

/// Overwrites `sums` with the inverse column sums of some views; `pixels` is a buffer for their images.
pub(super) fn column_sums(problem: &Problem<'_>, views: &[usize], pixels: &mut Array, sums: &mut Array) -> Result<()> {
    problem.place.fill(pixels, 1.0)?;
    problem.back(views, pixels, sums)?;
    invert(problem.place, sums)
}

impl Iteration for Sweep {
    fn advice(&self) -> Option<&'static str> {
        Some("try a smaller relaxation")
    }

    fn knows_change(&self) -> bool {
        false
    }

    /// Computes the sums that do not change.
    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
        problem.ones(&mut self.work)?;
        // One subset at a time, as in every pass.
        for views in &self.subsets {
            problem.forward(views, &self.work, &mut self.pixels)?;
            problem.place.scatter(&self.pixels, 0, &mut self.rows, views)?;
        }
        invert(problem.place, &mut self.rows)?;
        if let [all] = &self.subsets[..] {
            column_sums(problem, all, &mut self.pixels, &mut self.columns)?;
        }
        Ok(())
    }

    fn pass(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        Ok(Pass { residual: self.sweep(problem, pass, within)?, ..Pass::default() })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.x
    }
}
