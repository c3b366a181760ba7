//! Ends training when views that are kept aside are no longer predicted better, and keeps the state that predicted them best.

use crate::guard::strayed;
use conefield_core::arena::Layout;
use conefield_core::backend::Executable;
use conefield_core::checkpoint::{Resume, tensors_of};
use conefield_core::error::Result;
use conefield_core::pages::Pages;
use conefield_core::pipeline::Model;
use conefield_core::solver::{Best, Record};
use serde::{Deserialize, Serialize};

/// Under this name the best state goes into a checkpoint.
const NAME: &str = "best.";

/// What is known beside the best state.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Waited {
    /// The best record so far; starts anew when channels leave the work.
    best: Option<Best>,
    /// Records since.
    since: u64,
}

/// Looks at every record.
pub struct Patience {
    most: Option<u64>,
    waited: Waited,
    copy: Option<Copy>,
}

/// Parameters that predicted best.
struct Copy {
    params: Pages,
    masks: usize,
}

impl Patience {
    /// Lets `most` records pass without a better one; none looks at nothing.
    pub fn new(most: Option<u64>) -> Self {
        Self { most, waited: Waited::default(), copy: None }
    }

    /// Goes on where a checkpoint stood, with its best state.
    pub fn resume(&mut self, waited: Waited, resume: &Resume, model: &Model) -> Result<()> {
        if waited.best.is_some() {
            let layout = model.pipeline.layout();
            let mut params = Pages::zeros(layout.len());
            resume.load(NAME, layout, [&mut *params])?;
            self.copy = Some(Copy { params, masks: model.masks().len() });
        }
        self.waited = waited;
        Ok(())
    }

    /// What [`Patience::resume`] needs beside [`Patience::tensors`].
    pub fn waited(&self) -> &Waited {
        &self.waited
    }

    /// The best state, for a checkpoint.
    pub fn tensors<'a>(&'a self, layout: &'a Layout) -> Vec<(String, &'a [usize], &'a [f32])> {
        self.copy.iter().flat_map(|c| tensors_of(NAME, layout, [&*c.params])).collect()
    }

    /// To be called after channels may have left the work: what more of them came to is no state of this model.
    pub fn renew(&mut self, model: &Model) {
        if self.copy.as_ref().is_some_and(|c| c.masks != model.masks().len()) {
            (self.waited, self.copy) = (Waited::default(), None);
        }
    }

    /// Looks at a record of the model as it is: whether too many have passed without a better one.
    pub fn judge(&mut self, record: &Record, model: &mut Model, exe: &mut dyn Executable) -> Result<bool> {
        let (Some(most), Some(held_out)) = (self.most, record.held_out) else { return Ok(false) };
        let better = held_out.is_finite() && self.waited.best.is_none_or(|b| held_out < b.held_out);
        if better && self.keep(model, exe)? {
            self.waited = Waited { best: Some(Best { step: record.step, held_out }), since: 0 };
        } else if self.waited.best.is_some() {
            self.waited.since += 1;
        }
        Ok(self.waited.since >= most)
    }

    /// Copies the parameters, unless the state is not finite: the guard has yet to find that out.
    fn keep(&mut self, model: &mut Model, exe: &mut dyn Executable) -> Result<bool> {
        exe.fetch(model)?;
        if strayed(&model.arena).is_some() {
            return Ok(false);
        }
        let (params, masks) = (&model.arena.params, model.masks().len());
        match &mut self.copy {
            Some(copy) => copy.params.copy_from_slice(params),
            None => self.copy = Some(Copy { params: params.clone(), masks }),
        }
        Ok(true)
    }

    /// Brings the best state into `model`; which record it was.
    pub fn finish(self, model: &mut Model) -> Option<Best> {
        let (copy, best) = self.copy.zip(self.waited.best)?;
        model.arena.params.copy_from_slice(&copy.params);
        Some(best)
    }
}
