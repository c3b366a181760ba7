//! A normalizer for conefield: features `[n, F]` to features `[n, F]`.
//!
//! This start scales and shifts every channel by numbers that are learned: `y = w·x + b`. Its backward pass is written
//! by hand; `cargo test` compares it with finite differences.

use conefield_plugin::error::Result;
use conefield_plugin::simd::Real;
use conefield_plugin::settings::NormalizerSpec;
use conefield_plugin::stage::{
    GradKind, Grads, Info, Kernel, Normalizer, Parameter, Reduced, Scope, Stage, Tile, TileMut,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

conefield_plugin::export!();
conefield_plugin::stage_type!(NormalizerSpec, "@name@", Settings, "a learned scale and shift of every channel");

/// Settings in a spec.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Initial scale.
    pub scale: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { scale: 1.0 }
    }
}

impl NormalizerSpec for Settings {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(Affine { width, scale: self.scale }))
    }
}

struct Affine {
    width: usize,
    scale: f32,
}

// One source for single precision (training) and double precision (checks).
impl<R: Real> Kernel<R> for Affine {
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let (scale, shift) = params.split_at(self.width);
        for c in 0..self.width {
            for (y, &x) in y.channel(c).iter_mut().zip(x.channel(c)) {
                *y = scale[c] * x + shift[c];
            }
        }
    }

    fn backward(
        &self,
        params: &[R],
        x: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        mut dx: Option<TileMut<'_, R>>,
    ) {
        let mut add = |at: usize, sum: R| {
            if grads.range.contains(&at) {
                grads.values[at - grads.range.start] += sum;
            }
        };
        for c in 0..self.width {
            add(c, x.channel(c).iter().zip(dy.channel(c)).map(|(&x, &dy)| x * dy).sum());
            add(self.width + c, dy.channel(c).iter().copied().sum());
            if let Some(dx) = &mut dx {
                for (dx, &dy) in dx.channel(c).iter_mut().zip(dy.channel(c)) {
                    *dx = params[c] * dy;
                }
            }
        }
    }
}

impl Stage for Affine {
    fn info(&self) -> Info {
        let n = self.width;
        Info {
            input: n,
            output: n,
            params: 2 * n,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Dense,
            macs: n,
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let block = |name: &str, start| Parameter { name: name.into(), shape: vec![self.width], start };
        vec![block("scale", 0), block("shift", self.width)]
    }

    fn init(&self, _: u64, params: &mut [f32]) {
        let (scale, shift) = params.split_at_mut(self.width);
        scale.fill(self.scale);
        shift.fill(0.0);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        format!("@name@: {} channels, each with a scale and a shift", self.width)
    }
}

impl Normalizer for Affine {
    /// Channels are independent: without some, the rest is a smaller stage of the same kind.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        let part = |start: usize| keep.iter().map(move |&c| start + c..start + c + 1);
        Ok(Reduced {
            stage: Box::new(Self { width: keep.len(), scale: self.scale }),
            params: part(0).chain(part(self.width)).collect(),
            channels: keep.to_vec(),
        })
    }
}
