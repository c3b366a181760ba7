//! `conefield reconstruct` as a separate process, for comparisons, studies and searches.

use super::General;
use super::protocol::{RunProtocol, word};
use super::reconstruct::{FAILED, conditions, identity};
use crate::run_folder::Recorded;
use crate::{program, signals};
use conefield::tradeoff::json::LONGEST;
use conefield::tradeoff::trial::TrialInput;
use conefield::{files, input, plugins, specs};
use conefield_core::scan::Scan;
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result};
use conefield_io::Lease;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};

/// What a changed reference is called in errors.
const REFERENCE: &str = "voxels of the reference";

/// One run.
pub struct Trial<'a> {
    pub scan: PathBuf,
    /// The spec, as on the command line.
    pub spec: &'a str,
    /// The file to start from.
    pub init: Option<&'a str>,
    /// The run's folder.
    pub output: PathBuf,
    pub protocol: RunProtocol,
}

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

/// Whether `folder` holds a finished run.
pub fn is_done(folder: &Path) -> bool {
    ["record.json", "volume.nii.gz"].iter().all(|f| folder.join(f).exists())
}

impl Trial<'_> {
    /// How the run starts; `loaded` is its spec.
    ///
    /// # Errors
    /// The folder holds a different run.
    pub fn start(&self, loaded: &Loaded, input: &TrialInput) -> Result<Start> {
        let Self { output, protocol, .. } = self;
        if !output.exists() {
            return Ok(Start::Anew);
        }
        let now = || identity(loaded, protocol, &input.held, &input.scan, &specs::checksums(loaded)?);
        if is_done(output) {
            let mut now = now()?;
            now.insert("reference".into(), Value::from(protocol.named_reference()).to_string());
            now.insert(REFERENCE.into(), Value::from(input.reference_fnv1a64.clone()).to_string());
            now.insert("peak".into(), input.peak.to_string());
            now.insert("backend".into(), protocol.backend.kind().into());
            files::same_run(&output.join("record.json").display().to_string(), &recorded(output)?, &now)?;
            return Ok(Start::Done);
        }
        let checkpoint = output.join("checkpoint.safetensors");
        if checkpoint.exists() {
            files::read_checkpoint(&checkpoint, &now()?)?;
            return Ok(Start::Resuming);
        }
        Ok(Start::Replacing)
    }

    /// Does the run unless it is finished. Returns the error of a failed run. `part` names the work in the message of an
    /// interruption.
    pub fn run(&self, start: Start, part: String, general: &General) -> Result<Option<String>> {
        let mode = match start {
            Start::Done => return Ok(None),
            Start::Resuming => Some("--resume"),
            Start::Replacing => Some("--force"),
            Start::Anew => None,
        };
        if signals::caught().is_some() {
            return Err(Error::Stopped { part });
        }
        let mut command = program::command()?;
        command.args(general.arguments()).args(["reconstruct", "--as-part"]).args(mode);
        command.args(self.init.map(|init| word("--init", init)));
        command.arg(word("--spec", self.spec)).arg(word("--output", &self.output));
        command.args(self.protocol.arguments()).arg("--").arg(&self.scan);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
        let mut child = child.map_err(|e| Error::io("conefield", e))?;
        let mut input = child.stdin.take();
        let said = program::read(child.stdout.take());
        // Ctrl-C reaches the child directly; a signal to this process alone reaches it through the end of its input.
        let status = program::wait(&mut child, "conefield", &mut || {
            if signals::caught().is_some() {
                input = None;
            }
            Ok(())
        })?;
        drop(input);
        let said = said.join().unwrap_or_default();
        if let Some(signal) = ended_by(status).filter(|_| !status.success()).filter(|s| [2, 15].contains(s)) {
            signals::note(signal);
        }
        if signals::caught().is_some() {
            return Err(Error::Stopped { part });
        }
        let line = said.lines().find_map(|l| l.strip_prefix(FAILED)).map(str::to_owned);
        Ok((!status.success()).then(|| line.unwrap_or_else(|| format!("the process ended with {status}"))))
    }
}

/// The [`identity`] of a finished run and its reference.
fn recorded(folder: &Path) -> Result<BTreeMap<String, String>> {
    let known = Recorded::read(folder)?;
    let backend = known.backend["backend"].as_str().unwrap_or_default();
    let mut all = BTreeMap::from([
        ("conefield".into(), known.version),
        ("seed".into(), known.seed.to_string()),
        ("spec".into(), conefield_core::files::read_text(&folder.join("spec.toml"), LONGEST)?),
        ("reference".into(), Value::from(known.reference).to_string()),
        (REFERENCE.into(), Value::from(known.reference_fnv1a64).to_string()),
        ("peak".into(), known.peak.to_string()),
        ("backend".into(), backend.split(',').next().unwrap_or_default().into()),
    ]);
    all.extend(conditions(&known.scan, &known.held_out_views, &known.limits, known.budget_s, &known.files)?);
    all.extend(plugins::identity(&known.plugins));
    Ok(all)
}

/// Begins the work in a folder: continues there, or moves aside what is there. From now on a signal ends it after its step.
pub fn begin(lease: &mut Lease, goes_on: bool) -> Result<()> {
    signals::listen();
    if goes_on {
        lease.go_on();
        return Ok(());
    }
    lease.replace()
}

/// Reads scan and reference to check that they fit together and that `check` accepts the scan, and keeps a summary.
pub fn input(path: &Path, protocol: &RunProtocol, check: &dyn Fn(&Scan) -> Result<()>) -> Result<TrialInput> {
    protocol.memory(conefield_io::scan_size(path)?).reading().check()?;
    // The run, which knows its spec, warns of what lies beyond the volume.
    let (scan, reference) = input::read(path, protocol.reference.as_deref(), true)?;
    check(&scan)?;
    protocol.input(path, scan, reference).map(|(input, record)| TrialInput::of(input, record))
}

/// The signal that ended a process, from an exit status above 128 (as in shells) or from the system.
fn ended_by(status: ExitStatus) -> Option<u8> {
    #[cfg(unix)]
    let signal = std::os::unix::process::ExitStatusExt::signal(&status);
    #[cfg(not(unix))]
    let signal = None;
    signal.or(status.code().and_then(|c| c.checked_sub(128))).and_then(|s| u8::try_from(s).ok())
}
