//! The log on standard error. Messages may contain text from files, so each is one line of limited length without
//! control characters. A closed log does not stop the work.

use crate::out::{LONGEST_LINE, plain_line};
use crate::progress;
use std::fmt::Debug;
use std::io::{self, IsTerminal, Write};
use tracing::field::Field;
use tracing::level_filters::LevelFilter;
use tracing::warn;
use tracing_subscriber::field::MakeExt as _;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::fmt;
use tracing_subscriber::fmt::format::{self, Writer};
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::util::SubscriberInitExt as _;

/// The environment variable for the log level without --verbose and --quiet.
const VARIABLE: &str = "RUST_LOG";

/// Starts the log: warnings and information by default, more with `verbose`, errors only if `quiet`, otherwise as set
/// in `RUST_LOG`.
pub fn start(verbose: u8, quiet: bool) {
    let level = match (quiet, verbose) {
        (true, _) => LevelFilter::ERROR,
        (_, 0) => LevelFilter::INFO,
        (_, 1) => LevelFilter::DEBUG,
        _ => LevelFilter::TRACE,
    };
    let asked = std::env::var(VARIABLE).ok().filter(|a| !a.is_empty() && !quiet && verbose == 0);
    let filter = asked.as_deref().map(str::parse::<Targets>);
    let written = fmt::layer()
        .fmt_fields(format::debug_fn(field).delimited(", "))
        .with_writer(|| Stderr)
        .log_internal_errors(false)
        .with_ansi(io::stderr().is_terminal())
        .with_target(false);
    let kept = match &filter {
        Some(Ok(targets)) => targets.clone(),
        // These crates write hundreds of lines about one start of a GPU.
        _ => Targets::new()
            .with_default(level)
            .with_targets(["wgpu_core", "wgpu_hal", "naga"].map(|name| (name, level.min(LevelFilter::WARN)))),
    };
    let _ = tracing_subscriber::registry().with(written.with_filter(kept)).try_init();
    if let Some(Err(e)) = filter {
        warn!("{VARIABLE}: {e}; it is ignored");
    }
}

/// Formats one field of an event; the message has no name.
fn field(writer: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> std::fmt::Result {
    let text = plain_line(&format!("{value:?}"), LONGEST_LINE);
    if field.name() == "message" { write!(writer, "{text}") } else { write!(writer, "{}={text}", field.name()) }
}

/// Logs the error that ends the command.
pub fn error(text: &str) {
    let _ = writeln!(Stderr, "error: {}", plain_line(text, LONGEST_LINE));
}

/// Standard error, written between redraws of bars. Failed writes (closed, full) do not stop the work.
struct Stderr;

impl Write for Stderr {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        progress::between_bars(|| {
            let _ = io::stderr().write_all(text);
        });
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let _ = io::stderr().flush();
        Ok(())
    }
}
