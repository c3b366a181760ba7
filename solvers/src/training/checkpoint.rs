//! Checkpoints of a run: the model, the run's counters, and the state of every callback under its name.

use super::callback::{Callbacks, Kept};
use super::run::{Run, Tally, strayed};
use conefield_core::checkpoint::{Checkpoint, Resume, Standing, tensors};
use conefield_core::error::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// The content of a checkpoint besides the model.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Whole<T> {
    run: T,
    callbacks: BTreeMap<String, Value>,
}

/// Writes a checkpoint if one is due, and ends an interrupted run.
pub fn keep(run: &mut Run<'_>, callbacks: &Callbacks) -> Result<()> {
    let cancelled = run.observer.cancelled();
    // The state from which a run was resumed needs no checkpoint.
    let begun = run.step > run.job.resume.map_or(0, |r| r.standing.step);
    if begun && (cancelled || run.observer.checkpoint_due()) {
        run.clock.pause();
        run.exe.fetch(&mut run.model)?;
        // A state that is not finite, which a callback has yet to detect, is not saved: an earlier checkpoint stays.
        if strayed(&run.model.arena).is_none() {
            let layout = run.model.pipeline.layout();
            let mut tensors = tensors(&run.model);
            let mut values = BTreeMap::new();
            for callback in &callbacks.0 {
                let state = callback.state(layout)?;
                values.insert(callback.name().to_owned(), state.value);
                tensors.extend(state.tensors);
            }
            let method = serde_json::to_value(Whole { run: &run.tally, callbacks: values });
            let standing = Standing {
                step: run.step,
                // The record of this step, if due, follows the checkpoint.
                recorded: run.step.saturating_sub(1),
                samples: run.samples,
                seconds: run.clock.seconds(),
                masks: run.model.masks().to_vec(),
                method: method.map_err(|e| Error::unsupported("checkpoint", e.to_string()))?,
            };
            run.observer.keep(&Checkpoint { tensors, standing }, cancelled)?;
        }
        run.clock.resume();
    }
    if cancelled { Err(Error::Interrupted { step: run.step }) } else { Ok(()) }
}

/// Restores a run, whose model is already restored, and its callbacks from `resume`. Refuses a missing state, and a
/// state that belongs to no part of the run.
pub fn restore(run: &mut Run<'_>, callbacks: &mut Callbacks, resume: &Resume) -> Result<()> {
    let whole: Whole<Tally> = serde_json::from_value(resume.standing.method.clone())
        .map_err(|e| Error::invalid(&resume.place, "method", e, "the state of a training run"))?;
    (run.step, run.samples, run.tally) = (resume.standing.step, resume.standing.samples, whole.run);
    let mut known: BTreeSet<String> = tensors(&run.model).into_iter().map(|t| t.0).collect();
    for callback in &mut callbacks.0 {
        let name = callback.name();
        let value = whole.callbacks.get(name);
        let value =
            value.ok_or_else(|| Error::invalid(&resume.place, name, "nothing", "the state of this callback"))?;
        callback.restore(&Kept { resume, name, value }, run)?;
        known.extend(callback.state(run.model.pipeline.layout())?.tensors.into_iter().map(|t| t.0));
    }
    let names: Vec<&str> = callbacks.0.iter().map(|c| c.name()).collect();
    if let Some(other) = whole.callbacks.keys().find(|k| !names.contains(&k.as_str())) {
        let expected = format!("the callbacks of this run: {}", names.join(", "));
        return Err(Error::invalid(&resume.place, other, "the state of a callback that does not run", expected));
    }
    match resume.names().find(|k| !known.contains(*k)) {
        Some(other) => Err(Error::invalid(&resume.place, other, "a tensor", "only what this run keeps")),
        None => Ok(()),
    }
}
