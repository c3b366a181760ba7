//! Losses.

use super::*;

table! {
    ConefieldLoss: at needs_scan fitted wgsl;
    loss(keys, _) { Box::new(settings::<dyn LossSpec>(keys)?.build()?) };
    dyn Loss: "loss"
}

shims! {
    fn at(loss: dyn Loss, predicted: *const f64, measured: *const f64, count: usize, out: *mut f64, slope: *mut f64; error) {
        let from = many(predicted, count).iter().zip(many(measured, count));
        let to = many_mut(out, count).iter_mut().zip(many_mut(slope, count));
        for ((&predicted, &measured), (out, slope)) in from.zip(to) {
            (*out, *slope) = loss.at(predicted, measured);
        }
        loss.fault()?;
    }

    fn needs_scan(loss: dyn Loss) -> u32, or 0, { loss.needs_scan().into() }

    fn fitted(loss: dyn Loss, noise: *const ConefieldNoise, out: *mut *mut c_void; error) {
        let ConefieldNoise { sigma, growth, measured, count } = *noise;
        let fitted = loss.fitted(&NoiseModel { sigma, growth, measured: many(measured, count) });
        loss.fault()?;
        if let Some(fitted) = fitted {
            *out = hand_over(fitted);
        }
    }

    fn wgsl(loss: dyn Loss; source) {
        write_wgsl(source, loss.wgsl())?;
    }
}
