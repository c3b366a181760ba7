//! `conefield reconstruct` as a separate process, for comparisons, studies and searches.

use super::General;
use super::protocol::{RunProtocol, word};
use super::reconstruct::FAILED;
use crate::{program, signals};
use conefield::input;
use conefield::memory::Run;
use conefield::tradeoff::trial::TrialInput;
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};
use std::path::Path;
use std::process::{ExitStatus, Stdio};

/// One run.
pub struct Trial<'a> {
    pub scan: &'a Path,
    /// The spec, as on the command line.
    pub spec: &'a str,
    /// The run's folder.
    pub output: &'a Path,
    pub protocol: &'a RunProtocol,
    /// Further options.
    pub more: &'a [String],
}

impl Trial<'_> {
    /// Runs it. Returns the error of a failed run. `part` names the work in the message of an interruption.
    pub fn run(&self, part: String, general: &General) -> Result<Option<String>> {
        if signals::caught().is_some() {
            return Err(Error::Stopped { part });
        }
        let mut command = program::command()?;
        command.args(general.arguments()).args(["reconstruct", "--as-part"]).args(self.more);
        command.arg(word("--spec", self.spec)).arg(word("--output", self.output));
        command.args(self.protocol.arguments()).arg("--").arg(self.scan);
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

/// Reads scan and reference to check that they fit together, and keeps a summary.
pub fn input(path: &Path, protocol: &RunProtocol) -> Result<TrialInput> {
    input_of(path, protocol, |_| Ok(()))
}

/// The same, after `check` has inspected the scan.
pub fn input_of(path: &Path, protocol: &RunProtocol, check: impl FnOnce(&Scan) -> Result<()>) -> Result<TrialInput> {
    let all = Run {
        scan: conefield_io::scan_size(path)?,
        split: protocol.hold_out.is_some(),
        reference: protocol.reference.is_some(),
        resume: false,
    };
    all.reading().check()?;
    let (scan, reference) = input::read(path, protocol.reference.as_deref())?;
    check(&scan)?;
    let held = protocol.held_out(scan.geometry.views.len())?;
    let peak = protocol.peak(reference.as_ref());
    TrialInput::of(path, scan, reference.as_ref(), peak, held)
}

/// The signal that ended a process, from an exit status above 128 (as in shells) or from the system.
fn ended_by(status: ExitStatus) -> Option<u8> {
    #[cfg(unix)]
    let signal = std::os::unix::process::ExitStatusExt::signal(&status);
    #[cfg(not(unix))]
    let signal = None;
    signal.or(status.code().and_then(|c| c.checked_sub(128))).and_then(|s| u8::try_from(s).ok())
}
