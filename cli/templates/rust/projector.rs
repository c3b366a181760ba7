//! A projector for conefield: rays to samples, each with its length.
//!
//! This start takes the middles of equal intervals within the reconstruction box. The line integral is the sum of
//! attenuation times length, and its adjoint comes with the trait.

@stage "equal intervals within the box"
    /// Samples per ray that meets the box.
    pub samples: usize = 128,
    /// Use a random position in every interval instead of its middle.
    pub random: bool = false,
@

impl ProjectorSpec for Settings {
    fn build(&self) -> Result<Box<dyn Projector>> {
        ensure((1..=65_536).contains(&self.samples), "spec", "samples", self.samples, "1 to 65536")?;
        Ok(Box::new(self.clone()))
    }
}

impl Projector for Settings {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        let [near, far] = ray.inside;
        if far > near { self.samples } else { 0 }
    }

    /// `seed` is `None` for rendering: then nothing is random.
    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
        let [near, far] = ray.inside;
        let n = self.max_samples(ray);
        let length = (far - near) / n as f32;
        for i in 0..n {
            let place = match seed {
                Some(seed) if self.random => unit(mix(seed, i as u64)),
                _ => 0.5,
            };
            let t = near + (i as f32 + place) * length;
            out.points.push(std::array::from_fn(|k| ray.origin[k] + t * ray.direction[k]));
            out.weights.push(length);
        }
    }

    fn describe(&self) -> String {
        format!("@name@: {} samples per ray", self.samples)
    }
}
