//! Initializers.

#![allow(unsafe_code)]

use crate::library::{Functions, Handle, Text, Type};
use crate::trial::{UNTOUCHED, timed};
use conefield_core::arena::{Arena, InitReport, Layout};
use conefield_core::error::Result;
use conefield_core::settings::Initializer;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::sync::Arc;

/// An initializer of a library.
pub struct InitializerStage {
    handle: Handle,
    functions: ConefieldInitializer,
    describe: String,
}

/// Makes an initializer.
pub(crate) fn build(ty: &Arc<Type>, settings: &Value) -> Result<InitializerStage> {
    let (own, settings) = (ty.clone(), settings.clone());
    timed(ty, move || {
        let handle = own.create(&settings, 0)?;
        let Functions::Initializer(functions) = own.functions else {
            return Err(own.failed("create", CONEFIELD_FAILED, "it is no initializer"));
        };
        let describe = handle.describe();
        Ok(InitializerStage { handle, functions, describe })
    })
}

/// Numbers behind the parameters that nobody may write to.
const GUARD: usize = 1 << 12;

impl Initializer for InitializerStage {
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        let failed = |status, text: &str| self.handle.ty.failed("apply", status, text);
        let block = |b: &conefield_core::arena::Block| ConefieldBlock {
            name: ConefieldStr::of(&b.name),
            shape: b.shape.as_ptr(),
            dimensions: b.shape.len(),
            start: b.range.start,
            length: b.range.len(),
        };
        let blocks: Vec<ConefieldBlock> = layout.blocks.iter().map(block).collect();
        // A copy, so that what it does wrong does no harm.
        let mut params = arena.params.to_vec();
        params.resize(arena.params.len() + GUARD, f32::from_bits(UNTOUCHED));
        let mut filled = vec![0u8; blocks.len()];
        let mut error = Text::new();
        let n = arena.params.len();
        let status = self.functions.apply.map_or(CONEFIELD_FAILED, |apply| {
            // SAFETY: the stage is alive; everything handed over lives for the time of the call and has the length beside it.
            unsafe {
                apply(
                    self.handle.stage,
                    blocks.as_ptr(),
                    blocks.len(),
                    params.as_mut_ptr(),
                    n,
                    filled.as_mut_ptr(),
                    error.room(),
                )
            }
        });
        if status != CONEFIELD_OK {
            return Err(failed(status, &error.text()));
        }
        if params[n..].iter().any(|v| v.to_bits() != UNTOUCHED) {
            return Err(failed(CONEFIELD_FAILED, "it writes past the parameters"));
        }
        let mut report = InitReport::default();
        for (b, &filled) in layout.blocks.iter().zip(&filled) {
            if filled == 0 {
                report.fresh.push((b.name.clone(), "not filled".into()));
                continue;
            }
            let from = &params[b.range.clone()];
            if let Some(v) = from.iter().find(|v| !v.is_finite()) {
                return Err(failed(CONEFIELD_FAILED, &format!("{} holds {v}", b.name)));
            }
            arena.params[b.range.clone()].copy_from_slice(from);
            report.loaded.push(b.name.clone());
        }
        Ok(report)
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }
}
