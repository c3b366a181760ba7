//! The `conefield` command, one module a subcommand, and the specs that come with it.

mod commands;
mod files;
mod memory;
mod out;
mod outgoing;
mod parse;
mod progress;
mod run;
mod signals;
pub mod specs;

// Stage types register themselves when their crate is linked.
use {
    conefield_encoders as _, conefield_fields as _, conefield_initializers as _, conefield_normalizers as _,
    conefield_projectors as _, conefield_solvers as _,
};

use clap::{ArgAction, Parser};
use conefield_core::Error;
use std::process::ExitCode;

/// Reconstructs CT volumes from few cone-beam X-ray views with neural attenuation fields.
#[derive(Parser)]
#[command(name = "conefield", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
    /// More log messages; twice for all.
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "General options")]
    verbose: u8,
    /// No progress, and of the log errors only.
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = "General options")]
    quiet: bool,
    /// Worker threads [default: one a core].
    #[arg(long, global = true, value_name = "N", help_heading = "General options", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Memory that a command may take, such as 8GiB [default: what is available]. One that needs more is refused.
    #[arg(long, global = true, value_name = "SIZE", help_heading = "General options", value_parser = parse::bytes)]
    memory: Option<u64>,
}

/// Runs the command line. Exit status: 0 done, 1 failed, 2 wrong use, 130 or 143 interrupted.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    progress::start_log(cli.verbose, cli.quiet);
    if let Some(bytes) = cli.memory {
        memory::set_budget(bytes);
    }
    if let Some(n) = cli.threads
        && let Err(e) = rayon::ThreadPoolBuilder::new().num_threads(n.into()).build_global()
    {
        eprintln!("error: {n} threads: {e}");
        return ExitCode::FAILURE;
    }
    match commands::run(cli.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("error: {e}");
            match (&e, signals::caught()) {
                (Error::Interrupted { .. } | Error::Cancelled { .. }, Some(signal)) => ExitCode::from(128 + signal),
                _ => ExitCode::FAILURE,
            }
        }
    }
}
