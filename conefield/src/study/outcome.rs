//! The outcome of a run, and its table columns.

use crate::score::{SCORES, score_cells};
use crate::tradeoff::trial::Figures;
use conefield_core::Result;
use conefield_evaluation::report::text::{bytes, number};
use serde::Serialize;
use std::path::Path;

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// With a result.
    Done,
    /// Without a result.
    Failed,
}

/// The outcome of a run.
#[derive(Debug, Clone, Serialize)]
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
    /// The outcome of the finished run in `folder`.
    pub fn of_run(folder: &Path) -> Result<Self> {
        Ok(Self { status: Status::Done, error: None, figures: Some(Figures::of_run(folder)?) })
    }

    /// The outcome of a failed run.
    pub fn failed(error: String) -> Self {
        Self { status: Status::Failed, error: Some(error), figures: None }
    }
}

/// Table columns for the quality of a result: scores if there is a reference, else the error of held-out views, else
/// the loss, which is the least informative.
#[derive(Debug, Clone, Copy)]
pub struct Columns {
    /// Whether there is a reference.
    pub scores: bool,
    /// Whether there are held-out views.
    pub held_out: bool,
    /// Whether the loss is the only measure.
    pub loss: bool,
}

impl Columns {
    /// The columns for runs with a reference, or with held-out views.
    pub fn of(scores: bool, held_out: bool) -> Self {
        Self { scores, held_out, loss: !scores && !held_out }
    }

    /// The headings: quality, then time and memory.
    pub fn heads(&self) -> Vec<&'static str> {
        let mut heads = vec![];
        heads.extend(SCORES.iter().filter(|_| self.scores));
        heads.extend(self.held_out.then_some("held-out error"));
        heads.extend(self.loss.then_some("loss"));
        heads.extend(["steps or passes", "solve time, s", "total time, s", "peak memory"]);
        heads
    }

    /// The cells below the headings; mostly empty for a failed run.
    pub fn cells(&self, outcome: &Outcome) -> Vec<String> {
        let Some(figures) = &outcome.figures else {
            return (0..self.heads().len()).map(|c| if c == 0 { "failed" } else { "-" }.to_owned()).collect();
        };
        let mut cells = vec![];
        if self.scores {
            let ssims = ["ssim_2d", "ssim_3d", "ssim_skimage"].map(|name| figures.score(name));
            cells.extend(match figures.psnr() {
                Some(psnr) => score_cells(psnr, ssims),
                None => std::array::from_fn(|_| "-".to_owned()),
            });
        }
        cells.extend(self.held_out.then(|| figure(figures.held_out)));
        cells.extend(self.loss.then(|| figure(figures.loss)));
        cells.push(number(figures.steps));
        cells.extend([figures.train_s, figures.total_s].map(|s| format!("{s:.2}")));
        cells.push(figures.peak_bytes.map_or("-".into(), bytes));
        cells
    }
}

fn figure(x: Option<f64>) -> String {
    x.map_or("-".into(), |x| format!("{x:.4e}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_equal_result_has_no_number_for_its_psnr() {
        let scores = serde_json::json!({ "psnr": null, "ssim_2d": 1.0, "ssim_3d": null, "ssim_skimage": 1.0 });
        let figures = Figures {
            steps: 1,
            train_s: 1.0,
            export_s: 0.5,
            total_s: 2.0,
            peak_bytes: None,
            threads: 2,
            parameters: 0,
            samples: 0,
            samples_per_s: None,
            loss: None,
            held_out: None,
            scores: Some(scores),
        };
        let outcome = Outcome { status: Status::Done, error: None, figures: Some(figures) };
        let shown = Columns::of(true, true).cells(&outcome);
        assert_eq!(shown, ["inf", "1.0000", "-", "1.0000", "-", "1", "1.00", "2.00", "-"]);
        let shown = Columns::of(false, false).cells(&outcome);
        assert_eq!(shown, ["-", "1", "1.00", "2.00", "-"]);
        let shown = Columns::of(false, true).cells(&Outcome::failed("why".into()));
        assert_eq!(shown, ["failed", "-", "-", "-", "-"]);
    }
}
