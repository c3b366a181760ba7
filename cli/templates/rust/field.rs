//! A field for conefield: features `[n, F]` to attenuation `[n, 1]`, `y = ln(1 + exp(w·x + b))`, which is never
//! negative.

@stage "a weighted sum through a softplus"
    /// Initial shift; the lower it is, the closer the first volume is to 0.
    pub bias: f32 = -1.0,
@

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
    #[inline(always)]
    fn sum<N: Lanes>(&self, params: &[N::Real], x: Channels<N>) -> N {
        let mut sum = x.same(0.0) + params[self.width];
        for c in 0..self.width {
            sum += x.at(c) * params[c];
        }
        sum
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

    #[inline(always)]
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        y.set(0, self.sum(params, x).softplus());
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        // The slope of the softplus is 1/(1 + exp(−sum)).
        let d = dy.at(0) / ((-self.sum(params, x)).exp() + N::Real::ONE);
        for c in 0..self.width {
            grads.param(c, d * x.at(c));
            grads.input(c, d * params[c]);
        }
        grads.param(self.width, d);
    }

    fn describe(&self) -> String {
        format!("@name@: softplus of a sum of {} channels", self.width)
    }
}
