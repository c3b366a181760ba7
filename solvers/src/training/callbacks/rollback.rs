//! Guards training. If values become non-finite or the loss diverges, the run returns to its last good state and
//! continues with half the learning rate.
//!
//! Losses are judged in windows of 25 steps, so that divergence is found within 50 steps. A run has diverged if a
//! window's mean corresponds to differences ten times as large as in the best window so far. Before the first window,
//! the reference is the loss of an empty volume or the first loss. Differences below a hundredth of the measured values
//! count as that, because a loss close to 0 may well jump. A run has died if a field that was not empty has the loss of
//! an empty volume for 25 consecutive steps: too long a step has moved it to a place without gradients. Steps continue
//! to count: the run still ends, and uses other rays than those that caused the problem. Adam's update count is
//! restored with its moments, whose bias it corrects.

use crate::training::culprit;
use crate::training::run::{HINT, Run, strayed};
use crate::training::{Callback, CallbackSpec, Kept, State, Update};
use conefield_core::backend::{StepStats, Work};
use conefield_core::checkpoint::tensors_of;
use conefield_core::pages::{Pages, copy};
use conefield_core::parallel;
use conefield_core::prelude::*;
use conefield_core::scan::Scan;
use conefield_core::scene::Scene;
use ndarray::{ArrayView2, Axis};
use std::sync::Arc;

/// Steps per window.
const WINDOW: u64 = 25;
/// Minimum number of steps between two copies of the state, which bring all parameters from the device.
const EVERY: u64 = 100;
/// At least one step in this many of those before a copy lies between it and the next.
const SHARE: u64 = 8;
/// Differences below this share of the measured values count as this share.
const SMALL: f64 = 0.01;
/// Relative difference between a field's loss and that of an empty volume from which the field is not empty.
const ALIVE: f64 = 1e-3;
/// Its name in specs and checkpoints, and the prefix of its tensors.
const NAME: &str = "rollback";
const PREFIX: &str = "rollback.";

/// Settings of `rollback`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Rollback {
    /// How often a run may return to its last good state, each time with half the learning rate.
    pub times: u64,
}

impl Default for Rollback {
    fn default() -> Self {
        Self { times: 8 }
    }
}

conefield_core::stage_type!(CallbackSpec, "rollback", Rollback, "returns a diverging run to its last good state");

impl CallbackSpec for Rollback {
    fn build(&self) -> Result<Box<dyn Callback>> {
        ensure(self.times > 0, "spec", "times", 0, "at least 1; omit rollback to disable it")?;
        Ok(Box::new(Guard { times: self.times, loss: None, measured: 0.0, watched: Watched::default(), copy: None }))
    }
}

/// The state besides the copy.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Watched {
    /// The lowest mean of a window so far; reset when channels are removed.
    level: Option<f64>,
    /// Losses of the current window: of the field, and of an empty volume.
    sum: f64,
    empty: f64,
    steps: u64,
    /// Both sums of the previous window.
    last: [f64; 2],
    /// Whether the field has ever been different from empty.
    alive: bool,
    /// Consecutive steps in which the field was empty.
    dead: u64,
    /// Step and updates of the copy.
    kept: Option<[u64; 2]>,
}

/// The callback that [`Rollback`] builds.
struct Guard {
    times: u64,
    /// The run's loss.
    loss: Option<Arc<dyn Loss>>,
    /// A typical measured line integral through the object, in the scale that stages see.
    measured: f64,
    watched: Watched,
    /// Parameters and both moments of the last good state.
    copy: Option<[Pages; 3]>,
}

impl Callback for Guard {
    fn name(&self) -> &'static str {
        NAME
    }

    fn begin(&mut self, run: &mut Run<'_>) -> Result<()> {
        (self.loss, self.measured) = (Some(run.loss.clone()), measured(run.job.scan, run.scene));
        Ok(())
    }

    fn masked(&mut self) {
        (self.watched.level, self.copy) = (None, None);
        (self.watched.sum, self.watched.empty, self.watched.steps) = (0.0, 0.0, 0);
    }

    /// Judges a step by its loss. If the run is rolled back, the gradients are discarded.
    fn after_gradients(&mut self, work: &Work<'_>, stats: &StepStats, run: &mut Run<'_>) -> Result<Update> {
        if !(stats.loss.is_finite() && stats.prior.is_finite()) {
            let what = format!("the loss is {}, the prior {}", stats.loss, stats.prior);
            return match self.spent(&what, run) {
                None => self.back(&what, run),
                Some(what) => Err(culprit::diverged(run, work, &what)),
            };
        }
        let empty: f64 = work.rays.iter().map(|r| self.of(0.0, f64::from(r.target))).sum();
        let empty = empty / work.rays.len().max(1) as f64;
        self.watched.sum += stats.loss;
        self.watched.empty += empty;
        self.watched.steps += 1;
        let level = *self.watched.level.get_or_insert(stats.loss.max(self.of(0.0, self.measured)));
        let other = (stats.loss - empty).abs() > ALIVE * empty;
        self.watched.alive |= other;
        self.watched.dead = if other { 0 } else { self.watched.dead + 1 };
        if self.copy.is_none() {
            return self.keep(run);
        }
        if let Some(what) = self.ran_away() {
            return self.back(&what, run);
        }
        if self.watched.alive && self.watched.dead >= WINDOW {
            return self.back("the field died, its loss is that of an empty volume", run);
        }
        if self.watched.steps < WINDOW {
            return Ok(Update::Take);
        }
        let mean = self.watched.sum / WINDOW as f64;
        self.watched.level = Some(level.min(mean));
        self.watched.last = [self.watched.sum, self.watched.empty];
        (self.watched.sum, self.watched.empty, self.watched.steps) = (0.0, 0.0, 0);
        let calm = mean <= self.beyond(2.0, level);
        let due = self.watched.kept.is_none_or(|[at, _]| run.step >= at + EVERY.max(at / SHARE));
        if calm && due { self.keep(run) } else { Ok(Update::Take) }
    }

    /// Judges the last steps, which no further step judges, unless the run ends at an earlier state; reports if the whole
    /// run was in vain.
    fn at_end(&mut self, run: &mut Run<'_>) -> Result<()> {
        let away = self.ran_away();
        run.exe.fetch(&mut run.model)?;
        if let Some(what) = away.or_else(|| strayed(&run.model.arena)).filter(|_| !run.settled) {
            self.back(&what, run)?;
        } else if let Some(said) = self.in_vain(run.step) {
            run.report(said);
        }
        Ok(())
    }

    fn state<'a>(&'a self, layout: &'a Layout) -> Result<State<'a>> {
        let parts = self.copy.iter().map(|copy| copy.each_ref().map(|p| &**p));
        let tensors = parts.flat_map(|parts| tensors_of(PREFIX, layout, &parts)).collect();
        State::new(NAME, &self.watched, tensors)
    }

    fn restore(&mut self, kept: &Kept<'_>, run: &Run<'_>) -> Result<()> {
        self.watched = kept.value()?;
        if self.watched.kept.is_some() {
            let layout = run.model.pipeline.layout();
            let mut copy = [(); 3].map(|()| Pages::zeros(layout.len()));
            kept.parts(layout, &mut copy.each_mut().map(|p| &mut **p))?;
            self.copy = Some(copy);
        }
        Ok(())
    }

    /// The parameters and both moments.
    fn bytes(&self, parameters: u64) -> u64 {
        3 * size_of::<f32>() as u64 * parameters
    }
}

impl Guard {
    /// The message that the last steps are no better than an empty volume, if so. Early steps seldom are, whatever
    /// follows.
    fn in_vain(&self, step: u64) -> Option<String> {
        if step < 4 * WINDOW {
            return None;
        }
        let Watched { sum, empty, last, .. } = self.watched;
        let (found, empty) = (sum + last[0], empty + last[1]);
        let text = "the field is no better than an empty volume; another optimizer.lr or more steps may help";
        (empty > 0.0 && found > 0.99 * empty).then(|| text.to_owned())
    }

    /// How the window's losses show divergence. Missing steps of the window count 0.
    fn ran_away(&self) -> Option<String> {
        let Watched { level, sum, steps, .. } = self.watched;
        let level = level?;
        let away = sum / WINDOW as f64 > self.beyond(10.0, level);
        let mean = sum / steps.max(1) as f64;
        away.then(|| format!("the loss grew from {level:.3e} to {mean:.3e}"))
    }

    /// The loss of a prediction.
    fn of(&self, predicted: f64, measured: f64) -> f64 {
        self.loss.as_ref().map_or(0.0, |loss| loss.at(predicted, measured).0)
    }

    /// The loss of differences `factor` times as large as those of the loss `level`.
    fn beyond(&self, factor: f64, level: f64) -> f64 {
        let of = |difference: f64| self.of(difference, 0.0);
        of(1.0) / of(1.0 / factor) * level.max(of(SMALL * self.measured))
    }

    /// Copies the state after a good loss; rejects it if it is not finite after all.
    fn keep(&mut self, run: &mut Run<'_>) -> Result<Update> {
        run.exe.fetch(&mut run.model)?;
        if let Some(what) = strayed(&run.model.arena) {
            return self.back(&what, run);
        }
        let Arena { params, first, second, .. } = &run.model.arena;
        match &mut self.copy {
            Some(kept) => kept.iter_mut().zip([params, first, second]).for_each(|(k, p)| copy(k, p)),
            None => self.copy = Some([params, first, second].map(Pages::clone)),
        }
        self.watched.kept = Some([run.step, run.tally.updates]);
        Ok(Update::Take)
    }

    /// Why the run cannot return to an earlier state after `what`, if so.
    fn spent(&self, what: &str, run: &Run<'_>) -> Option<String> {
        if self.copy.is_none() {
            return Some(what.to_owned());
        }
        let spent = run.tally.rollbacks >= self.times;
        spent.then(|| format!("{what}, after {} rollbacks with half the rate each time", self.times))
    }

    /// Restores the last good state and reports it, or gives up.
    fn back(&mut self, what: &str, run: &mut Run<'_>) -> Result<Update> {
        let step = run.step;
        let spent = self.spent(what, run);
        let (Some(kept), Some([at, updates]), None) = (&self.copy, self.watched.kept, &spent) else {
            let what = spent.unwrap_or_else(|| what.to_owned());
            return Err(Error::Diverged { step, what: format!("{what}; {HINT}") });
        };
        let Arena { params, grads, first, second } = &mut run.model.arena;
        [params, first, second].into_iter().zip(kept).for_each(|(p, k)| copy(p, k));
        grads.fill(0.0);
        run.exe.renew();
        run.tally.updates = updates;
        run.tally.rollbacks += 1;
        run.tally.rate *= 0.5;
        self.watched = Watched { sum: 0.0, empty: 0.0, steps: 0, dead: 0, ..self.watched.clone() };
        let rate = run.tally.rate;
        run.report(format!("step {step}: {what}; rolled back to step {at}, learning rate times {rate}"));
        Ok(Update::Leave)
    }
}

/// The mean of the measurements of `scan`, weighted by themselves, so that air does not count. In the scale that stages
/// see.
fn measured(scan: &Scan, scene: &Scene) -> f64 {
    let view = |v: ArrayView2<'_, f32>| {
        v.iter().fold([0.0; 2], |[s, t], p| [s + f64::from(*p).powi(2), t + f64::from(p.abs())])
    };
    let sums: Vec<[f64; 2]> = parallel::map(scan.projections.axis_iter(Axis(0)), |_, v| view(v));
    let [squares, sum] = sums.iter().fold([0.0; 2], |[s, t], [u, v]| [s + u, t + v]);
    squares / sum.max(f64::MIN_POSITIVE) / scene.line_scale()
}
