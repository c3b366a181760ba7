//! Attention over the levels of an encoder (Oh et al. 2026, GH-NAF: Grid-Adaptive Hash-Level-Attended Neural
//! Attenuation Fields, CVPR). Each point weights the levels by a softmax, so that coarse levels can represent smooth
//! tissue and fine ones edges.
//!
//! Maps features `[n, F]` of `L` levels to `[n, F]`: `a = softmax(W·x + b)` over the levels, `y_c = L·a_l·x_c` for each
//! channel `c` of level `l`. It starts near the identity: small features give every level the weight 1/L.
//!
//! The publication's code is not available, and its abstract specifies neither the input of the attention nor how
//! levels are combined. Here the input is a linear map of the features, and levels stay separate. The publication's
//! additional training target of the attention (from gradients of the attenuation, and uncertainty) is not included.

use crate::passes::{Back, Forward};
use conefield_core::dense::{Output as Into, WeightMatrix, affine, affine_input, affine_weights};
use conefield_core::prelude::*;
use conefield_core::simd::{Op, Simd, SimdBase, SimdFloat, V, load, run, store};
use conefield_core::wgsl::{Sum, declare, functions};
use std::fmt::Write;

/// Settings of `level-attention`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LevelAttention {
    /// Channels per level, equal to the encoder's `features`.
    pub features: usize,
}

impl Default for LevelAttention {
    fn default() -> Self {
        Self { features: 2 }
    }
}

conefield_core::stage_type!(
    NormalizerSpec,
    "level-attention",
    LevelAttention,
    "weighs the encoder's levels at each point by a softmax"
);

impl NormalizerSpec for LevelAttention {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(LevelAttentionStage::new(self, width)?))
    }
}

/// The stage that [`LevelAttention`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct LevelAttentionStage {
    /// Level of each channel, from 0, ascending.
    level: Vec<usize>,
    levels: usize,
}

impl LevelAttentionStage {
    /// The stage for `width` channels; fails if a setting does not fit.
    pub fn new(settings: &LevelAttention, width: usize) -> Result<Self> {
        let f = settings.features;
        ensure((1..=64).contains(&f), "spec", "features", f, "1 to 64")?;
        let fits = width > 0 && width.is_multiple_of(f);
        ensure(
            fits,
            "spec",
            "features",
            f,
            format!("the encoder's features a level: a divisor of its {width} channels"),
        )?;
        Ok(Self { level: (0..width).map(|c| c / f).collect(), levels: width / f })
    }

    fn width(&self) -> usize {
        self.level.len()
    }

    fn weights(&self) -> usize {
        self.levels * self.width()
    }

    fn matrix<'a, R>(&self, params: &'a [R]) -> WeightMatrix<'a, R> {
        WeightMatrix { data: &params[..self.weights()], ld: self.width(), column: 0 }
    }
}

/// The tape holds the weights of the levels.
impl<R: Real> Op for Forward<'_, LevelAttentionStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (stage, n) = (self.stage, self.x.rows);
        let bias = &self.params[stage.weights()..];
        affine(stage.matrix(self.params), Some(bias), self.x.data, self.tape.data, n);
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let mut i = 0;
        while i < n {
            let mut top = load(s, self.tape.channel(0), i);
            for l in 1..stage.levels {
                top = top.max(load(s, self.tape.channel(l), i));
            }
            let mut sum = number(0.0);
            for l in 0..stage.levels {
                let e = R::exp_lanes(s, load(s, self.tape.channel(l), i) - top);
                sum += e;
                store::<S, R>(e, self.tape.channel(l), i);
            }
            for l in 0..stage.levels {
                let a = load(s, self.tape.channel(l), i) / sum;
                store::<S, R>(a, self.tape.channel(l), i);
            }
            let levels = number(stage.levels as f64);
            for (c, &l) in stage.level.iter().enumerate() {
                let a = load(s, self.tape.channel(l), i) * levels;
                store::<S, R>(load(s, self.x.channel(c), i) * a, self.y.channel(c), i);
            }
            i += V::<S, R>::LEN;
        }
    }
}

impl<R: Real> Op for Back<'_, LevelAttentionStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let (stage, Backward { params, x, mut tape, dy, grads, mut dx }) = (self.stage, self.pass);
        let n = x.rows;
        let zero = V::<S, R>::splat(s, R::ZERO);
        let levels = V::<S, R>::splat(s, R::of(stage.levels as f64));
        let mut i = 0;
        while i < n {
            // With g_l = L·Σ dy·x over the channels of level l: ∂L/∂z_l = a_l·(g_l − Σ a·g).
            let mut mean = zero;
            for (c, &l) in stage.level.iter().enumerate() {
                let a = load(s, tape.channel(l), i) * levels;
                let dy = load(s, dy.channel(c), i);
                mean = (a * dy).mul_add(load(s, x.channel(c), i), mean);
                if let Some(dx) = &mut dx {
                    store::<S, R>(a * dy, dx.channel(c), i);
                }
            }
            let mut c = 0;
            for l in 0..stage.levels {
                let mut g = zero;
                while c < stage.width() && stage.level[c] == l {
                    g = load(s, dy.channel(c), i).mul_add(load(s, x.channel(c), i), g);
                    c += 1;
                }
                let dz = load(s, tape.channel(l), i) * (g * levels - mean);
                store::<S, R>(dz, tape.channel(l), i);
            }
            i += V::<S, R>::LEN;
        }
        debug_assert_eq!(grads.range, 0..params.len());
        let (dw, db) = grads.values.split_at_mut(stage.weights());
        let dz = &*tape.data;
        affine_weights(dz, x.data, dw, stage.width(), 0, Some(db), n);
        if let Some(dx) = dx {
            affine_input(stage.matrix(params), dz, dx.data, Into::Add, n);
        }
    }
}

impl<R: Real> Kernel<R> for LevelAttentionStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        run(Forward { stage: self, params, x, y, tape });
    }

    fn backward(&self, pass: Backward<'_, R>) {
        run(Back { stage: self, pass });
    }
}

impl Stage for LevelAttentionStage {
    fn info(&self) -> Info {
        let width = self.width();
        Info {
            input: width,
            output: width,
            params: self.weights() + self.levels,
            tape: self.levels,
            grads: GradKind::Dense,
            macs: self.weights() + 2 * width + 10 * self.levels,
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![
            Parameter { name: "weight".into(), shape: vec![self.levels, self.width()], start: 0 },
            Parameter { name: "bias".into(), shape: vec![self.levels], start: self.weights() },
        ]
    }

    /// Weights uniform in ±1/√F, as for PyTorch's linear layers; no level is preferred.
    fn init(&self, seed: u64, params: &mut [f32]) {
        let (weights, bias) = params.split_at_mut(self.weights());
        let bound = 1.0 / (self.width() as f32).sqrt();
        for (i, w) in weights.iter_mut().enumerate() {
            *w = (2.0 * unit(mix(seed, i as u64)) - 1.0) * bound;
        }
        bias.fill(0.0);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn wgsl(&self) -> Option<Fragment> {
        let (levels, width, bias) = (self.levels, self.width(), self.weights());
        let constants =
            format!("const stage_LEVELS = {levels}u;\nconst stage_WIDTH = {width}u;\nconst stage_BIAS = {bias}u;\n");
        let mut forward = "    let a = stage_attention(x);\n".to_string();
        let mut backward = format!("{forward}    var d: array<f32, {levels}>;\n    var mean = 0.0;\n");
        let (mut sums, mut slopes) = (String::new(), String::new());
        for (c, l) in self.level.iter().enumerate() {
            let _ = writeln!(forward, "    (*y)[{c}] = (*x)[{c}] * (a[{l}] * {levels}.0);");
            let _ = writeln!(sums, "    d[{l}] += (*dy)[{c}] * (*x)[{c}] * {levels}.0;");
            let _ = writeln!(slopes, "        (*dx)[{c}] = a[{l}] * {levels}.0 * (*dy)[{c}];");
        }
        for l in 0..levels {
            let _ = writeln!(sums, "    mean += a[{l}] * d[{l}];");
        }
        for l in 0..levels {
            let _ = writeln!(sums, "    d[{l}] = a[{l}] * (d[{l}] - mean);");
        }
        let _ = write!(
            backward,
            "{sums}    for (var c = 0u; c < {width}u; c++) {{ stage_keep(c, (*x)[c]); }}
    for (var l = 0u; l < {levels}u; l++) {{ stage_keep({width}u + l, d[l]); }}
    if stage_wants_dx {{
{slopes}        for (var l = 0u; l < {levels}u; l++) {{
            for (var c = 0u; c < {width}u; c++) {{ (*dx)[c] += d[l] * stage_param(l * {width}u + c); }}
        }}
    }}
"
        );
        let weights = Sum { at: 0, ld: width, left: width, outputs: levels, right: 0, inputs: width };
        let constants = declare(width + levels, &[weights, Sum::vector(bias, width, levels)]) + &constants;
        let functions = functions(width, width, &forward, &backward);
        Some(Fragment::new(&[&constants, include_str!("level_attention.wgsl"), &functions]))
    }

    fn describe(&self) -> String {
        format!("level-attention: {} levels of {} channels", self.levels, self.width())
    }
}

impl Normalizer for LevelAttentionStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        ensure(!keep.is_empty(), "level-attention", "channels", "none kept", "at least one")?;
        let mut old: Vec<usize> = keep.iter().map(|&c| self.level[c]).collect();
        let numbers = old.clone();
        old.dedup();
        let level = numbers.iter().filter_map(|l| old.iter().position(|o| o == l)).collect();
        let weights = old.iter().flat_map(|l| keep.iter().map(move |c| l * self.width() + c));
        let bias = old.iter().map(|l| self.weights() + l);
        let params = weights.chain(bias).map(|p| p..p + 1).collect();
        let stage = Self { level, levels: old.len() };
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..keep.len()).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_follow_the_formula() {
        let stage = LevelAttentionStage::new(&LevelAttention { features: 2 }, 4).unwrap();
        let params = [0.5, -1.0, 0.25, 2.0, -0.5, 1.5, 1.0, 0.0, 0.1, -0.2];
        let (x, n) = ([0.3, -0.7, 1.1, 0.4], 1);
        let (mut y, mut tape) = ([0.0; 4], [0.0; 2]);
        stage.forward(&params, Tile::new(&x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
        let z: Vec<f64> =
            (0..2).map(|l| params[8 + l] + (0..4).map(|c| params[4 * l + c] * x[c]).sum::<f64>()).collect();
        let sum: f64 = z.iter().map(|z| z.exp()).sum();
        for c in 0..4 {
            assert!((y[c] - 2.0 * z[c / 2].exp() / sum * x[c]).abs() < 1e-12, "{c}: {y:?}");
        }
    }

    #[test]
    fn channels_that_are_no_whole_levels_are_refused() {
        let e = LevelAttentionStage::new(&LevelAttention { features: 4 }, 10).unwrap_err().to_string();
        assert!(e.contains("features") && e.contains("10 channels"), "{e}");
    }

    #[test]
    fn a_level_without_channels_leaves_the_softmax() {
        let stage = LevelAttentionStage::new(&LevelAttention { features: 2 }, 6).unwrap();
        let r = stage.keep_inputs(&[0, 4, 5]).unwrap();
        let kept: Vec<usize> = r.params.iter().map(|p| p.start).collect();
        assert_eq!(kept, [0, 4, 5, 12, 16, 17, 18, 20]);
        assert_eq!(r.stage.parameters()[0].shape, [2, 3]);
    }
}
