//! Watches over training. A run that leaves the finite numbers, or whose loss runs away, goes back to its last good state
//! and on from there with half the learning rate.
//!
//! Losses are judged in windows of 25 steps, so that a run is found out within 50. It has run away where a window's mean
//! is that of differences ten times as large as in the best window so far. Before the first window that is what an empty
//! volume has, or the first loss; and differences below a hundredth of what was measured count as that, since a loss next
//! to nothing may well jump. It has died where a field that was not empty gives the loss of an empty volume for 25 steps on
//! end: too long a step has taken it to where no gradient comes back from. Steps go on counting: the run still ends, and meets other rays than those that led astray.
//! Adam's count of updates goes back with its moments, whose bias it corrects.

use conefield_core::arena::{Arena, Layout};
use conefield_core::backend::{Adam, Executable, StepStats, Work};
use conefield_core::checkpoint::{Resume, tensors_of};
use conefield_core::error::{Error, Result};
use conefield_core::loss::Loss;
use conefield_core::pages::Pages;
use conefield_core::pipeline::Model;
use conefield_core::scan::Scan;
use conefield_core::scene::Scene;
use ndarray::{ArrayView2, Axis};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Steps whose losses are judged together.
const WINDOW: u64 = 25;
/// Steps between two copies of the state, at least.
const EVERY: u64 = 100;
/// Share of what was measured below which differences count as that share.
const SMALL: f64 = 0.01;
/// Share by which a field's loss differs from that of an empty volume, if it is none.
const ALIVE: f64 = 1e-3;
/// Under this name the copy goes into a checkpoint.
const NAME: &str = "good.";

/// What the guard knows beside its copy.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Watched {
    /// Times that the run went back.
    pub rollbacks: u64,
    /// Updates that parameters and moments have seen.
    updates: u64,
    /// The lowest mean of a window so far; starts anew when channels leave the work.
    level: Option<f64>,
    /// Losses of the window that is not over, and of an empty volume there.
    sum: f64,
    empty: f64,
    steps: u64,
    /// Both sums of the window before.
    last: [f64; 2],
    /// Whether the field has ever been other than empty.
    alive: bool,
    /// Steps on end in which it was not.
    dead: u64,
    /// Step and updates of the copy.
    kept: Option<[u64; 2]>,
}

/// Looks at every step between gradients and update.
pub struct Guard<'a> {
    most: u64,
    loss: &'a dyn Loss,
    /// A line integral as it was measured where there is an object, in the scale that stages see.
    measured: f64,
    watched: Watched,
    copy: Option<Copy>,
}

/// Parameters and moments under which a loss was fine.
struct Copy {
    parts: [Pages; 3],
    masks: usize,
}

impl<'a> Guard<'a> {
    /// A guard that lets a run on `scan` go back `most` times; with 0 it keeps no copy, and only a number that is not finite
    /// ends the run.
    pub fn new(most: u64, loss: &'a dyn Loss, scan: &Scan, scene: &Scene) -> Self {
        // The mean of what was measured, weighted with itself: air does not count, however much of it there is.
        let view = |v: ArrayView2<'_, f32>| {
            v.iter().fold([0.0; 2], |[s, t], p| [s + f64::from(*p).powi(2), t + f64::from(p.abs())])
        };
        let sums: Vec<[f64; 2]> = scan.projections.axis_iter(Axis(0)).into_par_iter().map(view).collect();
        let [squares, sum] = sums.iter().fold([0.0; 2], |[s, t], [u, v]| [s + u, t + v]);
        let measured = squares / sum.max(f64::MIN_POSITIVE) / scene.line_scale();
        Self { most, loss, measured, watched: Watched::default(), copy: None }
    }

    /// Goes on where a checkpoint stood, with its copy.
    pub fn resume(&mut self, watched: Watched, resume: &Resume, model: &Model) -> Result<()> {
        if watched.kept.is_some() {
            let layout = model.pipeline.layout();
            let mut parts = [(); 3].map(|()| Pages::zeros(layout.len()));
            resume.load(NAME, layout, parts.each_mut().map(|p| &mut **p))?;
            self.copy = Some(Copy { parts, masks: model.masks().len() });
        }
        self.watched = watched;
        Ok(())
    }

    /// What [`Guard::resume`] needs beside [`Guard::tensors`].
    pub fn watched(&self) -> &Watched {
        &self.watched
    }

    /// The copy, for a checkpoint.
    pub fn tensors<'b>(&'b self, layout: &'b Layout) -> Vec<(String, &'b [usize], &'b [f32])> {
        self.copy.iter().flat_map(|c| tensors_of(NAME, layout, c.parts.each_ref().map(|p| &**p))).collect()
    }

    /// Times that the run went back.
    pub fn rollbacks(&self) -> u64 {
        self.watched.rollbacks
    }

    /// What the learning rate is multiplied with.
    pub fn rate(&self) -> f64 {
        0.5f64.powi(self.watched.rollbacks.min(1000) as i32)
    }

    /// `settings` for the next update, which is counted.
    pub fn next(&mut self, settings: Adam) -> Adam {
        self.watched.updates += 1;
        Adam { lr: settings.lr * self.rate(), step: self.watched.updates, ..settings }
    }

    /// Judges the gradients of a step by their loss. Says so where the run went back: the gradients are gone then, and
    /// there is nothing to update with.
    pub fn judge(
        &mut self,
        work: &Work<'_>,
        stats: &StepStats,
        model: &mut Model,
        exe: &mut dyn Executable,
    ) -> Result<Option<String>> {
        let step = work.step;
        if self.copy.as_ref().is_some_and(|c| c.masks != model.masks().len()) {
            (self.watched.level, self.copy) = (None, None);
            (self.watched.sum, self.watched.empty, self.watched.steps) = (0.0, 0.0, 0);
        }
        if !(stats.loss.is_finite() && stats.prior.is_finite()) {
            let what = format!("the loss is {}, the prior {}", stats.loss, stats.prior);
            return self.back(step, &what, model, exe).map(Some);
        }
        if self.most == 0 {
            return Ok(None);
        }
        let empty: f64 = work.rays.iter().map(|r| self.loss.at(0.0, f64::from(r.target)).0).sum();
        let empty = empty / work.rays.len().max(1) as f64;
        self.watched.sum += stats.loss;
        self.watched.empty += empty;
        self.watched.steps += 1;
        let level = *self.watched.level.get_or_insert(stats.loss.max(self.loss.at(0.0, self.measured).0));
        let other = (stats.loss - empty).abs() > ALIVE * empty;
        self.watched.alive |= other;
        self.watched.dead = if other { 0 } else { self.watched.dead + 1 };
        if self.copy.is_none() {
            return self.keep(step, model, exe);
        }
        if let Some(what) = self.ran_away() {
            return self.back(step, &what, model, exe).map(Some);
        }
        if self.watched.alive && self.watched.dead >= WINDOW {
            let what = "the field died, its loss is that of an empty volume";
            return self.back(step, what, model, exe).map(Some);
        }
        if self.watched.steps < WINDOW {
            return Ok(None);
        }
        let mean = self.watched.sum / WINDOW as f64;
        self.watched.level = Some(level.min(mean));
        self.watched.last = [self.watched.sum, self.watched.empty];
        (self.watched.sum, self.watched.empty, self.watched.steps) = (0.0, 0.0, 0);
        let calm = mean <= self.beyond(2.0, level);
        let due = self.watched.kept.is_none_or(|[at, _]| step >= at + EVERY);
        if calm && due { self.keep(step, model, exe) } else { Ok(None) }
    }

    /// Judges the end of a run, what no further step would look at; and says so where all of it was for nothing.
    pub fn finish(&mut self, step: u64, model: &mut Model, exe: &mut dyn Executable) -> Result<Option<String>> {
        let away = self.ran_away();
        exe.fetch(model)?;
        match away.or_else(|| strayed(&model.arena)) {
            Some(what) => self.back(step, &what, model, exe).map(Some),
            None => Ok(self.in_vain(step)),
        }
    }

    /// That the last steps are no better than an empty volume, if so. The first ones seldom are, whatever comes of them.
    fn in_vain(&self, step: u64) -> Option<String> {
        if step < 4 * WINDOW {
            return None;
        }
        let Watched { sum, empty, last, .. } = self.watched;
        let (found, empty) = (sum + last[0], empty + last[1]);
        let text = "the field is no better than an empty volume; another solver.lr or more steps may help";
        (empty > 0.0 && found > 0.99 * empty).then(|| text.to_owned())
    }

    /// How the window's losses show that the run has run away. Steps that the window still lacks count 0.
    fn ran_away(&self) -> Option<String> {
        let Watched { level, sum, steps, .. } = self.watched;
        let level = level?;
        let away = sum / WINDOW as f64 > self.beyond(10.0, level);
        let mean = sum / steps.max(1) as f64;
        away.then(|| format!("the loss ran away, from {level:.3e} to {mean:.3e}"))
    }

    /// The loss of differences `factor` times as large as those of the loss `level`.
    fn beyond(&self, factor: f64, level: f64) -> f64 {
        let of = |difference: f64| self.loss.at(difference, 0.0).0;
        of(1.0) / of(1.0 / factor) * level.max(of(SMALL * self.measured))
    }

    /// Copies the state, which the step's loss has found good; one that is not finite is no good after all.
    fn keep(&mut self, step: u64, model: &mut Model, exe: &mut dyn Executable) -> Result<Option<String>> {
        exe.fetch(model)?;
        if let Some(what) = strayed(&model.arena) {
            return self.back(step, &what, model, exe).map(Some);
        }
        let Arena { params, first, second, .. } = &model.arena;
        let masks = model.masks().len();
        match &mut self.copy {
            Some(copy) => copy.parts.iter_mut().zip([params, first, second]).for_each(|(c, p)| c.copy_from_slice(p)),
            None => self.copy = Some(Copy { parts: [params, first, second].map(Pages::clone), masks }),
        }
        self.watched.kept = Some([step, self.watched.updates]);
        Ok(None)
    }

    /// Brings the last good state back, or gives up.
    fn back(&mut self, step: u64, what: &str, model: &mut Model, exe: &mut dyn Executable) -> Result<String> {
        let hint = "try a smaller solver.lr";
        let (Some(copy), Some([at, updates])) = (&self.copy, self.watched.kept) else {
            return Err(Error::Diverged { step, what: format!("{what}; {hint}") });
        };
        if self.watched.rollbacks >= self.most {
            let what = format!("{what}, after it had gone back {} times with half the rate each time", self.most);
            return Err(Error::Diverged { step, what: format!("{what}; {hint}") });
        }
        let Arena { params, grads, first, second } = &mut model.arena;
        [params, first, second].into_iter().zip(&copy.parts).for_each(|(p, c)| p.copy_from_slice(c));
        grads.fill(0.0);
        exe.renew();
        let rollbacks = self.watched.rollbacks + 1;
        self.watched = Watched { rollbacks, updates, sum: 0.0, empty: 0.0, steps: 0, dead: 0, ..self.watched.clone() };
        Ok(format!("step {step}: {what}; back to where step {at} was, learning rate times {}", self.rate()))
    }
}

/// How parameters or moments show that they are no longer finite.
pub fn strayed(arena: &Arena) -> Option<String> {
    let parts = [("parameter", &arena.params), ("first moment", &arena.first), ("second moment", &arena.second)];
    parts.into_iter().find_map(|(name, part)| {
        let (i, x) = part.par_iter().enumerate().find_first(|(_, x)| !x.is_finite())?;
        Some(format!("{name} {i} is {x}"))
    })
}
