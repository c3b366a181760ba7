//! Initializers.

#![allow(unsafe_code)]

use crate::library::{self, Functions, Handle, Text, Type};
use crate::trial::{UNTOUCHED, timed};
use conefield_core::arena::{Arena, Block, InitReport, Layout, Weights};
use conefield_core::error::{Error, Result};
use conefield_core::settings::{Initializer, KnownVolume};
use conefield_plugin_abi::*;
use serde_json::Value;
use std::ptr;
use std::sync::Arc;

/// An initializer of a library.
pub struct InitializerStage {
    handle: Handle,
    functions: ConefieldInitializer,
    volume: Option<KnownVolume>,
    describe: String,
}

/// Makes an initializer; `weights` reads a file that its settings name.
pub(crate) fn build(
    ty: &Arc<Type>,
    settings: &Value,
    weights: &dyn Fn(&str) -> Result<Weights>,
) -> Result<InitializerStage> {
    let Functions::Initializer(functions) = ty.functions else {
        return Err(ty.failed("create", CONEFIELD_FAILED, "it is no initializer"));
    };
    let (own, settings) = (ty.clone(), settings.clone());
    let (handle, path) = timed(ty, move || {
        let handle = own.create(&settings, 0)?;
        let path = named(&handle, "weights", |path| {
            // SAFETY: the stage is alive, `path` is to be written.
            functions.weights.map(|f| unsafe { f(handle.stage, path) })
        })?;
        Ok((handle, path))
    })?;
    let read = path.map(|p| weights(&p)).transpose()?;
    timed(ty, move || {
        let handle = match read {
            Some(weights) => with_weights(&handle, &functions, &weights)?,
            None => handle,
        };
        let mut steps = 0;
        let path = named(&handle, "volume", |path| {
            // SAFETY: the stage is alive, `path` and `steps` are to be written.
            functions.volume.map(|f| unsafe { f(handle.stage, path, &mut steps) })
        })?;
        let describe = handle.describe();
        Ok(InitializerStage { handle, functions, volume: path.map(|path| KnownVolume { path, steps }), describe })
    })
}

/// A name that the stage gives, if it has the function and anything to name.
fn named(
    handle: &Handle,
    call: &str,
    ask: impl FnOnce(&mut ConefieldStr) -> Option<ConefieldStatus>,
) -> Result<Option<String>> {
    let mut path = ConefieldStr { data: ptr::null(), length: 0 };
    match ask(&mut path) {
        None | Some(CONEFIELD_UNSUPPORTED) => Ok(None),
        // SAFETY: the plugin says that so many bytes stand there as long as the stage lives.
        Some(CONEFIELD_OK) => unsafe { library::text(path, &handle.ty.words(), call) }.map(Some),
        Some(status) => Err(handle.ty.failed(call, status, "")),
    }
}

/// The stage that has these weights.
fn with_weights(handle: &Handle, functions: &ConefieldInitializer, weights: &Weights) -> Result<Handle> {
    let tensor = |(name, (shape, values)): (&String, &(Vec<usize>, Vec<f32>))| ConefieldTensor {
        name: ConefieldStr::of(name),
        shape: shape.as_ptr(),
        dimensions: shape.len(),
        values: values.as_ptr(),
        length: values.len(),
    };
    let tensors: Vec<ConefieldTensor> = weights.tensors.iter().map(tensor).collect();
    let (mut out, mut error) = (ptr::null_mut(), Text::new());
    let status = functions.with_weights.map_or(CONEFIELD_FAILED, |f| {
        // SAFETY: the stage is alive; everything handed over lives for the time of the call and has the length beside it.
        unsafe { f(handle.stage, tensors.as_ptr(), tensors.len(), &mut out, error.room()) }
    });
    if status != CONEFIELD_OK {
        return Err(handle.ty.failed("with_weights", status, &error.text()));
    }
    let nothing = || Error::invalid(handle.ty.words(), "with_weights", "nothing", "a new stage");
    handle.made(out, "with_weights")?.ok_or_else(nothing)
}

/// Blocks as a library sees them.
fn blocks(layout: &Layout) -> Vec<ConefieldBlock> {
    let block = |b: &Block| ConefieldBlock {
        name: ConefieldStr::of(&b.name),
        shape: b.shape.as_ptr(),
        dimensions: b.shape.len(),
        start: b.range.start,
        length: b.range.len(),
    };
    layout.blocks.iter().map(block).collect()
}

/// Numbers behind the parameters that nobody may write to.
const GUARD: usize = 1 << 12;

impl Initializer for InitializerStage {
    fn check(&self, layout: &Layout) -> Result<()> {
        let Some(check) = self.functions.check else { return Ok(()) };
        let (blocks, mut error) = (blocks(layout), Text::new());
        // SAFETY: the stage is alive; everything handed over lives for the time of the call and has the length beside it.
        let status = unsafe { check(self.handle.stage, blocks.as_ptr(), blocks.len(), error.room()) };
        if status == CONEFIELD_OK { Ok(()) } else { Err(self.handle.ty.failed("check", status, &error.text())) }
    }

    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        let failed = |status, text: &str| self.handle.ty.failed("apply", status, text);
        let blocks = blocks(layout);
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

    fn volume(&self) -> Option<KnownVolume> {
        self.volume.clone()
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }
}
