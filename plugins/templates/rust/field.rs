//! A field for conefield: features `[n, F]` to attenuation `[n, 1]`.
//!
//! This start is a weighted sum through a softplus, which is never negative: `y = ln(1 + exp(w·x + b))`. Its backward pass
//! is written by hand; `cargo test` compares it with finite differences.

use conefield_plugin::error::Result;
use conefield_plugin::random::{mix, unit};
use conefield_plugin::simd::Real;
use conefield_plugin::spec::FieldSpec;
use conefield_plugin::stage::{Field, GradKind, Grads, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

conefield_plugin::export!();
conefield_plugin::stage_type!(Field, "@name@", Settings, "a weighted sum through a softplus");

/// What a spec may set.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The shift that training starts from; the lower, the nearer to 0 the first volume.
    pub bias: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bias: -1.0 }
    }
}

#[typetag::serde(name = "@name@")]
impl FieldSpec for Settings {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(Sum { width, bias: self.bias }))
    }
}

struct Sum {
    width: usize,
    bias: f32,
}

// One source for the single precision that trains and the double precision that checks it.
impl<R: Real> Kernel<R> for Sum {
    /// Leaves the slope of the softplus for `backward`.
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, mut tape: TileMut<'_, R>) {
        let y = y.channel(0);
        y.fill(params[self.width]);
        for c in 0..self.width {
            for (y, &x) in y.iter_mut().zip(x.channel(c)) {
                *y += params[c] * x;
            }
        }
        for (y, slope) in y.iter_mut().zip(tape.channel(0)) {
            *slope = R::of(1.0 / (1.0 + (-y.f64()).exp()));
            *y = y.softplus();
        }
    }

    fn backward(
        &self,
        params: &[R],
        x: Tile<'_, R>,
        mut tape: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        mut dx: Option<TileMut<'_, R>>,
    ) {
        // From here on the gradient of the sum itself.
        let dsum = tape.channel(0);
        for (slope, &dy) in dsum.iter_mut().zip(dy.channel(0)) {
            *slope *= dy;
        }
        let mut add = |at: usize, sum: R| {
            if grads.range.contains(&at) {
                grads.values[at - grads.range.start] += sum;
            }
        };
        for c in 0..self.width {
            add(c, x.channel(c).iter().zip(&*dsum).map(|(&x, &d)| x * d).sum());
            if let Some(dx) = &mut dx {
                for (dx, &d) in dx.channel(c).iter_mut().zip(&*dsum) {
                    *dx = params[c] * d;
                }
            }
        }
        add(self.width, dsum.iter().copied().sum());
    }
}

impl Stage for Sum {
    fn info(&self) -> Info {
        Info {
            input: self.width,
            output: 1,
            params: self.width + 1,
            tape: 1,
            scope: Scope::Row,
            grads: GradKind::Dense,
            macs: self.width,
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let block = |name: &str, n, start| Parameter { name: name.into(), shape: vec![n], start };
        vec![block("weight", self.width, 0), block("bias", 1, self.width)]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        let bound = 1.0 / (self.width as f32).sqrt();
        for (i, p) in params.iter_mut().enumerate() {
            *p = bound * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
        params[self.width] = self.bias;
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        format!("@name@: softplus of a sum of {} channels", self.width)
    }
}

impl Field for Sum {
    /// Without some inputs it is a shorter sum.
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        Ok(Reduced {
            stage: Box::new(Self { width: keep.len(), bias: self.bias }),
            params: keep.iter().copied().chain([self.width]).map(|c| c..c + 1).collect(),
            channels: vec![0],
        })
    }
}
