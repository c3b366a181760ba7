//! The absolute difference, as in NI-NeRF.

use conefield_core::prelude::*;

/// Settings of `l1`: there are none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct L1 {}

conefield_core::stage_type!(LossSpec, "l1", L1, "the absolute difference");

impl LossSpec for L1 {
    fn build(&self) -> Result<Box<dyn Loss>> {
        Ok(Box::new(*self))
    }
}

impl Loss for L1 {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let d = predicted - measured;
        (d.abs(), if d == 0.0 { 0.0 } else { d.signum() })
    }

    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&["fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {
    let d = predicted - measured;
    return vec2<f32>(abs(d), sign(d));
}
"]))
    }

    fn describe(&self) -> String {
        "l1".into()
    }
}
