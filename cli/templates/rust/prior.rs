//! A prior for conefield: half the squared differences of neighbouring points, in small blocks placed at random.

@stage "squared differences of neighbouring points"
    /// Weight relative to the mean loss of a ray.
    pub weight: f64 = 0.1,
    /// Blocks per step.
    pub blocks: usize = 32,
    /// Points along a block's edge.
    pub edge: usize = 8,
    /// Spacing of the points in voxels.
    pub spacing: f64 = 1.0,
@

impl PriorSpec for Settings {
    fn build(&self) -> Result<Box<dyn Prior>> {
        Prior::blocks(self).validate()?;
        Ok(Box::new(self.clone()))
    }
}

impl Prior for Settings {
    fn blocks(&self) -> Blocks {
        Blocks { edge: self.edge, count: self.blocks, spacing: self.spacing, weight: self.weight }
    }

    /// The penalty. Adds `scale` times its derivatives to `gradient`.
    fn block(&self, values: &[f64], scale: f64, gradient: &mut [f64]) -> f64 {
        let mut sum = 0.0;
        for step in [self.edge * self.edge, self.edge, 1] {
            for i in (0..values.len()).filter(|i| i / step % self.edge + 1 < self.edge) {
                let d = values[i + step] - values[i];
                sum += 0.5 * d * d;
                gradient[i + step] += scale * d;
                gradient[i] -= scale * d;
            }
        }
        sum
    }

    fn describe(&self) -> String {
        format!("@name@: squared differences, weight {}", self.weight)
    }
}
