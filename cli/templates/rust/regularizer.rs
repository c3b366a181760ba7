//! A regularizer for conefield: quadratic smoothness, half the squared differences of neighbouring coefficients.

@stage "squared differences of neighbours"
    /// Strength, as a multiple of the root mean square of back-projected noise, for differences of 1/mm.
    pub weight: f64 = 100.0,
    /// Gradient steps of the proximal map per update.
    pub inner: usize = 4,
@

impl RegularizerSpec for Settings {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        let good = self.weight.is_finite() && self.weight >= 0.0;
        ensure(good, "spec", "weight", self.weight, "a finite number, 0 or more")?;
        ensure((1..=1000).contains(&self.inner), "spec", "inner", self.inner, "1 to 1000")?;
        Ok(Box::new(self.clone()))
    }
}

impl Regularizer for Settings {
    /// The penalty on a grid. Its arrays come from `space`, which counts their bytes.
    fn on(&self, grid: &VoxelGrid, space: &Space) -> Result<Box<dyn Penalty>> {
        let side = grid.spacing.iter().product::<f64>().cbrt();
        let strength = grid.spacing.map(|s| (side / s).powi(2) as f32);
        let [u, slope] = [0, 1].map(|_| space.on_host(grid.shape.iter().product()));
        Ok(Box::new(On { shape: grid.shape, strength, inner: self.inner, u, slope }))
    }

    /// The weight λ. `noise(k)` is k times the root mean square of the scan's noise in the gradient of the data term.
    fn weight(&self, _: &VoxelGrid, noise: &mut dyn FnMut(f64) -> f64) -> Result<f64> {
        Ok(noise(self.weight))
    }

    fn describe(&self) -> String {
        format!("@name@: squared differences, weight {} times the noise", self.weight)
    }
}

/// The penalty on one grid.
struct On {
    shape: [usize; 3],
    /// Weight of a squared difference along each axis.
    strength: [f32; 3],
    inner: usize,
    /// The result of the last call, from which the next one starts.
    u: Vec<f32>,
    /// The gradient of the penalty.
    slope: Vec<f32>,
}

/// Calls `take` with each pair of neighbours of a grid and their axis.
fn neighbours([x, y, z]: [usize; 3], mut take: impl FnMut(usize, usize, usize)) {
    for (axis, (step, n)) in [(y * z, x), (z, y), (1, z)].into_iter().enumerate() {
        (0..x * y * z).filter(|i| i / step % n + 1 < n).for_each(|i| take(i, i + step, axis));
    }
}

impl Penalty for On {
    /// The penalty of coefficients.
    fn value(&self, x: ArrayView3<'_, f32>) -> f64 {
        let x: Vec<f32> = x.iter().copied().collect();
        let mut sum = 0.0;
        neighbours(self.shape, |i, j, axis| sum += 0.5 * f64::from(self.strength[axis]) * f64::from(x[j] - x[i]).powi(2));
        sum
    }

    /// Takes some gradient steps towards the minimum of `½‖u − v‖² + tau·R(u)` with u ≥ 0.
    fn prox(&mut self, v: &[f32], tau: f32, u: &mut [f32]) {
        let Self { shape, strength, inner, u: at, slope } = self;
        let share = 1.0 / (1.0 + tau * 4.0 * strength.iter().sum::<f32>());
        for _ in 0..*inner {
            slope.fill(0.0);
            neighbours(*shape, |i, j, axis| {
                let d = strength[axis] * (at[j] - at[i]);
                slope[j] += d;
                slope[i] -= d;
            });
            for ((at, v), slope) in at.iter_mut().zip(v).zip(&*slope) {
                *at = ((1.0 - share) * *at + share * (v - tau * slope)).max(0.0);
            }
        }
        u.copy_from_slice(at);
    }

    /// The state from which the next call starts, for checkpoints.
    fn state(&mut self) -> Vec<(&str, StatePart<'_>)> {
        vec![("u", StatePart::Host(&mut self.u))]
    }
}
