//! A linear map of a field.

use conefield_core::dense::WeightMatrix;
use conefield_core::random::uniform;
use conefield_core::stage::Parameter;
use std::ops::Range;

/// A linear map: `[output][skip + input]` weights, then biases.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Linear {
    /// Input channels from the features.
    pub skip: usize,
    /// Input channels from the previous layer, or from the features on the first layer.
    pub input: usize,
    /// Output channels.
    pub output: usize,
    /// Its first parameter.
    pub start: usize,
}

impl Linear {
    /// Number of columns of the weights.
    pub fn ld(&self) -> usize {
        self.skip + self.input
    }

    pub fn weights(&self) -> Range<usize> {
        self.start..self.start + self.output * self.ld()
    }

    pub fn bias(&self) -> Range<usize> {
        let start = self.weights().end;
        start..start + self.output
    }

    /// Weights and biases.
    pub fn all(&self) -> Range<usize> {
        self.start..self.bias().end
    }

    /// Its two blocks of parameters, named after `name`.
    pub fn parameters(&self, name: &str) -> [Parameter; 2] {
        let block = |part: &str, shape, start| Parameter { name: format!("{name}.{part}"), shape, start };
        [block("weight", vec![self.output, self.ld()], self.start), block("bias", vec![self.output], self.bias().start)]
    }

    /// Initializes weights and biases uniformly within these bounds.
    pub fn init(&self, seed: u64, params: &mut [f32], bounds: [f64; 2]) {
        for (range, bound) in [self.weights(), self.bias()].into_iter().zip(bounds) {
            range.for_each(|i| params[i] = uniform(seed, i, bound));
        }
    }

    /// The columns of the weights from `column` on.
    pub fn matrix<'a, R>(&self, params: &'a [R], column: usize) -> WeightMatrix<'a, R> {
        WeightMatrix { data: &params[self.weights()], ld: self.ld(), column }
    }

    /// Gradients of weights and of biases.
    pub fn gradients<'a, R>(&self, grads: &'a mut [R]) -> (&'a mut [R], &'a mut [R]) {
        grads[self.all()].split_at_mut(self.weights().len())
    }

    /// The parameters left if only `keep` of the features remain: columns of the first layer (`skip` is 0), or of the
    /// skip features.
    pub fn keep(&self, keep: &[usize]) -> Vec<Range<usize>> {
        let features = if self.skip == 0 { self.input } else { self.skip };
        let mut params = vec![];
        for row in self.weights().step_by(self.ld()) {
            params.extend(keep.iter().map(|&c| row + c..row + c + 1));
            params.push(row + features..row + self.ld());
        }
        params.push(self.bias());
        params
    }
}
