//! A loss for conefield: `sqrt(d² + s²) − s` of the difference `d`, an absolute value that is rounded near 0.

@stage "the absolute difference, rounded near 0"
    /// Differences well below this have a quadratic loss.
    pub scale: f64 = 0.01,
@

impl LossSpec for Settings {
    fn build(&self) -> Result<Box<dyn Loss>> {
        // Shaders use single precision.
        let good = self.scale > 0.0 && (self.scale as f32).is_normal();
        ensure(good, "spec", "scale", self.scale, "a positive number of single precision")?;
        Ok(Box::new(self.clone()))
    }
}

impl Loss for Settings {
    /// The loss and its derivative with respect to `predicted`.
    fn at(&self, predicted: f64, measured: f64) -> (f64, f64) {
        let d = predicted - measured;
        let size = d.hypot(self.scale);
        (d * (d / (size + self.scale)), d / size)
    }

    /// The same for a GPU; without it the loss runs on the CPU only.
    fn wgsl(&self) -> Option<Fragment> {
        let scale = format!("const stage_scale = f32({:?});\n", self.scale as f32);
        let at = "fn stage_at(predicted: f32, measured: f32) -> vec2<f32> {
    let d = predicted - measured;
    let size = sqrt(d * d + stage_scale * stage_scale);
    return vec2<f32>(d * (d / (size + stage_scale)), d / size);
}
";
        Some(Fragment::new(&[&scale, at]))
    }

    fn describe(&self) -> String {
        format!("@name@: rounded below {}", self.scale)
    }
}
