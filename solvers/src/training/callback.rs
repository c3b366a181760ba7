//! What a callback is: something beside the training loop that looks at a run and may act on it.

use super::run::Run;
use conefield_core::arena::Layout;
use conefield_core::backend::{StepStats, Work};
use conefield_core::checkpoint::Resume;
use conefield_core::error::{Error, Result};
use conefield_core::method::Record;
use conefield_core::pipeline::Pipeline;
use conefield_core::registry::Kind;
use conefield_core::registry::Settings;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::fmt::Debug;

/// Settings of a callback.
#[typetag::serde(tag = "type")]
pub trait CallbackSpec: Debug + Send + Sync {
    /// The callback, or why the settings make none.
    fn build(&self) -> Result<Box<dyn Callback>>;
    /// The same settings again.
    fn copy(&self) -> Box<dyn CallbackSpec>;
}

impl Settings for dyn CallbackSpec {
    const KIND: Kind = Kind::Callback;
}

impl Clone for Box<dyn CallbackSpec> {
    fn clone(&self) -> Self {
        self.copy()
    }
}

/// Whether a step's gradients are used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Update {
    /// The parameters are updated with them.
    Take,
    /// They are left: the callback has put the run into another state.
    Leave,
}

/// Looks at a run beside the training loop. A method that a callback does not write does nothing.
///
/// A loop goes: [`between_steps`](Self::between_steps), checkpoint, at the end of the run [`at_end`](Self::at_end), then
/// [`at_record`](Self::at_record), [`before_step`](Self::before_step), [`after_gradients`](Self::after_gradients), update.
pub trait Callback: Send {
    /// Its name: the key of its state in a checkpoint.
    fn name(&self) -> &'static str;

    /// Refuses a pipeline that it cannot work on, before anything is trained.
    fn check(&self, pipeline: &Pipeline) -> Result<()> {
        let _ = pipeline;
        Ok(())
    }

    /// Before the first step of a run, of a resumed one after [`Callback::restore`].
    fn begin(&mut self, run: &mut Run<'_>) -> Result<()> {
        let _ = run;
        Ok(())
    }

    /// Between two steps, before a checkpoint. A resumed run calls it again.
    fn between_steps(&mut self, run: &mut Run<'_>) -> Result<()> {
        let _ = run;
        Ok(())
    }

    /// After the last step of a run that its limits end, before the last record.
    fn at_end(&mut self, run: &mut Run<'_>) -> Result<()> {
        let _ = run;
        Ok(())
    }

    /// When a record is made: may add to it, or end the run with it ([`Run::settled`]).
    fn at_record(&mut self, record: &mut Record, run: &mut Run<'_>) -> Result<()> {
        let _ = (record, run);
        Ok(())
    }

    /// Before a step that follows.
    fn before_step(&mut self, run: &mut Run<'_>) -> Result<()> {
        let _ = run;
        Ok(())
    }

    /// Channels have left the model: what is kept of its parameters or features no longer fits.
    fn masked(&mut self) {}

    /// Between gradients and update.
    fn after_gradients(&mut self, work: &Work<'_>, stats: &StepStats, run: &mut Run<'_>) -> Result<Update> {
        let _ = (work, stats, run);
        Ok(Update::Take)
    }

    /// After training: may change what comes out.
    fn finish(&mut self, run: &mut Run<'_>) -> Result<()> {
        let _ = run;
        Ok(())
    }

    /// What it needs to go on from a checkpoint.
    fn state<'a>(&'a self, layout: &'a Layout) -> Result<State<'a>> {
        let _ = layout;
        Ok(State::default())
    }

    /// Takes back what [`Callback::state`] gave.
    fn restore(&mut self, kept: &Kept<'_>, run: &Run<'_>) -> Result<()> {
        let _ = run;
        kept.value()
    }

    /// Whether it looks at views that are kept aside.
    fn needs_held_out(&self) -> bool {
        false
    }

    /// Bytes that it holds for so many parameters.
    fn bytes(&self, parameters: u64) -> u64 {
        let _ = parameters;
        0
    }

    /// Its settings in words.
    fn describe(&self) -> Option<String> {
        None
    }
}

/// The state of a callback for a checkpoint.
#[derive(Debug, Default)]
pub struct State<'a> {
    /// What it knows.
    pub value: Value,
    /// Name, shape and values of what it keeps; names begin with that of the callback and a point.
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
    /// What it knew.
    pub value: &'a Value,
}

impl Kept<'_> {
    /// What it knew, as it wrote it.
    pub fn value<T: DeserializeOwned>(&self) -> Result<T> {
        let expected = "what this callback keeps";
        T::deserialize(self.value).map_err(|e| Error::invalid(&self.resume.place, self.name, e, expected))
    }

    /// One of its tensors, of this shape.
    pub fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        self.resume.shaped(name, shape).map(<[f32]>::to_vec)
    }

    /// The parts of an arena that [`tensors_of`](conefield_core::checkpoint::tensors_of) named after the callback.
    pub fn parts<const N: usize>(&self, layout: &Layout, parts: [&mut [f32]; N]) -> Result<()> {
        self.resume.load(&format!("{}.", self.name), layout, parts)
    }
}

/// The callbacks of a run, in the order in which they are called.
pub struct Callbacks(pub Vec<Box<dyn Callback>>);

impl Callbacks {
    /// Calls each.
    pub fn each(&mut self, mut call: impl FnMut(&mut dyn Callback) -> Result<()>) -> Result<()> {
        self.0.iter_mut().try_for_each(|c| call(c.as_mut()))
    }
}
