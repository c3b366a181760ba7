//! Spectral channel mask (Xu et al. 2025, NI-NeRF, section 2.3; details from its published code): permanently removes
//! channels whose image is noise.
//!
//! Once, after `epoch` passes over the views, every channel is evaluated on slices of the volume. Its image is scaled
//! to [0, 1] by its extremes and Fourier-transformed; frequencies within a quarter of the width around zero are
//! excluded: `(i − w/2)² + (j − h/2)² < (w/4)²` with integer halves and quarters and the zero frequency at
//! `(w/2, h/2)`. Magnitudes are clipped to [0, 1]; the mean of their squares over all pixels is the channel's energy.
//!
//! White noise scores at most the share of included pixels: `1 − π/16 ≈ 0.804` on a square, less where x is longer than
//! y (0.61 at 2:1), and slightly less again on small slices, where fewer magnitudes reach 1. Only nearly white channels
//! therefore reach the published threshold of 0.8, and on some slices none do. `rule = "relative"` divides by the score
//! of white noise, uniform between its extremes, on slices of the same size.
//!
//! Features are evaluated at the encoder's output: channels are removed from the encoder and all later stages.

use super::needs_features;
use crate::training::run::Run;
use crate::training::{Callback, CallbackSpec, Kept, State};
use conefield_core::pipeline::Pipeline;
use conefield_core::prelude::*;
use conefield_fourier::{Complex, Fft, forward_f64};
use std::sync::Arc;

/// Its name in specs and checkpoints.
const NAME: &str = "fft-mask";

/// Which channels are removed when a channel is noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Scope {
    /// This channel and all after it, as published. Channels must be ordered from coarse to fine.
    Finer,
    /// This channel only.
    Channel,
}

/// Reference of the energy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The threshold itself, as published; the score of the same noise depends on the size of the slice.
    Published,
    /// The threshold times the energy of white noise on slices of the same size.
    Relative,
}

/// Slices across the rotation axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Slices {
    /// A named set of slices.
    Named(Named),
    /// At these fractions of the volume's height, 0 to 1.
    Fractions(Vec<f64>),
}

/// Named sets of slices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Named {
    /// The middle slice, as published.
    CentralAxial,
}

/// Settings of `fft-mask`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FftMask {
    /// Completed passes over all views after which the mask is decided, once.
    pub epoch: f64,
    /// Energy above which a channel is noise; see `rule`.
    pub threshold: f64,
    /// Reference of the energy.
    pub rule: Rule,
    /// Which channels are removed when a channel is noise.
    pub scope: Scope,
    /// Slices to evaluate: `"central-axial"`, or fractions of the height. Energies are averaged over them.
    pub slices: Slices,
    /// Channels of the encoder to keep, ascending, from an earlier run: applied at the first step without measurement.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep: Option<Vec<usize>>,
}

impl Default for FftMask {
    fn default() -> Self {
        Self {
            epoch: 10.0,
            threshold: 0.8,
            rule: Rule::Published,
            scope: Scope::Finer,
            slices: Slices::Named(Named::CentralAxial),
            keep: None,
        }
    }
}

conefield_core::stage_type!(CallbackSpec, "fft-mask", FftMask, "removes channels whose spectrum is noise");

impl CallbackSpec for FftMask {
    fn build(&self) -> Result<Box<dyn Callback>> {
        let Self { epoch, threshold, .. } = *self;
        ensure(epoch.is_finite() && epoch >= 0.0, "spec", "epoch", epoch, "a finite number, 0 or more")?;
        ensure(threshold.is_finite() && threshold > 0.0, "spec", "threshold", threshold, "a finite number above 0")?;
        if let Slices::Fractions(f) = &self.slices {
            ensure(!f.is_empty(), "spec", "slices", "none", "\"central-axial\" or at least one fraction")?;
            for f in f {
                ensure((0.0..=1.0).contains(f), "spec", "slices", f, "fractions from 0 to 1")?;
            }
        }
        Ok(Box::new(Masker { settings: self.clone(), done: false }))
    }
}

/// The callback that [`FftMask`] builds.
struct Masker {
    settings: FftMask,
    /// Whether the mask has been decided.
    done: bool,
}

impl Callback for Masker {
    fn name(&self) -> &'static str {
        NAME
    }

    fn check(&self, pipeline: &Pipeline) -> Result<()> {
        needs_features(NAME, pipeline)?;
        let width = pipeline.encoder.info().output;
        if let Some(keep) = &self.settings.keep {
            let fits = keep.is_sorted_by(|a, b| a < b) && keep.last().is_some_and(|&c| c < width);
            let expected = format!("some of channels 0 to {}, ascending", width - 1);
            return ensure(fits, "spec", "keep", format!("{keep:?}"), expected);
        }
        let ordered = self.settings.scope != Scope::Finer || pipeline.encoder.coarse_to_fine();
        let found = format!(
            "\"finer\" with an encoder whose channels are not ordered from coarse to fine: {}",
            pipeline.encoder.describe()
        );
        ensure(ordered, "spec", "scope", found, "\"channel\" with this encoder")
    }

    fn before_step(&mut self, run: &mut Run<'_>) -> Result<()> {
        let early = self.settings.keep.is_none() && run.epoch() < self.settings.epoch;
        if self.done || early {
            return Ok(());
        }
        let width = run.model.pipeline.encoder.info().output;
        let (keep, report) = match &self.settings.keep {
            Some(keep) => {
                let keep = still_there(keep, run.model.masks());
                let report = format!("fft-mask: {} of {width} channels kept, as set in the spec", keep.len());
                (keep, report)
            }
            None => {
                let Run { exe, model, scene, .. } = run;
                let [w, h, _] = scene.grid.shape;
                let mut features = |k: usize| {
                    let points: Vec<_> = (0..w * h).map(|p| scene.voxel([p / h, p % h, k])).collect();
                    exe.encode(model, &points)
                };
                let (keep, found) = self.settings.decide(width, scene.grid.shape, &mut features)?;
                (keep, format!("fft-mask after {} epochs: {found}", run.epoch()))
            }
        };
        self.done = true;
        run.mask(keep)?;
        run.tally.window.events.push(report);
        Ok(())
    }

    fn at_end(&mut self, run: &mut Run<'_>) -> Result<()> {
        if !self.done {
            let (ended, epoch) = (run.epoch(), self.settings.epoch);
            let report = format!(
                "fft-mask: no channel was evaluated: the run ends after {ended:.2} epochs, before epoch {epoch}"
            );
            run.tally.window.events.push(report);
        }
        Ok(())
    }

    fn state<'a>(&'a self, _: &'a Layout) -> Result<State<'a>> {
        State::new(NAME, &self.done, vec![])
    }

    fn restore(&mut self, kept: &Kept<'_>, _: &Run<'_>) -> Result<()> {
        self.done = kept.value()?;
        Ok(())
    }

    fn describe(&self) -> Option<String> {
        let FftMask { epoch, threshold, rule, scope, keep, .. } = &self.settings;
        if let Some(keep) = keep {
            return Some(format!("fft-mask keeps {} channels", keep.len()));
        }
        let of = if *rule == Rule::Relative { " of white noise" } else { "" };
        let what = if *scope == Scope::Finer { "with all finer ones" } else { "each alone" };
        Some(format!("fft-mask after {epoch} epochs removes channels above {threshold}{of}, {what}"))
    }
}

/// Positions of the channels `keep` of the whole encoder after `masks` have been applied.
fn still_there(keep: &[usize], masks: &[Vec<usize>]) -> Vec<usize> {
    masks.iter().fold(keep.to_vec(), |keep, mask| {
        keep.iter().filter_map(|c| mask.iter().position(|stayed| stayed == c)).collect()
    })
}

/// The features of an axial slice: channel-major, `[channel][x][y]`.
type Features<'a> = dyn FnMut(usize) -> Result<Vec<f32>> + 'a;

impl FftMask {
    /// Mean energy of each of `width` channels over the slices, `None` if a feature is not finite; and whether the
    /// channel is constant on all slices.
    fn energies(&self, width: usize, [w, h, d]: [usize; 3], of: &mut Features<'_>) -> Result<Vec<(Option<f64>, bool)>> {
        let heights: Vec<usize> = match &self.slices {
            Slices::Named(Named::CentralAxial) => vec![d / 2],
            Slices::Fractions(f) => f.iter().map(|f| ((f * d as f64) as usize).min(d - 1)).collect(),
        };
        let mut spectrum = Spectrum::new(w, h);
        let mut found = vec![(Some(0.0), true); width];
        for &k in &heights {
            let features = of(k)?;
            for (image, (energy, constant)) in features.chunks(w * h).zip(&mut found) {
                let (low, high) =
                    image.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
                let finite = image.iter().all(|v| v.is_finite());
                *energy = energy.filter(|_| finite);
                *constant &= finite && low == high;
                if let Some(e) = energy
                    && low < high
                {
                    let (low, range) = (f64::from(low), f64::from(high) - f64::from(low));
                    *e += spectrum.energy(image.iter().map(|&v| (f64::from(v) - low) / range)) / heights.len() as f64;
                }
            }
        }
        Ok(found)
    }

    /// Which of `width` channels to keep in a volume of this shape, and a log line.
    fn decide(&self, width: usize, shape: [usize; 3], of: &mut Features<'_>) -> Result<(Vec<usize>, String)> {
        let all: Vec<usize> = (0..width).collect();
        let [w, h, d] = shape;
        if w < 8 || h < 8 || d == 0 {
            let said = format!("slices of {w} x {h} say nothing about noise; all {width} channels kept");
            return Ok((all, said));
        }
        let found = self.energies(width, shape, of)?;
        let white = match self.rule {
            Rule::Published => 1.0,
            Rule::Relative => white_noise(w, h),
        };
        let noise = |c: usize| found[c].0.is_some_and(|e| e > self.threshold * white);
        let mut keep: Vec<usize> = match self.scope {
            Scope::Channel => all.iter().copied().filter(|&c| !noise(c)).collect(),
            Scope::Finer => all.iter().copied().take_while(|&c| !noise(c)).collect(),
        };
        let mut notes = vec![];
        if keep.is_empty() {
            keep.push(0);
            notes.push("every channel is noise: the first is kept anyway".to_string());
        }
        let list = |which: &dyn Fn(usize) -> bool| {
            all.iter().filter(|&&c| which(c)).map(usize::to_string).collect::<Vec<_>>().join(", ")
        };
        for (what, which) in [("constant", list(&|c| found[c].1)), ("not finite", list(&|c| found[c].0.is_none()))] {
            if !which.is_empty() {
                notes.push(format!("{what}: {which}"));
            }
        }
        let energies: Vec<_> =
            found.iter().map(|(e, _)| e.map_or("-".into(), |e| format!("{:.3}", e / white))).collect();
        let of = if self.rule == Rule::Relative { " of white noise" } else { "" };
        let mut said = format!(
            "{} of {width} channels kept; energies{of} [{}], noise above {}",
            keep.len(),
            energies.join(" "),
            self.threshold
        );
        for n in notes {
            said += &format!("; {n}");
        }
        Ok((keep, said))
    }
}

/// Computes energies of images of one size.
struct Spectrum {
    w: usize,
    h: usize,
    /// The transforms of a row (`h` values) and of a column (`w`).
    along: [Arc<dyn Fft<f64>>; 2],
    rows: Vec<Complex<f64>>,
    columns: Vec<Complex<f64>>,
}

impl Spectrum {
    fn new(w: usize, h: usize) -> Self {
        let zero = vec![Complex::default(); w * h];
        Self { w, h, along: [forward_f64(h), forward_f64(w)], rows: zero.clone(), columns: zero }
    }

    /// Energy of an image `[w, h]` with values in [0, 1].
    fn energy(&mut self, image: impl Iterator<Item = f64>) -> f64 {
        let (w, h) = (self.w, self.h);
        self.rows.iter_mut().zip(image).for_each(|(c, v)| *c = Complex::new(v, 0.0));
        self.along[0].process(&mut self.rows);
        for i in 0..w {
            for j in 0..h {
                self.columns[j * w + i] = self.rows[i * h + j];
            }
        }
        self.along[1].process(&mut self.columns);
        let (half_w, half_h, radius) = ((w / 2) as i64, (h / 2) as i64, (w / 4) as i64);
        let mut sum = 0.0;
        for j in 0..h {
            for i in 0..w {
                // Bin i holds frequency i or i − w: after the shift it is at w/2 + frequency.
                let shifted = ((i + w / 2) % w) as i64 - half_w;
                let across = ((j + h / 2) % h) as i64 - half_h;
                if shifted * shifted + across * across >= radius * radius {
                    sum += self.columns[j * w + i].norm_sqr().min(1.0);
                }
            }
        }
        sum / (w * h) as f64
    }
}

/// Energy of white noise, uniform in [0, 1], on a slice of this size, with a fixed seed.
fn white_noise(w: usize, h: usize) -> f64 {
    let noise: Vec<f32> = (0..w * h).map(|p| unit(mix(0x5EED, p as u64))).collect();
    let (low, high) = noise.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
    let scaled = noise.iter().map(|&v| f64::from(v - low) / f64::from(high - low));
    Spectrum::new(w, h).energy(scaled)
}

#[cfg(test)]
mod tests {
    use super::*;

    type Channel = fn([f32; 3]) -> f32;

    fn smooth(p: [f32; 3]) -> f32 {
        (-20.0 * ((p[0] - 0.5).powi(2) + (p[1] - 0.4).powi(2))).exp()
    }
    fn noise(p: [f32; 3]) -> f32 {
        unit(mix(u64::from(p[0].to_bits()), u64::from(p[1].to_bits())))
    }
    fn constant(_: [f32; 3]) -> f32 {
        0.25
    }
    fn broken(p: [f32; 3]) -> f32 {
        if p[0] > 0.5 { f32::NAN } else { 0.0 }
    }

    /// The decision for these channels in a volume of this shape, and the requested slices.
    fn decide(settings: &FftMask, shape: [usize; 3], channels: &[Channel]) -> (Vec<usize>, String, Vec<usize>) {
        let mut asked = vec![];
        let [w, h, _] = shape;
        let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32;
        let mut features = |k: usize| {
            asked.push(k);
            let point = |p: usize| [at(p / h, w), at(p % h, h), at(k, shape[2])];
            Ok(channels.iter().flat_map(|f| (0..w * h).map(move |p| f(point(p)))).collect())
        };
        let (keep, said) = settings.decide(channels.len(), shape, &mut features).unwrap();
        (keep, said, asked)
    }

    const SHAPE: [usize; 3] = [128, 96, 20];

    #[test]
    fn energies_equal_a_plain_fourier_sum() {
        let (w, h) = (12, 9);
        let image: Vec<f64> = (0..w * h).map(|p| f64::from(unit(mix(3, p as u64))) * 0.2).collect();
        let mut want = 0.0;
        for i in 0..w {
            for j in 0..h {
                let (u, v) = (i as i64 - 6, j as i64 - 4);
                if u * u + v * v < 9 {
                    continue;
                }
                let mut sum = Complex::new(0.0, 0.0);
                for (p, x) in image.iter().enumerate() {
                    let turns = u as f64 * (p / h) as f64 / w as f64 + v as f64 * (p % h) as f64 / h as f64;
                    sum += Complex::from_polar(*x, -std::f64::consts::TAU * turns);
                }
                want += sum.norm().clamp(0.0, 1.0).powi(2);
            }
        }
        let found = Spectrum::new(w, h).energy(image.into_iter());
        assert!((found - want / 108.0).abs() < 1e-12, "{found} {}", want / 108.0);
    }

    #[test]
    fn white_noise_scores_the_area_less_what_is_not_clipped() {
        // |F|² of N uniform numbers is exponential with mean N/12, clipped at 1.
        for n in [32usize, 64, 200] {
            let mean = (n * n) as f64 / 12.0;
            let quarter = (n / 4) as i64;
            let inside = (-quarter..=quarter)
                .flat_map(|i| (-quarter..=quarter).map(move |j| i * i + j * j))
                .filter(|d| *d < quarter * quarter)
                .count();
            let area = 1.0 - inside as f64 / (n * n) as f64;
            let want = area * mean * (1.0 - (-1.0 / mean).exp());
            assert!((white_noise(n, n) - want).abs() < 2e-3, "{n}: {} {want}", white_noise(n, n));
        }
    }

    #[test]
    fn noise_takes_all_finer_channels_or_itself() {
        let channels: [Channel; 4] = [smooth, constant, noise, smooth];
        let relative = FftMask { rule: Rule::Relative, threshold: 0.9, ..FftMask::default() };
        let (keep, said, _) = decide(&relative, SHAPE, &channels);
        assert_eq!(keep, [0, 1]);
        assert!(said.contains("2 of 4") && said.contains("constant: 1") && !said.contains('\n'), "{said}");
        assert_eq!(decide(&FftMask { scope: Scope::Channel, ..relative }, SHAPE, &channels).0, [0, 1, 3]);
    }

    #[test]
    fn the_published_threshold_depends_on_the_slice_and_the_relative_one_does_not() {
        let channels: [Channel; 2] = [smooth, noise];
        for (shape, published) in [([256, 256, 4], vec![0]), ([256, 128, 4], vec![0, 1])] {
            assert_eq!(decide(&FftMask::default(), shape, &channels).0, published, "{shape:?}");
            let relative = FftMask { rule: Rule::Relative, threshold: 0.9, ..FftMask::default() };
            assert_eq!(decide(&relative, shape, &channels).0, [0], "{shape:?}");
        }
    }

    #[test]
    fn it_never_masks_everything_and_nothing_on_small_slices() {
        let all = FftMask { threshold: 1e-9, ..FftMask::default() };
        let (keep, said, _) = decide(&all, SHAPE, &[noise, smooth]);
        assert!(keep == [0] && said.contains("the first is kept"), "{said}");
        let (keep, said, asked) = decide(&all, [7, 96, 20], &[noise, smooth]);
        assert!(keep == [0, 1] && asked.is_empty() && said.contains("7 x 96"), "{said}");
    }

    #[test]
    fn several_slices_are_looked_at_and_averaged() {
        let settings = FftMask { slices: Slices::Fractions(vec![0.0, 0.5, 1.0]), ..FftMask::default() };
        let (keep, said, asked) = decide(&settings, SHAPE, &[smooth, broken]);
        assert_eq!((keep, asked), (vec![0, 1], vec![0, 10, 19]));
        assert!(said.contains("not finite: 1"), "{said}");
        assert_eq!(decide(&FftMask::default(), SHAPE, &[smooth]).2, [10]);
    }

    #[test]
    fn channels_that_left_before_are_not_counted() {
        assert_eq!(still_there(&[0, 2, 5], &[]), [0, 2, 5]);
        assert_eq!(still_there(&[0, 2, 5], &[vec![0, 1, 2, 3]]), [0, 2]);
        assert_eq!(still_there(&[0, 2, 5], &[vec![1, 2, 5, 7], vec![0, 2]]), [1]);
    }
}
