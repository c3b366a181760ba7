//! Data terms.

use super::*;
use conefield_core::scan::ScanHeader;

settings! {
    data_term DataTermSpec(self) -> dyn DataTerm { self.build(0, DataTermStage::tried) }
}

/// A data term from a library.
pub struct DataTermStage(Foreign<ConefieldDataTerm>);

impl DataTermStage {
    /// The data term of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let stage = Self(Foreign::new(handle)?);
        let mut numbers = drawn(2 * 6 * 7).map(|x| 2.0 * x);
        let scan = Array3::from_shape_simple_fn([2, 6, 7], || numbers.next().unwrap_or_default());
        let misfit = stage.made_of(scan.view())?;
        stage.0.settled(below_zero("the noise that it finds", misfit.noise()))?;
        for (view, measured) in scan.outer_iter().enumerate() {
            let measured: Vec<f32> = measured.iter().copied().collect();
            let of = |x| Guarded::of(&vec![x; measured.len()]);
            let [mut residuals, mut curve, mut spread] = [0.5f32, 1.0, 1.0].map(of);
            let sum = misfit.differentiate(view, &measured, residuals.inner());
            misfit.curve(view, &measured, curve.inner());
            misfit.spread(view, &measured, spread.inner());
            misfit.fault()?;
            stage.0.settled(residuals.complaint("derivatives").or_else(|| curve.complaint("curvatures")))?;
            stage.0.settled(spread.complaint("spread of noise").or_else(|| below_zero("the misfit", sum)))?;
        }
        Ok(stage)
    }

    /// The data term of one scan.
    fn made_of(&self, measured: ArrayView3<'_, f32>) -> Result<MisfitOn> {
        let shape: [usize; 3] = measured.dim().into();
        let measured = measured.as_standard_layout();
        Ok(MisfitOn(self.0.derived("of", make!(self.0, of(measured.as_ptr(), shape.as_ptr()))?)?))
    }

    /// Memory held for a scan, and temporary memory, in bytes.
    fn bytes(&self, header: &ScanHeader) -> [u64; 2] {
        let shape = [header.views, header.detector[0], header.detector[1]];
        let [mut held, mut brief] = [0; 2];
        if let Some(f) = self.0.functions.bytes {
            // SAFETY: the stage is alive, both numbers are writable.
            unsafe { f(self.0.handle.stage, shape.as_ptr(), &mut held, &mut brief) };
        }
        [held, brief].map(|bytes: u64| bytes.min(MOST_BYTES))
    }
}

impl DataTerm for DataTermStage {
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        Ok(Box::new(self.made_of(measured)?))
    }

    fn held(&self, header: &ScanHeader) -> u64 {
        self.bytes(header)[0]
    }

    fn scratch(&self, header: &ScanHeader) -> u64 {
        self.bytes(header)[1]
    }

    said! { 0: describe }
}

/// A data term that a library made for one scan.
pub(crate) struct MisfitOn(Foreign<ConefieldDataTerm>);

/// The common length: a library gets one.
fn same(measured: &[f32], out: &[f32]) -> usize {
    assert_eq!(measured.len(), out.len(), "a number for each pixel");
    out.len()
}

impl Misfit for MisfitOn {
    fn differentiate(&self, view: usize, measured: &[f32], residuals: &mut [f32]) -> f64 {
        let mut sum = f64::NAN;
        let (from, count, to) = (measured.as_ptr(), same(measured, residuals), residuals.as_mut_ptr());
        let done = call!(self.0, differentiate(view, from, count, to, &mut sum));
        self.0.noted(done.map(|()| sum), f64::NAN)
    }

    fn curve(&self, view: usize, measured: &[f32], values: &mut [f32]) {
        let (from, count, to) = (measured.as_ptr(), same(measured, values), values.as_mut_ptr());
        self.0.noted(call!(self.0, curve(view, from, count, to)), ());
    }

    fn spread(&self, view: usize, measured: &[f32], values: &mut [f32]) {
        let (from, count, to) = (measured.as_ptr(), same(measured, values), values.as_mut_ptr());
        self.0.noted(call!(self.0, spread(view, from, count, to)), ());
    }

    fn noise(&self) -> f64 {
        // SAFETY: the stage is alive.
        self.0.functions.noise.map_or(f64::NAN, |f| unsafe { f(self.0.handle.stage) })
    }

    said! { 0: describe fault }
}
