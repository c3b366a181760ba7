//! Priors.

use super::*;

table! {
    ConefieldPrior: blocks block wgsl;
    prior(keys, _) { Box::new(settings::<dyn PriorSpec>(keys)?.build()?) };
    dyn Prior: "prior"
}

shims! {
    fn blocks(prior: dyn Prior, out: *mut ConefieldBlocks) {
        let Blocks { edge, count, spacing, weight } = prior.blocks();
        *out = ConefieldBlocks { edge, count, spacing, weight };
    }

    fn block(
        prior: dyn Prior, values: *const f64, count: usize, scale: f64, gradient: *mut f64, penalty: *mut f64; error
    ) {
        *penalty = prior.block(many(values, count), scale, many_mut(gradient, count));
        prior.fault()?;
    }

    fn wgsl(prior: dyn Prior; source) {
        write_wgsl(source, prior.wgsl())?;
    }
}
