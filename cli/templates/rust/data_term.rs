//! A data term for conefield: `c²·(√(1 + (r/c)²) − 1)` of a residual r, squares that grow like |r| from some times the
//! noise on.

@stage "quadratic for small residuals, linear for large ones"
    /// Residuals well above this many standard deviations of the noise have a linear cost.
    pub from: f64 = 3.0,
@

impl DataTermSpec for Settings {
    fn build(&self) -> Result<Box<dyn DataTerm>> {
        let good = self.from.is_finite() && self.from > 0.0;
        ensure(good, "spec", "from", self.from, "a positive finite number")?;
        Ok(Box::new(self.clone()))
    }
}

impl DataTerm for Settings {
    /// The data term of the line integrals `[view, row, column]` of a scan.
    fn of(&self, measured: ArrayView3<'_, f32>) -> Result<Box<dyn Misfit>> {
        let noise = noise(measured);
        Ok(Box::new(On { noise, scale: (self.from * noise).max(1e-6) }))
    }

    fn describe(&self) -> String {
        format!("@name@: squares up to {} times the noise", self.from)
    }
}

/// The noise of a scan: second differences along rows contain little else, and edges hardly change their median.
fn noise(measured: ArrayView3<'_, f32>) -> f64 {
    let mut all = vec![];
    for row in measured.rows() {
        all.extend(row.windows(3).into_iter().map(|w| f64::from(w[0] - 2.0 * w[1] + w[2]).abs()));
    }
    if all.is_empty() {
        return 0.0;
    }
    let middle = all.len() / 2;
    *all.select_nth_unstable_by(middle, f64::total_cmp).1 / 0.6745 / 6f64.sqrt()
}

/// The data term of one scan.
struct On {
    noise: f64,
    scale: f64,
}

impl Misfit for On {
    /// The sum over the pixels of a view; residuals become derivatives.
    fn differentiate(&self, _view: usize, _measured: &[f32], residuals: &mut [f32]) -> f64 {
        let mut sum = 0.0;
        for r in residuals {
            let by = f64::from(*r) / self.scale;
            let root = by.hypot(1.0);
            sum += self.scale * self.scale * (by * by / (root + 1.0));
            *r = (f64::from(*r) / root) as f32;
        }
        sum
    }

    /// The second derivative is at most 1, so values stay unchanged.
    fn curve(&self, _view: usize, _measured: &[f32], _values: &mut [f32]) {}

    /// Derivatives scatter at most like the noise.
    fn spread(&self, _view: usize, _measured: &[f32], _values: &mut [f32]) {}

    fn noise(&self) -> f64 {
        self.noise
    }

    fn describe(&self) -> String {
        format!("noise of {:.3e} in line integrals", self.noise)
    }
}
