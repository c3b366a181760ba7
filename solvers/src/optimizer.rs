//! The optimizer: Adam (Kingma and Ba 2015) with a decaying learning rate.

use crate::schedule::Decay;
use conefield_core::backend::Adam;
use conefield_core::error::{Result, ensure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of Adam.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Optimizer {
    /// Learning rate.
    pub lr: f64,
    /// Decay of the learning rate.
    pub decay: Decay,
    /// Decay rates of the moments.
    pub betas: [f64; 2],
    /// Added to the root of the second moment.
    pub eps: f64,
}

impl Default for Optimizer {
    fn default() -> Self {
        Self { lr: 1e-3, decay: Decay::Exponential(0.1), betas: [0.9, 0.999], eps: 1e-8 }
    }
}

impl Optimizer {
    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        ensure(self.lr.is_finite() && self.lr > 0.0, "spec", "lr", self.lr, "a positive finite number")?;
        // Second moments are cleared below 1e-36: a smaller ε would allow steps of any size, or 0/0.
        let eps = self.eps.is_finite() && self.eps >= 1e-16;
        ensure(eps, "spec", "eps", self.eps, "a finite number, at least 1e-16")?;
        let betas = self.betas.iter().all(|b| (0.0..1.0).contains(b));
        ensure(betas, "spec", "betas", format!("{:?}", self.betas), "two numbers from 0 to below 1")?;
        self.decay.validate()
    }

    /// Adam's settings for update `step` (from 1).
    pub fn adam(&self, step: u64, epoch: f64, share: f64) -> Adam {
        Adam {
            lr: self.lr * self.decay.at(epoch, share),
            beta1: self.betas[0],
            beta2: self.betas[1],
            eps: self.eps,
            step,
        }
    }
}
