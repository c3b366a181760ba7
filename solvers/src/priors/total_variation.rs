//! Isotropic total variation: the cost of a difference between neighbours is proportional to its size.

use conefield_core::prelude::*;
use conefield_core::wgsl::is_positive;

/// Settings of `total-variation`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TotalVariation {
    /// Weight relative to the mean loss of a ray.
    pub weight: f64,
    /// Blocks per step.
    pub blocks: usize,
    /// Points along a block's edge.
    pub edge: usize,
    /// Spacing of the points in voxels.
    pub spacing: f64,
    /// Differences below this (in the scale that stages see) have a quadratic cost.
    pub smoothing: f64,
}

impl Default for TotalVariation {
    fn default() -> Self {
        Self { weight: 1e-3, blocks: 64, edge: 8, spacing: 1.0, smoothing: 1e-4 }
    }
}

conefield_core::stage_type!(
    PriorSpec,
    "total-variation",
    TotalVariation,
    "isotropic total variation over small random blocks of neighbouring points"
);

impl PriorSpec for TotalVariation {
    fn build(&self) -> Result<Box<dyn Prior>> {
        self.blocks().validate()?;
        let found = self.smoothing;
        ensure(is_positive(found), "spec", "smoothing", found, "a positive number of single precision")?;
        Ok(Box::new(*self))
    }
}

impl Prior for TotalVariation {
    fn blocks(&self) -> Blocks {
        let Self { weight, blocks: count, edge, spacing, .. } = *self;
        Blocks { edge, count, spacing, weight }
    }

    /// Uses forward differences, without differences across the block's sides.
    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        let e = self.edge;
        let strides = [e * e, e, 1];
        let mut sum = 0.0;
        for i in 0..values.len() {
            let index = [i / (e * e), i / e % e, i % e];
            let d: [f64; 3] =
                std::array::from_fn(|k| if index[k] + 1 < e { values[i + strides[k]] - values[i] } else { 0.0 });
            let size = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + self.smoothing * self.smoothing).sqrt();
            sum += size - self.smoothing;
            if size > 0.0 {
                for k in 0..3 {
                    if index[k] + 1 < e {
                        let g = scale * d[k] / size;
                        gradient[i + strides[k]] += g;
                        gradient[i] -= g;
                    }
                }
            }
        }
        sum
    }

    fn wgsl(&self) -> Option<Fragment> {
        let smoothing = format!("const stage_smoothing = f32({:?});\n", self.smoothing as f32);
        Some(Fragment::new(&[&smoothing, include_str!("total_variation.wgsl")]))
    }

    fn describe(&self) -> String {
        format!("total variation {}", self.weight)
    }
}
