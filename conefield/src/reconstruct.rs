//! Reconstruction from Rust: a scan, the name of a spec, a volume.

use crate::method::Read;
use crate::session::{self, Request, Run};
use crate::specs;
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::method::{Limits, Observer, Reconstruction, Silent, Solution};
use conefield_core::scan::{Scan, Volume};
use conefield_core::trained::TrainedField;
use conefield_evaluation::metrics::Scores;
use std::sync::Arc;
use std::time::Instant;

/// A reconstruction on the CPU as in `conefield reconstruct`, in memory.
///
/// ```no_run
/// # fn main() -> conefield::Result<()> {
/// let scan = conefield::read_scan("scan")?;
/// let result = conefield::Reconstruct::with("smooth-tv").run(scan)?;
/// conefield::io::write_volume("volume.nii.gz", &result.volume)?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug, Clone, Default)]
pub struct Reconstruct {
    spec: Option<String>,
    sets: Vec<String>,
    limits: Limits,
    budget: Option<f64>,
    held_out: Vec<usize>,
    reference: Option<Volume>,
    seed: u64,
}

/// The result.
pub struct Reconstructed {
    /// The volume, in attenuation per unit of the scan.
    pub volume: Volume,
    /// The trained field, if the method has one.
    pub field: Option<TrainedField>,
    /// The name of the spec that ran.
    pub spec: String,
    /// Number of steps or passes.
    pub steps: u64,
    /// Time for them in seconds.
    pub train_s: f64,
    /// Scores against the reference, if there is one.
    pub scores: Option<Scores>,
}

impl Reconstruct {
    /// Uses a built-in spec, a method type, or a spec file.
    pub fn with(spec: &str) -> Self {
        Self { spec: Some(spec.to_owned()), ..Self::default() }
    }

    /// Uses the best method for this many seconds in total on this machine.
    pub fn within(seconds: f64) -> Self {
        Self { budget: Some(seconds), ..Self::default() }
    }

    /// Changes a setting, such as `encoder.levels=8`.
    pub fn set(mut self, setting: &str) -> Self {
        self.sets.push(setting.to_owned());
        self
    }

    /// Limits the number of steps or passes.
    pub fn steps(mut self, steps: u64) -> Self {
        self.limits.steps = Some(steps);
        self
    }

    /// Limits the solving time in seconds.
    pub fn seconds(mut self, seconds: f64) -> Self {
        self.limits.seconds = Some(seconds);
        self
    }

    /// Holds out these views and predicts them.
    pub fn hold_out(mut self, views: &[usize]) -> Self {
        self.held_out = views.to_vec();
        self
    }

    /// Sets the reference volume for scores.
    pub fn reference(mut self, volume: Volume) -> Self {
        self.reference = Some(volume);
        self
    }

    /// Sets the seed of all randomness (default 0).
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Runs the reconstruction.
    pub fn run(self, scan: impl Into<Arc<Scan>>) -> Result<Reconstructed> {
        self.watched(scan, &mut Silent)
    }

    /// Runs the reconstruction with an observer, which receives progress reports and can end the run.
    pub fn watched(self, scan: impl Into<Arc<Scan>>, observer: &mut dyn Observer) -> Result<Reconstructed> {
        let begin = Instant::now();
        let Self { spec, sets, limits, budget, held_out, reference, seed } = self;
        let (scan, backend) = (scan.into(), Cpu::new());
        scan.validate("scan")?;
        let read = spec.as_ref().map(|spec| |sets: &[String]| specs::read(spec, sets));
        let spec = read.as_ref().map(|read| read as Read<'_>);
        let request = Request { spec, sets, limits, budget, seed, ..Request::default() };
        let mut run = Run::in_memory(scan, held_out, reference, None, request, &backend, begin, &|| false)?;
        let solved = run.solve(None, None, observer)?;
        let (volume, written) = run.scored(&solved, &Reconstruction::volume)?;
        let Solution { result, steps, train_s, .. } = solved.solution;
        let spec = run.method.loaded.spec.name.clone();
        Ok(Reconstructed { volume, field: session::field(result), spec, steps, train_s, scores: written.scores })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_projectors::simulate::{PhantomKind, Protocol, phantom_of, simulate};

    #[test]
    fn a_scan_becomes_a_scored_volume() {
        let truth = phantom_of(PhantomKind::Head, 24);
        let scan = simulate(&truth, &Protocol::r2(&truth.grid).with_detector([24, 24]).with_views(16)).unwrap();
        let with = |spec: &str| Reconstruct::with(spec).reference(truth.clone());
        let result = with("cgls").steps(4).hold_out(&[3]).run(scan.clone()).unwrap();
        assert_eq!((&result.spec[..], result.steps, result.volume.data.shape()), ("cgls", 4, &[24; 3][..]));
        assert!(result.field.is_none() && result.scores.unwrap().psnr > 15.0);
        let result = with("fast").set("training.rays=64").steps(3).run(scan.clone()).unwrap();
        assert!(result.field.is_some());
        let said = |r: Reconstruct| r.run(scan.clone()).err().unwrap().to_string();
        assert!(said(Reconstruct::with("faste")).contains("fast"));
        assert!(said(Reconstruct::within(5.0).steps(3)).contains("a budget, or steps and seconds"));
        assert!(said(Reconstruct::with("fdk").hold_out(&[16])).contains("below 16"));
    }
}
