//! ASD-POCS (Sidky and Pan, Phys. Med. Biol. 53(17), 2008): a pass of ordered-subset SART towards the data, then steps
//! of steepest descent on total variation, whose length depends on the change of the data pass.

use super::noise::{self, Noise};
use super::order::{Order, Subsets};
use super::plan::OnVoxels;
use super::problem::{change, copy, distance, norm2};
use super::sart::{Sweep, Updates};
use super::shared::{Shared, settings};
use super::tv::{anisotropy, descend};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::error::Result;
use conefield_core::method::Method;
use conefield_core::place::Array;
use conefield_core::scan::Scan;
use ndarray::Array3;

settings! {
    /// Settings of `asd-pocs`.
    AsdPocs {
        /// File of a known volume to start from.
        start,
        stop: Stop::after(20),
        /// Number of ordered subsets of the views, or "views" for one view at a time.
        subsets: Subsets = Subsets::Count(50),
        /// Descent steps per pass.
        descents: usize = 20,
    }
}

/// Relaxation of the data passes, and its factor after each pass.
const RELAXATION: f64 = 1.0;
const DECAY: f64 = 0.97;
/// Length of the first descent steps relative to the change of the first data pass.
const ALPHA: f64 = 0.05;
/// Factor of the step length, applied while the descent steps change more than [`RATIO`] of the data pass and the
/// residual exceeds what the scan's noise explains.
const ALPHA_DECAY: f64 = 0.95;
const RATIO: f64 = 0.95;

conefield_core::stage_type!(Method, "asd-pocs", AsdPocs, "alternates data passes and total-variation descent");

impl AsdPocs {
    fn built(&self) -> Result<OnVoxels> {
        let Self { subsets, descents, .. } = *self;
        let order = Order::Golden;
        let updates = Updates { subsets, relaxation: RELAXATION, decay: DECAY, order, nonnegative: true };
        updates.validate()?;
        let text = format!("asd-pocs: {subsets}, {descents} descents per pass");
        let method = OnVoxels::new(Shared { text, subsets, ..self.shared()? }, move |space, x, scan| {
            space.pass(noise::scratch(space.header()));
            let noise = |pixels: &Array3<f32>| Noise::of(pixels.view(), false).sigma * (pixels.len() as f64).sqrt();
            Ok(Box::new(AsdPocsIterate {
                descents,
                target: scan.map_or(0.0, |scan| noise(&scan.projections)),
                sweep: Sweep::new(updates, space, x)?,
                length: 0.0,
                before: space.volume()?,
                fitted: space.volume()?,
            }))
        });
        let found = |scan: &Scan| vec![Noise::of(scan.projections.view(), false).to_string()];
        Ok(OnVoxels { found, ..method })
    }
}

struct AsdPocsIterate {
    descents: usize,
    sweep: Sweep,
    /// Norm of a residual of pure noise.
    target: f64,
    /// Length of a descent step.
    length: f64,
    /// The volume before a pass.
    before: Array,
    /// The volume after the data pass.
    fitted: Array,
}

impl Iteration for AsdPocsIterate {
    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
        self.sweep.prepare(problem)
    }

    fn pass(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        let (grid, place) = (&problem.scan.geometry.volume, problem.place);
        copy(place, &self.sweep.x, &mut self.before)?;
        let residual = self.sweep.sweep(problem, pass, within)?;
        let data = distance(place, &self.sweep.x, &self.before)?;
        if pass == 0 {
            self.length = ALPHA * data / self.descents.max(1) as f64;
        }
        copy(place, &self.sweep.x, &mut self.fitted)?;
        let mean = (norm2(place, &self.fitted)? / self.fitted.len() as f64).sqrt();
        for _ in 0..self.descents {
            descend(place, &mut self.sweep.x, anisotropy(grid), self.length, 1e-3 * mean as f32, &mut self.sweep.work)?;
            problem.outside(&mut self.sweep.x, 0.0)?;
        }
        // The descents leave the bounds.
        let bounds = self.sweep.bounds(problem);
        problem.clip(&mut self.sweep.x, bounds)?;
        let prior = distance(place, &self.sweep.x, &self.fitted)?;
        if prior > RATIO * data && residual.sqrt() > self.target {
            self.length *= ALPHA_DECAY;
        }
        Ok(Pass { residual, change: Some(change(place, &self.sweep.x, &self.before)?), prior: None })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.sweep.x
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.length]
    }
}
