//! Losses.

use super::*;

settings! {
    loss LossSpec(self) -> dyn Loss { self.build(0, LossStage::tried) }
}

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
        let able = !needs_scan || own.functions.fitted.is_some();
        own.require(able, "needs_scan", || "it needs a scan with no function fitted".into())?;
        let stage = Self { own, needs_scan };
        let values: Vec<f64> = (0..16).map(|i| 0.25 * f64::from(i) - 0.5).collect();
        for shift in [0.0, 0.25, -1.0] {
            let predicted: Vec<f64> = values.iter().map(|v| v + shift).collect();
            let [mut loss, mut slope] = [0; 2].map(|_| Guarded::<f64>::new(values.len()));
            stage.compare(&predicted, &values, loss.inner().as_mut_ptr(), slope.inner().as_mut_ptr())?;
            stage.own.settled(loss.broken("losses").or_else(|| slope.broken("slopes")))?;
            for (i, (loss, slope)) in loss.inner().iter().zip(slope.inner()).enumerate() {
                let pair = format!("predicted {}, measured {}", predicted[i], values[i]);
                let unwritten = loss.is_mark() || slope.is_mark();
                stage.own.settled(unwritten.then(|| format!("{pair}: a number is left unwritten")))?;
                let good = loss.is_finite() && *loss >= 0.0 && slope.is_finite();
                stage.own.settled((!good).then(|| format!("{pair}: loss {loss}, slope {slope}")))?;
            }
        }
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
        Ok(Some(Box::new(timed(self.own.ty(), move || Self::tried(handle))?)))
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
