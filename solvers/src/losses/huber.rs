//! Half the squared difference where it is small, linear where it is large.

use conefield_core::prelude::*;
use conefield_core::wgsl::is_positive;

/// Settings of `huber`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Huber {
    /// Difference above which the loss is linear, in the scale that stages see. There the most absorbing rays measure
    /// about 0.25 with `scene.attenuation = "scan"`, and about 1 with `{ relative = 0.25 }`.
    pub delta: f64,
}

impl Default for Huber {
    fn default() -> Self {
        Self { delta: 0.01 }
    }
}

conefield_core::stage_type!(LossSpec, "huber", Huber, "half the squared difference, linear where it is large");

impl LossSpec for Huber {
    fn build(&self) -> Result<Box<dyn Loss>> {
        ensure(is_positive(self.delta), "spec", "delta", self.delta, "a positive number of single precision")?;
        Ok(Box::new(*self))
    }
}

impl Loss for Huber {
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let (d, delta) = (predicted - measured, self.delta);
        if d.abs() <= delta { (0.5 * d * d, d) } else { (delta * (d.abs() - 0.5 * delta), delta * d.signum()) }
    }

    fn wgsl(&self) -> Option<Fragment> {
        let delta = self.delta as f32;
        Some(Fragment::new(&[&format!(
            "const stage_delta = f32({delta:?});

fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {{
    let d = predicted - measured;
    if abs(d) <= stage_delta {{
        return vec2<f32>(0.5 * d * d, d);
    }}
    return vec2<f32>(stage_delta * (abs(d) - 0.5 * stage_delta), stage_delta * sign(d));
}}
"
        )]))
    }

    fn describe(&self) -> String {
        format!("huber up to {}", self.delta)
    }
}
