//! Inputs of a run: the scan, held-out views, the reference volume.

use crate::parse::HoldOut;
use crate::tradeoff::schedule::Schedule;
use crate::{files, score};
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::method::{Job, Limits};
use conefield_core::scan::{Scan, Volume};
use conefield_core::words::counted;
use conefield_core::{Error, Result, checksum};
use conefield_io::{DataSet, Parts};
use conefield_scans::diagnosis::survey;
use std::path::Path;
use std::sync::Arc;

/// Inputs of a run.
pub struct Input {
    /// The training views.
    pub scan: Arc<Scan>,
    /// The held-out views.
    pub aside: Option<Scan>,
    /// Indices of the held-out views.
    pub held: Vec<usize>,
    /// The reference volume, if known.
    pub reference: Option<Volume>,
    /// Checksum of the voxels of the reference.
    pub reference_fnv1a64: Option<String>,
    /// The data range of scores.
    pub peak: f64,
}

impl Input {
    /// Splits `whole` into training views and the held-out views `held`. The default of `peak` comes from the
    /// reference.
    pub fn new(whole: Arc<Scan>, held: Vec<usize>, reference: Option<Volume>, peak: Option<f64>) -> Result<Self> {
        if reference.is_none() && peak.is_some() {
            tracing::warn!("peak: it has no effect without a reference");
        }
        let peak = reference.as_ref().map_or(peak.unwrap_or(1.0), |r| score::peak(peak, r));
        let (scan, aside) = if held.is_empty() {
            (whole, None)
        } else {
            let (scan, aside) = whole.split(&held)?;
            (Arc::new(scan), Some(aside))
        };
        let reference_fnv1a64 = reference.as_ref().map(|r| checksum::of_numbers(&r.data));
        Ok(Self { scan, aside, held, reference, reference_fnv1a64, peak })
    }

    /// The job of a method, with the limits of `schedule` in addition to `limits`.
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
            limits: Limits { deadline, then, steps: limits.steps.or(schedule.and_then(|s| s.passes)), ..limits },
            volumes: &files::volume,
            ..Job::new(&self.scan, backend)
        }
    }
}

/// The scan at `path` and the reference volume, if one is asked for: a file, or the scan's own volume for "truth". Logs
/// warnings about problems for a reconstruction; if `surrounded`, none of an object beyond the volume. Refuses a reference
/// with another shape than the scan's volume.
pub fn read(path: &Path, reference: Option<&Path>, surrounded: bool) -> Result<(Scan, Option<Volume>)> {
    let own = reference.is_some_and(is_truth);
    let DataSet { train: scan, volume, .. } =
        conefield_scans::read_data_set(path, Parts { tests: false, volume: own })?;
    // A volume that came unasked is not held beside the reference.
    let volume = volume.filter(|_| own);
    files::warn_of(path, &survey(&scan), surrounded);
    let volume = match reference {
        None => None,
        Some(_) if own => Some(volume.ok_or_else(|| no_truth(path))?),
        Some(file) => Some(conefield_io::read_volume(file)?),
    };
    if let (Some(volume), Some(file)) = (&volume, reference) {
        check_reference(&file.display().to_string(), volume, &scan)?;
    }
    Ok((scan, volume))
}

/// The reference volume of a `scan` that was read from `scan_path`: the file `path`, or for "truth" the scan's volume.
pub fn reference(path: &Path, scan_path: &Path, scan: &Scan) -> Result<Volume> {
    let volume = if is_truth(path) {
        conefield_io::read_truth(scan_path)?.ok_or_else(|| no_truth(scan_path))?
    } else {
        conefield_io::read_volume(path)?
    };
    check_reference(&path.display().to_string(), &volume, scan)?;
    Ok(volume)
}

/// Whether `path` asks for the scan's own volume, also where there is a file of this name: `./truth` is that file.
pub fn is_truth(path: &Path) -> bool {
    path == Path::new("truth")
}

fn no_truth(scan: &Path) -> Error {
    Error::invalid(scan.display().to_string(), "--reference truth", "a scan without a truth", "a volume file")
}

/// Refuses a reference whose shape differs from the scan's volume; errors name `place`.
pub fn check_reference(place: &str, volume: &Volume, scan: &Scan) -> Result<()> {
    let want = scan.geometry.volume.shape;
    let expected = format!("{want:?}, the shape of the scan's volume");
    ensure(volume.data.shape() == want, place, "shape", format!("{:?}", volume.data.shape()), expected)
}

/// Indices of the held-out views out of `n`. Refuses an empty choice; errors name `place` and `field`.
pub fn held_out(choice: Option<&HoldOut>, n: usize, place: &str, field: &str) -> Result<Vec<usize>> {
    let Some(choice) = choice else { return Ok(vec![]) };
    let held = choice.views(n);
    let found = format!("{choice}, which selects none of {}", counted(n, "view"));
    ensure(!held.is_empty(), place, field, found, "at least one view")?;
    Ok(held)
}

/// The views that `--views` chooses out of `n`; none without a choice.
pub fn chosen(choice: Option<&HoldOut>, n: usize) -> Result<Vec<usize>> {
    let views = held_out(choice, n, "command line", "--views")?;
    match views.iter().find(|view| **view >= n) {
        Some(view) => Err(Error::invalid("command line", "--views", view, format!("numbers below {n}"))),
        None => Ok(views),
    }
}
