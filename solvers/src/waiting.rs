//! Waits for a smaller error of held-out views, record by record.

use conefield_core::method::Best;
use serde::{Deserialize, Serialize};

/// The best record so far, and how long ago it was.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Waited {
    /// The best record.
    pub best: Option<Best>,
    /// Records since the best one.
    pub since: u64,
}

impl Waited {
    /// Whether this error is smaller than the best one.
    pub fn is_better(&self, held_out: f64) -> bool {
        held_out.is_finite() && self.best.is_none_or(|b| held_out < b.held_out)
    }

    /// Counts a record: a new best one whose state is kept, or one without improvement.
    pub fn count(&mut self, step: u64, held_out: f64, kept: bool) {
        if kept {
            *self = Self { best: Some(Best { step, held_out }), since: 0 };
        } else if self.best.is_some() {
            self.since += 1;
        }
    }
}
