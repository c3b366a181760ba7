//! A run: the state shared by the training loop and its callbacks.

use crate::optimizer::Optimizer;
use crate::schedule::Clock;
use conefield_core::arena::Arena;
use conefield_core::backend::{Adam, Executable, StepStats};
use conefield_core::error::{Error, Result};
use conefield_core::finite::stray;
use conefield_core::loss::Loss;
use conefield_core::method::{Best, DriftRecord, Job, Limits, Observer, Record};
use conefield_core::pipeline::Model;
use conefield_core::scene::Scene;
use ndarray::aview1;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Advice when training diverges.
pub const HINT: &str = "try a smaller optimizer.lr";

/// A run of the training loop.
pub struct Run<'a> {
    /// The job.
    pub job: &'a Job<'a>,
    /// Maps between the world and the stages.
    pub scene: &'a Scene,
    /// Receives reports.
    pub observer: &'a mut dyn Observer,
    /// Stages and parameters. The parameters may be on a device: [`Executable::fetch`] copies them.
    pub model: Model,
    /// Computes gradients and updates.
    pub exe: Box<dyn Executable>,
    /// Measures training time.
    pub clock: Clock,
    /// Loss between predicted and measured values.
    pub loss: Arc<dyn Loss>,
    /// The update rule.
    pub optimizer: Optimizer,
    /// Steps per pass over the views.
    pub steps_an_epoch: u64,
    /// Steps between two records.
    pub report_every: u64,
    /// Finished steps.
    pub step: u64,
    /// Training samples so far.
    pub samples: u64,
    /// Further counters.
    pub tally: Tally,
    /// Whether the run ends with the current record.
    pub settled: bool,
    /// The record of the final state, if a callback chose one.
    pub best: Option<Best>,
}

/// Counters of a run besides its steps, saved in checkpoints.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tally {
    /// Sums since the last record.
    pub window: Window,
    /// Updates of parameters and moments.
    pub updates: u64,
    /// Factor of the learning rate.
    pub rate: f64,
    /// Number of rollbacks to an earlier state.
    pub rollbacks: u64,
    /// Share of the run at the last record.
    #[serde(default)]
    pub recorded: f64,
}

impl Default for Tally {
    fn default() -> Self {
        Self { window: Window::default(), updates: 0, rate: 1.0, rollbacks: 0, recorded: 0.0 }
    }
}

impl<'a> Run<'a> {
    /// A run of `job` before its first step, with default limits and settings.
    pub fn new(
        job: &'a Job<'a>,
        scene: &'a Scene,
        observer: &'a mut dyn Observer,
        model: Model,
        exe: Box<dyn Executable>,
    ) -> Self {
        Self {
            job,
            scene,
            observer,
            model,
            exe,
            clock: Clock::new(Limits::default(), job.limits, 0.0),
            loss: Arc::new(crate::losses::L1 {}),
            optimizer: Optimizer::default(),
            steps_an_epoch: 1,
            report_every: 1,
            step: 0,
            samples: 0,
            tally: Tally::default(),
            settled: false,
            best: None,
        }
    }

    /// Completed passes over the views.
    pub fn epoch(&self) -> f64 {
        self.step as f64 / self.steps_an_epoch as f64
    }

    /// Adam's settings for the next update. The caller sets its number and scales the learning rate.
    pub fn adam(&self) -> Adam {
        self.optimizer.adam(1, self.epoch(), self.clock.share(self.step))
    }

    /// Warns of an event, now and in the next record.
    pub fn report(&mut self, said: String) {
        self.observer.warn(&said);
        self.tally.window.events.push(said);
    }

    /// Permanently removes all channels of the encoder except `keep`.
    pub fn mask(&mut self, keep: Vec<usize>) -> Result<()> {
        self.exe.fetch(&mut self.model)?;
        self.model.mask(keep)?;
        self.exe = self.job.backend.compile(&self.model.pipeline)?.0;
        Ok(())
    }

    /// Enables the first `channels` channels of the encoder and disables the others.
    pub fn open(&mut self, channels: usize) -> Result<()> {
        self.exe.fetch(&mut self.model)?;
        self.model.pipeline.open(channels)?;
        self.exe = self.job.backend.compile(&self.model.pipeline)?.0;
        Ok(())
    }

    /// Fetches the parameters and refuses values that are not finite.
    pub fn check_finite(&mut self) -> Result<()> {
        self.exe.fetch(&mut self.model)?;
        match strayed(&self.model.arena) {
            Some(what) => Err(Error::Diverged { step: self.step, what: format!("{what}; {HINT}") }),
            None => Ok(()),
        }
    }
}

/// Sums since the last record.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// Steps with an update.
    pub steps: u64,
    loss: f64,
    prior: f64,
    samples: u64,
    seconds: f64,
    /// Measured drift.
    pub drift: Vec<DriftRecord>,
    /// Other events.
    pub events: Vec<String>,
}

impl Window {
    /// Adds a step.
    pub fn add(&mut self, stats: &StepStats, seconds: f64) {
        self.steps += 1;
        self.loss += stats.loss;
        self.prior += stats.prior;
        self.samples += stats.samples;
        self.seconds += seconds;
    }

    /// The record of these steps.
    pub fn record(&mut self, step: u64, seconds: f64, lr: f64) -> Record {
        let n = self.steps as f64;
        Record {
            step,
            seconds,
            loss: Some(self.loss / n),
            prior: (self.prior > 0.0).then_some(self.prior / n),
            lr: Some(lr),
            samples_per_s: Some(self.samples as f64 / self.seconds.max(1e-12)),
            drift: std::mem::take(&mut self.drift),
            events: std::mem::take(&mut self.events),
            ..Record::default()
        }
    }
}

/// A message if parameters or moments are no longer finite.
pub fn strayed(arena: &Arena) -> Option<String> {
    let parts = [("parameter", &arena.params), ("first moment", &arena.first), ("second moment", &arena.second)];
    parts.into_iter().find_map(|(name, part)| {
        let (i, x) = stray(&aview1(part))?;
        Some(format!("{name} {i} is {x}"))
    })
}
