//! An encoder for conefield: points `[n, 3]` of the unit cube to features `[n, F]`.
//!
//! This start has waves of doubling frequency along each axis, each with an amplitude that is learned:
//! `y = a·sin(2^k·π·x)`. Its backward pass is written by hand; `cargo test` compares it with finite differences.

use conefield_plugin::error::{Result, ensure};
use conefield_plugin::simd::Real;
use conefield_plugin::spec::EncoderSpec;
use conefield_plugin::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Scope, Stage, Tile, TileMut};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

conefield_plugin::export!();
conefield_plugin::stage_type!(Encoder, "@name@", Settings, "waves of doubling frequency with learned amplitudes");

/// What a spec may set.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Frequencies along each axis, from half a turn a cube side on.
    pub bands: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bands: 6 }
    }
}

#[typetag::serde(name = "@name@")]
impl EncoderSpec for Settings {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        ensure((1..=16).contains(&self.bands), "spec", "encoder.bands", self.bands, "1 to 16")?;
        Ok(Box::new(Waves { bands: self.bands }))
    }
}

struct Waves {
    bands: usize,
}

impl Waves {
    /// Axis and angular frequency of each channel.
    fn channels<R: Real>(&self) -> impl Iterator<Item = (usize, R)> {
        let bands = self.bands;
        (0..3 * bands).map(move |c| (c / bands, R::of(std::f64::consts::PI * f64::from(1u32 << (c % bands)))))
    }
}

// One source for the single precision that trains and the double precision that checks it.
impl<R: Real> Kernel<R> for Waves {
    fn forward(&self, amplitudes: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        for (c, (axis, frequency)) in self.channels::<R>().enumerate() {
            for (y, &x) in y.channel(c).iter_mut().zip(x.channel(axis)) {
                *y = amplitudes[c] * (frequency * x).sin_cos().0;
            }
        }
    }

    fn backward(
        &self,
        amplitudes: &[R],
        x: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        mut dx: Option<TileMut<'_, R>>,
    ) {
        if let Some(dx) = &mut dx {
            dx.data.fill(R::ZERO);
        }
        for (c, (axis, frequency)) in self.channels::<R>().enumerate() {
            let mut sum = R::ZERO;
            for (i, (&x, &dy)) in x.channel(axis).iter().zip(dy.channel(c)).enumerate() {
                let (sin, cos) = (frequency * x).sin_cos();
                sum += dy * sin;
                if let Some(dx) = &mut dx {
                    dx.channel(axis)[i] += dy * amplitudes[c] * frequency * cos;
                }
            }
            if grads.range.contains(&c) {
                grads.values[c - grads.range.start] += sum;
            }
        }
    }
}

impl Stage for Waves {
    fn info(&self) -> Info {
        let n = 3 * self.bands;
        Info {
            input: 3,
            output: n,
            params: n,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Dense,
            macs: 10 * n,
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![Parameter { name: "amplitude".into(), shape: vec![3, self.bands], start: 0 }]
    }

    /// Every wave alike.
    fn init(&self, _: u64, params: &mut [f32]) {
        params.fill(1.0);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        format!("@name@: {} waves along each axis", self.bands)
    }
}

impl Encoder for Waves {
    fn coarse_to_fine(&self) -> bool {
        false
    }
}
