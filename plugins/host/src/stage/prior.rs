//! Priors of a field.

#![allow(unsafe_code)]

use super::{Foreign, ask, call, said};
use crate::library::Handle;
use crate::trial;
use conefield_core::prelude::*;
use conefield_plugin_abi::*;

/// A prior from a library.
pub struct PriorStage {
    own: Foreign<ConefieldPrior>,
    blocks: Blocks,
}

impl PriorStage {
    /// The prior of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let own = Foreign::<ConefieldPrior>::new(handle)?;
        let mut b = ConefieldBlocks::default();
        ask!(own, blocks(&mut b))?;
        let blocks = Blocks { edge: b.edge, count: b.count, spacing: b.spacing, weight: b.weight };
        blocks.validate().map_err(|e| own.wrong("blocks", &e.to_string()))?;
        let stage = Self { own, blocks };
        trial::prior(stage.own.ty(), blocks.points(), |values, gradient| {
            stage.penalty(values, 1.0, gradient.as_mut_ptr())
        })?;
        Ok(stage)
    }

    /// The penalty of `values`; adds one derivative per value to `gradient`.
    fn penalty(&self, values: &[f64], scale: f64, gradient: *mut f64) -> Result<f64> {
        let mut penalty = f64::NAN;
        call!(self.own, block(values.as_ptr(), values.len(), scale, gradient, &mut penalty))?;
        Ok(penalty)
    }
}

impl Prior for PriorStage {
    fn blocks(&self) -> Blocks {
        self.blocks
    }

    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        assert_eq!(values.len(), gradient.len(), "a derivative for each value");
        self.own.noted(self.penalty(values, scale, gradient.as_mut_ptr()), f64::NAN)
    }

    said! { own: describe fault wgsl }
}
