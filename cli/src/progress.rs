//! Progress on standard error: bars on a terminal, otherwise log lines.

use crate::board::Board;
use crate::out::duration;
use crate::signals;
use conefield::files;
use conefield::record::History;
use conefield_core::Result;
use conefield_core::checkpoint::Checkpoint;
use conefield_core::geometry::VoxelGrid;
use conefield_core::method::{Observer, Record};
use conefield_core::parts::Part;
use conefield_evaluation::report::MiddleSlices;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use ndarray::Array3;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;
use std::sync::LazyLock;
use std::time::{Duration, Instant};
use tracing::{debug, info, warn};

/// The bars on the terminal; the log is written between redraws.
static BARS: LazyLock<MultiProgress> = LazyLock::new(|| MultiProgress::with_draw_target(ProgressDrawTarget::hidden()));

/// Interval of progress reports without a terminal.
const EVERY: Duration = Duration::from_secs(5);

/// Enables bars if standard error is a terminal.
pub fn show_bars() {
    if io::stderr().is_terminal() {
        BARS.set_draw_target(ProgressDrawTarget::stderr());
    }
}

/// Calls `f` while no bar is drawn.
pub fn between_bars(f: impl FnOnce()) {
    BARS.suspend(f);
}

/// Shows a solver's progress and writes its records.
pub struct Progress {
    bar: ProgressBar,
    begun: Instant,
    shown: Instant,
    what: String,
    step: u64,
    /// The last record.
    pub latest: Option<Record>,
    log: Option<(PathBuf, File)>,
    /// The checkpoint.
    pub keeper: Option<Renewed>,
    /// What identifies the run in its checkpoint.
    pub run: BTreeMap<String, String>,
    /// What its checkpoint keeps for the record.
    pub history: History,
    /// The middle slices during the run.
    pub live: Option<Renewed>,
    /// The file for TensorBoard.
    pub board: Option<Board>,
}

/// A file that is written anew at an interval.
pub struct Renewed {
    path: PathBuf,
    every: Duration,
    last: Instant,
}

impl Renewed {
    /// Writes `path` every `seconds` seconds.
    pub fn new(path: PathBuf, seconds: f64) -> Self {
        Self { path, every: Duration::from_secs_f64(seconds), last: Instant::now() }
    }

    fn due(&self) -> bool {
        self.last.elapsed() >= self.every
    }
}

impl Progress {
    /// Progress of `what`. Records are written to `log` (JSON, one per line) as they arrive.
    pub fn new(what: &str, log: Option<(PathBuf, File)>) -> Self {
        let bar = BARS.add(ProgressBar::new(1000));
        if let Ok(style) = ProgressStyle::with_template("{prefix} [{bar:12}] {percent:>3} %  {wide_msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_prefix(what.to_owned());
        Self {
            bar,
            begun: Instant::now(),
            shown: Instant::now(),
            what: what.into(),
            step: 0,
            latest: None,
            log,
            keeper: None,
            run: BTreeMap::new(),
            history: History::default(),
            live: None,
            board: None,
        }
    }

    /// Calls `f` with the file for TensorBoard. After a failure the run continues without it.
    fn on_board(&mut self, f: impl FnOnce(&mut Board) -> Result<()>) {
        if let Some(board) = &mut self.board
            && let Err(e) = f(board)
        {
            warn!("{e}; nothing more is written for TensorBoard");
            self.board = None;
        }
    }

    /// Shows that `share` of work without steps is done, with the time left.
    pub fn reach(&mut self, share: f64) {
        let left = self.begun.elapsed().as_secs_f64() * (1.0 - share) / share.max(1e-6);
        self.show(share, &|_| format!("{} left", duration(left)));
    }

    /// Shows that `share` of the work is done, with an explanatory line, unless the last update is recent.
    fn show(&mut self, share: f64, line: &dyn Fn(&Self) -> String) {
        let wait = if self.bar.is_hidden() { EVERY } else { Duration::from_millis(100) };
        if self.shown.elapsed() < wait {
            return;
        }
        self.shown = Instant::now();
        let line = line(self);
        if self.bar.is_hidden() {
            info!("{} {:.0} %: {line}", self.what, 100.0 * share);
        } else {
            self.bar.set_position((1000.0 * share.clamp(0.0, 1.0)) as u64);
            self.bar.set_message(line);
        }
    }

    /// The current state in one line.
    fn line(&self, step: u64, seconds_left: f64) -> String {
        let r = self.latest.clone().unwrap_or_default();
        // A narrow terminal cuts the end off.
        let parts = [
            Some(format!("step {step}")),
            seconds_left.is_finite().then(|| format!("{} left", duration(seconds_left))),
            r.psnr.map(|p| format!("{p:.2} dB")),
            r.held_out.map(|h| format!("held out {h:.4}")),
            r.loss.map(|loss| format!("loss {loss:.3e}")),
            r.samples_per_s.map(|speed| format!("{:.2} M samples/s", speed / 1e6)),
        ];
        parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
    }
}

impl Observer for Progress {
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64) {
        self.step = step;
        self.show(share, &|me| me.line(step, seconds_left));
    }

    fn record(&mut self, record: &Record) {
        self.latest = Some(record.clone());
        if let Some((path, file)) = &mut self.log {
            let line = serde_json::to_string(record).map_err(io::Error::other).and_then(|mut line| {
                line.push('\n');
                file.write_all(line.as_bytes())
            });
            if let Err(e) = line {
                warn!("{}: {e}; no more records are written", path.display());
                self.log = None;
            }
        }
        self.on_board(|board| serde_json::to_value(record).map_or(Ok(()), |record| board.record(&record)));
    }

    fn note(&mut self, text: &str) {
        info!("{text}");
    }

    fn warn(&mut self, text: &str) {
        warn!("{text}");
    }

    fn cancelled(&self) -> bool {
        signals::caught().is_some()
    }

    fn checkpoint_due(&self) -> bool {
        self.keeper.as_ref().is_some_and(Renewed::due)
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<'_>) -> Result<()> {
        let Some(keeper) = &mut self.keeper else { return Ok(()) };
        let written = files::write_checkpoint(&keeper.path, checkpoint, &self.run, &self.history);
        keeper.last = Instant::now();
        written?;
        debug!("checkpoint after step {}", checkpoint.standing.step);
        Ok(())
    }

    fn slices_due(&self) -> bool {
        self.live.as_ref().is_some_and(Renewed::due)
    }

    fn slices(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        let Some(live) = &mut self.live else { return Ok(()) };
        let mut middle = MiddleSlices::new(grid);
        slices.iter().for_each(|(part, values)| middle.gather(part, values.view()));
        files::picture(&live.path, None, &middle)?;
        live.last = Instant::now();
        let (picture, step) = (live.path.clone(), self.step);
        self.on_board(|board| board.picture(step, "live", &picture));
        Ok(())
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
        BARS.remove(&self.bar);
    }
}
