//! Layer normalization (Ba et al. 2016, equation 3): every row of features `[n, F]` to mean 0 and variance 1 over its
//! channels, then scaled and shifted per channel: `y = γ·(x − mean)/√(variance + eps) + β`, with the biased variance
//! (divided by F), as in PyTorch.
//!
//! Means are taken of differences to the row's first channel, so that a row of equal values gives exactly `β` despite
//! rounding. A row whose largest magnitude would overflow when squared is first scaled down by a power of two. This
//! changes only the influence of `eps`, which is then far below rounding.

use crate::passes::{Back, Forward};
use conefield_core::dense::total;
use conefield_core::prelude::*;
use conefield_core::simd::{Op, Select, Simd, SimdBase, SimdFloat, V, load, run, store};
use conefield_core::wgsl::{Sum, declare};

/// Settings of `layer-norm`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LayerNorm {
    /// Added to the variance.
    pub eps: f64,
    /// Whether a learned scale and shift follow, initially 1 and 0.
    pub affine: bool,
}

impl Default for LayerNorm {
    fn default() -> Self {
        Self { eps: 1e-5, affine: true }
    }
}

conefield_core::stage_type!(
    NormalizerSpec,
    "layer-norm",
    LayerNorm,
    "mean 0 and variance 1 over the channels of a row"
);

impl NormalizerSpec for LayerNorm {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(LayerNormStage::new(self, width)?))
    }
}

/// The stage that [`LayerNorm`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct LayerNormStage {
    settings: LayerNorm,
    width: usize,
}

/// Tape: mean of the (scaled) differences to the first channel, reciprocal standard deviation, scale.
const TAPE: usize = 3;

impl LayerNormStage {
    /// The stage for `width` channels; fails if a setting is out of range.
    pub fn new(settings: &LayerNorm, width: usize) -> Result<Self> {
        let eps = settings.eps;
        ensure((1e-30..=1.0).contains(&eps), "spec", "eps", eps, "1e-30 to 1")?;
        ensure(width > 0, "layer-norm", "channels", width, "at least one")?;
        Ok(Self { settings: settings.clone(), width })
    }

    /// `γ` of channel `c`; its `β` is `width` further.
    fn gamma<R: Real>(&self, params: &[R], c: usize) -> R {
        if self.settings.affine { params[c] } else { R::ONE }
    }

    fn beta<R: Real>(&self, params: &[R], c: usize) -> R {
        if self.settings.affine { params[self.width + c] } else { R::ZERO }
    }
}

/// Above the first number a row is scaled by the second. The third is a lower bound of the variance, for a finite root
/// if `eps` vanishes at that scale.
fn huge<R: Real>() -> [R; 3] {
    let powers = if size_of::<R>() == 4 { [50, -80, -120] } else { [400, -600, -960] };
    powers.map(|p| R::of(f64::powi(2.0, p)))
}

impl<R: Real> Op for Forward<'_, LayerNormStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let number = |v: R| V::<S, R>::splat(s, v);
        let [limit, small, least] = huge::<R>();
        let share = number(R::of(1.0 / self.stage.width as f64));
        let eps = number(R::of(self.stage.settings.eps));
        let mut i = 0;
        while i < self.x.rows {
            let mut largest = number(R::ZERO);
            for x in self.x.data.chunks_exact(self.x.rows) {
                largest = largest.max(load(s, x, i).abs());
            }
            let scale = largest.simd_gt(number(limit)).select(number(small), number(R::ONE));
            let first = load(s, self.x.channel(0), i) * scale;
            let mut mean = number(R::ZERO);
            for x in self.x.data.chunks_exact(self.x.rows) {
                mean += load(s, x, i) * scale - first;
            }
            let mean = mean * share;
            let mut variance = number(R::ZERO);
            for x in self.x.data.chunks_exact(self.x.rows) {
                let d = (load(s, x, i) * scale - first) - mean;
                variance = d.mul_add(d, variance);
            }
            let variance = variance.mul_add(share, (eps * scale * scale).max(number(least)));
            let root = number(R::ONE) / variance.sqrt();
            for c in 0..self.stage.width {
                let d = (load(s, self.x.channel(c), i) * scale - first) - mean;
                let (gamma, beta) = (self.stage.gamma(self.params, c), self.stage.beta(self.params, c));
                store::<S, R>((d * root).mul_add(number(gamma), number(beta)), self.y.channel(c), i);
            }
            for (c, v) in [mean, root, scale].into_iter().enumerate() {
                store::<S, R>(v, self.tape.channel(c), i);
            }
            i += V::<S, R>::LEN;
        }
    }
}

/// Results of forward for one vector of rows.
#[derive(Clone, Copy)]
struct RowMoments<T> {
    first: T,
    mean: T,
    root: T,
    scale: T,
}

impl<R: Real> Back<'_, LayerNormStage, R> {
    #[inline(always)]
    fn found<S: Simd>(&self, s: S, i: usize) -> RowMoments<V<S, R>> {
        let tape = Tile::new(&*self.pass.tape.data, self.pass.x.rows);
        let mean = load(s, tape.channel(0), i);
        let root = load(s, tape.channel(1), i);
        let scale = load(s, tape.channel(2), i);
        RowMoments { first: load(s, self.pass.x.channel(0), i) * scale, mean, root, scale }
    }

    /// `(x − mean)/deviation` of input `c`, for the rows from `i`.
    #[inline(always)]
    fn normal<S: Simd>(&self, s: S, f: RowMoments<V<S, R>>, c: usize, i: usize) -> V<S, R> {
        ((load(s, self.pass.x.channel(c), i) * f.scale - f.first) - f.mean) * f.root
    }
}

impl<R: Real> Op for Back<'_, LayerNormStage, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        let (n, stage) = (self.pass.x.rows, self.stage);
        let zero = V::<S, R>::splat(s, R::ZERO);
        if stage.settings.affine {
            let range = self.pass.grads.range.clone();
            for c in 0..stage.width {
                if range.contains(&c) {
                    let mut sum = zero;
                    let mut i = 0;
                    while i < n {
                        sum = self.normal(s, self.found(s, i), c, i).mul_add(load(s, self.pass.dy.channel(c), i), sum);
                        i += V::<S, R>::LEN;
                    }
                    self.pass.grads.values[c - range.start] += sum.as_slice().iter().copied().sum::<R>();
                }
                if range.contains(&(stage.width + c)) {
                    self.pass.grads.values[stage.width + c - range.start] += total(s, self.pass.dy.channel(c));
                }
            }
        }
        let Some(mut dx) = self.pass.dx.take() else { return };
        let share = V::<S, R>::splat(s, R::of(1.0 / stage.width as f64));
        let mut i = 0;
        while i < n {
            // With g = γ·dy: dx = (g − mean(g) − x̂·mean(g·x̂))/deviation, means over all channels.
            let found = self.found(s, i);
            let (mut mean, mut along) = (zero, zero);
            for c in 0..stage.width {
                let g = load(s, self.pass.dy.channel(c), i) * stage.gamma(self.pass.params, c);
                mean += g;
                along = g.mul_add(self.normal(s, found, c, i), along);
            }
            let (mean, along) = (mean * share, along * share);
            let back = found.root * found.scale;
            for c in 0..stage.width {
                let g = load(s, self.pass.dy.channel(c), i) * stage.gamma(self.pass.params, c);
                let d = (g - mean - self.normal(s, found, c, i) * along) * back;
                store::<S, R>(d, dx.channel(c), i);
            }
            i += V::<S, R>::LEN;
        }
    }
}

impl<R: Real> Kernel<R> for LayerNormStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, tape: TileMut<'_, R>) {
        run(Forward { stage: self, params, x, y, tape });
    }

    fn backward(&self, pass: Backward<'_, R>) {
        run(Back { stage: self, pass });
    }
}

impl Stage for LayerNormStage {
    fn info(&self) -> Info {
        Info {
            input: self.width,
            output: self.width,
            params: if self.settings.affine { 2 * self.width } else { 0 },
            tape: TAPE,
            grads: if self.settings.affine { GradKind::Dense } else { GradKind::None },
            macs: 4 * self.width,
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let n = self.width;
        let block = |name: &str, start| Parameter { name: name.into(), shape: vec![n], start };
        if self.settings.affine { vec![block("weight", 0), block("bias", n)] } else { vec![] }
    }

    fn init(&self, _: u64, params: &mut [f32]) {
        if self.settings.affine {
            let (gamma, beta) = params.split_at_mut(self.width);
            gamma.fill(1.0);
            beta.fill(0.0);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn wgsl(&self) -> Option<Fragment> {
        let (n, eps, affine) = (self.width, self.settings.eps as f32, self.settings.affine);
        let (declared, keeps) = if affine {
            let lines = format!(
                "    for (var c = 0u; c < {n}u; c++) {{
        stage_keep(c, stage_normal(x, r, c) * (*dy)[c]);
        stage_keep({n}u + c, (*dy)[c]);
    }}
"
            );
            (declare(2 * n, &[Sum::vector(0, 0, n), Sum::vector(n, n, n)]), lines)
        } else {
            Default::default()
        };
        let settings = format!(
            "{declared}const stage_WIDTH = {n}u;
const stage_EPS = {eps:?};
const stage_AFFINE = {affine};
fn stage_gradients(x: ptr<function, array<f32, {n}>>, r: stage_Row, dy: ptr<function, array<f32, {n}>>) {{
{keeps}}}
"
        );
        Some(Fragment::new(&[&settings, include_str!("layer_norm.wgsl")]))
    }

    fn describe(&self) -> String {
        let affine = if self.settings.affine { "with" } else { "without" };
        format!("layer-norm: {} channels, eps {}, {affine} scale and shift", self.width, self.settings.eps)
    }
}

impl Normalizer for LayerNormStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        ensure(!keep.is_empty(), "layer-norm", "channels", "none kept", "at least one")?;
        let both = keep.iter().copied().chain(keep.iter().map(|c| self.width + c));
        let params = if self.settings.affine { both.map(|p| p..p + 1).collect() } else { vec![] };
        let stage = Self { settings: self.settings.clone(), width: keep.len() };
        Ok(Reduced { stage: Box::new(stage), params, channels: (0..keep.len()).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn apply<R: Real>(stage: &LayerNormStage, params: &[R], x: &[R], n: usize) -> Vec<R> {
        let mut y = vec![R::ZERO; stage.width * n];
        let mut tape = vec![R::ZERO; TAPE * n];
        stage.forward(params, Tile::new(x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
        y
    }

    #[test]
    fn rows_follow_the_formula() {
        let stage = LayerNormStage::new(&LayerNorm::default(), 5).unwrap();
        let params = [1.0, 2.0, 0.5, -1.0, 1.0, 0.0, 0.1, 0.2, 0.3, 0.4];
        let n = 3;
        let x: Vec<f64> = (0..5 * n).map(|i| (i as f64 * 0.77).sin() * 4.0).collect();
        let y = apply(&stage, &params, &x, n);
        for i in 0..n {
            let row: Vec<f64> = (0..5).map(|c| x[c * n + i]).collect();
            let mean = row.iter().sum::<f64>() / 5.0;
            let variance = row.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / 5.0;
            for c in 0..5 {
                let want = (row[c] - mean) / (variance + 1e-5).sqrt() * params[c] + params[5 + c];
                assert!((y[c * n + i] - want).abs() < 1e-12, "{c} {i}");
            }
        }
    }

    #[test]
    fn equal_channels_give_the_shift_exactly_and_huge_ones_stay_finite() {
        let stage = LayerNormStage::new(&LayerNorm::default(), 4).unwrap();
        let params = [3.0f32, 3.0, 3.0, 3.0, 0.1, 0.2, 0.3, 0.4];
        for v in [0.0, 1e-40, 0.1, 12345.678, 1e30, -3.4e38] {
            assert_eq!(apply(&stage, &params, &[v; 4], 1), [0.1, 0.2, 0.3, 0.4], "{v}");
        }
        for v in [1e15f32, 1e18, 1e30, 3.4e38] {
            let y = apply(&stage, &params, &[v, -v, v, -v], 1);
            for (c, y) in y.iter().enumerate() {
                let want = if c % 2 == 0 { 3.0 } else { -3.0 } + params[4 + c];
                assert!((y - want).abs() < 1e-4, "{v}: {y} {want}");
            }
        }
        let one = LayerNormStage::new(&LayerNorm::default(), 1).unwrap();
        assert_eq!(apply(&one, &[5.0f32, 0.25], &[7.0, -1e30], 2), [0.25, 0.25]);
    }

    #[test]
    fn dropped_inputs_leave_the_statistics() {
        let stage = LayerNormStage::new(&LayerNorm::default(), 4).unwrap();
        let r = stage.keep_inputs(&[0, 3]).unwrap();
        assert_eq!((r.stage.info().input, r.stage.info().output, r.channels), (2, 2, vec![0, 1]));
        assert_eq!(r.params, [0..1, 3..4, 4..5, 7..8]);
        let small = LayerNormStage::new(&LayerNorm { affine: false, ..LayerNorm::default() }, 2).unwrap();
        let y = apply(&small, &[], &[1.0, 0.5], 1);
        assert!((y[1] + 0.25 / (0.0625f64 + 1e-5).sqrt()).abs() < 1e-12, "{y:?}");
        assert!(stage.keep_inputs(&[]).is_err());
    }
}
