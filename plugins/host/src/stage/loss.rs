//! Losses.

#![allow(unsafe_code)]

use super::{Foreign, call, make, said};
use crate::library::Handle;
use crate::trial;
use conefield_core::prelude::*;
use conefield_plugin_abi::*;

/// A loss from a library.
pub struct LossStage {
    own: Foreign<ConefieldLoss>,
    needs_scan: bool,
}

impl LossStage {
    /// The loss of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let own = Foreign::<ConefieldLoss>::new(handle)?;
        // SAFETY: the stage is alive.
        let needs_scan = own.functions.needs_scan.is_some_and(|f| unsafe { f(own.handle.stage) } != 0);
        if needs_scan && own.functions.fitted.is_none() {
            return Err(own.wrong("needs_scan", "it needs a scan with no function fitted"));
        }
        let stage = Self { own, needs_scan };
        trial::loss(stage.own.ty(), |predicted, measured, [loss, slope]| {
            stage.compare(predicted, measured, loss.as_mut_ptr(), slope.as_mut_ptr())
        })?;
        Ok(stage)
    }

    /// Writes the losses of all pairs to `loss` and their derivatives to `slope`.
    fn compare(&self, predicted: &[f64], measured: &[f64], loss: *mut f64, slope: *mut f64) -> Result<()> {
        call!(self.own, at(predicted.as_ptr(), measured.as_ptr(), measured.len(), loss, slope))
    }

    /// [`Loss::fitted`] with its error.
    fn try_fitted(&self, noise: &NoiseModel<'_>) -> Result<Option<Box<dyn Loss>>> {
        if !self.needs_scan {
            return Ok(None);
        }
        let NoiseModel { sigma, growth, measured } = *noise;
        let noise = ConefieldNoise { sigma, growth, measured: measured.as_ptr(), count: measured.len() };
        let Some(handle) = make!(self.own, fitted(&noise))? else { return Ok(None) };
        Ok(Some(Box::new(trial::timed(self.own.ty(), move || Self::tried(handle))?)))
    }
}

impl Loss for LossStage {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let [mut loss, mut slope] = [f64::NAN; 2];
        let done = self.compare(&[predicted], &[measured], &mut loss, &mut slope).map(|()| (loss, slope));
        self.own.noted(done, (f64::NAN, f64::NAN))
    }

    fn needs_scan(&self) -> bool {
        self.needs_scan
    }

    fn fitted(&self, noise: &NoiseModel<'_>) -> Option<Box<dyn Loss>> {
        self.own.noted(self.try_fitted(noise), None)
    }

    said! { own: describe fault wgsl }
}
