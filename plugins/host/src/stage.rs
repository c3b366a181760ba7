//! Ordinary stages made of a library's.

pub mod initializer;
pub mod map;
pub mod projector;

use conefield_core::error::Error;
use conefield_core::error::Result;
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
