//! An encoder for conefield: `y = sin(d·x + p)` with directions `d` and phases `p` that are learned.

use conefield_plugin::prelude::*;

conefield_plugin::export!();
stage_type!(EncoderSpec, "@name@", Settings, "waves of learned directions");

/// What a spec may set.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Number of channels, one per wave.
    pub waves: usize,
    /// Largest initial frequency of a wave, in radians per cube side.
    pub frequency: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { waves: 32, frequency: 20.0 }
    }
}

impl EncoderSpec for Settings {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        ensure((1..=4096).contains(&self.waves), "spec", "waves", self.waves, "1 to 4096")?;
        Ok(Box::new(ByRow::new(self.clone())))
    }
}

impl Settings {
    /// The angle of wave `c`, whose parameters are its direction and its phase.
    fn angle<R: Real>(params: &[R], x: &[R], c: usize) -> R {
        (0..3).fold(params[4 * c + 3], |sum, k| sum + params[4 * c + k] * x[k])
    }
}

impl RowMap for Settings {
    fn widths(&self) -> [usize; 2] {
        [3, self.waves]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("wave".into(), vec![self.waves, 4])]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            *p = self.frequency * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
    }

    fn forward<R: Real>(&self, params: &[R], x: &[R], y: &mut [R]) {
        for (c, y) in y.iter_mut().enumerate() {
            *y = Self::angle(params, x, c).sin_cos().0;
        }
    }

    fn backward<R: Real>(&self, params: &[R], x: &[R], dy: &[R], grads: &mut Sums<'_, R>, dx: &mut [R]) {
        for (c, &dy) in dy.iter().enumerate() {
            let slope = dy * Self::angle(params, x, c).sin_cos().1;
            for k in 0..3 {
                grads.add(4 * c + k, slope * x[k]);
                dx[k] += slope * params[4 * c + k];
            }
            grads.add(4 * c + 3, slope);
        }
    }

    /// For `step_cells` of a projector, as in the spec balanced: resolving a period takes two cells.
    fn resolutions(&self) -> Option<Vec<f64>> {
        Some(vec![f64::from(self.frequency / std::f32::consts::PI).max(1.0); self.waves])
    }

    fn describe(&self) -> String {
        format!("@name@: {} waves", self.waves)
    }
}
