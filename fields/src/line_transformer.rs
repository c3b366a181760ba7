//! The network of SAX-NeRF (Cai et al., CVPR 2024): maps features `[n, F]` of the samples of a ray to attenuation
//! `[n, 1]` by F → W → blocks of [line attention](crate::normalizers::line_attention) → (F + W) → W → 1. An
//! activation follows each linear map and the last block. The columns of the skip layer are the F features, then the W
//! channels of the last block.
//!
//! `line-attention` alone is a normalizer, which can also precede other fields.

use crate::linear::Linear;
use crate::normalizers::line_attention::{LineAttention, LineAttentionStage};
use conefield_core::activation::{Activation, activate};
use conefield_core::dense::{Output as Into, affine, affine_input, affine_weights};
use conefield_core::prelude::*;
use std::ops::Range;

/// Settings of `line-transformer`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LineTransformer {
    /// Channels of the hidden layers.
    pub width: usize,
    /// Blocks of line attention, 1 to 16.
    pub blocks: usize,
    /// Settings of each block.
    pub attention: LineAttention,
    /// Activation after each linear map but the last, and after the last block.
    pub activation: Activation,
    /// Activation after the last linear map.
    pub output: Activation,
}

impl Default for LineTransformer {
    fn default() -> Self {
        Self {
            width: 32,
            blocks: 1,
            attention: LineAttention::default(),
            activation: Activation::LeakyRelu,
            output: Activation::Sigmoid,
        }
    }
}

conefield_core::stage_type!(
    FieldSpec,
    "line-transformer",
    LineTransformer,
    "SAX-NeRF's network: attention between neighbouring samples of a ray"
);

impl FieldSpec for LineTransformer {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(LineTransformerStage::new(self, width)?))
    }
}

/// The stage that [`LineTransformer`] builds.
#[derive(Debug, Clone)]
pub struct LineTransformerStage {
    settings: LineTransformer,
    input: usize,
    first: Linear,
    block: LineAttentionStage,
    /// The first parameter of each block.
    blocks: Vec<usize>,
    skip: Linear,
    last: Linear,
    /// The stage for points off any ray.
    points: Option<Box<Self>>,
}

impl LineTransformerStage {
    /// The stage for `input` features; fails if a setting is out of range.
    pub fn new(settings: &LineTransformer, input: usize) -> Result<Self> {
        let &LineTransformer { width, blocks, ref attention, .. } = settings;
        ensure((1..=512).contains(&width), "spec", "width", width, "1 to 512 channels")?;
        ensure((1..=16).contains(&blocks), "spec", "blocks", blocks, "1 to 16")?;
        let block = LineAttentionStage::new(attention, width).map_err(|e| e.within("attention"))?;
        let first = Linear { skip: 0, input, output: width, start: 0 };
        let each = block.info().params;
        let starts: Vec<usize> = (0..blocks).map(|k| first.all().end + k * each).collect();
        let skip = Linear { skip: input, input: width, output: width, start: first.all().end + blocks * each };
        let last = Linear { skip: 0, input: width, output: 1, start: skip.all().end };
        let alone = block.of_points();
        let stage = Self { settings: settings.clone(), input, first, block, blocks: starts, skip, last, points: None };
        Ok(Self { points: Some(Box::new(Self { block: alone, ..stage.clone() })), ..stage })
    }

    fn linear(&self) -> [(&'static str, &Linear); 3] {
        [("first", &self.first), ("skip", &self.skip), ("last", &self.last)]
    }

    /// The parameter range of a block.
    fn of_block(&self, start: usize) -> Range<usize> {
        start..start + self.block.info().params
    }
}

/// Values kept from forward to backward, `[channels][n]` each.
struct Tape<'a, R> {
    /// The layers before the blocks, after them, and after the skip: output and derivative of the activation.
    first: [&'a mut [R]; 2],
    mixed: [&'a mut [R]; 2],
    skip: [&'a mut [R]; 2],
    /// The derivative of the last activation.
    last: &'a mut [R],
    /// Each block's output and tape.
    blocks: Vec<[&'a mut [R]; 2]>,
}

impl<'a, R: Real> Tape<'a, R> {
    fn of(stage: &LineTransformerStage, mut tape: TileMut<'a, R>) -> Self {
        let (width, own) = (stage.settings.width, stage.block.info().tape);
        let [first, mixed, skip] = std::array::from_fn(|_| [tape.take(width), tape.take(width)]);
        let last = tape.take(1);
        let blocks = stage.blocks.iter().map(|_| [tape.take(width), tape.take(own)]).collect();
        Self { first, mixed, skip, last, blocks }
    }
}

fn multiply<R: Real>(product: &mut [R], other: &[R]) {
    product.iter_mut().zip(other).for_each(|(a, &b)| *a *= b);
}

impl<R: Real> Kernel<R> for LineTransformerStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let (Self { settings, skip, last, .. }, n) = (self, x.rows);
        let mut tape = Tape::of(self, tape);
        let [first, slope] = &mut tape.first;
        affine(self.first.matrix(params, 0), Some(&params[self.first.bias()]), x.data, slope, n);
        activate(settings.activation, slope, first);
        let mut before: &[R] = first;
        for (&start, [output, own]) in self.blocks.iter().zip(&mut tape.blocks) {
            let (out, own) = (TileMut::new(output, n), TileMut::new(own, n));
            self.block.forward(&params[self.of_block(start)], Tile::new(before, n), out, own);
            before = output;
        }
        let [mixed, slope] = &mut tape.mixed;
        slope.copy_from_slice(before);
        activate(settings.activation, slope, mixed);
        let [hidden, slope] = &mut tape.skip;
        affine(skip.matrix(params, skip.skip), Some(&params[skip.bias()]), mixed, slope, n);
        affine(skip.matrix(params, 0), None, x.data, slope, n);
        activate(settings.activation, slope, hidden);
        affine(last.matrix(params, 0), Some(&params[last.bias()]), hidden, tape.last, n);
        activate(settings.output, tape.last, y.data);
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, mut dx }: Backward<'_, R>) {
        debug_assert_eq!(grads.range, 0..params.len());
        let (Self { first, skip, last, .. }, n, grads) = (self, x.rows, grads.values);
        let mut tape = Tape::of(self, tape);
        // The derivatives of activations become `∂L` of their arguments.
        multiply(tape.last, dy.data);
        let [hidden, d_skip] = tape.skip;
        let (dw, db) = last.gradients(grads);
        affine_weights(tape.last, hidden, dw, last.ld(), 0, Some(db), n);
        affine_input(last.matrix(params, 0), tape.last, d_skip, Into::Multiply, n);
        let [mixed, d] = tape.mixed;
        let (dw, db) = skip.gradients(grads);
        affine_weights(d_skip, mixed, dw, skip.ld(), skip.skip, Some(db), n);
        affine_weights(d_skip, x.data, dw, skip.ld(), 0, None, n);
        affine_input(skip.matrix(params, skip.skip), d_skip, d, Into::Multiply, n);
        if let Some(dx) = &mut dx {
            affine_input(skip.matrix(params, 0), d_skip, dx.data, Into::Set, n);
        }
        let [features, d_first] = tape.first;
        for (k, &start) in self.blocks.iter().enumerate().rev() {
            let (before, from) = tape.blocks.split_at_mut(k);
            let [output, own] = &mut from[0];
            let input: &[R] = if let Some([output, _]) = before.last() { output } else { features };
            self.block.backward(Backward {
                params: &params[self.of_block(start)],
                x: Tile::new(input, n),
                tape: TileMut::new(own, n),
                dy: Tile::new(d, n),
                grads: Grads::all(&mut grads[self.of_block(start)]),
                // The block's output is no longer needed: `∂L` of its input replaces it.
                dx: Some(TileMut::new(output, n)),
            });
            d.copy_from_slice(output);
        }
        multiply(d_first, d);
        let (dw, db) = first.gradients(grads);
        affine_weights(d_first, x.data, dw, first.ld(), 0, Some(db), n);
        if let Some(dx) = dx {
            affine_input(first.matrix(params, 0), d_first, dx.data, Into::Add, n);
        }
    }

    fn points(&self) -> Option<&(dyn Kernel<R> + '_)> {
        self.points.as_deref().map(|stage| stage as _)
    }
}

impl Stage for LineTransformerStage {
    fn info(&self) -> Info {
        let (width, block) = (self.settings.width, self.block.info());
        let linear: usize = self.linear().map(|(_, l)| l.weights().len()).iter().sum();
        Info {
            input: self.input,
            output: 1,
            params: self.last.all().end,
            tape: 6 * width + 1 + self.blocks.len() * (width + block.tape),
            scope: Scope::Ray,
            grads: GradKind::Dense,
            macs: linear + self.blocks.len() * block.macs,
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let mut all = vec![];
        for (name, l) in self.linear() {
            all.extend(l.parameters(name));
        }
        for (k, start) in self.blocks.iter().enumerate() {
            let of = |p: Parameter| Parameter { name: format!("blocks.{k}.{}", p.name), start: start + p.start, ..p };
            all.extend(self.block.parameters().into_iter().map(of));
        }
        all.sort_by_key(|p| p.start);
        all
    }

    /// Linear maps are initialized as in PyTorch.
    fn init(&self, seed: u64, params: &mut [f32]) {
        for (_, l) in self.linear() {
            l.init(seed, params, [1.0 / (l.ld() as f64).sqrt(); 2]);
        }
        for &start in &self.blocks {
            self.block.init(mix(seed, start as u64), &mut params[self.of_block(start)]);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        let (f, w, blocks) = (self.input, self.settings.width, self.blocks.len());
        let block = self.block.describe();
        let s = &self.settings;
        format!("line-transformer: {f}→{w}→{blocks} × ({block})→(+{f})→{w}→1, {:?} and {:?}", s.activation, s.output)
            .to_lowercase()
    }
}

impl Field for LineTransformerStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let stage = Self::new(&self.settings, keep.len())?;
        let blocks = self.first.all().end..self.skip.start;
        let params = [self.first.keep(keep), vec![blocks], self.skip.keep(keep), vec![self.last.all()]].concat();
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_network_has_its_parameter_count() {
        let stage = LineTransformerStage::new(&LineTransformer::default(), 32).unwrap();
        let block = 2 * 64 + 3 * 32 * 32 + 8 * 4 + 32 * 33 + 128 * 32 + 128 * 128 + 32 * 128;
        assert_eq!(stage.info().params, 33 * 32 + block + 65 * 32 + 33);
        let named: usize = stage.parameters().iter().map(|p| p.range().len()).sum();
        assert_eq!(named, stage.info().params);
    }

    #[test]
    fn settings_out_of_range_are_refused_by_their_key() {
        let attention = LineAttention { heads: 0, ..LineAttention::default() };
        let bad = LineTransformer { attention, ..LineTransformer::default() };
        let error = LineTransformerStage::new(&bad, 4).unwrap_err().to_string();
        assert!(error.contains("attention.heads"), "{error}");
        let bad = LineTransformer { blocks: 17, ..LineTransformer::default() };
        assert!(LineTransformerStage::new(&bad, 4).unwrap_err().to_string().contains("blocks"));
    }
}
