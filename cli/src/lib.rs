//! The `conefield` command: arguments, progress, and the files it owns.

mod board;
mod boundary;
mod commands;
mod log;
mod out;
mod outgoing;
mod program;
mod progress;
mod run_folder;
mod segmenter;
mod signals;

use clap::Parser;
use conefield::{memory, plugins, ranks};
use conefield_core::{Error, Result, simd};
use std::ffi::OsString;
use std::process::ExitCode;
use std::time::Duration;

/// Reconstructs CT volumes from few cone-beam X-ray views, with classical methods and neural fields.
#[derive(Parser)]
#[command(name = "conefield", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: commands::Command,
    #[command(flatten)]
    general: commands::General,
}

/// Logs the error that ends the command. That of one process is mostly that of all: the leading one says it first, and
/// then the others are gone.
fn complain(e: &Error) {
    match ranks::rank() {
        0 => log::error(&e.to_string()),
        rank => {
            std::thread::sleep(Duration::from_secs(1));
            log::error(&format!("process {rank}: {e}"));
        }
    }
}

const SUCCESS: u8 = 0;
const FAILURE: u8 = 1;

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    ExitCode::from(run(std::env::args_os(), None))
}

/// Runs a command line, starting with the program's name. Returns the exit status: 0 success, 1 failure, 2 usage error,
/// 130 or 143 interrupted. `program` are the words that start the command in another process if the executable of this
/// one does not: an interpreter and its arguments.
pub fn run(args: impl IntoIterator<Item = OsString>, program: Option<Vec<OsString>>) -> u8 {
    let args: Vec<OsString> = args.into_iter().collect();
    program::note(program, args.iter().skip(1).cloned().collect());
    let cli = Cli::parse_from(args);
    let joined = match ranks::start() {
        Ok(joined) => joined,
        Err(e) => {
            log::error(&e.to_string());
            return FAILURE;
        }
    };
    let status = obey(cli);
    if status != SUCCESS {
        // The others may wait for what this process does not send.
        joined.into_iter().for_each(ranks::Joined::abandon);
    }
    status
}

/// Runs a command. Returns the exit status.
fn obey(cli: Cli) -> u8 {
    let general = cli.general;
    let quiet = general.quiet || ranks::rank() > 0;
    if !quiet {
        progress::show_bars();
    }
    log::start(general.verbose, quiet);
    let done = prepare(&cli.command, &general).and_then(|()| commands::run(cli.command, &general));
    let Err(e) = done else { return SUCCESS };
    complain(&e);
    match (&e, signals::caught()) {
        (
            Error::Interrupted { .. } | Error::Stopped { .. } | Error::Cancelled { .. } | Error::Aborted { .. },
            Some(signal),
        ) => 128 + signal,
        _ => FAILURE,
    }
}

/// Prepares this process for a command.
fn prepare(command: &commands::Command, general: &commands::General) -> Result<()> {
    signals::watch()?;
    memory::set_budget(general.memory);
    general.scratch.iter().for_each(|folder| memory::allow_scratch(folder));
    if let Some(n) = general.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n.into()).build_global();
        pool.map_err(|e| Error::unsupported(format!("{n} threads"), e.to_string()))?;
    }
    if let Some(found) = simd::other_level() {
        let used = simd::level_name();
        tracing::warn!(
            "CONEFIELD_SIMD: found {found:?}, expected avx512, avx2 or baseline, if this machine has it; {used} is used"
        );
    }
    // A plugin under check is loaded only in a separate process.
    if !matches!(command, commands::Command::Plugins(p) if p.is_check()) {
        plugins::search(&general.plugins, general.allow_plugins_from_spec);
    }
    if ranks::count() > 1 && !matches!(command, commands::Command::Reconstruct(_)) {
        let why = "several processes: they share the work of `conefield reconstruct` only";
        return Err(Error::unsupported("mpirun", why));
    }
    // `plugins` shows refused plugins itself.
    if matches!(command, commands::Command::Plugins(_)) { Ok(()) } else { plugins::settle() }
}
