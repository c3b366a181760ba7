//! Line attention (Cai et al., *Structure-aware sparse-view X-ray 3D reconstruction*, SAX-NeRF, CVPR 2024): attention
//! between neighbouring samples of a ray, in segments.
//!
//! Maps features `[n, F]` to `[n, F]` in two steps with skip connections: `z = x + attention(LN(x))`,
//! `y = z + feed(LN(z))`.
//!
//! - Attention: a linear map gives queries, keys and values of several heads, `d` channels each. Within a segment,
//!   `o_i = Σ_j softmax_j(q_i·k_j/√d + p_ij)·v_j`, with learned `p` for each head; a linear map takes all `o` back to
//!   `F` channels.
//! - Feed-forward: `F → H → H → F` without biases, with GELU in between.
//!
//! A segment has `segment` consecutive samples; the last of a ray may be shorter. A point off any ray is its own
//! segment. The published code has no such points: it evaluates volumes in segments of neighbouring voxels.

use crate::normalizers::layer_norm::{LayerNorm, LayerNormStage};
use conefield_core::activation::{Activation, activate};
use conefield_core::dense::{Output as Into, WeightMatrix, affine, affine_input, affine_weights};
use conefield_core::prelude::*;
use conefield_core::random::uniform;
use conefield_core::simd::{Op, Simd, SimdBase, V, load, run, store};
use std::f64::consts::TAU;
use std::ops::Range;

/// Maximum samples per segment.
const LONGEST: usize = 64;

/// Settings of `line-attention`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LineAttention {
    /// Samples per segment, 1 to 64.
    pub segment: usize,
    /// Attention heads.
    pub heads: usize,
    /// Channels of each head.
    pub head_width: usize,
    /// Hidden channels of the feed-forward part, as a multiple of the features.
    pub expansion: usize,
}

impl Default for LineAttention {
    fn default() -> Self {
        Self { segment: 2, heads: 8, head_width: 4, expansion: 4 }
    }
}

conefield_core::stage_type!(
    NormalizerSpec,
    "line-attention",
    LineAttention,
    "attention between neighbouring samples of a ray, with a feed-forward network"
);

impl NormalizerSpec for LineAttention {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(LineAttentionStage::new(self, width)?))
    }
}

/// The stage that [`LineAttention`] builds.
#[derive(Debug, Clone)]
pub struct LineAttentionStage {
    settings: LineAttention,
    norm: LayerNormStage,
    width: usize,
    hidden: usize,
    at: Places,
    /// Samples that look at each other: `settings.segment`, or 1 for points off any ray.
    reach: usize,
    /// The stage for points off any ray.
    points: Option<Box<Self>>,
}

/// Parameter ranges. Matrices are row-major, with a row for each output.
#[derive(Debug, Clone)]
struct Places {
    norms: [Range<usize>; 2],
    /// Queries, keys and values, concatenated.
    qkv: Range<usize>,
    /// `[head][i][j]`.
    position: Range<usize>,
    project: Range<usize>,
    project_bias: Range<usize>,
    feed: [Range<usize>; 3],
}

impl LineAttentionStage {
    /// The stage for `width` channels; fails if a setting is out of range.
    pub fn new(settings: &LineAttention, width: usize) -> Result<Self> {
        let LineAttention { segment, heads, head_width, expansion } = *settings;
        let named = [
            ("segment", segment, LONGEST),
            ("heads", heads, 64),
            ("head_width", head_width, 64),
            ("expansion", expansion, 16),
        ];
        for (name, found, most) in named {
            ensure((1..=most).contains(&found), "spec", name, found, format!("1 to {most}"))?;
        }
        Self::of(settings.clone(), width, expansion * width)
    }

    fn of(settings: LineAttention, width: usize, hidden: usize) -> Result<Self> {
        let norm = LayerNormStage::new(&LayerNorm::default(), width)?;
        let mut end = 0;
        let ranges = blocks(&settings, width, hidden).map(|(_, shape)| {
            let start = end;
            end += shape.iter().product::<usize>();
            start..end
        });
        let [scale_0, shift_0, qkv, position, project, project_bias, scale_1, shift_1, feed_0, feed_1, feed_2] = ranges;
        let at = Places {
            norms: [scale_0.start..shift_0.end, scale_1.start..shift_1.end],
            qkv,
            position,
            project,
            project_bias,
            feed: [feed_0, feed_1, feed_2],
        };
        let stage = Self { reach: settings.segment, settings, norm, width, hidden, at, points: None };
        Ok(Self { points: Some(Box::new(stage.of_points())), ..stage })
    }

    /// The same function of points off any ray: each row is a segment of its own.
    pub fn of_points(&self) -> Self {
        Self { reach: 1, points: None, ..self.clone() }
    }

    /// Channels of all heads.
    fn inner(&self) -> usize {
        self.settings.heads * self.settings.head_width
    }

    /// Channels of each part of the tape, in the order of [`Tape`].
    fn tape(&self) -> [usize; 14] {
        let (f, h, inner) = (self.width, self.hidden, self.inner());
        let norm = self.norm.info().tape;
        let attention = self.settings.heads * self.settings.segment;
        [norm, f, 3 * inner, attention, inner, f, norm, f, h, h, h, h, 3 * inner, f]
    }

    /// Multiply-adds of the forward pass, in the order of the parts in `blocks`.
    fn macs(&self) -> usize {
        let (f, h, inner) = (self.width, self.hidden, self.inner());
        4 * f * inner + 2 * inner * self.settings.segment + 2 * f * h + h * h + 2 * self.norm.info().macs
    }
}

/// Names and shapes of the parameters, in order.
fn blocks(settings: &LineAttention, f: usize, h: usize) -> [(&'static str, Vec<usize>); 11] {
    let LineAttention { segment, heads, head_width, .. } = *settings;
    let inner = heads * head_width;
    [
        ("norm.0.weight", vec![f]),
        ("norm.0.bias", vec![f]),
        ("qkv.weight", vec![3 * inner, f]),
        ("position", vec![heads, segment, segment]),
        ("project.weight", vec![f, inner]),
        ("project.bias", vec![f]),
        ("norm.1.weight", vec![f]),
        ("norm.1.bias", vec![f]),
        ("feed.0.weight", vec![h, f]),
        ("feed.1.weight", vec![h, h]),
        ("feed.2.weight", vec![f, h]),
    ]
}

/// Values kept from forward to backward, `[channels][n]` each, and working memory of backward.
struct Tape<'a, R> {
    norm: [&'a mut [R]; 2],
    /// Inputs of attention and of the feed-forward part; backward stores their `∂L` there.
    normed: [&'a mut [R]; 2],
    /// Queries, keys and values.
    qkv: &'a mut [R],
    /// Weights, `[head][j]`: the share of row `j` of its segment in a row.
    weights: &'a mut [R],
    /// The output of all heads; backward stores its `∂L` there.
    attended: &'a mut [R],
    /// `z`, the sum after attention.
    sum: &'a mut [R],
    /// Hidden layers and the derivatives of their activations.
    hidden: [&'a mut [R]; 2],
    slope: [&'a mut [R]; 2],
    /// `∂L` of `qkv`, and of `sum`.
    d_qkv: &'a mut [R],
    d_sum: &'a mut [R],
}

impl<'a, R: Real> Tape<'a, R> {
    fn of(stage: &LineAttentionStage, mut tape: TileMut<'a, R>) -> Self {
        let [norm_0, normed_0, qkv, weights, attended, sum, norm_1, normed_1, h0, s0, h1, s1, d_qkv, d_sum] =
            stage.tape().map(|channels| tape.take(channels));
        Self {
            norm: [norm_0, norm_1],
            normed: [normed_0, normed_1],
            qkv,
            weights,
            attended,
            sum,
            hidden: [h0, h1],
            slope: [s0, s1],
            d_qkv,
            d_sum,
        }
    }
}

/// A whole matrix with `columns` columns.
fn matrix<R>(data: &[R], columns: usize) -> WeightMatrix<'_, R> {
    WeightMatrix { data, ld: columns, column: 0 }
}

/// Computes `sum = x + attention(normed[0])`.
struct Attend<'a, 'b, R> {
    stage: &'a LineAttentionStage,
    params: &'a [R],
    x: Tile<'a, R>,
    tape: &'a mut Tape<'b, R>,
}

impl<R: Real> Op for Attend<'_, '_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { stage, params, x, tape } = self;
        let (n, at, inner) = (x.rows, stage.at.clone(), stage.inner());
        let LineAttention { segment, heads, head_width: d, .. } = stage.settings;
        let reach = stage.reach;
        tape.qkv.fill(R::ZERO);
        affine(matrix(&params[at.qkv], stage.width), None, tape.normed[0], tape.qkv, n);
        let (queries, rest) = tape.qkv.split_at(inner * n);
        let (keys, values) = rest.split_at(inner * n);
        let position = &params[at.position];
        let scale = R::of(1.0 / (d as f64).sqrt());
        for head in 0..heads {
            for j in 0..reach {
                let weights = &mut tape.weights[(head * segment + j) * n..][..n];
                for start in (0..n).step_by(reach) {
                    let long = reach.min(n - start);
                    for i in 0..long {
                        // If the last segment has no row j, any finite score will do: its weight becomes 0.
                        let partner = start + if j < long { j } else { 0 };
                        let mut product = R::ZERO;
                        for c in head * d..(head + 1) * d {
                            product += queries[c * n + start + i] * keys[c * n + partner];
                        }
                        weights[start + i] = scale * product + position[(head * segment + i) * segment + j];
                    }
                }
            }
            softmax(s, &mut tape.weights[head * segment * n..][..reach * n], reach, n);
        }
        tape.attended.fill(R::ZERO);
        for c in 0..inner {
            let (value, out) = (&values[c * n..][..n], &mut tape.attended[c * n..][..n]);
            for j in 0..reach {
                let weights = &tape.weights[(c / d * segment + j) * n..][..n];
                for start in (0..n).step_by(reach).take_while(|start| start + j < n) {
                    for i in start..(start + reach).min(n) {
                        out[i] += weights[i] * value[start + j];
                    }
                }
            }
        }
        tape.sum.copy_from_slice(x.data);
        let (weights, bias) = (matrix(&params[at.project], inner), &params[at.project_bias]);
        affine(weights, None, tape.attended, tape.sum, n);
        for (sum, &b) in tape.sum.chunks_exact_mut(n).zip(bias) {
            sum.iter_mut().for_each(|v| *v += b);
        }
    }
}

/// Softmax over `segment` channels of scores. Rows missing in a short last segment get the weight 0.
#[inline(always)]
fn softmax<S: Simd, R: Real>(s: S, scores: &mut [R], segment: usize, n: usize) {
    let mut i = 0;
    while i < n {
        let mut top = load(s, &scores[..n], i);
        for j in 1..segment {
            top = top.max(load(s, &scores[j * n..(j + 1) * n], i));
        }
        for j in 0..segment {
            let scores = &mut scores[j * n..(j + 1) * n];
            let e = R::exp_lanes(s, load(s, scores, i) - top);
            store::<S, R>(e, scores, i);
        }
        i += V::<S, R>::LEN;
    }
    let whole = n / segment * segment;
    for j in n - whole..segment {
        scores[j * n + whole..(j + 1) * n].fill(R::ZERO);
    }
    let mut i = 0;
    while i < n {
        let mut sum = V::<S, R>::splat(s, R::ZERO);
        for j in 0..segment {
            sum += load(s, &scores[j * n..(j + 1) * n], i);
        }
        for j in 0..segment {
            let scores = &mut scores[j * n..(j + 1) * n];
            let weight = load(s, scores, i) / sum;
            store::<S, R>(weight, scores, i);
        }
        i += V::<S, R>::LEN;
    }
}

impl LineAttentionStage {
    /// Computes `y = sum + feed(normed[1])`.
    fn feed<R: Real>(&self, params: &[R], y: TileMut<'_, R>, tape: &mut Tape<'_, R>) {
        let (n, [first, second, third]) = (y.rows, self.at.feed.clone());
        let ([h0, h1], [s0, s1]) = (&mut tape.hidden, &mut tape.slope);
        s0.fill(R::ZERO);
        affine(matrix(&params[first], self.width), None, tape.normed[1], s0, n);
        activate(Activation::Gelu, s0, h0);
        s1.fill(R::ZERO);
        affine(matrix(&params[second], self.hidden), None, h0, s1, n);
        activate(Activation::Gelu, s1, h1);
        y.data.copy_from_slice(tape.sum);
        affine(matrix(&params[third], self.hidden), None, h1, y.data, n);
    }

    /// Backward pass of the feed-forward part: `∂L` of `normed[1]` from `dy`.
    fn feed_back<R: Real>(&self, params: &[R], dy: Tile<'_, R>, grads: &mut [R], tape: &mut Tape<'_, R>) {
        let (n, [first, second, third]) = (dy.rows, self.at.feed.clone());
        let (f, h) = (self.width, self.hidden);
        let ([h0, h1], [s0, s1]) = (&tape.hidden, &mut tape.slope);
        affine_weights(dy.data, h1, &mut grads[third.clone()], h, 0, None, n);
        affine_input(matrix(&params[third], h), dy.data, s1, Into::Multiply, n);
        affine_weights(s1, h0, &mut grads[second.clone()], h, 0, None, n);
        affine_input(matrix(&params[second], h), s1, s0, Into::Multiply, n);
        affine_weights(s0, tape.normed[1], &mut grads[first.clone()], f, 0, None, n);
        affine_input(matrix(&params[first], f), s0, tape.normed[1], Into::Set, n);
    }

    /// Backward pass of attention: `∂L` of `normed[0]` from `d_sum`.
    fn attend_back<R: Real>(&self, params: &[R], n: usize, grads: &mut [R], tape: &mut Tape<'_, R>) {
        let (at, inner) = (self.at.clone(), self.inner());
        let LineAttention { segment, heads, head_width: d, .. } = self.settings;
        let reach = self.reach;
        let (dw, db) = grads[at.project.start..at.project_bias.end].split_at_mut(at.project.len());
        affine_weights(tape.d_sum, tape.attended, dw, inner, 0, Some(db), n);
        affine_input(matrix(&params[at.project], inner), tape.d_sum, tape.attended, Into::Set, n);
        let (d_attended, position) = (&*tape.attended, &mut grads[at.position]);
        let (queries, rest) = tape.qkv.split_at(inner * n);
        let (keys, values) = rest.split_at(inner * n);
        tape.d_qkv.fill(R::ZERO);
        let (d_queries, rest) = tape.d_qkv.split_at_mut(inner * n);
        let (d_keys, d_values) = rest.split_at_mut(inner * n);
        let scale = R::of(1.0 / (d as f64).sqrt());
        let mut d_weight = [R::ZERO; LONGEST];
        for head in 0..heads {
            let channels = head * d..(head + 1) * d;
            for start in (0..n).step_by(reach) {
                let long = reach.min(n - start);
                for i in 0..long {
                    let row = start + i;
                    let weight = |j: usize| tape.weights[(head * segment + j) * n + row];
                    let mut mean = R::ZERO;
                    for j in 0..long {
                        let mut product = R::ZERO;
                        for c in channels.clone() {
                            product += d_attended[c * n + row] * values[c * n + start + j];
                            d_values[c * n + start + j] += weight(j) * d_attended[c * n + row];
                        }
                        d_weight[j] = product;
                        mean += weight(j) * product;
                    }
                    for j in 0..long {
                        let d_score = weight(j) * (d_weight[j] - mean);
                        position[(head * segment + i) * segment + j] += d_score;
                        for c in channels.clone() {
                            d_queries[c * n + row] += scale * d_score * keys[c * n + start + j];
                            d_keys[c * n + start + j] += scale * d_score * queries[c * n + row];
                        }
                    }
                }
            }
        }
        affine_weights(tape.d_qkv, tape.normed[0], &mut grads[at.qkv.clone()], self.width, 0, None, n);
        affine_input(matrix(&params[at.qkv], self.width), tape.d_qkv, tape.normed[0], Into::Set, n);
    }
}

impl<R: Real> Kernel<R> for LineAttentionStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        let (n, [first, second]) = (x.rows, self.at.norms.clone());
        let mut tape = Tape::of(self, tape);
        let Tape { norm, normed, .. } = &mut tape;
        let tiles = (TileMut::new(normed[0], n), TileMut::new(norm[0], n));
        self.norm.forward(&params[first], x, tiles.0, tiles.1);
        run(Attend { stage: self, params, x, tape: &mut tape });
        let Tape { norm, normed, sum, .. } = &mut tape;
        let tiles = (TileMut::new(normed[1], n), TileMut::new(norm[1], n));
        self.norm.forward(&params[second], Tile::new(sum, n), tiles.0, tiles.1);
        self.feed(params, y, &mut tape);
    }

    fn backward(&self, Backward { params, x, tape, dy, grads, mut dx }: Backward<'_, R>) {
        debug_assert_eq!(grads.range, 0..params.len());
        let (n, [first, second], grads) = (x.rows, self.at.norms.clone(), grads.values);
        let mut tape = Tape::of(self, tape);
        self.feed_back(params, dy, grads, &mut tape);
        let Tape { norm, normed, sum, d_sum, .. } = &mut tape;
        self.norm.backward(Backward {
            params: &params[second.clone()],
            x: Tile::new(sum, n),
            tape: TileMut::new(norm[1], n),
            dy: Tile::new(normed[1], n),
            grads: Grads::all(&mut grads[second]),
            dx: Some(TileMut::new(d_sum, n)),
        });
        add(d_sum, dy.data);
        self.attend_back(params, n, grads, &mut tape);
        let Tape { norm, normed, d_sum, .. } = &mut tape;
        self.norm.backward(Backward {
            params: &params[first.clone()],
            x,
            tape: TileMut::new(norm[0], n),
            dy: Tile::new(normed[0], n),
            grads: Grads::all(&mut grads[first]),
            dx: dx.as_mut().map(|dx| TileMut::new(dx.data, n)),
        });
        if let Some(dx) = dx {
            add(dx.data, d_sum);
        }
    }

    fn points(&self) -> Option<&(dyn Kernel<R> + '_)> {
        self.points.as_deref().map(|stage| stage as _)
    }
}

fn add<R: Real>(sum: &mut [R], other: &[R]) {
    sum.iter_mut().zip(other).for_each(|(a, &b)| *a += b);
}

impl Stage for LineAttentionStage {
    fn info(&self) -> Info {
        Info {
            input: self.width,
            output: self.width,
            params: self.at.feed[2].end,
            tape: self.tape().iter().sum(),
            scope: Scope::Ray,
            grads: GradKind::Dense,
            macs: self.macs(),
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let mut start = 0;
        let of = |(name, shape): (&str, Vec<usize>)| {
            let p = Parameter { name: name.into(), shape, start };
            start = p.range().end;
            p
        };
        blocks(&self.settings, self.width, self.hidden).map(of).into()
    }

    /// Matrices are initialized as PyTorch's linear layers, norms with 1 and 0, positions from a normal distribution of
    /// standard deviation 1, truncated at ±2, as published.
    fn init(&self, seed: u64, params: &mut [f32]) {
        let inner = self.inner();
        for p in self.parameters() {
            let fan_in = match p.name.as_str() {
                "project.bias" => inner,
                _ => p.shape[p.shape.len() - 1],
            };
            let bound = 1.0 / (fan_in as f64).sqrt();
            for i in p.range() {
                params[i] = match p.name.as_str() {
                    "norm.0.weight" | "norm.1.weight" => 1.0,
                    "norm.0.bias" | "norm.1.bias" => 0.0,
                    "position" => normal(seed, i as u64) as f32,
                    _ => uniform(seed, i, bound),
                };
            }
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn describe(&self) -> String {
        let LineAttention { segment, heads, head_width, .. } = self.settings;
        format!(
            "line-attention: {} channels, segments of {segment} samples, {heads} heads of {head_width} channels, {} hidden",
            self.width, self.hidden
        )
    }
}

/// A standard normal number between -2 and 2 (Box and Muller 1958; values outside are redrawn).
fn normal(seed: u64, i: u64) -> f64 {
    let mut draws = (0..).map(|k| {
        let [a, b] = [0, 1].map(|part| f64::from(unit(mix(mix(seed, i), 2 * k + part))));
        (-2.0 * (1.0 - a).ln()).sqrt() * (TAU * b).cos()
    });
    draws.find(|x| x.abs() <= 2.0).expect("of a normal distribution 95 % lie within two deviations")
}

impl Normalizer for LineAttentionStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        ensure(!keep.is_empty(), "line-attention", "channels", "none kept", "at least one")?;
        // The hidden layers keep their width.
        let stage = Self::of(self.settings.clone(), keep.len(), self.hidden)?;
        let mut params = vec![];
        for p in self.parameters() {
            match p.name.as_str() {
                // One column per channel.
                "qkv.weight" | "feed.0.weight" => {
                    let rows = p.range().step_by(self.width);
                    params.extend(rows.flat_map(|row| keep.iter().map(move |c| row + c..row + c + 1)));
                }
                // Independent of the channels.
                "position" | "feed.1.weight" => params.push(p.range()),
                // One row per channel.
                _ => {
                    let row: usize = p.shape[1..].iter().product();
                    params.extend(keep.iter().map(|c| p.start + c * row..p.start + (c + 1) * row));
                }
            }
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..keep.len()).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn apply(stage: &LineAttentionStage, params: &[f64], x: &[f64], n: usize) -> Vec<f64> {
        let (mut y, mut tape) = (vec![0.0; stage.width * n], vec![0.0; stage.info().tape * n]);
        stage.forward(params, Tile::new(x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
        y
    }

    fn drawn(stage: &LineAttentionStage, n: usize) -> (Vec<f64>, Vec<f64>) {
        let mut params = vec![0.0; stage.info().params];
        stage.init(5, &mut params);
        let x = (0..stage.width * n).map(|i| (i as f64 * 0.77).sin() * 2.0).collect();
        (params.into_iter().map(f64::from).collect(), x)
    }

    /// The formula, evaluated row by row.
    fn plainly(stage: &LineAttentionStage, params: &[f64], x: &[f64], n: usize) -> Vec<f64> {
        let (f, inner, d) = (stage.width, stage.inner(), stage.settings.head_width);
        let (segment, at) = (stage.settings.segment, &stage.at);
        let norm = |row: &[f64], p: &[f64]| -> Vec<f64> {
            let mean = row.iter().sum::<f64>() / f as f64;
            let variance = row.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / f as f64;
            (0..f).map(|c| (row[c] - mean) / (variance + 1e-5).sqrt() * p[c] + p[f + c]).collect()
        };
        let times = |w: &[f64], x: &[f64]| -> Vec<f64> {
            w.chunks_exact(x.len()).map(|w| w.iter().zip(x).map(|(a, b)| a * b).sum()).collect()
        };
        let row = |i: usize| -> Vec<f64> { (0..f).map(|c| x[c * n + i]).collect() };
        let read: Vec<Vec<f64>> =
            (0..n).map(|i| times(&params[at.qkv.clone()], &norm(&row(i), &params[at.norms[0].clone()]))).collect();
        let mut y = vec![0.0; f * n];
        for i in 0..n {
            let start = i / segment * segment;
            let mates: Vec<usize> = (start..(start + segment).min(n)).collect();
            let mut found = vec![];
            for head in 0..stage.settings.heads {
                let score = |j: &usize| {
                    let product: f64 = (head * d..(head + 1) * d).map(|c| read[i][c] * read[*j][inner + c]).sum();
                    let p = (head * segment + i - start) * segment + j - start;
                    product / (d as f64).sqrt() + params[at.position.clone()][p]
                };
                let e: Vec<f64> = mates.iter().map(|j| score(j).exp()).collect();
                let sum: f64 = e.iter().sum();
                for c in head * d..(head + 1) * d {
                    found.push(mates.iter().zip(&e).map(|(j, e)| e / sum * read[*j][2 * inner + c]).sum());
                }
            }
            let out = times(&params[at.project.clone()], &found);
            let z: Vec<f64> = (0..f).map(|c| row(i)[c] + out[c] + params[at.project_bias.clone()][c]).collect();
            let gelu =
                |v: Vec<f64>| -> Vec<f64> { v.into_iter().map(|x| 0.5 * x * libm::erfc(-x / 2f64.sqrt())).collect() };
            let mut hidden = norm(&z, &params[at.norms[1].clone()]);
            for layer in &at.feed[..2] {
                hidden = gelu(times(&params[layer.clone()], &hidden));
            }
            let fed = times(&params[at.feed[2].clone()], &hidden);
            (0..f).for_each(|c| y[c * n + i] = z[c] + fed[c]);
        }
        y
    }

    #[test]
    fn rows_follow_the_formula() {
        for (segment, n) in [(2, 8), (2, 7), (3, 11), (5, 3), (1, 4), (64, 70)] {
            let settings = LineAttention { segment, heads: 3, head_width: 2, expansion: 2 };
            let stage = LineAttentionStage::new(&settings, 5).unwrap();
            let (params, x) = drawn(&stage, n);
            let (got, want) = (apply(&stage, &params, &x, n), plainly(&stage, &params, &x, n));
            for (g, w) in got.iter().zip(&want) {
                assert!((g - w).abs() < 1e-10, "segment {segment}, {n} rows: {g} {w}");
            }
        }
    }

    #[test]
    fn rows_look_at_their_own_segment_only() {
        let stage = LineAttentionStage::new(&LineAttention::default(), 4).unwrap();
        let (params, mut x) = drawn(&stage, 6);
        let before = apply(&stage, &params, &x, 6);
        x[3] += 1.0;
        let after = apply(&stage, &params, &x, 6);
        let changed: Vec<bool> = (0..6).map(|i| (0..4).any(|c| before[c * 6 + i] != after[c * 6 + i])).collect();
        assert_eq!(changed, [false, false, true, true, false, false]);
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        for (name, settings) in [
            ("segment", LineAttention { segment: 65, ..LineAttention::default() }),
            ("heads", LineAttention { heads: 0, ..LineAttention::default() }),
            ("head_width", LineAttention { head_width: 65, ..LineAttention::default() }),
            ("expansion", LineAttention { expansion: 17, ..LineAttention::default() }),
        ] {
            let error = LineAttentionStage::new(&settings, 4).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
        let error = LineAttentionStage::new(&LineAttention::default(), 4).unwrap().keep_inputs(&[]).err().unwrap();
        assert!(error.to_string().contains("none kept"), "{error}");
    }
}
