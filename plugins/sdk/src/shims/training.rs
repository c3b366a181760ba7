//! Losses and priors.

use super::{built, guard, hand_over, many, many_mut, shims, wgsl};
use conefield_core::loss::NoiseModel;
use conefield_core::prior::Blocks;
use conefield_plugin_abi::*;
use std::ffi::c_void;
use std::ptr;

pub static LOSS: ConefieldLoss = ConefieldLoss {
    size: size_of::<ConefieldLoss>(),
    at: Some(at),
    needs_scan: Some(needs_scan),
    fitted: Some(fitted),
    wgsl: Some(wgsl),
};

pub static PRIOR: ConefieldPrior =
    ConefieldPrior { size: size_of::<ConefieldPrior>(), blocks: Some(blocks), block: Some(block), wgsl: Some(wgsl) };

shims! {
    fn at(loss: loss, predicted: *const f64, measured: *const f64, count: usize, out: *mut f64, slope: *mut f64; error) {
        let from = many(predicted, count).iter().zip(many(measured, count));
        let to = many_mut(out, count).iter_mut().zip(many_mut(slope, count));
        for ((&predicted, &measured), (out, slope)) in from.zip(to) {
            (*out, *slope) = loss.at(predicted, measured);
        }
        loss.fault()?;
    }

    fn needs_scan(loss: loss) -> u32, or 0, { loss.needs_scan().into() }

    fn fitted(loss: loss, noise: *const ConefieldNoise, out: *mut *mut c_void; error) {
        let ConefieldNoise { sigma, growth, measured, count } = *noise;
        if let Some(fitted) = loss.fitted(&NoiseModel { sigma, growth, measured: many(measured, count) }) {
            *out = hand_over(fitted);
        }
        loss.fault()?;
    }

    fn blocks(prior: prior, out: *mut ConefieldBlocks) {
        let Blocks { edge, count, spacing, weight } = prior.blocks();
        *out = ConefieldBlocks { edge, count, spacing, weight };
    }

    fn block(
        prior: prior, values: *const f64, count: usize, scale: f64, gradient: *mut f64, penalty: *mut f64; error
    ) {
        *penalty = prior.block(many(values, count), scale, many_mut(gradient, count));
        prior.fault()?;
    }
}
