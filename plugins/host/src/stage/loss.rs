//! Losses.

#![allow(unsafe_code)]

use super::{Fault, fragment};
use crate::library::{Functions, Handle, Text, Type};
use crate::trial;
use conefield_core::error::Result;
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::ptr;
use std::sync::Arc;

/// A loss of a library.
pub struct LossStage {
    handle: Handle,
    functions: ConefieldLoss,
    needs_scan: bool,
    describe: String,
    fault: Fault,
}

/// Makes a loss and tries it out.
pub(crate) fn build(ty: &Arc<Type>, settings: &Value) -> Result<LossStage> {
    let (own, settings) = (ty.clone(), settings.clone());
    trial::timed(ty, move || LossStage::tried(own.create(&settings, 0)?))
}

impl LossStage {
    /// The loss behind `handle`, tried out.
    fn tried(handle: Handle) -> Result<Self> {
        let Functions::Loss(functions) = handle.ty.functions else {
            return Err(handle.ty.failed("create", CONEFIELD_FAILED, "it is no loss"));
        };
        // SAFETY: the stage is alive.
        let needs_scan = functions.needs_scan.is_some_and(|f| unsafe { f(handle.stage) } != 0);
        if needs_scan && functions.fitted.is_none() {
            let what = "it needs a scan with no function fitted";
            return Err(handle.ty.failed("needs_scan", CONEFIELD_FAILED, what));
        }
        let describe = handle.describe();
        let stage = Self { handle, functions, needs_scan, describe, fault: Fault::default() };
        trial::loss(&stage.handle.ty, |predicted, measured, [loss, slope]| {
            stage.compare(predicted, measured, loss.as_mut_ptr(), slope.as_mut_ptr())
        })?;
        Ok(stage)
    }

    /// The losses of as many pairs as there are to `loss`, their derivatives to `slope`.
    fn compare(&self, predicted: &[f64], measured: &[f64], loss: *mut f64, slope: *mut f64) -> Result<()> {
        let mut error = Text::new();
        let (count, predicted, measured) = (measured.len(), predicted.as_ptr(), measured.as_ptr());
        let status = self.functions.at.map_or(CONEFIELD_FAILED, |at| {
            // SAFETY: the stage is alive, and there are `count` numbers or room for them at every pointer.
            unsafe { at(self.handle.stage, predicted, measured, count, loss, slope, error.room()) }
        });
        if status == CONEFIELD_OK { Ok(()) } else { Err(self.handle.ty.failed("at", status, &error.text())) }
    }

    /// [`Loss::fitted`] with what went wrong.
    fn try_fitted(&self, noise: &NoiseModel<'_>) -> Result<Option<Box<dyn Loss>>> {
        let Some(fitted) = self.functions.fitted.filter(|_| self.needs_scan) else { return Ok(None) };
        let NoiseModel { sigma, growth, measured } = *noise;
        let noise = ConefieldNoise { sigma, growth, measured: measured.as_ptr(), count: measured.len() };
        let mut stage = ptr::null_mut();
        let mut error = Text::new();
        // SAFETY: the stage is alive; everything handed over lives for the time of the call.
        let status = unsafe { fitted(self.handle.stage, &noise, &mut stage, error.room()) };
        if status != CONEFIELD_OK {
            return Err(self.handle.ty.failed("fitted", status, &error.text()));
        }
        let Some(handle) = self.handle.made(stage, "fitted")? else { return Ok(None) };
        let ty = handle.ty.clone();
        Ok(Some(Box::new(trial::timed(&ty, move || Self::tried(handle))?)))
    }
}

impl Loss for LossStage {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let [mut loss, mut slope] = [f64::NAN; 2];
        match self.compare(&[predicted], &[measured], &mut loss, &mut slope) {
            Ok(()) => (loss, slope),
            Err(e) => {
                self.fault.set(e);
                (f64::NAN, f64::NAN)
            }
        }
    }

    fn wgsl(&self) -> Option<Fragment> {
        fragment(&self.handle, self.functions.wgsl)
    }

    fn needs_scan(&self) -> bool {
        self.needs_scan
    }

    fn fitted(&self, noise: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        self.try_fitted(noise).unwrap_or_else(|e| {
            self.fault.set(e);
            None
        })
    }

    fn fault(&self) -> Result<()> {
        self.fault.take()
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }
}
