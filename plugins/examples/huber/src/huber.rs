//! Total variation with Huber's function: gradients below `threshold` have a quadratic cost, so that slopes stay
//! smooth; larger ones have a linear cost, so that edges stay sharp. Where all gradients are small, total variation
//! causes staircase artefacts.
//!
//! `R(x) = Σ_j h(|∇x|_j)`, `h(t) = t²/2δ` up to δ and `t − δ/2` above. Its proximal map is computed on the dual, like
//! that of total variation: `u = max(0, v − τ·∇ᵀp)` with `|p_j| ≤ 1`, and p ascends along `∇u − δ·p` (Chambolle and
//! Pock, J. Math. Imaging Vis. 40(1), 2011, section 6.2.2).

use conefield_plugin::prelude::*;

/// Settings of `huber`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
// The coefficients of the conformance kit are of order one.
#[schemars(extend("examples" = [{"threshold": 0.2}, {"threshold": 0.05, "inner": 1}]))]
pub struct Huber {
    /// Strength, as a multiple of the root mean square of back-projected noise.
    pub weight: f64,
    /// Differences between neighbours, in 1/mm, below which slopes stay smooth.
    pub threshold: f64,
    /// Dual steps per update.
    pub inner: usize,
}

impl Default for Huber {
    fn default() -> Self {
        Self { weight: 1.2, threshold: 5e-4, inner: 5 }
    }
}

conefield_plugin::stage_type!(RegularizerSpec, "huber", Huber, "flat or smooth attenuation with few edges");

impl RegularizerSpec for Huber {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        let good = self.weight.is_finite() && self.weight >= 0.0;
        ensure(good, "spec", "weight", self.weight, "a finite number, 0 or more")?;
        let good = self.threshold.is_finite() && self.threshold > 0.0;
        ensure(good, "spec", "threshold", self.threshold, "a positive finite number")?;
        ensure((1..=1000).contains(&self.inner), "spec", "inner", self.inner, "1 to 1000")?;
        Ok(Box::new(*self))
    }
}

impl Regularizer for Huber {
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        let side = grid.spacing.iter().product::<f64>().cbrt();
        let scale = grid.spacing.map(|s| (side / s) as f32);
        let dual = [0, 1, 2].map(|_| space.on_host(grid.shape.iter().product()));
        Ok(Box::new(On { shape: grid.shape, scale, threshold: self.threshold as f32, inner: self.inner, dual }))
    }

    fn weight(&self, _: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(noise(self.weight))
    }

    fn describe(&self) -> String {
        format!("huber: weight {} times the noise, smooth below {}/mm", self.weight, self.threshold)
    }
}

/// The penalty on one grid.
struct On {
    shape: [usize; 3],
    /// Factors of differences along each axis.
    scale: [f32; 3],
    threshold: f32,
    inner: usize,
    /// The dual variable along each axis.
    dual: [Vec<f32>; 3],
}

impl On {
    /// Strides between neighbours along each axis.
    fn steps(&self) -> [usize; 3] {
        [self.shape[1] * self.shape[2], self.shape[2], 1]
    }

    /// The neighbour of coefficient `i` along `axis`, if it is not the last one.
    fn next(&self, i: usize, axis: usize) -> Option<usize> {
        let step = self.steps()[axis];
        (i / step % self.shape[axis] + 1 < self.shape[axis]).then_some(i + step)
    }

    /// `∇x` at coefficient `i`.
    fn gradient(&self, x: &[f32], i: usize) -> [f32; 3] {
        [0, 1, 2].map(|axis| self.next(i, axis).map_or(0.0, |next| self.scale[axis] * (x[next] - x[i])))
    }

    /// `u = max(0, v − τ·∇ᵀp)`.
    fn primal(&self, v: &[f32], tau: f32, u: &mut [f32]) {
        let steps = self.steps();
        for (i, u) in u.iter_mut().enumerate() {
            let mut sum = 0.0;
            for axis in 0..3 {
                let p = &self.dual[axis];
                let first = (i / steps[axis]).is_multiple_of(self.shape[axis]);
                let before = if first { 0.0 } else { p[i - steps[axis]] };
                let here = if self.next(i, axis).is_some() { p[i] } else { 0.0 };
                sum += self.scale[axis] * (before - here);
            }
            *u = (v[i] - tau * sum).max(0.0);
        }
    }
}

impl Penalty for On {
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let x: Vec<f32> = x.iter().copied().collect();
        let threshold = f64::from(self.threshold);
        let of = |i| {
            let size = self.gradient(&x, i).iter().map(|d| f64::from(*d).powi(2)).sum::<f64>().sqrt();
            if size < threshold { 0.5 * size * size / threshold } else { size - 0.5 * threshold }
        };
        (0..x.len()).map(of).sum()
    }

    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        let bound = 4.0 * self.scale.iter().map(|g| g * g).sum::<f32>();
        let step = 1.0 / (tau * bound + self.threshold);
        for _ in 0..self.inner {
            self.primal(v, tau, u);
            for i in 0..u.len() {
                let slope = self.gradient(u, i);
                let p: [f32; 3] = [0, 1, 2].map(|axis| {
                    let p = self.dual[axis][i];
                    p + step * (slope[axis] - self.threshold * p)
                });
                let size = p.iter().map(|p| p * p).sum::<f32>().sqrt().max(1.0);
                for axis in 0..3 {
                    self.dual[axis][i] = p[axis] / size;
                }
            }
        }
        self.primal(v, tau, u);
    }

    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        let [x, y, z] = &mut self.dual;
        [("dual.x", x), ("dual.y", y), ("dual.z", z)].map(|(name, p)| (name, StatePart::Host(p))).into()
    }
}
