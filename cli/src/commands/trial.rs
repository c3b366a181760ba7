//! `conefield reconstruct` as a process of its own: what comparisons and searches are made of.

use super::General;
use super::protocol::{RunProtocol, word};
use super::reconstruct::{FAILED, split};
use super::record::ScanRecord;
use crate::memory::Run;
use crate::{files, signals};
use conefield_core::{Error, Result};
use conefield_report::MiddleSlices;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::io::Read;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

/// Longest record, table or spec that is read back, in bytes.
pub const LONGEST: u64 = 16 << 20;
/// Between two looks at a run's process.
const LOOK: Duration = Duration::from_millis(20);

/// One run.
pub struct Trial<'a> {
    pub scan: &'a Path,
    /// As it would be asked for.
    pub spec: &'a str,
    /// The run's folder.
    pub output: &'a Path,
    pub protocol: &'a RunProtocol,
    /// Further options.
    pub more: &'a [&'a str],
}

/// What is known of the input once all of it was looked at.
pub struct TrialInput {
    pub scan: ScanRecord,
    pub held: Vec<usize>,
    pub reference: Option<MiddleSlices>,
}

/// What a table takes from a run's `record.json`, under the names that it has there.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Figures {
    pub steps: u64,
    pub train_s: f64,
    pub export_s: f64,
    pub total_s: f64,
    pub peak_bytes: Option<u64>,
    pub threads: usize,
    pub parameters: usize,
    pub samples: u64,
    pub samples_per_s: Option<f64>,
    pub loss: Option<f64>,
    pub held_out: Option<f64>,
    /// Kept as it stands, with the reasons for what is missing.
    pub scores: Option<Value>,
}

impl Trial<'_> {
    /// Runs it; what went wrong with it, if anything did. `part` is what an interruption is told to have interrupted.
    pub fn run(&self, part: String, general: &General) -> Result<Option<String>> {
        if signals::caught().is_some() {
            return Err(Error::Stopped { part });
        }
        let program = std::env::current_exe().map_err(|e| Error::io("conefield", e))?;
        let io = |e| Error::io(&program, e);
        let mut command = Command::new(&program);
        command.args(general.arguments()).args(["reconstruct", "--as-part"]).args(self.more);
        command.arg(word("--spec", self.spec)).arg(word("--output", self.output));
        command.args(self.protocol.arguments()).arg("--").arg(self.scan);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(io)?;
        let mut input = child.stdin.take();
        let output = child.stdout.take();
        let said = std::thread::spawn(move || {
            let mut said = vec![];
            let _ = output.map(|mut o| o.read_to_end(&mut said));
            String::from_utf8_lossy(&said).into_owned()
        });
        let status = loop {
            if let Some(status) = child.try_wait().map_err(io)? {
                break status;
            }
            // Ctrl-C reaches the child by itself; a signal to this process alone reaches it by the end of its input.
            if signals::caught().is_some() {
                input = None;
            }
            std::thread::sleep(LOOK);
        };
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

impl TrialInput {
    /// Reads scan and reference, to refuse what does not fit; of both only little is kept.
    pub fn read(path: &Path, protocol: &RunProtocol) -> Result<Self> {
        let all = Run {
            scan: conefield_io::scan_size(path)?,
            split: protocol.hold_out.is_some(),
            reference: protocol.reference.is_some(),
            resume: false,
        };
        all.reading().check(|_| vec![])?;
        let scan = files::scan(path)?;
        let reference = protocol.reference(path, &scan)?;
        let record = ScanRecord::of(path, &scan)?;
        let held = protocol.held_out(scan.geometry.views.len())?;
        if !held.is_empty() {
            split(scan, &held)?;
        }
        Ok(Self { scan: record, held, reference: reference.as_ref().map(MiddleSlices::of) })
    }
}

impl Figures {
    /// Of the finished run in `folder`.
    pub fn of_run(folder: &Path) -> Result<Self> {
        read_json(&folder.join("record.json"))
    }

    /// dB; infinite, which JSON has no number for, where the result is the reference.
    pub fn psnr(&self) -> Option<f64> {
        self.scores.as_ref().map(|s| s["psnr"].as_f64().unwrap_or(f64::INFINITY))
    }

    /// One of the scores, where it is defined.
    pub fn score(&self, name: &str) -> Option<f64> {
        self.scores.as_ref().and_then(|s| s[name].as_f64())
    }
}

/// Reads what this program wrote.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let text = conefield_core::files::read_text(path, LONGEST)?;
    let expected = "what conefield writes there; --force starts anew";
    serde_json::from_str(&text).map_err(|e| Error::invalid(path.display().to_string(), "JSON", e, expected))
}

/// What ended a process: its exit status above 128, as shells have it, or the signal itself.
fn ended_by(status: ExitStatus) -> Option<u8> {
    #[cfg(unix)]
    let signal = std::os::unix::process::ExitStatusExt::signal(&status);
    #[cfg(not(unix))]
    let signal = None;
    signal.or(status.code().and_then(|c| c.checked_sub(128))).and_then(|s| u8::try_from(s).ok())
}
