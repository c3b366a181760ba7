//! Callbacks: they observe a training run and may act on it.

use super::run::Run;
use conefield_core::arena::Layout;
use conefield_core::backend::{StepStats, Work};
use conefield_core::checkpoint::Resume;
use conefield_core::error::{Error, Result};
use conefield_core::method::Record;
use conefield_core::pipeline::Pipeline;
use conefield_core::registry::Registered;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Settings of a callback.
pub trait CallbackSpec: Copied + Registered + Send + Sync {
    /// The callback, or why the settings are invalid.
    fn build(&self) -> Result<Box<dyn Callback>>;
}

/// Settings of a callback that can be copied.
pub trait Copied {
    /// A copy of the settings.
    fn copied(&self) -> Box<dyn CallbackSpec>;
}

impl<T: CallbackSpec + Clone + 'static> Copied for T {
    fn copied(&self) -> Box<dyn CallbackSpec> {
        Box::new(self.clone())
    }
}

conefield_core::settings_of!(Callback, CallbackSpec);

impl Clone for Box<dyn CallbackSpec> {
    fn clone(&self) -> Self {
        (**self).copied()
    }
}

/// Whether to use a step's gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Update {
    /// Update the parameters.
    Take,
    /// Discard the gradients: the callback has changed the run's state.
    Leave,
}

/// Observes a run alongside the training loop. By default, each method does nothing.
///
/// Order of calls per iteration: [`between_steps`](Self::between_steps), checkpoint, at the end of the run
/// [`at_end`](Self::at_end), then [`at_record`](Self::at_record), [`before_step`](Self::before_step),
/// [`after_gradients`](Self::after_gradients), update.
pub trait Callback: Send {
    /// Its name, the key of its state in a checkpoint.
    fn name(&self) -> &'static str;

    /// Refuses an unsuitable pipeline before training.
    fn check(&self, _pipeline: &Pipeline) -> Result<()> {
        Ok(())
    }

    /// Called before the first step of a run; in a resumed run, after [`Callback::restore`].
    fn begin(&mut self, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// Called between two steps, before a checkpoint. A resumed run calls it again.
    fn between_steps(&mut self, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// Called after the last step, before the last record; if that record ends the run, after [`at_record`](Self::at_record).
    fn at_end(&mut self, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// Called for each record: may add to it, or end the run with it ([`Run::settled`]).
    fn at_record(&mut self, _record: &mut Record, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// Called before each step.
    fn before_step(&mut self, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// Called after channels were removed from the model: stored parameters or features no longer match.
    fn masked(&mut self) {}

    /// Called between gradients and update.
    fn after_gradients(&mut self, _work: &Work<'_>, _stats: &StepStats, _run: &mut Run<'_>) -> Result<Update> {
        Ok(Update::Take)
    }

    /// Called after training: may change the result.
    fn finish(&mut self, _run: &mut Run<'_>) -> Result<()> {
        Ok(())
    }

    /// The state for a checkpoint.
    fn state<'a>(&'a self, _layout: &'a Layout) -> Result<State<'a>> {
        Ok(State::default())
    }

    /// Restores the result of [`Callback::state`].
    fn restore(&mut self, kept: &Kept<'_>, _run: &Run<'_>) -> Result<()> {
        kept.value()
    }

    /// Whether it uses held-out views.
    fn needs_held_out(&self) -> bool {
        false
    }

    /// Bytes for this many parameters.
    fn bytes(&self, _parameters: u64) -> u64 {
        0
    }

    /// Description of its settings.
    fn describe(&self) -> Option<String> {
        None
    }
}

/// The state of a callback for a checkpoint.
#[derive(Debug, Default)]
pub struct State<'a> {
    /// Serialized values.
    pub value: Value,
    /// Name, shape and values of its tensors; names begin with the callback's name and a dot.
    pub tensors: Vec<(String, &'a [usize], &'a [f32])>,
}

impl<'a> State<'a> {
    /// The state of the callback `name`.
    pub fn new(name: &str, value: &impl Serialize, tensors: Vec<(String, &'a [usize], &'a [f32])>) -> Result<Self> {
        let value = serde_json::to_value(value).map_err(|e| Error::unsupported(name, e.to_string()))?;
        Ok(Self { value, tensors })
    }
}

/// The state of a callback from a checkpoint.
pub struct Kept<'a> {
    /// The checkpoint.
    pub resume: &'a Resume,
    /// The callback's name.
    pub name: &'static str,
    /// Serialized values.
    pub value: &'a Value,
}

impl Kept<'_> {
    /// The deserialized values.
    pub fn value<T: DeserializeOwned>(&self) -> Result<T> {
        let expected = "the state of this callback";
        serde_json::from_value(self.value.clone())
            .map_err(|e| Error::invalid(&self.resume.place, self.name, e, expected))
    }

    /// One of its tensors, of this shape.
    pub fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        self.resume.shaped(name, shape).map(<[f32]>::to_vec)
    }

    /// Reads the parts of an arena that [`tensors_of`](conefield_core::checkpoint::tensors_of) stored under the
    /// callback's name.
    pub fn parts(&self, layout: &Layout, parts: &mut [&mut [f32]]) -> Result<()> {
        self.resume.load(&format!("{}.", self.name), layout, parts)
    }
}

/// The callbacks of a run, in calling order.
pub struct Callbacks(pub Vec<Box<dyn Callback>>);

impl Callbacks {
    /// Calls each.
    pub fn each(&mut self, mut call: impl FnMut(&mut dyn Callback) -> Result<()>) -> Result<()> {
        self.0.iter_mut().try_for_each(|c| call(c.as_mut()))
    }
}
