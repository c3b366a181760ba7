//! Options of a reconstruction besides scan and spec, shared by all methods of a comparison.

use super::EndOptions;
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::input::{self, Input};
use conefield::memory;
use conefield::parse::{self, HoldOut};
use conefield::record::ScanRecord;
use conefield_core::Result;
use conefield_core::scan::{Scan, Volume};
use conefield_io::ScanSize;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The options that `reconstruct` and `compare` share.
#[derive(Debug, Clone, Args)]
pub struct RunProtocol {
    /// Time between two checkpoints, for --resume.
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = parse::seconds)]
    pub checkpoint_every: f64,
    /// Change a setting, such as encoder.levels=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    #[command(flatten)]
    pub ends: EndOptions,
    /// Time of the whole command, from start to last file, such as 60s or 10m.
    #[arg(long, value_name = "TIME", value_parser = parse::seconds, conflicts_with_all = ["steps", "seconds", "at_most"])]
    pub budget: Option<f64>,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP_OF_A_RUN)]
    pub backend: BackendChoice,
    /// The reference volume to score against: a file, or "truth" for the one in the scan.
    #[arg(long, value_name = "VOLUME")]
    pub reference: Option<PathBuf>,
    /// The data range for PSNR and SSIM [default: 1 for a reference in [0, 1] that exceeds 0.5, else its range].
    #[arg(long, value_parser = parse::above_zero)]
    pub peak: Option<f64>,
    /// Views to hold out and predict, such as 3,17 or every:10.
    #[arg(long, value_name = "VIEWS", value_parser = parse::hold_out)]
    pub hold_out: Option<HoldOut>,
    /// Seed of all random numbers.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
}

impl RunProtocol {
    /// The reference as it is named.
    pub fn named_reference(&self) -> Option<String> {
        self.reference.as_ref().map(|r| r.display().to_string())
    }

    /// The memory of a run besides its method.
    pub fn memory(&self, scan: ScanSize) -> memory::Run {
        memory::Run { split: self.hold_out.is_some(), reference: self.reference.is_some(), ..memory::Run::on(scan) }
    }

    /// The inputs of a run on the scan `whole` from `path`, and the record of that scan. Refuses held-out views that select
    /// none, or that leave none for training.
    pub fn input(&self, path: &Path, whole: Scan, reference: Option<Volume>) -> Result<(Input, ScanRecord)> {
        let n = whole.geometry.views.len();
        let held = input::held_out(self.hold_out.as_ref(), n, "command line", "--hold-out")?;
        let record = ScanRecord::of(path, &whole)?;
        Ok((Input::new(Arc::new(whole), held, reference, self.peak)?, record))
    }

    /// The same options for a child process. Flag and value form one argument, since a value may begin with a dash.
    pub fn arguments(&self) -> Vec<OsString> {
        let Self { checkpoint_every, sets, ends, budget, backend, reference, peak, hold_out, seed } = self;
        let all = [
            ("--checkpoint-every", Some(checkpoint_every.to_string())),
            ("--seconds", ends.seconds.map(|t| t.to_string())),
            ("--budget", budget.map(|t| t.to_string())),
            ("--steps", ends.steps.map(|n| n.to_string())),
            ("--at-most", ends.at_most.map(|t| t.to_string())),
            ("--backend", Some(backend.to_string())),
            ("--peak", peak.map(|p| p.to_string())),
            ("--hold-out", hold_out.as_ref().map(HoldOut::to_string)),
            ("--seed", Some(seed.to_string())),
        ];
        let all = all.into_iter().filter_map(|(flag, value)| Some(word(flag, value?)));
        let sets = sets.iter().map(|s| word("--set", s));
        all.chain(sets).chain(reference.iter().map(|r| word("--reference", r))).collect()
    }
}

/// `--flag=value`
pub fn word(flag: &str, value: impl AsRef<OsStr>) -> OsString {
    let mut word = OsString::from(flag);
    word.push("=");
    word.push(value);
    word
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        protocol: RunProtocol,
    }

    #[test]
    fn a_child_gets_the_same_options() {
        for ends in ["3,17 --seconds 1h --steps 7 --at-most 1e-9s", "every:10 --budget 2m"] {
            let line = format!(
                "x --checkpoint-every 0.1m --set a=b --set c=[1,2] --backend wgpu:2 --reference=-v.nii --peak 2.5 \
                 --hold-out {ends}"
            );
            let first = Line::try_parse_from(line.split(' ')).unwrap().protocol;
            let again = [OsString::from("x")].into_iter().chain(first.arguments());
            let second = Line::try_parse_from(again).unwrap().protocol;
            assert_eq!(format!("{first:?}"), format!("{second:?}"));
        }
    }
}
