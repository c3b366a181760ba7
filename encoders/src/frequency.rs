//! Frequency bands (Mildenhall et al. 2020, NeRF, equation 4): points `[n, 3]` in the unit cube to their sines and
//! cosines at `bands` frequencies.
//!
//! Band `k` of coordinate `x` is `sin(2π·f_k·x)` and `cos(2π·f_k·x)`, where `f_k` counts periods per cube side. NeRF's
//! `sin(2ᵏ·π·p)` on `p = 2x − 1` has `f_k = 2ᵏ`, up to a phase. Channels are ordered from low to high frequency: the
//! coordinates, then for each band `sin x, sin y, sin z, cos x, cos y, cos z`.

use conefield_core::error::{Result, ensure};
use conefield_core::settings::EncoderSpec;
use conefield_core::simd::{Op, Real, Select, Simd, SimdBase, SimdFloat, V, load, run, store};
use conefield_core::stage::{Encoder, Grads, Info, Kernel, Parameter, Reduced, Stage, Tile, TileMut};
use conefield_core::wgsl::{Fragment, functions};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;
use std::fmt::Write;

/// Spacing of the frequencies between 1 and the highest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Spacing {
    /// Geometric: `f_k = f_max^(k/(bands − 1))`.
    Log,
    /// Arithmetic: `f_k = 1 + (f_max − 1)·k/(bands − 1)`.
    Linear,
}

/// Settings of `frequency`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Frequency {
    /// Frequencies per coordinate, from 1 period per cube side to `max_frequency`.
    pub bands: usize,
    /// Spacing of the frequencies.
    pub spacing: Spacing,
    /// The highest frequency, in periods per cube side. The default of 10 bands up to 512 gives NeRF's octaves 2⁰ to
    /// 2⁹. A single band has this frequency.
    pub max_frequency: f64,
}

impl Default for Frequency {
    fn default() -> Self {
        Self { bands: 10, spacing: Spacing::Log, max_frequency: 512.0 }
    }
}

conefield_core::stage_type!(
    EncoderSpec,
    "frequency",
    Frequency,
    "sines and cosines of the position",
    example = r#"{"bands": 4, "max_frequency": 8.0}"#
);

impl EncoderSpec for Frequency {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(FrequencyStage::new(self)?))
    }
}

/// One frequency of one coordinate, and the channels of its sine and cosine, if used.
#[derive(Debug, Clone, PartialEq)]
struct Wave {
    axis: usize,
    frequency: f64,
    sin: Option<usize>,
    cos: Option<usize>,
}

/// The stage that [`Frequency`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct FrequencyStage {
    settings: Frequency,
    /// Coordinates that are passed through, with their channels.
    inputs: Vec<(usize, usize)>,
    waves: Vec<Wave>,
    outputs: usize,
}

impl FrequencyStage {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &Frequency) -> Result<Self> {
        let s = settings;
        ensure((1..=64).contains(&s.bands), "spec", "bands", s.bands, "1 to 64")?;
        let max = s.max_frequency;
        ensure((1.0..=1e6).contains(&max), "spec", "max_frequency", max, "1 to 1e6 periods per cube side")?;
        let mut waves = vec![];
        for k in 0..s.bands {
            let t = if s.bands == 1 { 1.0 } else { k as f64 / (s.bands - 1) as f64 };
            let exact = match s.spacing {
                Spacing::Log => max.powf(t),
                Spacing::Linear => 1.0 + (max - 1.0) * t,
            };
            // Rounded once, so that single and double precision use the same waves.
            let frequency = f64::from(exact as f32);
            for axis in 0..3 {
                let c = 3 + 6 * k + axis;
                waves.push(Wave { axis, frequency, sin: Some(c), cos: Some(c + 3) });
            }
        }
        Ok(Self {
            settings: s.clone(),
            inputs: (0..3).map(|axis| (axis, axis)).collect(),
            waves,
            outputs: 3 + 6 * s.bands,
        })
    }
}

/// `sin(2π·t)` and `cos(2π·t)`. `t` is in turns, so that whole turns cancel exactly before any rounding. The rest is at
/// most an eighth of a turn, where the truncation error of the Taylor series is below half a unit in the last place.
#[inline(always)]
fn sin_cos_turns<S: Simd, R: Real>(s: S, t: V<S, R>) -> (V<S, R>, V<S, R>) {
    let number = |v: f64| V::<S, R>::splat(s, R::of(v));
    let (single, zero) = (size_of::<R>() == 4, number(0.0));
    // From here on every float is an integer. NaN compares false and stays.
    let whole = t.abs().simd_ge(number(if single { 16_777_216.0 } else { 9_007_199_254_740_992.0 }));
    let t = whole.select(zero, t);
    let quarter = (t * number(4.0)).round_ties_even();
    let a = quarter.mul_add(number(-0.25), t) * number(TAU);
    let q = quarter - (quarter * number(0.25)).floor() * number(4.0);
    let square = a * a;
    let series = |last: usize| {
        // 1 − a²/((last − 1)·last)·(…), evaluated from the last term inwards.
        let mut sum = number(1.0);
        let mut k = last;
        while k >= 2 {
            sum = (square * sum).mul_add(number(-1.0 / (k * (k - 1)) as f64), number(1.0));
            k -= 2;
        }
        sum
    };
    let sin = a * series(if single { 9 } else { 17 });
    let cos = series(if single { 10 } else { 18 });
    let odd = q.simd_eq(number(1.0)) | q.simd_eq(number(3.0));
    let (sin, cos) = (odd.select(cos, sin), odd.select(sin, cos));
    let sin = q.simd_ge(number(2.0)).select(zero - sin, sin);
    let minus = q.simd_eq(number(1.0)) | q.simd_eq(number(2.0));
    (sin, minus.select(zero - cos, cos))
}

struct FrequencyForward<'a, R> {
    stage: &'a FrequencyStage,
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
}

impl<R: Real> Op for FrequencyForward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        for &(axis, c) in &self.stage.inputs {
            self.y.channel(c).copy_from_slice(self.x.channel(axis));
        }
        for wave in &self.stage.waves {
            let x = self.x.channel(wave.axis);
            let frequency = V::<S, R>::splat(s, R::of(wave.frequency));
            let mut i = 0;
            while i < x.len() {
                let (sin, cos) = sin_cos_turns::<S, R>(s, load(s, x, i) * frequency);
                if let Some(c) = wave.sin {
                    store::<S, R>(sin, self.y.channel(c), i);
                }
                if let Some(c) = wave.cos {
                    store::<S, R>(cos, self.y.channel(c), i);
                }
                i += V::<S, R>::LEN;
            }
        }
    }
}

struct FrequencyBackward<'a, R> {
    stage: &'a FrequencyStage,
    x: Tile<'a, R>,
    dy: Tile<'a, R>,
    dx: TileMut<'a, R>,
}

impl<R: Real> Op for FrequencyBackward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(mut self, s: S) {
        self.dx.data.fill(R::ZERO);
        for &(axis, c) in &self.stage.inputs {
            self.dx.channel(axis).copy_from_slice(self.dy.channel(c));
        }
        let zero = V::<S, R>::splat(s, R::ZERO);
        for wave in &self.stage.waves {
            let x = self.x.channel(wave.axis);
            let dx = self.dx.channel(wave.axis);
            let frequency = V::<S, R>::splat(s, R::of(wave.frequency));
            let slope = V::<S, R>::splat(s, R::of(TAU * wave.frequency));
            let dy = |c: Option<usize>, i| c.map_or(zero, |c| load(s, self.dy.channel(c), i));
            let mut i = 0;
            while i < x.len() {
                let (sin, cos) = sin_cos_turns::<S, R>(s, load(s, x, i) * frequency);
                let d = dy(wave.sin, i) * cos - dy(wave.cos, i) * sin;
                store::<S, R>(d.mul_add(slope, load(s, dx, i)), dx, i);
                i += V::<S, R>::LEN;
            }
        }
    }
}

impl<R: Real> Kernel<R> for FrequencyStage {
    fn forward(&self, _: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        run(FrequencyForward { stage: self, x, y });
    }

    fn backward(
        &self,
        _: &[R],
        x: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        _: Grads<'_, R>,
        dx: Option<TileMut<'_, R>>,
    ) {
        if let Some(dx) = dx {
            run(FrequencyBackward { stage: self, x, dy, dx });
        }
    }
}

impl Stage for FrequencyStage {
    fn info(&self) -> Info {
        Info { input: 3, output: self.outputs, macs: self.waves.len() * 16, ..Info::default() }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![]
    }

    fn init(&self, _: u64, _: &mut [f32]) {}

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn wgsl(&self) -> Option<Fragment> {
        let (mut forward, mut backward) = (String::new(), String::new());
        for (axis, c) in &self.inputs {
            let _ = writeln!(forward, "    (*y)[{c}] = (*x)[{axis}];");
            let _ = writeln!(backward, "    (*dx)[{axis}] = (*dy)[{c}];");
        }
        for (w, wave) in self.waves.iter().enumerate() {
            let Wave { axis, frequency, sin, cos } = wave;
            let _ = writeln!(forward, "    let w{w} = stage_sin_cos_turns((*x)[{axis}] * {:?});", *frequency as f32);
            let _ = writeln!(backward, "    let w{w} = stage_sin_cos_turns((*x)[{axis}] * {:?});", *frequency as f32);
            for (c, part) in [(sin, 'x'), (cos, 'y')] {
                let Some(c) = c else { continue };
                let _ = writeln!(forward, "    (*y)[{c}] = w{w}.{part};");
            }
            let dy = |c: &Option<usize>| c.map_or("0.0".to_owned(), |c| format!("(*dy)[{c}]"));
            let (slope, sin, cos) = ((TAU * frequency) as f32, dy(sin), dy(cos));
            let _ = writeln!(backward, "    (*dx)[{axis}] += {slope:?} * ({sin} * w{w}.y - {cos} * w{w}.x);");
        }
        let width = self.outputs;
        let functions = functions(3, width, &forward, &format!("    *dx = array<f32, 3>();\n{backward}"));
        Some(Fragment::new(&[include_str!("frequency.wgsl"), &functions]))
    }

    fn describe(&self) -> String {
        let s = &self.settings;
        format!(
            "frequency: {} bands up to {} periods per cube side ({}), {} channels",
            s.bands,
            s.max_frequency,
            if s.spacing == Spacing::Log { "log" } else { "linear" },
            self.outputs
        )
    }
}

impl Encoder for FrequencyStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), "frequency", "channels", "none kept", "at least one")?;
        let place = |c: usize| keep.iter().position(|&k| k == c);
        let stage = Self {
            settings: self.settings.clone(),
            inputs: self.inputs.iter().filter_map(|&(axis, c)| Some((axis, place(c)?))).collect(),
            waves: self
                .waves
                .iter()
                .map(|w| Wave { sin: w.sin.and_then(place), cos: w.cos.and_then(place), ..w.clone() })
                .filter(|w| w.sin.is_some() || w.cos.is_some())
                .collect(),
            outputs: keep.len(),
        };
        Ok(Reduced { stage: Box::new(stage), params: vec![], channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    /// Resolving a period takes two cells.
    fn resolutions(&self) -> Option<Vec<f64>> {
        let mut cells = vec![1.0; self.outputs];
        for w in &self.waves {
            [w.sin, w.cos].into_iter().flatten().for_each(|c| cells[c] = 2.0 * w.frequency);
        }
        Some(cells)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn encode<R: Real>(stage: &FrequencyStage, x: [R; 3]) -> Vec<R> {
        let mut y = vec![R::ZERO; stage.outputs];
        stage.forward(&[], Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
        y
    }

    #[test]
    fn bands_follow_the_formula_in_both_precisions() {
        for spacing in [Spacing::Log, Spacing::Linear] {
            let settings = Frequency { spacing, ..Frequency::default() };
            let stage = FrequencyStage::new(&settings).unwrap();
            for i in 0..200 {
                let x = [f64::from(i) * 0.005, 0.37 + f64::from(i) * 1e-4, 1.0 - f64::from(i) * 0.0049];
                let x32 = x.map(|v| v as f32);
                let x = x32.map(f64::from);
                let (y, y32) = (encode(&stage, x), encode(&stage, x32));
                for k in 0..10 {
                    let f = match spacing {
                        Spacing::Log => f64::powi(2.0, k),
                        Spacing::Linear => f64::from((1.0 + 511.0 * f64::from(k) / 9.0) as f32),
                    };
                    for d in 0..3 {
                        let (sin, cos) = (TAU * f * x[d]).sin_cos();
                        let c = 3 + 6 * k as usize + d;
                        assert!((y[c] - sin).abs() < 1e-11 && (y[c + 3] - cos).abs() < 1e-11, "{k} {d} {x:?}");
                        // An inexact product f·x is off by up to f·2⁻²⁴ turns.
                        let bound = 2e-7 + if spacing == Spacing::Log { 0.0 } else { TAU * f * 6e-8 };
                        assert!((f64::from(y32[c]) - sin).abs() < bound, "{k} {d} {x:?}: {} {sin}", y32[c]);
                        assert!((f64::from(y32[c + 3]) - cos).abs() < bound, "{k} {d} {x:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn settings_out_of_range_are_refused() {
        for (bad, field) in [
            (Frequency { bands: 0, ..Frequency::default() }, "bands"),
            (Frequency { max_frequency: f64::NAN, ..Frequency::default() }, "max_frequency"),
            (Frequency { max_frequency: 0.5, ..Frequency::default() }, "max_frequency"),
        ] {
            let e = FrequencyStage::new(&bad).unwrap_err().to_string();
            assert!(e.contains(field), "{e}");
        }
    }
}
