//! The training loop: draw a batch, compute its gradients, update the parameters.
//!
//! [`callbacks`] do everything else: they inspect gradients before the update, the model between steps, and every
//! record. A spec chooses some of them; [`checkpoint`] saves the state of all.

pub mod callback;
pub mod callbacks;
pub mod checkpoint;
mod culprit;
pub mod run;

pub use callback::{Callback, CallbackSpec, Callbacks, Kept, State, Update};
pub use run::Run;

use conefield_core::backend::{Adam, BlockWork, TrainRay, Work};
use conefield_core::error::Result;
use std::time::Instant;

/// The random batch of a step.
pub struct Draw<'a> {
    /// Rays with measured line integrals.
    pub rays: &'a [TrainRay],
    /// Priors of the field.
    pub priors: Vec<BlockWork<'a>>,
    /// Prepares the batch of the next step while this one is computed, so that a device need not wait for it.
    pub ahead: Box<dyn FnOnce() + Send + 'a>,
}

/// The data of training.
pub trait Task {
    /// The batch of step `step` (from 0) of a run with `seed`.
    fn draw(&mut self, seed: u64, step: u64) -> Draw<'_>;
}

/// Trains to the end of the run. The model of `run` is then the result.
pub fn train(run: &mut Run<'_>, task: &mut dyn Task, callbacks: &mut Callbacks) -> Result<()> {
    callbacks.each(|c| c.begin(run))?;
    run.clock.resume();
    loop {
        callbacks.each(|c| c.between_steps(run))?;
        checkpoint::keep(run, callbacks)?;
        let over = run.clock.done(run.step) >= 1.0;
        if over {
            callbacks.each(|c| c.at_end(run))?;
            run.check_finite()?;
        }
        record(run, callbacks, over)?;
        if over || run.settled {
            break;
        }
        let masks = run.model.masks().len();
        callbacks.each(|c| c.before_step(run))?;
        if run.model.masks().len() > masks {
            callbacks.0.iter_mut().for_each(|c| c.masked());
        }
        step(run, task, callbacks)?;
        let share = run.clock.done(run.step).min(1.0);
        let left = run.clock.left(share);
        run.observer.progress(run.step, share, left);
    }
    run.clock.pause();
    run.exe.fetch(&mut run.model)?;
    callbacks.each(|c| c.finish(run))
}

/// One step: batch, gradients and, unless a callback refuses it, update.
fn step(run: &mut Run<'_>, task: &mut dyn Task, callbacks: &mut Callbacks) -> Result<()> {
    let (adam, loss) = (run.adam(), run.loss.clone());
    let Draw { rays, priors, ahead } = task.draw(run.job.seed, run.step);
    let work = Work { step: run.step, seed: run.job.seed, loss: loss.as_ref(), rays, points: &[], priors: &priors };
    let start = Instant::now();
    let stats = rayon::in_place_scope(|scope| {
        scope.spawn(|_| ahead());
        run.exe.step(&mut run.model, &work)
    })?;
    let mut update = Update::Take;
    for callback in &mut callbacks.0 {
        if update == Update::Take {
            update = callback.after_gradients(&work, &stats, run)?;
        }
    }
    if update == Update::Take && !(stats.loss.is_finite() && stats.prior.is_finite()) {
        let what = format!("the loss is {}, the prior {}", stats.loss, stats.prior);
        return Err(culprit::diverged(run, &work, &what));
    }
    run.step += 1;
    run.samples += stats.samples;
    if update == Update::Take {
        run.tally.updates += 1;
        let adam = Adam { lr: adam.lr * run.tally.rate, step: run.tally.updates, ..adam };
        run.exe.update(&mut run.model, &adam)?;
        run.tally.window.add(&stats, start.elapsed().as_secs_f64());
    }
    Ok(())
}

/// Part of a run without a record at most, so that the curve of a short run has ten points.
const LONGEST_GAP: f64 = 0.1;

/// Records the steps since the last record, if one is due.
fn record(run: &mut Run<'_>, callbacks: &mut Callbacks, over: bool) -> Result<()> {
    let share = run.clock.done(run.step);
    // After one more step it would be too late.
    let late = share + share / run.step.max(1) as f64 > run.tally.recorded + LONGEST_GAP + 1e-9;
    let due = run.step > 0 && (run.step.is_multiple_of(run.report_every) || late || over);
    if !due || run.tally.window.steps == 0 {
        return Ok(());
    }
    run.tally.recorded = share;
    run.clock.pause();
    let lr = run.tally.rate * run.adam().lr;
    let mut record = run.tally.window.record(run.step, run.clock.seconds(), lr);
    callbacks.each(|c| c.at_record(&mut record, run))?;
    if run.settled {
        record.events.push("the stopping rule is met".into());
        if !over {
            callbacks.each(|c| c.at_end(run))?;
            record.events.append(&mut run.tally.window.events);
        }
    }
    run.observer.record(&record);
    run.tally.window = run::Window::default();
    run.clock.resume();
    Ok(())
}
