//! What a run reads: the scan, views of it that are kept aside, the volume to compare with.

use crate::parse::HoldOut;
use crate::{files, score};
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::method::{Job, Limits};
use conefield_core::scan::{Scan, Volume};
use conefield_core::{Error, Result};
use conefield_tradeoff::calibrate::Bench;
use conefield_tradeoff::schedule::Schedule;
use std::path::Path;
use std::sync::Arc;

/// What a run works on.
pub struct Input {
    /// The views to learn from.
    pub scan: Arc<Scan>,
    /// Those that are kept aside.
    pub aside: Option<Scan>,
    /// Their numbers.
    pub held: Vec<usize>,
    /// The volume sought, if it is known.
    pub reference: Option<Volume>,
    /// The data range of scores.
    pub peak: f64,
}

impl Input {
    /// Of `whole`, whose views `held` are kept aside. `peak`, where none is given, is what the reference says.
    pub fn new(whole: Arc<Scan>, held: Vec<usize>, reference: Option<Volume>, peak: Option<f64>) -> Result<Self> {
        let peak = reference.as_ref().map_or(peak.unwrap_or(1.0), |r| score::peak(peak, r));
        let (scan, aside) = if held.is_empty() {
            (whole, None)
        } else {
            let (scan, aside) = whole.split(&held)?;
            (Arc::new(scan), Some(aside))
        };
        Ok(Self { scan, aside, held, reference, peak })
    }

    /// What a budget is measured on.
    pub fn bench<'a>(&'a self, backend: &'a dyn Backend, seed: u64, cancelled: &'a dyn Fn() -> bool) -> Bench<'a> {
        let reference = self.reference.as_ref();
        Bench { scan: &self.scan, reference, peak: self.peak, backend, seed, volumes: &files::volume, cancelled }
    }

    /// What a method is given, with the ends of `schedule` beside `limits`.
    pub fn job<'a>(
        &'a self,
        backend: &'a dyn Backend,
        seed: u64,
        limits: Limits,
        schedule: Option<&Schedule>,
    ) -> Job<'a> {
        let (deadline, then) = (schedule.map(|s| s.deadline), schedule.and_then(|s| s.then));
        Job {
            held_out: self.aside.as_ref(),
            reference: self.reference.as_ref(),
            peak: self.peak,
            seed,
            limits: Limits { deadline, then, ..limits },
            volumes: &files::volume,
            ..Job::new(&self.scan, backend)
        }
    }
}

/// The volume to compare with, as large as `scan` asks for: the file `path`, or "truth" for the one that the scan at
/// `scan_path` comes with.
pub fn reference(path: &Path, scan_path: &Path, scan: &Scan) -> Result<Volume> {
    let volume = if path == Path::new("truth") && !path.exists() {
        let place = scan_path.display().to_string();
        conefield_io::read_truth(scan_path)?
            .ok_or_else(|| Error::invalid(place, "--reference truth", "a scan without a truth", "a volume file"))?
    } else {
        conefield_io::read_volume(path)?
    };
    check_reference(&path.display().to_string(), &volume, scan)?;
    Ok(volume)
}

/// Refuses a reference, called `place` in errors, that is not as large as `scan` asks for.
pub fn check_reference(place: &str, volume: &Volume, scan: &Scan) -> Result<()> {
    let want = scan.geometry.volume.shape;
    let expected = format!("{want:?}, the voxels that this scan asks for");
    ensure(volume.data.shape() == want, place, "shape", format!("{:?}", volume.data.shape()), expected)
}

/// Indices of the held-out views, of `n`. Refuses a choice that keeps none aside; `place` and `field` say where
/// it stands.
pub fn held_out(choice: Option<&HoldOut>, n: usize, place: &str, field: &str) -> Result<Vec<usize>> {
    let Some(choice) = choice else { return Ok(vec![]) };
    let held = choice.views(n);
    let found = format!("{choice}, which is none of {n} views");
    ensure(!held.is_empty(), place, field, found, "at least one view")?;
    Ok(held)
}
