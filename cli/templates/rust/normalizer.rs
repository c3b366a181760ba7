//! A normalizer for conefield: features `[n, F]` to features `[n, F]`.
//!
//! This start scales and shifts every channel by numbers that are learned: `y = w·x + b`. Its backward pass is written
//! by hand; `cargo test` compares it with finite differences.

@stage "a learned scale and shift of every channel"
    /// Initial scale.
    pub scale: f32 = 1.0,
@

impl NormalizerSpec for Settings {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(ByRow::new(Affine { width, scale: self.scale })))
    }
}

struct Affine {
    width: usize,
    scale: f32,
}

impl RowMap for Affine {
    fn widths(&self) -> [usize; 2] {
        [self.width; 2]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("scale".into(), vec![self.width]), ("shift".into(), vec![self.width])]
    }

    fn init(&self, _: u64, params: &mut [f32]) {
        let (scale, shift) = params.split_at_mut(self.width);
        scale.fill(self.scale);
        shift.fill(0.0);
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        for c in 0..self.width {
            y.set(c, x.at(c) * params[c] + params[self.width + c]);
        }
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        for c in 0..self.width {
            grads.param(c, dy.at(c) * x.at(c));
            grads.param(self.width + c, dy.at(c));
            grads.input(c, dy.at(c) * params[c]);
        }
    }

    fn macs(&self) -> usize {
        self.width
    }

    /// Channels are independent: without some, the rest is a smaller stage of the same kind.
    fn keep(&self, keep: &[usize]) -> Option<(Self, Vec<std::ops::Range<usize>>)> {
        let part = |start: usize| keep.iter().map(move |&c| start + c..start + c + 1);
        Some((Self { width: keep.len(), scale: self.scale }, part(0).chain(part(self.width)).collect()))
    }

    fn describe(&self) -> String {
        format!("@name@: {} channels, each with a scale and a shift", self.width)
    }
}
