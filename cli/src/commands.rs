//! The subcommands.

mod backends;
mod calibrate;
mod compare;
mod completions;
mod convert;
mod corrections;
mod demo;
mod evaluate;
mod explain;
mod export;
mod features;
mod import;
mod info;
mod plugins;
mod pretrain;
mod project;
mod protocol;
mod reconstruct;
mod report;
mod schema;
mod selection;
mod simulate;
mod study;
mod summary;
mod tradeoff;
mod trained;
mod trial;
mod units;
mod watch;

use clap::{ArgAction, Args, Subcommand};
use conefield_core::Result;
use conefield_core::method::Limits;
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// The subcommands; their help is that of their arguments.
#[derive(Subcommand)]
pub enum Command {
    Simulate(simulate::SimulateArgs),
    Import(import::ImportArgs),
    Calibrate(calibrate::CalibrateArgs),
    Reconstruct(reconstruct::ReconstructArgs),
    Compare(compare::CompareArgs),
    Study(study::StudyArgs),
    Tradeoff(tradeoff::TradeoffArgs),
    Pretrain(pretrain::PretrainArgs),
    Evaluate(evaluate::EvaluateArgs),
    Export(export::ExportArgs),
    Project(project::ProjectArgs),
    Report(report::ReportArgs),
    Features(features::FeaturesArgs),
    Explain(explain::ExplainArgs),
    Info(info::InfoArgs),
    Convert(convert::ConvertArgs),
    Backends(backends::BackendsArgs),
    Plugins(plugins::PluginsArgs),
    Schema(schema::SchemaArgs),
    Completions(completions::CompletionsArgs),
    Demo(demo::DemoArgs),
}

/// Runs a subcommand.
pub fn run(command: Command, general: &General) -> Result<()> {
    match command {
        Command::Simulate(c) => c.run(),
        Command::Import(c) => c.run(general),
        Command::Calibrate(c) => c.run(),
        Command::Reconstruct(c) => c.run(),
        Command::Compare(c) => c.run(general),
        Command::Study(c) => c.run(general),
        Command::Tradeoff(c) => c.run(general),
        Command::Pretrain(c) => c.run(),
        Command::Evaluate(c) => c.run(),
        Command::Export(c) => c.run(),
        Command::Project(c) => c.run(),
        Command::Report(c) => c.run(),
        Command::Features(c) => c.run(),
        Command::Explain(c) => c.run(),
        Command::Info(c) => c.run(),
        Command::Convert(c) => c.run(),
        Command::Backends(c) => c.run(),
        Command::Plugins(c) => c.run(),
        Command::Schema(c) => c.run(),
        Command::Completions(c) => c.run(),
        Command::Demo(c) => c.run(),
    }
}

/// Options of every subcommand.
#[derive(Args)]
pub struct General {
    /// More log messages; twice for all of them.
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "General options")]
    pub verbose: u8,
    /// No progress, and only errors in the log.
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = "General options")]
    pub quiet: bool,
    /// Worker threads [default: one per core].
    #[arg(long, global = true, value_name = "N", help_heading = "General options", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
    /// Memory limit, such as 8GiB [default: available memory]. A command that needs more uses scratch files if it may, and
    /// else is refused.
    #[arg(long, global = true, value_name = "SIZE", help_heading = "General options", value_parser = conefield::parse::bytes)]
    pub memory: Option<u64>,
    /// Folder for scratch files, on a fast disk [default: "reconstruct" uses the folder in which RUN is, other commands
    /// use none].
    #[arg(long, global = true, value_name = "FOLDER", help_heading = "General options")]
    pub scratch: Option<PathBuf>,
    /// Load this plugin, or every plugin in this folder; repeatable.
    #[arg(long = "plugin", global = true, value_name = "PATH", help_heading = "General options")]
    pub plugins: Vec<PathBuf>,
    /// Let specs load the plugins that they name. A plugin is code: allow this only for specs that you trust.
    #[arg(long, global = true, help_heading = "General options")]
    pub allow_plugins_from_spec: bool,
}

impl General {
    /// The same options for a child process.
    pub fn arguments(&self) -> Vec<OsString> {
        let mut all: Vec<OsString> = vec!["--verbose".into(); self.verbose.into()];
        if self.quiet {
            all.push("--quiet".into());
        }
        // A script may run in another folder.
        let whole = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.into()).into_os_string();
        for path in &self.plugins {
            all.push("--plugin".into());
            all.push(whole(path));
        }
        if self.allow_plugins_from_spec {
            all.push("--allow-plugins-from-spec".into());
        }
        if let Some(folder) = &self.scratch {
            all.push("--scratch".into());
            all.push(whole(folder));
        }
        let numbers = [("--threads", self.threads.map(u64::from)), ("--memory", self.memory)];
        for (flag, number) in numbers {
            all.extend(number.map(|n| format!("{flag}={n}").into()));
        }
        all
    }
}

/// Limits of training; the first one reached ends it.
#[derive(Debug, Clone, Default, Args, Serialize, Deserialize)]
pub struct EndOptions {
    /// Stop training after this time, such as 600s or 10m, without the time before and after training. In a chain, that of
    /// its first method.
    #[arg(long, value_name = "TIME", value_parser = conefield::parse::seconds)]
    pub seconds: Option<f64>,
    /// Stop training after this many steps.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Stop training after this time at the latest. Unlike --seconds, it neither replaces the spec's own limits nor
    /// stretches a learning-rate schedule.
    #[arg(long, value_name = "TIME", value_parser = conefield::parse::seconds)]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_most: Option<f64>,
}

impl EndOptions {
    /// The limits of a job.
    pub fn limits(&self) -> Limits {
        Limits { steps: self.steps, seconds: self.seconds, at_most: self.at_most, ..Limits::default() }
    }
}
