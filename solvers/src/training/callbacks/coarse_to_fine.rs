//! Coarse-to-fine training (Lin et al. 2021, BARF, section 3.3, for frequencies; Li et al. 2023, Neuralangelo, section
//! 3.2, for the levels of a hash grid): training begins with the encoder's coarse levels, and finer ones are enabled
//! one by one.
//!
//! The channels of a disabled level are 0 and are not computed, so that a step with few levels is cheap. Its features
//! keep their initial values, close to 0, so that enabling it causes no jump. It works with every encoder that has
//! tables of features ordered from coarse to fine.
//!
//! Of `L` levels, `levels` are enabled at first. The others follow at equal intervals, the last after `until` of the
//! run: at `share` of the run, `levels + ⌊(L − levels)·min(share/until, 1)⌋` are enabled.

use crate::training::run::Run;
use crate::training::{Callback, CallbackSpec};
use conefield_core::opened::Opened;
use conefield_core::pipeline::Pipeline;
use conefield_core::prelude::*;

/// Settings of `coarse-to-fine`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CoarseToFine {
    /// Levels enabled at first.
    pub levels: usize,
    /// Share of the run after which all levels are enabled, above 0 and at most 1.
    pub until: f64,
}

impl Default for CoarseToFine {
    fn default() -> Self {
        Self { levels: 1, until: 0.3 }
    }
}

conefield_core::stage_type!(
    CallbackSpec,
    "coarse-to-fine",
    CoarseToFine,
    "opens the encoder's levels one by one, coarse ones first"
);

impl CallbackSpec for CoarseToFine {
    fn build(&self) -> Result<Box<dyn Callback>> {
        ensure(self.levels > 0, "spec", "levels", 0, "at least 1")?;
        ensure(self.until > 0.0 && self.until <= 1.0, "spec", "until", self.until, "above 0, at most 1")?;
        Ok(Box::new(Opener(self.clone())))
    }
}

/// The callback that [`CoarseToFine`] builds. It is stateless: the completed share of the run determines the levels.
struct Opener(CoarseToFine);

impl CoarseToFine {
    /// Number of enabled levels, out of `all`, at `share` of the run.
    fn open(&self, all: usize, share: f64) -> usize {
        let closed = all.saturating_sub(self.levels);
        // The small addend makes an exact multiple enable its level despite rounding.
        let more = (closed as f64 * (share / self.until).min(1.0) + 1e-9).floor() as usize;
        (self.levels + more).min(all)
    }

    /// Enables the levels of step `step`. Returns an event if that changes their number.
    fn enable(&self, run: &mut Run<'_>, step: u64) -> Result<Option<String>> {
        let ends = ends(run.model.pipeline.encoder.as_ref());
        let open = self.open(ends.len(), run.clock.share(step));
        if ends[open - 1] == run.model.pipeline.open_channels() {
            return Ok(None);
        }
        run.open(ends[open - 1])?;
        Ok(Some(format!("coarse-to-fine: {open} of {} levels are open", ends.len())))
    }
}

/// End of each level in the encoder's channels.
fn ends(encoder: &dyn Encoder) -> Vec<usize> {
    let cells = encoder.resolutions().unwrap_or_default();
    (1..=cells.len()).filter(|&c| c == cells.len() || cells[c] != cells[c - 1]).collect()
}

impl Callback for Opener {
    fn name(&self) -> &'static str {
        "coarse-to-fine"
    }

    fn check(&self, pipeline: &Pipeline) -> Result<()> {
        let encoder = &pipeline.encoder;
        let ends = ends(encoder.as_ref());
        let refused = |why: &str| {
            let found = format!("coarse-to-fine with an encoder {why}: {}", encoder.describe());
            let expected = "one encoder with tables of features, such as hash-grid; with this one, callbacks without coarse-to-fine";
            Error::invalid("spec", "", found, expected)
        };
        if ends.is_empty() || !encoder.coarse_to_fine() {
            return Err(refused("whose channels are not ordered from coarse to fine"));
        }
        let most = ends.len();
        ensure(self.0.levels <= most, "spec", "levels", self.0.levels, format!("1 to {most}, as the encoder has"))?;
        Opened::new(encoder.clone(), ends[self.0.levels - 1]).map(drop).map_err(|e| refused(&format!("({e})")))
    }

    /// A resumed run may evaluate a record before its first step: with the levels of the step before.
    fn begin(&mut self, run: &mut Run<'_>) -> Result<()> {
        match run.step.checked_sub(1) {
            Some(before) => self.0.enable(run, before).map(drop),
            None => Ok(()),
        }
    }

    fn before_step(&mut self, run: &mut Run<'_>) -> Result<()> {
        if let Some(event) = self.0.enable(run, run.step)? {
            run.tally.window.events.push(event);
        }
        Ok(())
    }

    fn at_end(&mut self, run: &mut Run<'_>) -> Result<()> {
        let (open, all) = (run.model.pipeline.open_channels(), run.model.pipeline.encoder.info().output);
        if open < all {
            let report = format!("coarse-to-fine: the run ends with {open} of {all} channels open");
            run.tally.window.events.push(report);
        }
        Ok(())
    }

    /// Returns the whole encoder: a level that is still disabled has its initial features, close to 0.
    fn finish(&mut self, run: &mut Run<'_>) -> Result<()> {
        let all = run.model.pipeline.encoder.info().output;
        if run.model.pipeline.open_channels() < all { run.open(all) } else { Ok(()) }
    }

    fn describe(&self) -> Option<String> {
        let CoarseToFine { levels, until } = self.0;
        Some(format!("coarse-to-fine: {levels} levels at first, all after {:.0}% of the run", 100.0 * until))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_open_at_equal_distances() {
        let settings = CoarseToFine { levels: 2, until: 0.4 };
        for (share, open) in [(0.0, 2), (0.09, 2), (0.1, 3), (0.2, 4), (0.39, 5), (0.4, 6), (1.0, 6)] {
            assert_eq!(settings.open(6, share), open, "{share}");
        }
        // An encoder that a mask has left with fewer levels.
        assert_eq!(settings.open(1, 0.0), 1);
    }
}
