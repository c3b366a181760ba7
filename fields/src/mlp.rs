//! Multi-layer perceptron with skip connections: features `[n, F]` to attenuation `[n, 1]`.
//!
//! Layers count linear maps: `depth = 4, width = 32, skips = [2]` is F→32→32→(F+32)→32→1, the shape of NAF
//! (Zha et al. 2022) and NI-NeRF (Xu et al. 2025). A skip layer reads the features first, then the previous layer.

mod wgsl;

use crate::linear::Linear;
use conefield_core::activation::{self, Activation, activate};
use conefield_core::dense::{Output as Into, affine, affine_input, affine_weights};
use conefield_core::prelude::*;
use std::ops::Range;

/// Initialization of weights and biases.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Scheme {
    /// Weights and biases uniform in ±1/√inputs: PyTorch's default for linear layers.
    Torch,
    /// Weights uniform in ±√(6/inputs) (He et al. 2015), biases 0.
    He,
    /// Weights uniform in ±√(6/(inputs + outputs)) (Glorot & Bengio 2010), biases 0.
    Glorot,
}

/// Settings of `mlp`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Mlp {
    /// Channels of the hidden layers.
    pub width: usize,
    /// Number of linear layers, including the last.
    pub depth: usize,
    /// Layers (counted from 0) that read the features again, besides the previous layer.
    pub skips: Vec<usize>,
    /// Activation after every layer but the last.
    pub activation: Activation,
    /// Activation after the last layer.
    pub output: Activation,
    /// Initialization of the weights.
    pub init: Scheme,
}

impl Default for Mlp {
    fn default() -> Self {
        Self {
            width: 32,
            depth: 4,
            skips: vec![2],
            activation: Activation::Gelu,
            output: Activation::Squareplus,
            init: Scheme::Torch,
        }
    }
}

conefield_core::stage_type!(FieldSpec, "mlp", Mlp, "multi-layer perceptron with skip connections");

impl FieldSpec for Mlp {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(MlpStage::new(self, width)?))
    }
}

/// The stage that [`Mlp`] builds.
#[derive(Debug, Clone)]
pub struct MlpStage {
    settings: Mlp,
    input: usize,
    layers: Vec<Linear>,
}

impl MlpStage {
    /// The stage for `input` features; fails if a setting is out of range.
    pub fn new(settings: &Mlp, input: usize) -> Result<Self> {
        let s = settings;
        let depth = s.depth;
        ensure((1..=64).contains(&depth), "spec", "depth", depth, "1 to 64 linear layers")?;
        ensure((1..=1024).contains(&s.width), "spec", "width", s.width, "1 to 1024 channels")?;
        for &k in &s.skips {
            ensure(k > 0 && k < depth, "spec", "skips", k, format!("layers 1 to {}", depth - 1))?;
        }
        let mut layers = vec![];
        let mut start = 0;
        for i in 0..depth {
            let layer = Linear {
                skip: if s.skips.contains(&i) { input } else { 0 },
                input: if i == 0 { input } else { s.width },
                output: if i + 1 == depth { 1 } else { s.width },
                start,
            };
            start = layer.bias().end;
            layers.push(layer);
        }
        Ok(Self { settings: s.clone(), input, layers })
    }

    /// Tape channels: output and activation derivative of each hidden layer, then the derivative of the output
    /// activation.
    fn hidden(&self, layer: usize) -> Range<usize> {
        2 * layer * self.settings.width..(2 * layer + 1) * self.settings.width
    }
    fn slope(&self, layer: usize) -> Range<usize> {
        let w = self.settings.width;
        let start = (2 * layer + 1) * w;
        if layer + 1 == self.layers.len() { 2 * layer * w..2 * layer * w + 1 } else { start..start + w }
    }
}

impl<R: Real> Kernel<R> for MlpStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let n = x.rows;
        for (i, layer) in self.layers.iter().enumerate() {
            let last = i + 1 == self.layers.len();
            let act = if last { self.settings.output } else { self.settings.activation };
            // The linear map is written where its derivative will be stored; the activation then reads it in place.
            let from = if last { self.slope(i).start } else { self.hidden(i).start };
            let until = self.slope(i).end;
            let (before, rest) = tape.data.split_at_mut(from * n);
            let both = &mut rest[..(until - from) * n];
            let (h, z) = if last { (&mut y.data[..], both) } else { both.split_at_mut(layer.output * n) };
            let input = if i == 0 { x.data } else { &before[self.hidden(i - 1).start * n..self.hidden(i - 1).end * n] };
            affine(layer.matrix(params, layer.skip), Some(&params[layer.bias()]), input, z, n);
            if layer.skip > 0 {
                affine(layer.matrix(params, 0), None, x.data, z, n);
            }
            activate(act, z, h);
        }
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, mut dx }: Backward<'_, R>) {
        let n = x.rows;
        let last = self.layers.len() - 1;
        debug_assert_eq!(grads.range, 0..params.len());
        // The tape's derivatives become ∂L/∂z, layer by layer.
        for (d, &g) in tape.data[self.slope(last).start * n..].iter_mut().zip(dy.data) {
            *d *= g;
        }
        let mut fresh = true;
        for (i, layer) in self.layers.iter().enumerate().rev() {
            let (before, dz) = tape.data.split_at_mut(self.slope(i).start * n);
            let dz = &dz[..layer.output * n];
            let input = if i == 0 { x.data } else { &before[self.hidden(i - 1).start * n..self.hidden(i - 1).end * n] };
            let (dw, db) = layer.gradients(grads.values);
            affine_weights(dz, input, dw, layer.ld(), layer.skip, Some(db), n);
            if layer.skip > 0 {
                affine_weights(dz, x.data, dw, layer.ld(), 0, None, n);
            }
            if let Some(dx) = &mut dx
                && (layer.skip > 0 || i == 0)
            {
                let out = if fresh { Into::Set } else { Into::Add };
                affine_input(layer.matrix(params, 0), dz, dx.data, out, n);
                fresh = false;
            }
            if i > 0 {
                let slope = self.slope(i - 1);
                let dz_before = &mut before[slope.start * n..slope.end * n];
                affine_input(layer.matrix(params, layer.skip), dz, dz_before, Into::Multiply, n);
            }
        }
    }
}

impl Stage for MlpStage {
    fn info(&self) -> Info {
        Info {
            input: self.input,
            output: 1,
            params: self.layers.last().map_or(0, |l| l.all().end),
            tape: self.slope(self.layers.len() - 1).end,
            grads: GradKind::Dense,
            macs: self.layers.iter().map(|l| l.weights().len()).sum(),
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.layers.iter().enumerate().flat_map(|(i, l)| l.parameters(&i.to_string())).collect()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for l in &self.layers {
            let (fan_in, fan_out) = (l.ld() as f64, l.output as f64);
            let bounds = match self.settings.init {
                Scheme::Torch => [1.0 / fan_in.sqrt(); 2],
                Scheme::He => [(6.0 / fan_in).sqrt(), 0.0],
                Scheme::Glorot => [(6.0 / (fan_in + fan_out)).sqrt(), 0.0],
            };
            l.init(seed, params, bounds);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&[activation::WGSL, &wgsl::functions(self)]))
    }

    fn describe(&self) -> String {
        let mut shape = self.input.to_string();
        for (i, l) in self.layers.iter().enumerate() {
            if l.skip > 0 && i > 0 {
                shape += &format!("→(+{})", l.skip);
            }
            shape += &format!("→{}", l.output);
        }
        format!("mlp: {shape}, {:?} and {:?}", self.settings.activation, self.settings.output).to_lowercase()
    }
}

impl Field for MlpStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let stage = Self::new(&self.settings, keep.len())?;
        let reads = |(i, l): (usize, &Linear)| if i == 0 || l.skip > 0 { l.keep(keep) } else { vec![l.all()] };
        let params = self.layers.iter().enumerate().flat_map(reads).collect();
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_shapes_have_their_parameter_counts() {
        let count = |mlp: &Mlp, input| MlpStage::new(mlp, input).unwrap().info().params;
        assert_eq!(count(&Mlp::default(), 20), 21 * 32 + 33 * 32 + 53 * 32 + 33);
        let naf = Mlp { activation: Activation::LeakyRelu, output: Activation::Sigmoid, ..Mlp::default() };
        assert_eq!(count(&naf, 32), 33 * 32 + 33 * 32 + 65 * 32 + 33);
        let m = MlpStage::new(&Mlp::default(), 20).unwrap();
        assert_eq!(m.describe(), "mlp: 20→32→32→(+20)→32→1, gelu and squareplus");
    }
}
