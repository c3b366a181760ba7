//! Ordinary stages made of a library's.

#![allow(unsafe_code)]

pub mod initializer;
pub mod loss;
pub mod map;
pub mod prior;
pub mod projector;

use crate::library::{Handle, whole_text};
use conefield_core::error::{Error, Result};
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

/// What a stage's functions could not do since it was last asked for: the first of it.
#[derive(Default)]
pub(crate) struct Fault {
    there: AtomicBool,
    first: Mutex<Option<Error>>,
}

impl Fault {
    pub fn set(&self, error: Error) {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        self.there.store(true, Ordering::Release);
    }

    pub fn take(&self) -> Result<()> {
        if !self.there.load(Ordering::Acquire) {
            return Ok(());
        }
        self.there.store(false, Ordering::Release);
        self.first.lock().unwrap_or_else(PoisonError::into_inner).take().map_or(Ok(()), Err)
    }
}

type WgslFn = unsafe extern "C" fn(*const c_void, *mut ConefieldText) -> ConefieldStatus;

/// The WGSL of a stage, if it has any.
pub(crate) fn fragment(handle: &Handle, wgsl: Option<WgslFn>) -> Option<Fragment> {
    let wgsl = wgsl?;
    // SAFETY: the stage is alive; everything handed over lives for the time of the call.
    let ask = |room| unsafe { wgsl(handle.stage, room) };
    let source = whole_text(ask).ok()?;
    Some(Fragment { source })
}
