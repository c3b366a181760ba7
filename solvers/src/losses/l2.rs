//! Half the squared difference, as in NAF up to the factor.

use conefield_core::prelude::*;

/// Settings of `l2`: there are none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct L2 {}

conefield_core::stage_type!(LossSpec, "l2", L2, "half the squared difference");

impl LossSpec for L2 {
    fn build(&self) -> Result<Box<dyn Loss>> {
        Ok(Box::new(*self))
    }
}

impl Loss for L2 {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let d = predicted - measured;
        (0.5 * d * d, d)
    }

    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&["fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {
    let d = predicted - measured;
    return vec2<f32>(0.5 * d * d, d);
}
"]))
    }

    fn describe(&self) -> String {
        "l2".into()
    }
}
