//! An encoder for conefield: `y = sin(d·x + p)` with directions `d` and phases `p` that are learned.

@stage "waves of learned directions"
    /// Number of channels, one per wave.
    pub waves: usize = 32,
    /// Largest initial frequency of a wave, in radians per cube side.
    pub frequency: f32 = 20.0,
@

impl EncoderSpec for Settings {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        ensure((1..=4096).contains(&self.waves), "spec", "waves", self.waves, "1 to 4096")?;
        Ok(Box::new(ByRow::new(self.clone())))
    }
}

impl RowMap for Settings {
    fn widths(&self) -> [usize; 2] {
        [3, self.waves]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("wave".into(), vec![self.waves, 4])]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            *p = self.frequency * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        for (c, w) in params.chunks(4).enumerate() {
            let angle = x.at(0) * w[0] + x.at(1) * w[1] + x.at(2) * w[2] + w[3];
            y.set(c, angle.sin_cos().0);
        }
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        for (c, w) in params.chunks(4).enumerate() {
            let angle = x.at(0) * w[0] + x.at(1) * w[1] + x.at(2) * w[2] + w[3];
            let slope = dy.at(c) * angle.sin_cos().1;
            for k in 0..3 {
                grads.param(4 * c + k, slope * x.at(k));
                grads.input(k, slope * w[k]);
            }
            grads.param(4 * c + 3, slope);
        }
    }

    /// For `step_cells` of a projector, as in the spec balanced: resolving a period takes two cells.
    fn resolutions(&self) -> Option<Vec<f64>> {
        Some(vec![f64::from(self.frequency / std::f32::consts::PI).max(1.0); self.waves])
    }

    fn describe(&self) -> String {
        format!("@name@: {} waves", self.waves)
    }
}
