//! The outcome of a run, and its table columns.

use crate::score::SCORES;
use crate::tradeoff::json::read_json;
use crate::tradeoff::trial::Figures;
use conefield_core::Result;
use conefield_evaluation::report::text::{bytes, number};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// With a result.
    Done,
    /// In a search: the budget was too short to do anything.
    TooShort,
    /// Without a result.
    Failed,
}

/// The outcome of a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Outcome {
    /// How it ended.
    pub status: Status,
    /// The error of a failed run.
    pub error: Option<String>,
    /// Time, memory and scores.
    #[serde(flatten)]
    pub figures: Option<Figures>,
}

impl Outcome {
    /// The outcome of the run in `folder`, which is finished or has failed with `error`.
    pub fn of_run(folder: &Path, error: Option<String>) -> Result<Self> {
        if let Some(error) = error {
            return Ok(Self::failed(error));
        }
        let figures = read_json(&folder.join("record.json"))?;
        Ok(Self { status: Status::Done, error: None, figures: Some(figures) })
    }

    /// The outcome of a failed run.
    pub fn failed(error: String) -> Self {
        Self { status: Status::Failed, error: Some(error), figures: None }
    }
}

/// A column of tables: a figure of runs.
pub(super) struct Column {
    /// The figure's name in `record.json`.
    pub key: &'static str,
    pub head: &'static str,
    /// The figure of a run.
    pub of: fn(&Figures) -> Option<f64>,
    pub shown: fn(f64) -> String,
}

/// Quality, then time and memory.
pub(super) const COLUMNS: [Column; 10] = [
    Column { key: "psnr", head: SCORES[0], of: Figures::psnr, shown: two },
    Column { key: "ssim_2d", head: SCORES[1], of: |f| f.score("ssim_2d"), shown: four },
    Column { key: "ssim_3d", head: SCORES[2], of: |f| f.score("ssim_3d"), shown: four },
    Column { key: "ssim_skimage", head: SCORES[3], of: |f| f.score("ssim_skimage"), shown: four },
    Column { key: "held_out", head: "held-out error", of: |f| f.held_out, shown: |x| format!("{x:.3e}") },
    Column { key: "loss", head: "loss", of: |f| f.loss, shown: |x| format!("{x:.3e}") },
    Column { key: "steps", head: "steps or passes", of: |f| Some(f.steps as f64), shown: |x| number(x.round() as u64) },
    Column { key: "train_s", head: "solve time, s", of: |f| Some(f.train_s), shown: two },
    Column { key: "total_s", head: "total time, s", of: |f| Some(f.total_s), shown: two },
    Column {
        key: "peak_bytes",
        head: "peak memory",
        of: |f| f.peak_bytes.map(|b| b as f64),
        shown: |x| bytes(x as u64),
    },
];

fn two(x: f64) -> String {
    format!("{x:.2}")
}

fn four(x: f64) -> String {
    format!("{x:.4}")
}

/// The columns of a table of runs: scores if there is a reference, else the error of held-out views, else the loss, which
/// is the least informative; then time and memory.
pub struct Columns(pub(super) Vec<&'static Column>);

impl Columns {
    /// The columns for runs with a reference, or with held-out views.
    pub fn of(scores: bool, held_out: bool) -> Self {
        let wanted = |c: &&Column| match c.key {
            "held_out" => held_out,
            "loss" => !scores && !held_out,
            "steps" | "train_s" | "total_s" | "peak_bytes" => true,
            _ => scores,
        };
        Self(COLUMNS.iter().filter(wanted).collect())
    }

    /// The headings, after that of names.
    pub fn heads(&self, names: &str) -> Vec<String> {
        [names].into_iter().chain(self.0.iter().map(|c| c.head)).map(str::to_owned).collect()
    }

    /// The cells below the headings, after a name; mostly empty for a failed run.
    pub fn cells(&self, name: &str, outcome: &Outcome) -> Vec<String> {
        let cell = |(i, c): (usize, &&Column)| match (&outcome.figures, c.key) {
            (None, _) => if i == 0 { "failed" } else { "-" }.to_owned(),
            (Some(f), "held_out" | "loss") => (c.of)(f).map_or("-".into(), |x| format!("{x:.4e}")),
            (Some(f), _) => (c.of)(f).map_or("-".into(), c.shown),
        };
        [name.to_owned()].into_iter().chain(self.0.iter().enumerate().map(cell)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_equal_result_has_no_number_for_its_psnr() {
        let scores = serde_json::json!({ "psnr": null, "ssim_2d": 1.0, "ssim_3d": null, "ssim_skimage": 1.0 });
        let figures = Figures { steps: 1, train_s: 1.0, total_s: 2.0, scores: Some(scores), ..Figures::default() };
        let outcome = Outcome { status: Status::Done, error: None, figures: Some(figures) };
        let shown = Columns::of(true, true).cells("a", &outcome);
        assert_eq!(shown, ["a", "inf", "1.0000", "-", "1.0000", "-", "1", "1.00", "2.00", "-"]);
        let shown = Columns::of(false, false).cells("a", &outcome);
        assert_eq!(shown, ["a", "-", "1", "1.00", "2.00", "-"]);
        let shown = Columns::of(false, true).cells("a", &Outcome::failed("why".into()));
        assert_eq!(shown, ["a", "failed", "-", "-", "-", "-"]);
    }
}
