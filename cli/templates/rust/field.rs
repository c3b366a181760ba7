//! A field for conefield: features `[n, F]` to attenuation `[n, 1]`, `y = ln(1 + exp(w·x + b))`, which is never
//! negative.

use conefield_plugin::prelude::*;

conefield_plugin::export!();
stage_type!(FieldSpec, "@name@", Settings, "a weighted sum through a softplus");

/// Settings in a spec.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Initial shift; the lower it is, the closer the first volume is to 0.
    pub bias: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { bias: -1.0 }
    }
}

impl FieldSpec for Settings {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(ByRow::new(Sum { width, bias: self.bias })))
    }
}

struct Sum {
    width: usize,
    bias: f32,
}

impl Sum {
    fn sum<R: Real>(&self, params: &[R], x: &[R]) -> R {
        let weighted: R = x.iter().zip(params).map(|(&x, &w)| w * x).sum();
        weighted + params[self.width]
    }
}

impl RowMap for Sum {
    fn widths(&self) -> [usize; 2] {
        [self.width, 1]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("weight".into(), vec![self.width]), ("bias".into(), vec![1])]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        let bound = 1.0 / (self.width as f32).sqrt();
        for (i, p) in params.iter_mut().enumerate() {
            *p = bound * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
        params[self.width] = self.bias;
    }

    fn forward<R: Real>(&self, params: &[R], x: &[R], y: &mut [R]) {
        y[0] = self.sum(params, x).softplus();
    }

    fn backward<R: Real>(&self, params: &[R], x: &[R], dy: &[R], grads: &mut Sums<'_, R>, dx: &mut [R]) {
        let slope = R::of(1.0 / (1.0 + (-self.sum(params, x).f64()).exp()));
        let d = dy[0] * slope;
        for c in 0..self.width {
            grads.add(c, d * x[c]);
            dx[c] += d * params[c];
        }
        grads.add(self.width, d);
    }

    fn describe(&self) -> String {
        format!("@name@: softplus of a sum of {} channels", self.width)
    }
}
