//! The criterion without a reconstruction: the consistency of two views on the planes through both sources.
//!
//! A plane `n` through a source meets the detector in a line. The view alone gives the derivative of the object's plane
//! integral along the plane's normal (Grangeat, Mathematical Methods in Tomography, LNM 1497, 1991): `R(n) = ∫
//! g(θ)·δ'(n·θ) dθ` over all ray directions `θ` with line integrals `g`. For every plane through both sources, both
//! views must give the same value (Debbeler et al., Fully3D 2013; Aichert et al., IEEE Trans. Med. Imaging 34, 2015).
//! This holds for every object: the criterion depends neither on its size nor on the accuracy of a prediction from few
//! views.
//!
//! With `e₁`, `e₂` at right angles to the line through the sources, the planes are `n = e₂ − k·e₁`. A pixel with
//! direction `d` from the source and solid angle `|det(u, v, w)|/|d|³` (`w` to the detector's centre) lies in the plane
//! `k = d·e₂/d·e₁`, and `R(k) = Σ g·|det|/(|d|·(d·e₁)²)·δ'(k(pixel) − k)`. The derivative of a Gaussian of the same
//! width for both views replaces `δ'`. So there is no interpolation, and equal values stay equal.

use crate::calibration::criterion::{bin, spread};
use crate::calibration::parameters::{Correction, Parameter};
use crate::diagnosis::quantiles::median;
use conefield_core::geometry::{Geometry, Vec3, View, cross, dot, norm, sub};
use conefield_core::parallel;
use conefield_core::scan::{Scan, Unit};
use conefield_core::{Error, Result};
use ndarray::{Array3, ArrayView2, s};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Largest number of pairs of views.
const MOST_PAIRS: usize = 1500;
/// Standard deviation of the Gaussian, in widths of the pair's widest pixel.
const WIDE: f64 = 1.5;
/// Bins per standard deviation; the Gaussian is cut off after `END` standard deviations.
const FINE: usize = 8;
const END: usize = 5;
/// Share of planes ignored at either end, where the object enters and leaves as the geometry changes.
const MARGIN: f64 = 0.1;
/// Least number of planes of a pair; pairs with fewer are ignored.
const FEWEST: usize = 4;
/// Shares of the highest line integral. A local mean below the first is air and is ignored. A local mean above the
/// second at a side of the detector is an object that is cut off.
const AIR: f32 = 0.01;
const CUT: f32 = 0.05;
/// Least distance of the line through two sources from the volume's centre, and of every ray's end from the plane at
/// right angles to `e₁`, as shares of the distances from the source: planes around a line through the object do not
/// give parallel lines on the detector.
const PAST: f64 = 0.05;
const AHEAD: f64 = 0.15;
/// Number of brightness intervals for the noise measurement.
const STEPS: usize = 16;

/// A scan prepared for comparing pairs of views.
pub(crate) struct Consistency {
    /// The geometry of all views, before correction.
    pub geometry: Geometry,
    pixels: Vec<Vec<Pixel>>,
    pairs: Vec<Pair>,
    /// Number of planes of all pairs.
    planes: usize,
    /// Mean square of a view's values on the planes, divided by their noise variance.
    signal: f64,
    /// Root mean square change of the differences for a shift by a pixel.
    pub steepness: f64,
}

/// A pixel that shows the object.
struct Pixel {
    row: f64,
    column: f64,
    value: f64,
    /// Variance of its noise.
    variance: f64,
}

/// Two views and the planes that both show completely.
struct Pair {
    views: [usize; 2],
    /// The first plane, and the spacing of planes, which is also the standard deviation of the Gaussian.
    first: f64,
    width: f64,
    /// For each plane, whether no plane nearby is cut off.
    whole: Vec<bool>,
}

/// A pixel in a corrected geometry.
struct Seen {
    direction: Vec3,
    /// `g·|det|/|d|` and its variance.
    value: f64,
    variance: f64,
}

impl Consistency {
    /// Prepares `scan` with about `width` pixels along the longer side of the detector. Uses the planes that are
    /// complete in the geometry corrected by `known`.
    pub fn new(scan: &Scan, width: usize, known: &Correction) -> Result<Self> {
        let binned = Scan { unit: Unit::default(), ..spread(scan.binned(bin(scan.geometry.detector, width))) };
        let p = &binned.projections;
        let top = p.iter().copied().fold(0.0f32, f32::max);
        if top <= 0.0 {
            let expected = "line integrals of an object, positive where it absorbs";
            return Err(Error::invalid("scan", "projections", "no positive line integral", expected));
        }
        let around: Vec<Vec<f32>> = parallel::map(p.outer_iter(), |_, view| means(view, 2));
        let noise = Noise::of(p, AIR * top);
        let [rows, columns] = binned.geometry.detector;
        let view = |v: usize, mean: &Vec<f32>| -> Vec<Pixel> {
            // Pixels within two pixels of one that is not air.
            let shows = |r: usize, c: usize| {
                let near = |i: usize, n: usize| i.saturating_sub(2)..(i + 3).min(n);
                near(r, rows).any(|r| near(c, columns).any(|c| mean[r * columns + c] > AIR * top))
            };
            let all = (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c)));
            all.filter(|&(r, c)| shows(r, c))
                .map(|(r, c)| Pixel {
                    row: r as f64,
                    column: c as f64,
                    value: p[[v, r, c]].into(),
                    variance: noise.variance(mean[r * columns + c]),
                })
                .collect()
        };
        let pixels = parallel::map(&around, view);
        let side = |v: usize, x: &Pixel| {
            let (r, c) = (x.row as usize, x.column as usize);
            (r == 0 || c == 0 || r + 1 == rows || c + 1 == columns) && around[v][r * columns + c] > CUT * top
        };
        let geometry = binned.geometry.clone();
        let mut new = Self { geometry, pixels, pairs: vec![], planes: 0, signal: 1.0, steepness: 0.0 };
        let views = known.views(&new.geometry.views);
        let n = views.len();
        let all: Vec<[usize; 2]> = (0..n).flat_map(|i| (i + 1..n).map(move |j| [i, j])).collect();
        let some: Vec<[usize; 2]> = all.iter().step_by(all.len().div_ceil(MOST_PAIRS).max(1)).copied().collect();
        new.pairs = parallel::map(some, |_, pair| new.pair(&views, pair, &side)).into_iter().flatten().collect();
        new.planes = new.pairs.iter().map(|p| p.whole.iter().filter(|w| **w).count()).sum();
        if new.planes > 0 {
            new.measure(known)?;
        }
        Ok(new)
    }

    /// Number of planes of all pairs; 0 if no pair of views shows a plane completely.
    pub fn planes(&self) -> usize {
        self.planes
    }

    /// Approximate work of the misfits, in samples of a ray.
    pub fn work(&self) -> f64 {
        let of = |p: &Pair| p.views.iter().map(|&v| self.pixels[v].len() as f64).sum::<f64>();
        self.pairs.iter().map(of).sum()
    }

    /// The views of each pair.
    pub fn pairs(&self) -> Vec<[usize; 2]> {
        self.pairs.iter().map(|p| p.views).collect()
    }

    /// For each pair in the corrected geometry, the sum of squared differences of its views, divided by their noise
    /// variance. For pure noise this equals the number of planes in every geometry: the criterion is unbiased.
    pub fn misfits(&self, correction: &Correction) -> Vec<f64> {
        let of = |[(a, va), (b, vb)]: &[(f64, f64); 2]| (a - b).powi(2) / (va + vb).max(f64::MIN_POSITIVE);
        self.both(correction).iter().map(|pair| pair.iter().map(of).sum()).collect()
    }

    /// The sum of `misfits` relative to the views' values: 0 if they agree.
    pub fn error(&self, misfits: &[f64]) -> f64 {
        (misfits.iter().sum::<f64>() / (self.planes.max(1) as f64 * self.signal)).sqrt()
    }

    /// The values and variances of both views on each complete plane of each pair.
    fn both(&self, correction: &Correction) -> Vec<Vec<[(f64, f64); 2]>> {
        let views = correction.views(&self.geometry.views);
        let seen: Vec<Vec<Seen>> =
            parallel::map(self.pixels.iter().zip(&views), |_, (pixels, view)| self.seen(view, pixels));
        let of = |pair: &Pair| {
            let Some(frame) = self.frame(&views, pair.views) else { return vec![] };
            let [a, b] = pair.views.map(|v| planes(&seen[v], frame, pair));
            let whole = a.into_iter().zip(b).zip(&pair.whole).filter(|(_, whole)| **whole);
            whole.map(|((a, b), _)| [a, b]).collect()
        };
        parallel::map(&self.pairs, |_, pair| of(pair))
    }

    /// Measures the signal of the views and the increase of their difference with a shift along u.
    fn measure(&mut self, known: &Correction) -> Result<()> {
        let values = self.both(known);
        let square = |(a, v): &(f64, f64)| a * a / v.max(f64::MIN_POSITIVE);
        let sum: f64 = values.iter().flatten().flatten().map(square).sum();
        self.signal = (sum / (2 * self.planes) as f64).max(f64::MIN_POSITIVE);
        let (u, pixel) = (Parameter::OffsetU, Parameter::OffsetU.pixel(&self.geometry));
        let at = |x: f64| self.misfits(&known.with(u, known.get(u) + x * pixel)).iter().sum::<f64>();
        self.steepness = ((at(0.5) + at(-0.5) - 2.0 * at(0.0)) / (2.0 * 0.25) / self.planes as f64).max(0.0).sqrt();
        Ok(())
    }

    fn seen(&self, view: &View, pixels: &[Pixel]) -> Vec<Seen> {
        let whole = dot(cross(view.u, view.v), sub(view.detector, view.source)).abs();
        let of = |x: &Pixel| {
            let direction = sub(view.pixel(self.geometry.detector, x.row, x.column), view.source);
            let weight = whole / norm(direction);
            Seen { direction, value: weight * x.value, variance: weight * weight * x.variance }
        };
        pixels.iter().map(of).collect()
    }

    /// `e₁` and `e₂` of a pair, `e₁` towards the centre of the volume; `None` if the line through the sources passes
    /// too near the centre.
    fn frame(&self, views: &[View], [i, j]: [usize; 2]) -> Option<[Vec3; 2]> {
        let along = sub(views[j].source, views[i].source);
        let along = along.map(|x| x / norm(along));
        let ahead = sub(self.geometry.volume.center, views[i].source);
        let part = dot(ahead, along);
        let e1: Vec3 = std::array::from_fn(|k| ahead[k] - part * along[k]);
        let past = norm(e1);
        // Also false for identical sources, where the values are NaN.
        (past > PAST * norm(ahead)).then(|| {
            let e1 = e1.map(|x| x / past);
            [e1, cross(along, e1)]
        })
    }

    /// The planes of two views, if both show enough of them completely.
    fn pair(&self, views: &[View], pair: [usize; 2], side: &(impl Fn(usize, &Pixel) -> bool + Sync)) -> Option<Pair> {
        let [e1, e2] = self.frame(views, pair)?;
        let (mut low, mut high, mut width) = (f64::NEG_INFINITY, f64::INFINITY, 0.0f64);
        let mut cut = vec![];
        for v in pair {
            let view = &views[v];
            let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
            for x in &self.pixels[v] {
                let d = sub(view.pixel(self.geometry.detector, x.row, x.column), view.source);
                let ahead = dot(d, e1);
                if ahead <= AHEAD * norm(d) {
                    return None;
                }
                let k = dot(d, e2) / ahead;
                (least, most) = (least.min(k), most.max(k));
                let change = |a: Vec3| (dot(a, e2) - k * dot(a, e1)) / ahead;
                width = width.max(change(view.u).hypot(change(view.v)));
                if side(v, x) {
                    cut.push(k);
                }
            }
            (low, high) = (low.max(least), high.min(most));
        }
        let margin = MARGIN * (high - low);
        let (first, width, last) = (low + margin, WIDE * width, high - margin);
        if !(width > 0.0 && last - first > FEWEST as f64 * width) {
            return None;
        }
        let mut whole = vec![true; ((last - first) / width) as usize + 1];
        for k in cut {
            let from = ((k - first) / width - END as f64).ceil().max(0.0) as usize;
            let to = ((k - first) / width + END as f64).floor();
            for w in whole.iter_mut().skip(from).take(if to < from as f64 { 0 } else { to as usize + 1 - from }) {
                *w = false;
            }
        }
        (whole.iter().filter(|w| **w).count() >= FEWEST).then_some(Pair { views: pair, first, width, whole })
    }
}

/// The value of a view on each plane of a pair, and its variance.
fn planes(seen: &[Seen], [e1, e2]: [Vec3; 2], pair: &Pair) -> Vec<(f64, f64)> {
    let n = (pair.whole.len() + 2 * END) * FINE;
    let mut bins = vec![(0.0, 0.0); n + 1];
    let fine = pair.width / FINE as f64;
    let start = pair.first - (END * FINE) as f64 * fine;
    for x in seen {
        let ahead = dot(x.direction, e1);
        // Only in a geometry far from the pair's original one.
        if ahead <= 0.0 {
            continue;
        }
        let place = (dot(x.direction, e2) / ahead - start) / fine;
        if place >= 0.0 && place < n as f64 {
            let (bin, share) = (place as usize, place.fract());
            let weight = 1.0 / (ahead * ahead);
            let (value, variance) = (weight * x.value, weight * weight * x.variance);
            bins[bin].0 += (1.0 - share) * value;
            bins[bin].1 += (1.0 - share) * variance;
            bins[bin + 1].0 += share * value;
            bins[bin + 1].1 += share * variance;
        }
    }
    // The derivative of a Gaussian with a standard deviation of 1.
    let kernel: Vec<f64> = (0..=2 * END * FINE)
        .map(|i| i as f64 / FINE as f64 - END as f64)
        .map(|x| -x * (-x * x / 2.0).exp() / (2.0 * PI).sqrt())
        .collect();
    let plane = |i: usize| {
        let of = bins[i * FINE..].iter().zip(&kernel);
        of.fold((0.0, 0.0), |(a, v), ((value, variance), k)| (a + k * value, v + k * k * variance))
    };
    (0..pair.whole.len()).map(plane).collect()
}

/// Means of the pixels up to `reach` away.
fn means(view: ArrayView2<f32>, reach: usize) -> Vec<f32> {
    let (rows, columns) = view.dim();
    let near = |i: usize, n: usize| i.saturating_sub(reach)..(i + reach + 1).min(n);
    let all = (0..rows).flat_map(|r| (0..columns).map(move |c| (r, c)));
    all.map(|(r, c)| {
        let block = view.slice(s![near(r, rows), near(c, columns)]);
        block.sum() / block.len() as f32
    })
    .collect()
}

/// Variance of a pixel's noise as a function of brightness. A wrong variance would favour geometries in which noisy
/// pixels have less weight.
struct Noise {
    /// The upper limit of each interval, and the variance in it.
    steps: Vec<(f32, f64)>,
}

impl Noise {
    /// Measured from the curvature of three pixels in a row; edges hardly affect its median (Hampel, J. Am. Stat.
    /// Assoc. 69, 1974).
    fn of(p: &Array3<f32>, air: f32) -> Self {
        let columns = p.dim().2;
        let triples = |view: ArrayView2<f32>| -> Vec<(f32, f32)> {
            let row = |row: ndarray::ArrayView1<f32>| -> Vec<(f32, f32)> {
                let of = |c: usize| (row[c - 1] + row[c] + row[c + 1], (row[c - 1] - 2.0 * row[c] + row[c + 1]).abs());
                (1..columns.saturating_sub(1)).map(of).map(|(sum, bend)| (sum / 3.0, bend)).collect()
            };
            view.outer_iter().flat_map(row).filter(|(mean, _)| *mean > air).collect()
        };
        let mut all = parallel::map(p.outer_iter(), |_, view| triples(view)).concat();
        all.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let step = |part: &[(f32, f32)]| {
            let mut bends: Vec<f32> = part.iter().map(|x| x.1).collect();
            let median = f64::from(median(&mut bends).unwrap_or(0.0));
            // A median deviation is 0.6745 standard deviations; three pixels with weights 1, -2, 1 have six times the
            // variance.
            (part[part.len() - 1].0, (median / 0.6745).powi(2) / 6.0)
        };
        let mut steps: Vec<(f32, f64)> = all.chunks(all.len().div_ceil(STEPS).max(1)).map(step).collect();
        // Fewer photons reach brighter pixels, so their noise is larger: a larger variance at lower brightness comes
        // from edges.
        for i in (1..steps.len()).rev() {
            steps[i - 1].1 = steps[i - 1].1.min(steps[i].1);
        }
        // Without any noise, every pixel has the same weight.
        let most = steps.iter().map(|s| s.1).fold(0.0, f64::max);
        let least = if most > 0.0 { 1e-3 * most } else { 1.0 };
        steps.iter_mut().for_each(|s| s.1 = s.1.max(least));
        Self { steps }
    }

    fn variance(&self, value: f32) -> f64 {
        let step = self.steps.partition_point(|s| s.0 < value).min(self.steps.len().saturating_sub(1));
        self.steps.get(step).map_or(1.0, |s| s.1)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::calibration::search::Watch;
    use conefield_core::geometry::VoxelGrid;
    use conefield_core::orbit::CircularOrbit;
    use std::f64::consts::TAU;

    /// A watch that ignores progress and never cancels.
    pub(crate) struct Silent;

    impl Watch for Silent {}

    /// Gaussians with known line integrals: centre in mm, width in mm, largest value in 1/mm.
    const OBJECT: [(Vec3, f64, f64); 6] = [
        ([30.0, 5.0, 20.0], 7.0, 0.03),
        ([-25.0, 28.0, -5.0], 6.0, 0.03),
        ([5.0, -33.0, 32.0], 5.0, 0.03),
        ([-12.0, -15.0, -30.0], 8.0, 0.02),
        ([20.0, 30.0, -25.0], 5.0, 0.03),
        ([-35.0, -5.0, 15.0], 5.0, 0.03),
    ];

    /// Views of the Gaussians on a detector of 96 × 96 pixels of 2.5 mm, with noise of this standard deviation.
    pub(crate) fn scan(views: usize, noise: f64) -> Scan {
        let angles = (0..views).map(|i| TAU * i as f64 / views as f64).collect();
        let orbit = CircularOrbit { dso: 500.0, dsd: 800.0, pixel: [2.5; 2], offset: [0.0; 2], angles };
        let volume = VoxelGrid { shape: [64; 3], spacing: [2.0; 3], center: [0.0; 3] };
        let geometry = Geometry { views: orbit.views(), detector: [96, 96], volume };
        let mut seed = 1u64;
        let mut uniform = move || {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 33) as f64 / (1u64 << 31) as f64
        };
        let projections = Array3::from_shape_fn((views, 96, 96), |(v, r, c)| {
            let view = &geometry.views[v];
            let ray = sub(view.pixel([96, 96], r as f64, c as f64), view.source);
            let integral = |&(middle, width, value): &(Vec3, f64, f64)| {
                let to = sub(middle, view.source);
                let past = dot(to, to) - dot(to, ray).powi(2) / dot(ray, ray);
                value * width * (2.0 * PI).sqrt() * (-past / (2.0 * width * width)).exp()
            };
            // The sum of twelve uniform numbers is nearly normal with variance 1.
            let random = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
            (OBJECT.iter().map(integral).sum::<f64>() + noise * random) as f32
        });
        Scan { geometry, projections, unit: Unit::default(), provenance: Default::default() }
    }

    fn compared(scan: &Scan) -> Consistency {
        Consistency::new(scan, 96, &Correction::default()).unwrap()
    }

    fn error(pairs: &Consistency, parameter: Parameter, value: f64) -> f64 {
        pairs.error(&pairs.misfits(&Correction::default().with(parameter, value)))
    }

    #[test]
    fn pairs_are_consistent_only_in_the_true_geometry() {
        let pairs = compared(&scan(24, 0.0));
        let right = error(&pairs, Parameter::OffsetU, 0.0);
        let wrong = [
            (Parameter::OffsetU, 1.0),
            (Parameter::OffsetV, 5.0),
            (Parameter::Rotation, 0.5f64.to_radians()),
            (Parameter::Slant, 3f64.to_radians()),
            (Parameter::Distance, 40.0),
            (Parameter::Step, 0.005),
        ];
        for (p, x) in wrong {
            for x in [x, -x] {
                assert!(error(&pairs, p, x) > 3.0 * right, "{p} {x}: {} {right}", error(&pairs, p, x));
            }
        }
        assert!(right < 0.01, "{right}");
    }

    /// The reason why tilt is not estimated on a circle.
    #[test]
    fn a_tilt_on_a_circle_hardly_changes_the_error() {
        let pairs = compared(&scan(24, 0.0));
        let right = error(&pairs, Parameter::Tilt, 0.0);
        for degrees in [-3.0f64, 3.0] {
            let tilted = error(&pairs, Parameter::Tilt, degrees.to_radians());
            let slanted = error(&pairs, Parameter::Slant, degrees.to_radians());
            assert!(tilted < right + 0.05 * slanted, "{tilted} {slanted} {right}");
        }
    }

    /// The search minimizes the mean of the misfits; for pure noise it is 1 in every geometry.
    #[test]
    fn noise_favours_no_geometry() {
        let mut blank = scan(24, 0.01);
        let object = scan(24, 0.0).projections;
        let mean = |p: &Consistency, c: Correction| p.misfits(&c).iter().sum::<f64>() / p.planes as f64;
        let noisy = mean(&compared(&blank), Correction::default());
        assert!((noisy - 1.0).abs() < 0.1, "{noisy}");
        // The same pixels with only their noise.
        let mut only = compared(&blank);
        blank.projections -= &object;
        for (v, pixels) in only.pixels.iter_mut().enumerate() {
            for x in pixels {
                x.value = blank.projections[[v, x.row as usize, x.column as usize]].into();
            }
        }
        for (p, x) in [(Parameter::Distance, 40.0), (Parameter::Distance, -40.0), (Parameter::Step, 0.005)] {
            let change = mean(&only, Correction::default().with(p, x)) / mean(&only, Correction::default()) - 1.0;
            assert!(change.abs() < 0.02, "{p} {x}: {change}");
        }
    }

    #[test]
    fn planes_that_are_cut_off_are_ignored() {
        let whole = scan(24, 0.0);
        let all = compared(&whole).planes();
        let crop = |rows: usize, columns: usize| {
            let mut cut = whole.clone();
            cut.geometry.detector = [rows, columns];
            let [r, c] = [(96 - rows) / 2, (96 - columns) / 2];
            cut.projections = whole.projections.slice(s![.., r..r + rows, c..c + columns]).to_owned();
            compared(&cut)
        };
        let (high, narrow) = (crop(40, 96), crop(96, 20));
        assert!((1..all).contains(&high.planes()), "{all} {}", high.planes());
        assert!(error(&high, Parameter::OffsetU, 0.0) < 0.02);
        assert_eq!(narrow.planes(), 0);
        assert!(narrow.misfits(&Correction::default()).is_empty());
    }

    #[test]
    fn noise_is_measured_for_each_brightness() {
        let mut scan = scan(24, 0.0);
        let noise = super::tests::scan(24, 1.0).projections - &scan.projections;
        scan.projections = Array3::from_shape_fn(scan.projections.dim(), |(_, r, _)| if r < 48 { 1.0 } else { 2.0 });
        scan.projections.zip_mut_with(&noise, |p, n| *p += 0.01 * *p * n);
        let found = Noise::of(&scan.projections, 0.1);
        for value in [1.0f32, 2.0] {
            let deviation = found.variance(value).sqrt() / f64::from(value);
            assert!((deviation - 0.01).abs() < 0.001, "{value}: {deviation}");
        }
    }
}
