//! Common part of the plans of iterative methods.

use super::mask_bytes;
use super::order::{Subsets, summary};
use super::shared::Shared;
use crate::fit::object;
use crate::{solid, surround};
use conefield_core::error::Result;
use conefield_core::method::{Findings, Job, Line, Needs, Observer, Outline, Plan, Solution};
use conefield_core::scan::{Scan, ScanHeader};

/// An iterative method, built and validated.
pub(super) trait Iterative: Send + Sync {
    /// Its type name.
    fn kind(&self) -> &'static str;

    /// Its common settings.
    fn shared(&self) -> &Shared;

    /// Its own stages: key, type and description.
    fn stages(&self) -> Vec<Line> {
        vec![]
    }

    /// Its subsets of views.
    fn subsets(&self) -> Subsets {
        Subsets::Count(1)
    }

    /// Its findings about a scan besides the subsets, one line each.
    fn found(&self, scan: &Scan) -> Vec<String> {
        let _ = scan;
        vec![]
    }

    /// The header of the scan as the method uses it: binned detector, unknowns in place of voxels.
    fn seen(&self, scan: &ScanHeader) -> ScanHeader {
        *scan
    }

    /// Bytes of all its arrays except the resulting volume.
    fn bytes(&self, scan: &ScanHeader) -> u64;

    /// Description of its settings.
    fn describe(&self) -> String;

    /// Runs the method.
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution>;
}

/// Cost per unknown of the rest of a pass, in ray samples of forward and back-projection. On 50 views of 512² pixels
/// and 256³ voxels, ten subsets with total variation spend equal time on both.
const SAMPLES: f64 = 200.0;

/// The plan of an iterative method.
pub(super) struct IterativePlan<T>(pub(super) T);

impl<T: Iterative> Plan for IterativePlan<T> {
    fn outline(&self) -> Outline {
        let shared = self.0.shared();
        let projector = Line::new("projector", shared.projector_kind, &shared.projector.describe());
        let beside = [vec![projector], self.0.stages()].concat();
        Outline { method: Line::new("method", self.0.kind(), &self.0.describe()), beside, ..Outline::default() }
    }

    fn needs(&self, scan: &ScanHeader) -> Needs {
        let shared = self.0.shared();
        let working = self.0.bytes(scan) + mask_bytes(&shared.scene.support, &self.0.seen(scan));
        let [surround, corrected] = surround::bytes(shared.scene.surround, scan);
        let corrected = corrected + solid::bytes(&shared.scene.support, scan);
        Needs { surround, corrected, working, resume: working + 4 * scan.voxels(), volume: true, ..Needs::default() }
    }

    fn reads(&self, scan: &ScanHeader, _: u64) -> Vec<String> {
        let each = match self.0.subsets().count(scan.views) {
            1 => String::new(),
            n => format!(" for each of the {n} subsets"),
        };
        vec![format!("a pass goes through the views once, and through the arrays of the volume once{each}")]
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let scene = &self.0.shared().scene;
        let mut lines = surround::found(scan, scene.surround)?;
        lines.extend(object(scan, &scene.support, None)?.found);
        let subsets = self.0.subsets().of(scan.geometry.views.len());
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
