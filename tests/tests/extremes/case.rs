//! One case: what is done, how it must end, and how it did.

use crate::page::escaped;
use conefield_core::error::Result;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// A case that takes longer hangs.
const PATIENCE: Duration = Duration::from_secs(1800);

/// How a case must end.
#[derive(Debug, Clone, Copy)]
pub enum Ends {
    /// With a result that is right in the sense of the case.
    Right,
    /// With an error that holds these words.
    Refused(&'static [&'static str]),
    /// With such a result after going back at least once.
    Recovered,
    /// With a finite result; whether it is worth anything is not the case's question.
    Any,
    /// With a finite result that is said to be no better than an empty volume.
    Warned,
}

/// What a case found, where it was not refused.
#[derive(Default)]
pub struct Seen {
    /// The figure by which it is judged.
    pub figure: String,
    /// What it is held against: double precision, or the ordinary case.
    pub reference: String,
    /// Why it is not right.
    pub wrong: Option<String>,
    /// Times that training went back.
    pub rollbacks: u64,
    /// Whether training said that all of it was for nothing.
    pub warned: bool,
    /// Whether an empty volume is nearer to the object.
    pub worse: bool,
}

/// A case.
pub struct Case {
    what: String,
    expected: String,
    ends: Ends,
    run: Box<dyn FnOnce() -> Result<Seen> + Send>,
}

impl Case {
    /// A case whose result must be what `expected` says.
    pub fn right(
        what: impl Into<String>,
        expected: impl Into<String>,
        run: impl FnOnce() -> Result<Seen> + Send + 'static,
    ) -> Self {
        Self { what: what.into(), expected: expected.into(), ends: Ends::Right, run: Box::new(run) }
    }

    /// A case that must be refused with these words.
    pub fn refused(
        what: impl Into<String>,
        words: &'static [&'static str],
        run: impl FnOnce() -> Result<Seen> + Send + 'static,
    ) -> Self {
        Self { what: what.into(), expected: "refused".into(), ends: Ends::Refused(words), run: Box::new(run) }
    }

    /// The same with another end.
    pub fn ends(self, ends: Ends) -> Self {
        Self { ends, ..self }
    }

    /// Runs it, away from what else runs: a panic or a hang is a fault like another.
    pub fn run(self) -> Row {
        let (send, receive) = mpsc::channel();
        let run = self.run;
        thread::spawn(move || send.send(catch_unwind(AssertUnwindSafe(run))));
        let (ended, seen, fault) = match (receive.recv_timeout(PATIENCE), self.ends) {
            (Err(_), _) => ("hangs".to_owned(), None, Some("no end".to_owned())),
            (Ok(Err(_)), _) => ("panicked".into(), None, Some("a panic".into())),
            (Ok(Ok(Err(e))), ends) => {
                let (said, words) = (e.to_string(), if let Ends::Refused(words) = ends { words } else { &[""; 0] });
                let misses = words.iter().find(|w| !said.contains(*w)).map(|w| format!("{w:?} is not in: {said}"));
                let fault = if matches!(ends, Ends::Refused(_)) { misses } else { Some(format!("refused: {said}")) };
                (format!("refused: {said}"), None, fault)
            }
            (Ok(Ok(Ok(seen))), ends) => {
                let went_back = seen.rollbacks > 0;
                let ended = match (went_back, seen.warned) {
                    (false, false) if seen.worse => "finite",
                    (false, false) => "right",
                    (true, false) => "recovered",
                    (false, true) => "warned",
                    (true, true) => "recovered, warned",
                };
                let fault = match ends {
                    Ends::Refused(_) => Some(format!("not refused: {}", seen.figure)),
                    Ends::Right if went_back => Some(format!("went back {} times", seen.rollbacks)),
                    Ends::Recovered if !went_back => Some("did not go back".into()),
                    Ends::Recovered | Ends::Right if seen.warned => Some("no better than an empty volume".into()),
                    Ends::Right if seen.worse && self.expected.ends_with("better than nothing") => {
                        Some(format!("an empty volume is nearer ({})", seen.figure))
                    }
                    Ends::Warned if !seen.warned => Some("nothing was said".into()),
                    _ => seen.wrong.clone().map(|w| format!("{w} ({})", seen.figure)),
                };
                (ended.into(), Some(seen), fault)
            }
        };
        let Seen { figure, reference, .. } = seen.unwrap_or_default();
        Row { what: self.what, expected: self.expected, ended, figure, reference, fault }
    }
}

/// A row of the table.
pub struct Row {
    pub what: String,
    pub expected: String,
    pub ended: String,
    pub figure: String,
    pub reference: String,
    pub fault: Option<String>,
}

impl Row {
    /// As it stands on the page.
    pub fn line(&self) -> String {
        let cells = [&self.what, &self.expected, &self.ended, &self.figure, &self.reference];
        format!("| {} |\n", cells.map(|t| escaped(t)).join(" | "))
    }
}
