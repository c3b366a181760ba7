//! An initializer for conefield: fills parameters before training.
//!
//! This start fills every block whose name begins with `prefix` with uniform numbers; every other block keeps the
//! initialization by its own stage.

@stage "uniform numbers in the blocks of one stage"
    /// Fill blocks whose name begins with this, such as `encoder` or `field.0.weight`.
    pub prefix: String = "encoder".into(),
    /// Numbers are uniform in ± this.
    pub bound: f32 = 1e-4,
@

impl InitializerSpec for Settings {
    fn build(&self, _: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        let good = self.bound.is_finite() && self.bound >= 0.0;
        ensure(good, "spec", "bound", self.bound, "a finite number of at least 0")?;
        Ok(Box::new(self.clone()))
    }
}

impl Initializer for Settings {
    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        let mut report = InitReport::default();
        for block in &layout.blocks {
            if !block.name.starts_with(&self.prefix) {
                report.fresh.push((block.name.clone(), "not asked for".into()));
                continue;
            }
            for i in block.range.clone() {
                arena.params[i] = self.bound * (2.0 * unit(mix(1, i as u64)) - 1.0);
            }
            report.loaded.push(block.name.clone());
        }
        Ok(report)
    }

    fn describe(&self) -> String {
        format!("@name@: {} within {}", self.prefix, self.bound)
    }
}
