//! Ordinary stages made of a library's.

#![allow(unsafe_code)]

pub mod basis;
pub mod data_term;
pub mod initializer;
pub mod loss;
pub mod map;
pub mod prior;
pub mod projector;
pub mod regularizer;

use crate::library::{FunctionsOf, Handle, Text, Type, whole_text};
use crate::trial;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::VoxelGrid;
use conefield_core::stage::UnitRay;
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::ffi::c_void;
use std::ptr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// What a stage's functions could not do since it was last asked for: the first of it.
#[derive(Default)]
struct Fault {
    there: AtomicBool,
    first: Mutex<Option<Error>>,
}

impl Fault {
    fn set(&self, error: Error) {
        self.first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        self.there.store(true, Ordering::Release);
    }

    fn take(&self) -> Result<()> {
        if !self.there.load(Ordering::Acquire) {
            return Ok(());
        }
        self.there.store(false, Ordering::Release);
        self.first.lock().unwrap_or_else(PoisonError::into_inner).take().map_or(Ok(()), Err)
    }
}

/// A stage of a library with the functions of its kind: what every adapter holds.
pub(crate) struct Foreign<F> {
    handle: Handle,
    functions: F,
    describe: String,
    fault: Fault,
}

/// Makes a stage and tries it out, both within the time limit.
pub(crate) fn build<T: Send + 'static>(
    ty: &Arc<Type>,
    settings: &Value,
    width: usize,
    tried: impl FnOnce(Handle) -> Result<T> + Send + 'static,
) -> Result<T> {
    let (own, settings) = (ty.clone(), settings.clone());
    trial::timed(ty, move || tried(own.create(&settings, width)?))
}

impl<F: FunctionsOf> Foreign<F> {
    fn new(handle: Handle) -> Result<Self> {
        let another = || handle.ty.failed("create", CONEFIELD_FAILED, "it is of another kind");
        let functions = F::of(handle.ty.functions).ok_or_else(another)?;
        let describe = handle.describe();
        Ok(Self { handle, functions, describe, fault: Fault::default() })
    }

    /// The type that it is of.
    fn ty(&self) -> &Arc<Type> {
        &self.handle.ty
    }

    /// What is wrong with what `call` gave.
    fn wrong(&self, call: &str, what: &str) -> Error {
        self.ty().failed(call, CONEFIELD_FAILED, what)
    }

    /// Makes the call `f`, which gets the stage and room for a reason. One that fails is an error that names `call`.
    fn run(&self, call: &str, f: impl FnOnce(*mut c_void, *mut ConefieldText) -> ConefieldStatus) -> Result<()> {
        let mut error = Text::new();
        match f(self.handle.stage, error.room()) {
            CONEFIELD_OK => Ok(()),
            status => Err(self.ty().failed(call, status, &error.text())),
        }
    }

    /// As [`Foreign::run`], of a call that may say that there is no answer: whether there is one.
    fn asked(&self, call: &str, f: impl FnOnce(*mut c_void, *mut ConefieldText) -> ConefieldStatus) -> Result<bool> {
        let mut known = true;
        self.run(call, |stage, error| {
            let status = f(stage, error);
            known = status != CONEFIELD_UNSUPPORTED;
            if known { status } else { CONEFIELD_OK }
        })?;
        Ok(known)
    }

    /// What came of a call that has no result; what went wrong is a fault, and `instead` stands for it.
    fn noted<T>(&self, result: Result<T>, instead: T) -> T {
        result.unwrap_or_else(|e| {
            self.fault.set(e);
            instead
        })
    }

    /// The WGSL of the stage, if it has any.
    fn fragment(&self, wgsl: Option<WgslFn>) -> Option<Fragment> {
        let wgsl = wgsl?;
        // SAFETY: the stage is alive; everything handed over lives for the time of the call.
        let source = whole_text(|room| unsafe { wgsl(self.handle.stage, room) }).ok()?;
        Some(Fragment { source })
    }

    /// The stage that `call` makes of this one by `f`, which writes where to find it; nothing if it makes none. A refusal of
    /// settings names the setting.
    fn make(
        &self,
        call: &str,
        f: impl FnOnce(*mut c_void, *mut *mut c_void, *mut ConefieldText) -> ConefieldStatus,
    ) -> Result<Option<Handle>> {
        let (mut made, mut error) = (ptr::null_mut(), Text::new());
        match f(self.handle.stage, &mut made, error.room()) {
            CONEFIELD_OK => self.handle.made(made, call),
            status => Err(self.ty().refusal(call, status, &error.text())),
        }
    }

    /// As [`Foreign::make`], of a call that always makes a stage.
    fn must_make(
        &self,
        call: &str,
        f: impl FnOnce(*mut c_void, *mut *mut c_void, *mut ConefieldText) -> ConefieldStatus,
    ) -> Result<Handle> {
        self.make(call, f)?.ok_or_else(|| Error::invalid(self.ty().words(), call, "nothing", "a new stage"))
    }
}

/// Calls a function of a stage with the arguments between the stage and the room for a reason. What it is handed must live
/// for the time of the call and have the lengths that go with it.
macro_rules! call {
    ($own:expr, $function:ident($($argument:expr),* $(,)?)) => {
        match $own.functions.$function {
            // SAFETY: the stage is alive; the rest is as said above.
            Some(f) => $own.run(stringify!($function), |stage, error| unsafe { f(stage, $($argument,)* error) }),
            None => Err($own.wrong(stringify!($function), "there is no such function")),
        }
    };
}
use call;

type WgslFn = unsafe extern "C" fn(*const c_void, *mut ConefieldText) -> ConefieldStatus;

/// A grid as a library sees it.
fn raw_grid(grid: &VoxelGrid) -> ConefieldGrid {
    let VoxelGrid { shape, spacing, center } = *grid;
    ConefieldGrid { shape, spacing, center }
}

/// A small grid on which pieces of iterative methods are tried.
const SMALL: VoxelGrid = VoxelGrid { shape: [5, 4, 6], spacing: [1.0, 0.8, 1.5], center: [0.0; 3] };

/// A ray as a library sees it.
fn raw_ray(ray: &UnitRay) -> ConefieldRay {
    let UnitRay { origin, direction, inside, published, per_mm } = *ray;
    ConefieldRay { origin, direction, inside, published, per_mm }
}
