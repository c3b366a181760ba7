//! Priors of a field.

#![allow(unsafe_code)]

use super::{Fault, fragment};
use crate::library::{Functions, Handle, Text, Type};
use crate::trial;
use conefield_core::error::Result;
use conefield_core::prior::{Blocks, Prior};
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::sync::Arc;

/// A prior of a library.
pub struct PriorStage {
    handle: Handle,
    functions: ConefieldPrior,
    blocks: Blocks,
    describe: String,
    fault: Fault,
}

/// Makes a prior and tries it out.
pub(crate) fn build(ty: &Arc<Type>, settings: &Value) -> Result<PriorStage> {
    let (own, settings) = (ty.clone(), settings.clone());
    trial::timed(ty, move || PriorStage::tried(own.create(&settings, 0)?))
}

impl PriorStage {
    /// The prior behind `handle`, tried out.
    fn tried(handle: Handle) -> Result<Self> {
        let Functions::Prior(functions) = handle.ty.functions else {
            return Err(handle.ty.failed("create", CONEFIELD_FAILED, "it is no prior"));
        };
        let mut b = ConefieldBlocks { edge: 0, count: 0, spacing: 0.0, weight: 0.0 };
        // SAFETY: the stage is alive, `b` is to be written.
        let status = functions.blocks.map_or(CONEFIELD_FAILED, |blocks| unsafe { blocks(handle.stage, &mut b) });
        if status != CONEFIELD_OK {
            return Err(handle.ty.failed("blocks", status, ""));
        }
        let blocks = Blocks { edge: b.edge, count: b.count, spacing: b.spacing, weight: b.weight };
        blocks.validate().map_err(|e| handle.ty.failed("blocks", CONEFIELD_FAILED, &e.to_string()))?;
        let describe = handle.describe();
        let stage = Self { handle, functions, blocks, describe, fault: Fault::default() };
        trial::prior(&stage.handle.ty, blocks.points(), |values, gradient| {
            stage.penalty(values, 1.0, gradient.as_mut_ptr())
        })?;
        Ok(stage)
    }

    /// The penalty of `values`; adds as many derivatives to `gradient`.
    fn penalty(&self, values: &[f64], scale: f64, gradient: *mut f64) -> Result<f64> {
        let mut penalty = f64::NAN;
        let mut error = Text::new();
        let (count, values) = (values.len(), values.as_ptr());
        let status = self.functions.block.map_or(CONEFIELD_FAILED, |block| {
            // SAFETY: the stage is alive, and there are `count` numbers at both pointers.
            unsafe { block(self.handle.stage, values, count, scale, gradient, &mut penalty, error.room()) }
        });
        if status == CONEFIELD_OK { Ok(penalty) } else { Err(self.handle.ty.failed("block", status, &error.text())) }
    }
}

impl Prior for PriorStage {
    fn blocks(&self) -> Blocks {
        self.blocks
    }

    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        debug_assert_eq!(values.len(), gradient.len());
        self.penalty(values, scale, gradient.as_mut_ptr()).unwrap_or_else(|e| {
            self.fault.set(e);
            f64::NAN
        })
    }

    fn wgsl(&self) -> Option<Fragment> {
        fragment(&self.handle, self.functions.wgsl)
    }

    fn fault(&self) -> Result<()> {
        self.fault.take()
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }
}
