//! Frequency bands (Mildenhall et al. 2020, NeRF, equation 4): points `[n, 3]` in the unit cube to their sines and
//! cosines at `bands` frequencies.
//!
//! Band `k` of coordinate `x` is `sin(2π·f_k·x)` and `cos(2π·f_k·x)`, where `f_k` counts periods per cube side. NeRF's
//! `sin(2ᵏ·π·p)` on `p = 2x − 1` has `f_k = 2ᵏ`, up to a phase. Channels are ordered from low to high frequency: the
//! coordinates, then for each band `sin x, sin y, sin z, cos x, cos y, cos z`.

use conefield_core::prelude::*;
use conefield_core::wgsl::functions;
use std::f64::consts::TAU;
use std::fmt::Write;
use std::ops::Range;

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
        Ok(Box::new(ByRow::new(Waves::new(self)?)))
    }
}

/// One frequency of one coordinate, and the channels of its sine and cosine, if used.
#[derive(Clone)]
struct Wave {
    axis: usize,
    frequency: f64,
    sin: Option<usize>,
    cos: Option<usize>,
}

/// The map of [`Frequency`].
struct Waves {
    settings: Frequency,
    /// Coordinates that are passed through, with their channels.
    inputs: Vec<(usize, usize)>,
    waves: Vec<Wave>,
    outputs: usize,
}

impl Waves {
    /// All waves, or the setting that is out of range.
    fn new(settings: &Frequency) -> Result<Self> {
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

impl RowMap for Waves {
    fn widths(&self) -> [usize; 2] {
        [3, self.outputs]
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, _: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        for &(axis, c) in &self.inputs {
            y.set(c, x.at(axis));
        }
        for wave in &self.waves {
            let (sin, cos) = (x.at(wave.axis) * N::Real::of(wave.frequency)).sin_cos_turns();
            if let Some(c) = wave.sin {
                y.set(c, sin);
            }
            if let Some(c) = wave.cos {
                y.set(c, cos);
            }
        }
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, _: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        for axis in 0..3 {
            let own = self.inputs.iter().find(|(a, _)| *a == axis);
            let mut d = own.map_or(x.same(0.0), |&(_, c)| dy.at(c));
            for wave in self.waves.iter().filter(|w| w.axis == axis) {
                let (sin, cos) = (x.at(axis) * N::Real::of(wave.frequency)).sin_cos_turns();
                let [ds, dc] = [wave.sin, wave.cos].map(|c| c.map_or(x.same(0.0), |c| dy.at(c)));
                d = (ds * cos - dc * sin).mul_add(x.same(TAU * wave.frequency), d);
            }
            grads.input(axis, d);
        }
    }

    fn keep(&self, keep: &[usize]) -> Option<(Self, Vec<Range<usize>>)> {
        let place = |c: usize| keep.iter().position(|&k| k == c);
        let waves = self.waves.iter().map(|w| Wave { sin: w.sin.and_then(place), cos: w.cos.and_then(place), ..*w });
        let kept = Self {
            settings: self.settings.clone(),
            inputs: self.inputs.iter().filter_map(|&(axis, c)| Some((axis, place(c)?))).collect(),
            waves: waves.filter(|w| w.sin.is_some() || w.cos.is_some()).collect(),
            outputs: keep.len(),
        };
        Some((kept, vec![]))
    }

    fn macs(&self) -> usize {
        self.waves.len() * 16
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

#[cfg(test)]
mod tests {
    use super::*;

    fn encode<R: Real>(stage: &ByRow<Waves>, x: [R; 3]) -> Vec<R> {
        let mut y = vec![R::ZERO; stage.info().output];
        stage.forward(&[], Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
        y
    }

    #[test]
    fn bands_follow_the_formula_in_both_precisions() {
        for spacing in [Spacing::Log, Spacing::Linear] {
            let settings = Frequency { spacing, ..Frequency::default() };
            let stage = ByRow::new(Waves::new(&settings).unwrap());
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
            let e = bad.build().err().unwrap().to_string();
            assert!(e.contains(field), "{e}");
        }
    }
}
