//! The decay of the learning rate, and the end of a run.

use conefield_core::error::{Result, ensure};
use conefield_core::method::Limits;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;
use std::time::{Duration, Instant};

/// Decay of the learning rate over a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Decay {
    /// Constant.
    None,
    /// Multiplied by `factor` after every `epochs` passes over the views (published).
    Step {
        /// Passes over the views between two decreases.
        epochs: f64,
        /// Multiplier.
        factor: f64,
    },
    /// Geometric decay from 1 at the start to this factor at the end of the run, whatever ends it.
    Exponential(f64),
    /// Half a cosine from 1 at the start to this factor at the end of the run, whatever ends it (Loshchilov and Hutter,
    /// ICLR 2017, without restarts). Stays at high rates longer than a geometric decay to the same end.
    Cosine(f64),
}

impl Decay {
    /// The learning rate's factor after `epoch` passes, at `share` of the run.
    pub fn at(&self, epoch: f64, share: f64) -> f64 {
        match *self {
            Decay::None => 1.0,
            Decay::Step { epochs, factor } => factor.powf((epoch / epochs).floor()),
            Decay::Exponential(last) => last.powf(share.clamp(0.0, 1.0)),
            Decay::Cosine(last) => last + (1.0 - last) * 0.5 * (1.0 + (PI * share.clamp(0.0, 1.0)).cos()),
        }
    }

    /// Refuses factors and periods that are not positive and finite.
    pub fn validate(&self) -> Result<()> {
        let all = match *self {
            Decay::None => [1.0, 1.0],
            Decay::Step { epochs, factor } => [epochs, factor],
            Decay::Exponential(last) | Decay::Cosine(last) => [last, 1.0],
        };
        let good = all.iter().all(|x| x.is_finite() && *x > 0.0);
        ensure(good, "spec", "decay", format!("{self:?}"), "positive finite numbers")
    }
}

/// Counts steps and training time against their limits.
#[derive(Debug)]
pub struct Clock {
    limits: Limits,
    spent: Duration,
    running: Option<Instant>,
    /// Creation time, and the training time before; a deadline counts from there.
    made: (Instant, Duration),
}

impl Clock {
    /// A stopped clock. A limit on the command line replaces the spec's limit of the same kind. If the command line
    /// limits only time, the spec's number of steps does not end the run. A deadline replaces both.
    ///
    /// `spent` is the training time in seconds before a resumed run.
    pub fn new(spec: Limits, cli: Limits, spent: f64) -> Self {
        let timed = cli.seconds.is_some() || cli.deadline.is_some();
        let counted = cli.steps.is_some() || cli.deadline.is_some();
        let limits = Limits {
            steps: cli.steps.or(if timed { None } else { spec.steps }),
            seconds: cli.seconds.or(if counted { None } else { spec.seconds }),
            ..cli
        };
        let spent = Duration::try_from_secs_f64(spent).unwrap_or_default();
        Self { limits, spent, running: None, made: (Instant::now(), spent) }
    }

    /// Resumes training time.
    pub fn resume(&mut self) {
        self.running.get_or_insert_with(Instant::now);
    }

    /// Pauses training time: what follows is not counted.
    pub fn pause(&mut self) {
        if let Some(since) = self.running.take() {
            self.spent += since.elapsed();
        }
    }

    /// Seconds of training.
    pub fn seconds(&self) -> f64 {
        (self.spent + self.running.map_or(Duration::ZERO, |s| s.elapsed())).as_secs_f64()
    }

    /// An estimate of the seconds left when `share` of the run is done.
    pub fn left(&self, share: f64) -> f64 {
        self.seconds() * (1.0 - share).max(0.0) / share.max(1e-9)
    }

    /// Share of the run completed after `steps` steps, for schedules; ignores `at_most`, which may cut the run short.
    pub fn share(&self, steps: u64) -> f64 {
        let by_steps = self.share_of_steps(steps);
        let by_time = self.limits.seconds.map_or(0.0, |t| if t <= 0.0 { 1.0 } else { self.seconds() / t });
        by_steps.max(by_time).max(self.share_of_deadline(steps))
    }

    /// Includes pauses: other work of the run takes time from it too. Does not end a run before its first step.
    fn share_of_deadline(&self, steps: u64) -> f64 {
        let Some(end) = self.limits.deadline else { return 0.0 };
        let (made, before) = self.made;
        let whole = before + end.saturating_duration_since(made);
        let gone = before + made.elapsed();
        match (gone >= whole, steps) {
            (true, 0) => 1.0 - f64::EPSILON,
            (true, _) => 1.0,
            _ => gone.as_secs_f64() / whole.as_secs_f64(),
        }
    }

    /// Whether this many more seconds end before the deadline.
    pub fn allows(&self, seconds: f64) -> bool {
        self.limits.deadline.is_none_or(|end| end.saturating_duration_since(Instant::now()).as_secs_f64() >= seconds)
    }

    /// Like [`Clock::share`], by the number of steps alone; 0 without a limit on steps.
    pub fn share_of_steps(&self, steps: u64) -> f64 {
        self.limits.steps.map_or(0.0, |n| if n == 0 { 1.0 } else { steps as f64 / n as f64 })
    }

    /// Like [`Clock::share`], but includes `at_most`: 1 or more ends the run.
    pub fn done(&self, steps: u64) -> f64 {
        let cut = self.limits.at_most.map_or(0.0, |t| if t <= 0.0 { 1.0 } else { self.seconds() / t });
        self.share(steps).max(cut)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decays_are_what_their_names_say() {
        assert_eq!(Decay::Step { epochs: 10.0, factor: 0.1 }.at(25.0, 0.0), 0.1f64.powi(2));
        assert!((Decay::Exponential(0.01).at(0.0, 0.5) - 0.1).abs() < 1e-12);
        let cosine = Decay::Cosine(0.1);
        for (share, rate) in [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1), (1.5, 0.1)] {
            assert!((cosine.at(0.0, share) - rate).abs() < 1e-12);
        }
        assert!(Decay::Exponential(0.0).validate().is_err() && Decay::Cosine(-0.1).validate().is_err());
    }

    #[test]
    fn the_first_limit_ends_the_run() {
        let spec = Limits { steps: Some(10), seconds: Some(1e9), ..Limits::default() };
        let c = Clock::new(spec, Limits::default(), 0.0);
        assert!(c.share(9) < 1.0 && c.share(10) >= 1.0);
        let c = Clock::new(spec, Limits { seconds: Some(1e6), ..Limits::default() }, 0.0);
        assert!(c.share(1000) < 1.0);
    }

    #[test]
    fn what_cuts_a_run_short_stretches_no_schedule() {
        let spec = Limits { steps: Some(10), ..Limits::default() };
        for (at_most, over) in [(1e9, false), (3.0, true)] {
            let c = Clock::new(spec, Limits { at_most: Some(at_most), ..Limits::default() }, 4.0);
            assert_eq!((c.share(5), c.done(5) >= 1.0), (0.5, over));
            assert!(c.done(10) >= 1.0);
        }
    }

    #[test]
    fn a_deadline_replaces_the_other_ends_and_counts_pauses() {
        let spec = Limits { steps: Some(1), seconds: Some(1e-9), ..Limits::default() };
        let within =
            |seconds| Limits { deadline: Some(Instant::now() + Duration::from_secs(seconds)), ..Limits::default() };
        let c = Clock::new(spec, within(1000), 3000.0);
        // 3000 of 4000 seconds were spent before the run was resumed. The clock is stopped.
        assert!((0.75..0.76).contains(&c.share(5)), "{}", c.share(5));
        assert!(c.allows(900.0) && !c.allows(1001.0));
        let over = Clock::new(spec, within(0), 0.0);
        assert!(over.share(1) >= 1.0 && over.done(1) >= 1.0 && !over.allows(1e-3));
        assert!(over.done(0) < 1.0, "nothing was made yet");
        assert!(Clock::new(spec, Limits::default(), 0.0).allows(f64::MAX));
    }
}
