//! Spectral channel mask (Xu et al. 2025, NI-NeRF, section 2.3; details from its published code): channels whose image
//! is noise are removed for good.
//!
//! Once, after `epoch` passes over the views, every channel is looked at on slices of the volume: its image is scaled
//! to [0, 1] by its extremes, Fourier-transformed, and what lies within a quarter of the width of the zero frequency
//! is left out: `(i − w/2)² + (j − h/2)² < (w/4)²` with whole halves and quarters, the zero frequency at
//! `(w/2, h/2)`. Magnitudes are clipped to [0, 1]; the mean of their squares over all pixels is the channel's energy.
//!
//! White noise scores at most the share of pixels that is not left out: `1 − π/16 ≈ 0.804` on a square, less where x
//! is longer than y (0.61 at 2:1), and a little less again on small slices, where fewer magnitudes reach 1. The
//! published threshold of 0.8 is therefore met by nearly white channels only, and on some slices by none.
//! `rule = "relative"` divides by what white noise, uniform between its extremes, scores on slices of this very size.
//!
//! The stage itself passes features `[n, F]` on unchanged.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::random::{mix, unit};
use conefield_core::settings::NormalizerSpec;
use conefield_core::simd::Real;
use conefield_core::stage::{
    GradKind, Grads, Info, Kernel, Mask, Normalizer, Parameter, Probe, Reduced, Scope as Reach, Stage, Tile, TileMut,
};
use rustfft::FftPlanner;
use rustfft::num_complex::Complex;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};

/// What goes when a channel is noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Scope {
    /// This channel and all after it, as published. Channels must stand from coarse to fine.
    Finer,
    /// This channel.
    Channel,
}

/// What the energy is compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Rule {
    /// The threshold itself, as published; what the same noise scores depends on the size of the slice.
    Published,
    /// The threshold times the energy of white noise on slices of the same size.
    Relative,
}

/// Slices across the rotation axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Slices {
    /// By name.
    Named(Named),
    /// At these fractions of the volume's height, 0 to 1.
    Fractions(Vec<f64>),
}

/// Slices that have a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Named {
    /// The middle one, as published.
    CentralAxial,
}

/// Settings of `fft-mask`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FftMask {
    /// Finished passes over all views after which the mask is decided, once.
    pub epoch: f64,
    /// A channel with more energy is noise; see `rule`.
    pub threshold: f64,
    /// What the energy is compared with.
    pub rule: Rule,
    /// What goes when a channel is noise.
    pub scope: Scope,
    /// Slices to look at: `"central-axial"`, or fractions of the height. Energies are averaged over them.
    pub slices: Slices,
    /// Channels to keep as an earlier run decided, ascending: applied at the first step, nothing is measured.
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

conefield_core::stage_type!(Normalizer, "fft-mask", FftMask, "removes channels whose spectrum is noise");

#[typetag::serde(name = "fft-mask")]
impl NormalizerSpec for FftMask {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(FftMaskStage::new(self, width)?))
    }
}

/// The stage that [`FftMask`] builds.
#[derive(Debug)]
pub struct FftMaskStage {
    settings: FftMask,
    width: usize,
    /// The mask was decided. It is decided once.
    done: AtomicBool,
}

impl FftMaskStage {
    /// The stage for `width` channels, or which setting is out of range.
    pub fn new(settings: &FftMask, width: usize) -> Result<Self> {
        let s = settings;
        let bad = |field: &str| format!("normalizers.{field}");
        ensure(width > 0, "fft-mask", "channels", width, "at least one")?;
        ensure(s.epoch.is_finite() && s.epoch >= 0.0, "spec", &bad("epoch"), s.epoch, "a finite number, 0 or more")?;
        let t = s.threshold;
        ensure(t.is_finite() && t > 0.0, "spec", &bad("threshold"), t, "a finite number above 0")?;
        if let Slices::Fractions(f) = &s.slices {
            ensure(!f.is_empty(), "spec", &bad("slices"), "none", "\"central-axial\" or at least one fraction")?;
            for f in f {
                ensure((0.0..=1.0).contains(f), "spec", &bad("slices"), f, "fractions from 0 to 1")?;
            }
        }
        if let Some(keep) = &s.keep {
            let fits = keep.is_sorted_by(|a, b| a < b) && keep.last().is_some_and(|&c| c < width);
            ensure(
                fits,
                "spec",
                &bad("keep"),
                format!("{keep:?}"),
                format!("some of channels 0 to {}, ascending", width - 1),
            )?;
        }
        Ok(Self { settings: s.clone(), width, done: AtomicBool::new(false) })
    }

    /// Whether the mask was decided.
    pub fn done(&self) -> bool {
        self.done.load(Ordering::Relaxed)
    }

    fn without(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        ensure(!keep.is_empty(), "fft-mask", "channels", "none kept", "at least one")?;
        let place = |c: &usize| keep.iter().position(|k| k == c);
        let settings = FftMask {
            keep: self.settings.keep.as_ref().map(|old| old.iter().filter_map(place).collect()),
            ..self.settings.clone()
        };
        let stage = Self { settings, width: keep.len(), done: AtomicBool::new(self.done()) };
        Ok(Reduced { stage: Box::new(stage), params: vec![], channels: keep.to_vec() })
    }

    /// Mean energy of each channel over the slices, `None` where a feature is not finite; and how many slices had
    /// the channel constant.
    fn energies(&self, probe: &mut dyn Probe) -> Result<Vec<(Option<f64>, usize)>> {
        let [w, h, d] = probe.shape();
        let heights: Vec<usize> = match &self.settings.slices {
            Slices::Named(Named::CentralAxial) => vec![d / 2],
            Slices::Fractions(f) => f.iter().map(|f| ((f * d as f64) as usize).min(d - 1)).collect(),
        };
        let mut spectrum = Spectrum::new(w, h);
        let mut found = vec![(Some(0.0), 0); self.width];
        for &k in &heights {
            let points: Vec<_> = (0..w * h).map(|p| probe.voxel([p / h, p % h, k])).collect();
            let features = probe.encode(&points)?;
            if features.len() != self.width * points.len() {
                return Err(Error::unsupported(
                    "fft-mask",
                    format!(
                        "it has {} channels and the encoder {}: put it before anything that changes their number",
                        self.width,
                        features.len() / points.len()
                    ),
                ));
            }
            for (image, (energy, constant)) in features.chunks(points.len()).zip(&mut found) {
                let (low, high) =
                    image.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
                if image.iter().any(|v| !v.is_finite()) {
                    *energy = None;
                } else if low == high {
                    *constant += 1;
                } else if let Some(e) = energy {
                    let (low, range) = (f64::from(low), f64::from(high) - f64::from(low));
                    *e += spectrum.energy(image.iter().map(|&v| (f64::from(v) - low) / range)) / heights.len() as f64;
                }
            }
        }
        let constant = |c: usize| if c == heights.len() { c } else { 0 };
        Ok(found.into_iter().map(|(e, c)| (e, constant(c))).collect())
    }

    fn decide(&self, probe: &mut dyn Probe) -> Result<Mask> {
        let s = &self.settings;
        let all: Vec<usize> = (0..self.width).collect();
        if let Some(keep) = &s.keep {
            let report = format!("fft-mask: {} of {} channels kept as the spec says", keep.len(), self.width);
            return Ok(Mask { keep: keep.clone(), report });
        }
        let [w, h, d] = probe.shape();
        if w < 8 || h < 8 || d == 0 {
            let report =
                format!("fft-mask: slices of {w} x {h} say nothing about noise; all {} channels kept", self.width);
            return Ok(Mask { keep: all, report });
        }
        let found = self.energies(probe)?;
        let white = match s.rule {
            Rule::Published => 1.0,
            Rule::Relative => white_noise(w, h),
        };
        let noise = |c: usize| found[c].0.is_some_and(|e| e > s.threshold * white);
        let mut keep: Vec<usize> = match s.scope {
            Scope::Channel => all.iter().copied().filter(|&c| !noise(c)).collect(),
            Scope::Finer => all.iter().copied().take_while(|&c| !noise(c)).collect(),
        };
        let mut notes = vec![];
        if keep.is_empty() {
            keep.push(0);
            notes.push("every channel is noise: the first is kept all the same".to_string());
        }
        let list = |which: &dyn Fn(usize) -> bool| {
            all.iter().filter(|&&c| which(c)).map(usize::to_string).collect::<Vec<_>>().join(", ")
        };
        let constant = list(&|c| found[c].1 > 0);
        if !constant.is_empty() {
            notes.push(format!("constant: {constant}"));
        }
        let broken = list(&|c| found[c].0.is_none());
        if !broken.is_empty() {
            notes.push(format!("not finite: {broken}"));
        }
        let energies: Vec<_> =
            found.iter().map(|(e, _)| e.map_or("-".into(), |e| format!("{:.3}", e / white))).collect();
        let of = if s.rule == Rule::Relative { " of white noise" } else { "" };
        let mut report = format!(
            "fft-mask after {} epochs: {} of {} channels kept; energies{of} [{}], noise above {}",
            probe.epoch(),
            keep.len(),
            self.width,
            energies.join(" "),
            s.threshold
        );
        for n in notes {
            report += &format!("; {n}");
        }
        Ok(Mask { keep, report })
    }
}

/// Energies of images of one size.
struct Spectrum {
    w: usize,
    h: usize,
    planner: FftPlanner<f64>,
    rows: Vec<Complex<f64>>,
    columns: Vec<Complex<f64>>,
}

impl Spectrum {
    fn new(w: usize, h: usize) -> Self {
        let zero = vec![Complex::default(); w * h];
        Self { w, h, planner: FftPlanner::new(), rows: zero.clone(), columns: zero }
    }

    /// Energy of an image `[w, h]` with values in [0, 1].
    fn energy(&mut self, image: impl Iterator<Item = f64>) -> f64 {
        let (w, h) = (self.w, self.h);
        self.rows.iter_mut().zip(image).for_each(|(c, v)| *c = Complex::new(v, 0.0));
        self.planner.plan_fft_forward(h).process(&mut self.rows);
        for i in 0..w {
            for j in 0..h {
                self.columns[j * w + i] = self.rows[i * h + j];
            }
        }
        self.planner.plan_fft_forward(w).process(&mut self.columns);
        let (half_w, half_h, radius) = ((w / 2) as i64, (h / 2) as i64, (w / 4) as i64);
        let mut sum = 0.0;
        for j in 0..h {
            for i in 0..w {
                // Bin i holds frequency i or i − w: after the shift it stands at w/2 + frequency.
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

/// Energy of white noise, uniform in [0, 1], on a slice of this size; of a fixed seed.
fn white_noise(w: usize, h: usize) -> f64 {
    let noise: Vec<f32> = (0..w * h).map(|p| unit(mix(0x5EED, p as u64))).collect();
    let (low, high) = noise.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
    let scaled = noise.iter().map(|&v| f64::from(v - low) / f64::from(high - low));
    Spectrum::new(w, h).energy(scaled)
}

impl<R: Real> Kernel<R> for FftMaskStage {
    fn forward(&self, _: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        y.data.copy_from_slice(x.data);
    }

    fn backward(
        &self,
        _: &[R],
        _: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        _: Grads<'_, R>,
        dx: Option<TileMut<'_, R>>,
    ) {
        if let Some(dx) = dx {
            dx.data.copy_from_slice(dy.data);
        }
    }
}

impl Stage for FftMaskStage {
    fn info(&self) -> Info {
        Info {
            input: self.width,
            output: self.width,
            params: 0,
            tape: 0,
            scope: Reach::Row,
            grads: GradKind::None,
            macs: 0,
            identity: true,
        }
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

    fn describe(&self) -> String {
        if self.done() {
            return format!("fft-mask: decided, {} channels kept", self.width);
        }
        format!(
            "fft-mask: {} channels, decided after {} epochs, threshold {}{}, {}",
            self.width,
            self.settings.epoch,
            self.settings.threshold,
            if self.settings.rule == Rule::Relative { " of white noise" } else { "" },
            if self.settings.scope == Scope::Finer { "noise removes all finer channels" } else { "channel by channel" }
        )
    }
}

impl Normalizer for FftMaskStage {
    fn refresh(&self, probe: &mut dyn Probe) -> Result<Option<Mask>> {
        if self.done() {
            return Ok(None);
        }
        if self.settings.keep.is_none() {
            // Before the epoch too: what can't be decided later is refused at the first step.
            if self.settings.scope == Scope::Finer && !probe.coarse_to_fine() {
                return Err(Error::unsupported(
                    "fft-mask with scope \"finer\"",
                    "this encoder's channels do not stand from coarse to fine; use scope = \"channel\"",
                ));
            }
            if probe.epoch() < self.settings.epoch {
                return Ok(None);
            }
        }
        let mask = self.decide(probe)?;
        self.decided();
        Ok(Some(mask))
    }

    fn decided(&self) {
        self.done.store(true, Ordering::Relaxed);
    }

    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        self.without(keep)
    }

    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        self.without(keep)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Channels given as functions of the position.
    struct Fake {
        shape: [usize; 3],
        epoch: f64,
        ordered: bool,
        channels: Vec<fn([f32; 3]) -> f32>,
        asked: Vec<f32>,
    }

    impl Probe for Fake {
        fn encode(&mut self, points: &[[f32; 3]]) -> Result<Vec<f32>> {
            self.asked.push(points[0][2]);
            Ok(self.channels.iter().flat_map(|f| points.iter().map(|&p| f(p))).collect())
        }
        fn shape(&self) -> [usize; 3] {
            self.shape
        }
        fn voxel(&self, index: [usize; 3]) -> [f32; 3] {
            std::array::from_fn(|d| (index[d] as f32 + 0.5) / self.shape[d] as f32)
        }
        fn epoch(&self) -> f64 {
            self.epoch
        }
        fn coarse_to_fine(&self) -> bool {
            self.ordered
        }
    }

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

    fn probe(channels: &[fn([f32; 3]) -> f32]) -> Fake {
        Fake { shape: [128, 96, 20], epoch: 10.0, ordered: true, channels: channels.to_vec(), asked: vec![] }
    }

    fn refresh(settings: FftMask, probe: &mut Fake) -> Option<Mask> {
        FftMaskStage::new(&settings, probe.channels.len()).unwrap().refresh(probe).unwrap()
    }

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
        let channels: [fn([f32; 3]) -> f32; 4] = [smooth, constant, noise, smooth];
        let relative = FftMask { rule: Rule::Relative, threshold: 0.9, ..FftMask::default() };
        let mask = refresh(relative.clone(), &mut probe(&channels)).unwrap();
        assert_eq!(mask.keep, [0, 1]);
        assert!(mask.report.contains("2 of 4") && mask.report.contains("constant: 1"), "{}", mask.report);
        assert!(!mask.report.contains('\n'));
        let mask = refresh(FftMask { scope: Scope::Channel, ..relative }, &mut probe(&channels)).unwrap();
        assert_eq!(mask.keep, [0, 1, 3]);
    }

    #[test]
    fn the_published_threshold_depends_on_the_slice_and_the_relative_one_does_not() {
        let channels: [fn([f32; 3]) -> f32; 2] = [smooth, noise];
        for (shape, published) in [([256, 256, 4], vec![0]), ([256, 128, 4], vec![0, 1])] {
            let mut p = Fake { shape, ..probe(&channels) };
            assert_eq!(refresh(FftMask::default(), &mut p).unwrap().keep, published, "{shape:?}");
            let relative = FftMask { rule: Rule::Relative, threshold: 0.9, ..FftMask::default() };
            assert_eq!(refresh(relative, &mut p).unwrap().keep, [0], "{shape:?}");
        }
    }

    #[test]
    fn it_runs_once_after_its_epoch_and_never_masks_everything() {
        let stage = FftMaskStage::new(&FftMask { threshold: 1e-9, ..FftMask::default() }, 2).unwrap();
        let mut p = Fake { epoch: 9.99, ..probe(&[noise, smooth]) };
        assert_eq!(stage.refresh(&mut p).unwrap(), None);
        p.epoch = 10.0;
        let mask = stage.refresh(&mut p).unwrap().unwrap();
        assert_eq!(mask.keep, [0]);
        assert!(mask.report.contains("the first is kept"), "{}", mask.report);
        assert_eq!(stage.refresh(&mut p).unwrap(), None);
        let rest = stage.keep_inputs(&mask.keep).unwrap().stage;
        p.channels.pop();
        assert_eq!(rest.refresh(&mut p).unwrap(), None);
        assert_eq!(rest.info().input, 1);
    }

    #[test]
    fn several_slices_are_looked_at_and_averaged() {
        let settings = FftMask { slices: Slices::Fractions(vec![0.0, 0.5, 1.0]), ..FftMask::default() };
        let mut p = probe(&[smooth, broken]);
        let mask = refresh(settings, &mut p).unwrap();
        assert_eq!(p.asked, [0.025, 0.525, 0.975]);
        assert_eq!(mask.keep, [0, 1]);
        assert!(mask.report.contains("not finite: 1"), "{}", mask.report);
        let mut middle = probe(&[smooth]);
        refresh(FftMask::default(), &mut middle).unwrap();
        assert_eq!(middle.asked, [0.525]);
    }

    #[test]
    fn what_cannot_be_done_is_refused_with_words() {
        let mut p = Fake { ordered: false, ..probe(&[smooth, noise]) };
        let stage = FftMaskStage::new(&FftMask::default(), 2).unwrap();
        let e = stage.refresh(&mut p).unwrap_err().to_string();
        assert!(e.contains("finer") && e.contains("scope = \"channel\""), "{e}");
        let wide = FftMaskStage::new(&FftMask { scope: Scope::Channel, ..FftMask::default() }, 3).unwrap();
        let e = wide.refresh(&mut p).unwrap_err().to_string();
        assert!(e.contains("3 channels"), "{e}");
        for keep in [vec![], vec![1, 0], vec![2]] {
            let e = FftMaskStage::new(&FftMask { keep: Some(keep), ..FftMask::default() }, 2).unwrap_err().to_string();
            assert!(e.contains("normalizers.keep"), "{e}");
        }
    }

    #[test]
    fn a_mask_from_an_earlier_run_applies_at_once() {
        let mut p = Fake { epoch: 0.0, ..probe(&[smooth, noise, smooth]) };
        let mask = refresh(FftMask { keep: Some(vec![0, 2]), ..FftMask::default() }, &mut p).unwrap();
        assert_eq!((mask.keep, p.asked.len()), (vec![0, 2], 0));
    }
}
