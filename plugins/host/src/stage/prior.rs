//! Priors of a field.

use super::*;

settings! {
    prior PriorSpec(self) -> dyn Prior { self.build(0, PriorStage::tried) }
}

/// A prior from a library.
pub struct PriorStage {
    own: Foreign<ConefieldPrior>,
    blocks: Blocks,
}

impl PriorStage {
    /// The prior of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let own = Foreign::<ConefieldPrior>::new(handle)?;
        let mut b = ConefieldBlocks::default();
        ask!(own, blocks(&mut b))?;
        let blocks = Blocks { edge: b.edge, count: b.count, spacing: b.spacing, weight: b.weight };
        blocks.validate().map_err(|e| own.wrong("blocks", &e.to_string()))?;
        let stage = Self { own, blocks };
        let values: Vec<f64> = drawn(blocks.points()).map(f64::from).collect();
        let mut gradient = Guarded::zeroed(values.len());
        let penalty = stage.penalty(&values, 1.0, gradient.inner().as_mut_ptr())?;
        stage.own.settled(gradient.broken("gradient").or_else(|| below_zero("the penalty of a block", penalty)))?;
        stage.own.settled(gradient.unsound("gradient"))?;
        Ok(stage)
    }

    /// The penalty of `values`; adds one derivative per value to `gradient`.
    fn penalty(&self, values: &[f64], scale: f64, gradient: *mut f64) -> Result<f64> {
        let mut penalty = f64::NAN;
        call!(self.own, block(values.as_ptr(), values.len(), scale, gradient, &mut penalty))?;
        Ok(penalty)
    }
}

impl Prior for PriorStage {
    fn blocks(&self) -> Blocks {
        self.blocks
    }

    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        assert_eq!(values.len(), gradient.len(), "a derivative for each value");
        self.own.noted(self.penalty(values, scale, gradient.as_mut_ptr()), f64::NAN)
    }

    said! { own: describe fault wgsl }
}
