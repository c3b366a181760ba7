//! Common part of the plans of iterative methods.

use super::drive::{Iteration, buffers, drive};
use super::order::summary;
use super::shared::Shared;
use crate::fit::object;
use crate::{solid, surround};
use conefield_core::error::Result;
use conefield_core::method::{Findings, Job, Line, Needs, Observer, Outline, Plan, Reconstruction, Solution};
use conefield_core::place::{Array, Bounds};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::SupportRule;
use conefield_core::space::Space;
use std::time::Instant;

/// An iterative method, built and validated.
pub(super) trait Iterative: Send + Sync {
    /// Its common settings.
    fn shared(&self) -> &Shared;

    /// Its findings about a scan besides the subsets, one line each.
    fn found(&self, scan: &Scan) -> Vec<String>;

    /// The header of the scan as the method uses it: binned detector, unknowns in place of voxels.
    fn seen(&self, scan: &ScanHeader) -> ScanHeader {
        *scan
    }

    /// Bytes of all its arrays except the resulting volume.
    fn bytes(&self, scan: &ScanHeader) -> u64;

    /// Runs the method.
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution>;
}

/// Makes the state of a method from its first volume, with arrays of a space. Where the space only counts, there is no
/// scan.
type Make = dyn Fn(&Space, Array, Option<&Scan>) -> Result<Box<dyn Iteration>> + Send + Sync;

/// An iterative method whose unknowns are the voxels.
pub(super) struct OnVoxels {
    pub(super) shared: Shared,
    pub(super) make: Box<Make>,
    /// Findings about a scan besides the subsets, one line each.
    pub(super) found: fn(&Scan) -> Vec<String>,
    /// For a method that ignores the bounds until its end: whether it keeps to the lower one, too.
    pub(super) nonnegative: Option<bool>,
}

impl OnVoxels {
    /// The method whose state `make` makes.
    pub(super) fn new(
        shared: Shared,
        make: impl Fn(&Space, Array, Option<&Scan>) -> Result<Box<dyn Iteration>> + Send + Sync + 'static,
    ) -> Self {
        Self { shared, make: Box::new(make), found: |_| vec![], nonnegative: None }
    }
}

impl Iterative for OnVoxels {
    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn found(&self, scan: &Scan) -> Vec<String> {
        (self.found)(scan)
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        let made = space.volume().and_then(|x| (self.make)(&space, x, None));
        let knows_change = made.map_or(true, |method| method.knows_change());
        self.shared.price(&space, knows_change)
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = self.shared.open(job.scan.geometry.volume, 1, &self.shared.text, self, job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        let space = opened.space(job.scan.header());
        let start = self.shared.start(job, &problem, &space)?;
        let mut iteration = (self.make)(&space, start, Some(job.scan))?;
        let buffers = buffers(&self.shared.stop, iteration.knows_change(), &space)?;
        problem.settle()?;
        iteration.prepare(&problem)?;
        let mut solution = drive(job, &self.shared.stop, begun, &problem, buffers, iteration, observer)?;
        if let (Some(nonnegative), Reconstruction::Volume(volume)) = (self.nonnegative, &mut solution.result) {
            let bounds = Bounds { low: if nonnegative { problem.bounds.low } else { f32::MIN }, ..problem.bounds };
            // The volume is in the scan's unit.
            let factor = job.scan.unit.mm as f32;
            problem.regions.clip(&mut volume.data, &volume.grid, bounds, factor);
        }
        Ok(solution)
    }
}

/// Cost per unknown of the rest of a pass, in ray samples of forward and back-projection. On 50 views of 512² pixels
/// and 256³ voxels, ten subsets with total variation spend equal time on both.
const SAMPLES: f64 = 200.0;

/// The plan of an iterative method.
pub(super) struct IterativePlan(pub(super) Box<dyn Iterative>);

impl Plan for IterativePlan {
    fn outline(&self) -> Outline {
        let Shared { kind, text, stages, projector, projector_kind, .. } = self.0.shared();
        let projector = Line::new("projector", projector_kind, &projector.describe());
        let beside = std::iter::once(projector).chain(stages.iter().cloned()).collect();
        Outline { method: Line::new("method", kind, text), beside, ..Outline::default() }
    }

    fn needs(&self, scan: &ScanHeader) -> Needs {
        let shared = self.0.shared();
        let mask = if shared.scene.support == SupportRule::Box { 0 } else { self.0.seen(scan).voxels() };
        let working = self.0.bytes(scan) + mask;
        let [surround, corrected] = surround::bytes(shared.scene.surround, scan);
        let corrected = corrected + solid::bytes(&shared.scene.support, scan);
        Needs { surround, corrected, working, resume: working + 4 * scan.voxels(), volume: true, ..Needs::default() }
    }

    fn reads(&self, scan: &ScanHeader, _: u64) -> Vec<String> {
        let each = match self.0.shared().subsets.count(scan.views) {
            1 => String::new(),
            n => format!(" for each of the {n} subsets"),
        };
        vec![format!("a pass goes through the views once, and through the arrays of the volume once{each}")]
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let Shared { scene, subsets, .. } = self.0.shared();
        let mut lines = surround::found(scan, scene.surround)?;
        lines.extend(object(scan, &scene.support, None)?.found);
        let subsets = subsets.of(scan.geometry.views.len());
        lines.extend((subsets.len() > 1).then(|| summary(&subsets)));
        lines.extend(self.0.found(scan));
        Ok(Findings { lines, ..Findings::default() })
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        self.0.solve(job, observer)
    }

    fn needs_held_out(&self) -> Option<String> {
        self.0.shared().stop.patience.map(|_| "stop.patience".into())
    }

    fn passes(&self) -> Option<u64> {
        self.0.shared().stop.passes
    }

    fn seen(&self, scan: &ScanHeader) -> Option<ScanHeader> {
        Some(self.0.seen(scan))
    }

    fn work(&self, scan: &ScanHeader) -> f64 {
        let seen = self.0.seen(scan);
        seen.samples() + SAMPLES * seen.voxels() as f64
    }
}
