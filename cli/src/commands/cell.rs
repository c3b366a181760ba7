//! A run as part of a comparison or a study: how it starts, and its process.

use super::protocol::RunProtocol;
use super::reconstruct::{conditions, identity, identity_to_resume};
use super::trial::Trial;
use super::{EndOptions, General};
use conefield::files;
use conefield::plugins::{self, Used};
use conefield::record::ScanRecord;
use conefield::study::method::Method;
use conefield::tradeoff::json::{LONGEST, read_json};
use conefield::tradeoff::trial::TrialInput;
use conefield_core::Result;
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How a run starts, given the content of its folder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// The folder is empty.
    Anew,
    /// An earlier run ended without a checkpoint.
    Replacing,
    /// There is a checkpoint.
    Resuming,
    /// The run is finished.
    Done,
}

/// A method on a scan.
pub struct Cell<'a> {
    pub method: &'a Method,
    pub scan: PathBuf,
    /// The run's folder.
    pub run: PathBuf,
    pub protocol: RunProtocol,
}

/// Whether `folder` holds a finished run.
pub fn is_done(folder: &Path) -> bool {
    ["record.json", "volume.nii.gz"].iter().all(|f| folder.join(f).exists())
}

impl Cell<'_> {
    /// How the run starts.
    ///
    /// # Errors
    /// The folder holds a different run.
    pub fn start(&self, input: &TrialInput) -> Result<Start> {
        let Self { method, run, protocol, .. } = self;
        if !run.exists() {
            return Ok(Start::Anew);
        }
        let (loaded, held, scan) = (&method.loaded, &input.held, &input.scan);
        if is_done(run) {
            let mut now = identity(loaded, protocol, held, scan)?;
            now.insert("reference".into(), Value::from(protocol.named_reference()).to_string());
            now.insert("peak".into(), input.peak.to_string());
            now.insert("backend".into(), protocol.backend.kind().into());
            files::same_run(&run.join("record.json").display().to_string(), &recorded(run)?, &now)?;
            return Ok(Start::Done);
        }
        let checkpoint = run.join("checkpoint.safetensors");
        if checkpoint.exists() {
            files::read_checkpoint(&checkpoint, &identity_to_resume(loaded, protocol, held, scan)?)?;
            return Ok(Start::Resuming);
        }
        Ok(Start::Replacing)
    }

    /// Runs unless the run is finished. Returns the error of a failed run. `part` names the work in the message of an
    /// interruption.
    pub fn carry_out(&self, start: Start, part: String, general: &General) -> Result<Option<String>> {
        let mut more: Vec<String> = match start {
            Start::Done => return Ok(None),
            Start::Resuming => vec!["--resume".into()],
            Start::Replacing => vec!["--force".into()],
            Start::Anew => vec![],
        };
        more.extend(self.method.init.as_ref().map(|i| format!("--init={i}")));
        let Self { method, scan, run, protocol } = self;
        Trial { scan, spec: &method.spec, output: run, protocol, more: &more }.run(part, general)
    }
}

/// The [`identity`] of a finished run and its reference.
fn recorded(folder: &Path) -> Result<BTreeMap<String, String>> {
    #[derive(Deserialize)]
    struct Known {
        version: String,
        seed: u64,
        scan: ScanRecord,
        held_out_views: Vec<usize>,
        limits: EndOptions,
        #[serde(default)]
        budget_s: Option<f64>,
        reference: Value,
        peak: f64,
        backend: KnownBackend,
        #[serde(default)]
        plugins: Vec<Used>,
    }
    #[derive(Deserialize)]
    struct KnownBackend {
        backend: String,
    }
    let known: Known = read_json(&folder.join("record.json"))?;
    let mut all = BTreeMap::from([
        ("conefield".into(), known.version),
        ("seed".into(), known.seed.to_string()),
        ("spec".into(), conefield_core::files::read_text(&folder.join("spec.toml"), LONGEST)?),
        ("reference".into(), known.reference.to_string()),
        ("peak".into(), known.peak.to_string()),
        ("backend".into(), known.backend.backend.split(',').next().unwrap_or_default().into()),
    ]);
    all.extend(conditions(&known.scan, &known.held_out_views, &known.limits, known.budget_s)?);
    all.extend(plugins::identity(&known.plugins));
    Ok(all)
}
