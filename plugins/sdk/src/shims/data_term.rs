//! Data terms and their misfits for a scan.

use super::*;

table! {
    ConefieldDataTerm: bytes of noise differentiate curve spread;
    data_term(keys, _) { Box::new(settings::<dyn DataTermSpec>(keys)?.build()?) };
    dyn DataTerm: "data term", dyn Misfit: "data term of a scan"
}

shims! {
    fn bytes(term: dyn DataTerm, shape: *const usize, held: *mut u64, brief: *mut u64) -> (), or (), {
        // After a panic the host refuses the run.
        (*held, *brief) = (u64::MAX, u64::MAX);
        let header = header([0; 3], *shape.cast());
        (*held, *brief) = (term.held(&header), term.scratch(&header));
    }

    fn of(
        term: dyn DataTerm, measured: *const f32, shape: *const usize, misfit: *mut *mut c_void; error
    ) {
        *misfit = hand_over(term.of(array(*shape.cast(), measured)?)?);
    }

    fn noise(misfit: dyn Misfit) -> f64, or f64::NAN, { misfit.noise() }

    fn differentiate(
        misfit: dyn Misfit, view: usize, measured: *const f32, count: usize, residuals: *mut f32, sum: *mut f64; error
    ) {
        *sum = misfit.differentiate(view, many(measured, count), many_mut(residuals, count));
        misfit.fault()?;
    }

    fn curve(misfit: dyn Misfit, view: usize, measured: *const f32, count: usize, values: *mut f32; error) {
        misfit.curve(view, many(measured, count), many_mut(values, count));
        misfit.fault()?;
    }

    fn spread(misfit: dyn Misfit, view: usize, measured: *const f32, count: usize, values: *mut f32; error) {
        misfit.spread(view, many(measured, count), many_mut(values, count));
        misfit.fault()?;
    }
}
