//! Ordinary stages that wrap a library's.

#![allow(unsafe_code)]

pub mod basis;
pub mod data_term;
pub mod initializer;
pub mod loss;
pub mod map;
pub mod prior;
pub mod projector;
pub mod regularizer;

// The modules of the kinds take these imports by `use super::*`.
use crate::exit::inside;
use crate::library::{Handle, Text, Type, text, whole_text};
use crate::spec::settings;
use crate::trial::{GUARD, Guarded, Marked, below_zero, drawn, settled, timed};
use conefield_core::prelude::*;
use conefield_core::wgsl::FOREIGN;
use conefield_plugin_abi::*;
use ndarray::Array3;
use std::collections::BTreeSet;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::{ptr, slice};

/// Bytes that no stage holds: a larger number, such as that of a panic, counts as this one.
const MOST_BYTES: u64 = 1 << 60;

/// The first error of a stage's functions since the last query.
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

/// A stage of a library with the functions of its kind, shared by all adapters.
pub(crate) struct Foreign<F> {
    handle: Handle,
    functions: F,
    describe: String,
    fault: Fault,
}

impl<F: Copy + 'static> Foreign<F> {
    fn new(handle: Handle) -> Result<Self> {
        let another = || handle.ty.failed("create", CONEFIELD_FAILED, "it is of another kind");
        let functions = *handle.ty.functions.downcast_ref().ok_or_else(another)?;
        let describe = handle.describe()?;
        Ok(Self { handle, functions, describe, fault: Fault::default() })
    }

    /// Its type.
    fn ty(&self) -> &Arc<Type> {
        &self.handle.ty
    }

    /// The error for a wrong result of `call`.
    fn wrong(&self, call: &str, what: &str) -> Error {
        Error::unsupported(self.ty().words(), format!("{call}: {what}"))
    }

    /// Refuses a wrong result of `call`.
    fn require(&self, holds: bool, call: &str, what: impl FnOnce() -> String) -> Result<()> {
        if holds { Ok(()) } else { Err(self.wrong(call, &what())) }
    }

    /// Calls `f` with the stage and a buffer for the reason. Errors name `call`.
    fn run(&self, call: &str, f: impl FnOnce(*mut c_void, *mut ConefieldText) -> ConefieldStatus) -> Result<()> {
        let mut error = Text::new();
        match inside(|| f(self.handle.stage, error.room())) {
            CONEFIELD_OK => Ok(()),
            status => Err(self.ty().failed(call, status, &error.text())),
        }
    }

    /// As [`Foreign::run`], for a call that may have no answer; returns whether there is one.
    fn asked(&self, call: &str, f: impl FnOnce(*mut c_void, *mut ConefieldText) -> ConefieldStatus) -> Result<bool> {
        let mut known = true;
        self.run(call, |stage, error| {
            let status = f(stage, error);
            known = status != CONEFIELD_UNSUPPORTED;
            if known { status } else { CONEFIELD_OK }
        })?;
        Ok(known)
    }

    /// Refuses the stage with the complaint of its trial, if there is one.
    fn settled(&self, complaint: Option<String>) -> Result<()> {
        settled(self.ty(), complaint)
    }

    /// The value of a call that cannot return an error: records the error as a fault and returns `instead`.
    fn noted<T>(&self, result: Result<T>, instead: T) -> T {
        result.unwrap_or_else(|e| {
            self.fault.set(e);
            instead
        })
    }

    /// The end of a call that fills `out`: records its error and leaves NaN.
    fn filled<R: Real>(&self, result: Result<()>, out: &mut [R]) {
        if let Err(e) = result {
            self.fault.set(e);
            out.fill(R::of(f64::NAN));
        }
    }

    /// The WGSL of the stage, if any.
    fn fragment(&self, wgsl: Option<WgslFn>) -> Option<Fragment> {
        let wgsl = wgsl?;
        // SAFETY: the stage is alive; all arguments live during the call.
        match whole_text(|room| unsafe { wgsl(self.handle.stage, room) }) {
            Ok(source) => Some(Fragment { source: format!("{source}\n{FOREIGN}") }),
            Err((CONEFIELD_UNSUPPORTED, _)) => None,
            Err((status, why)) => {
                self.fault.set(self.ty().failed("wgsl", status, &why));
                None
            }
        }
    }

    /// The stage that `call` derives from this one by `f`, which writes its address; `None` if there is none. Errors
    /// about settings name the setting.
    fn make(
        &self,
        call: &str,
        f: impl FnOnce(*mut c_void, *mut *mut c_void, *mut ConefieldText) -> ConefieldStatus,
    ) -> Result<Option<Handle>> {
        let (mut made, mut error) = (ptr::null_mut(), Text::new());
        let status = inside(|| f(self.handle.stage, &mut made, error.room()));
        if status != CONEFIELD_OK {
            return Err(self.ty().refusal(call, status, &error.text()));
        }
        ensure(made != self.handle.stage, &self.ty().words(), call, "the old stage", "a new one")?;
        Ok((!made.is_null()).then(|| Handle { ty: self.ty().clone(), stage: made }))
    }

    /// The stage that `call` must have derived.
    fn derived(&self, call: &str, made: Option<Handle>) -> Result<Self> {
        Self::new(made.ok_or_else(|| Error::invalid(self.ty().words(), call, "nothing", "a new stage"))?)
    }
}

/// Calls a function of a stage; the arguments go between the stage and the buffer for the reason. They must live during
/// the call and have the accompanying lengths.
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

/// As [`call`], for a function without a buffer for the reason.
macro_rules! ask {
    ($own:expr, $function:ident($($argument:expr),*)) => {
        match $own.functions.$function {
            // SAFETY: the stage is alive; the rest is as for `call`.
            Some(f) => $own.run(stringify!($function), |stage, _| unsafe { f(stage, $($argument),*) }),
            None => Err($own.wrong(stringify!($function), "there is no such function")),
        }
    };
}
use ask;

/// As [`call`], for a function that derives another stage; `None` if it is absent or derives none.
macro_rules! make {
    ($own:expr, $function:ident($($argument:expr),*)) => {
        match $own.functions.$function {
            // SAFETY: the stage is alive; the rest is as for `call`.
            Some(f) => $own.make(stringify!($function), |stage, out, error| unsafe { f(stage, $($argument,)* out, error) }),
            None => Ok(None),
        }
    };
}
use make;

/// Methods of a stage's trait whose answers its `Foreign` holds.
macro_rules! said {
    ($own:tt:) => {};
    ($own:tt: describe $($rest:ident)*) => {
        fn describe(&self) -> String {
            self.$own.describe.clone()
        }
        said! { $own: $($rest)* }
    };
    ($own:tt: fault $($rest:ident)*) => {
        fn fault(&self) -> conefield_core::error::Result<()> {
            self.$own.fault.take()
        }
        said! { $own: $($rest)* }
    };
    ($own:tt: wgsl $($rest:ident)*) => {
        fn wgsl(&self) -> Option<conefield_core::wgsl::Fragment> {
            self.$own.fragment(self.$own.functions.wgsl)
        }
        said! { $own: $($rest)* }
    };
}
use said;

type WgslFn = unsafe extern "C" fn(*const c_void, *mut ConefieldText) -> ConefieldStatus;

/// A grid in the format of the ABI.
fn raw_grid(grid: &VoxelGrid) -> ConefieldGrid {
    let VoxelGrid { shape, spacing, center } = *grid;
    ConefieldGrid { shape, spacing, center }
}

/// A small grid for trials of parts of iterative methods.
const SMALL: VoxelGrid = VoxelGrid { shape: [5, 4, 6], spacing: [1.0, 0.8, 1.5], center: [0.0; 3] };

/// A ray in the format of the ABI.
fn raw_ray(ray: &UnitRay) -> ConefieldRay {
    let UnitRay { origin, direction, inside, published, per_mm } = *ray;
    ConefieldRay { origin, direction, inside, published, per_mm }
}
