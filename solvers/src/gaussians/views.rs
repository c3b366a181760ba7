//! Training on whole views: implements the executable that a backend provides for other fields.

use super::cells::Cells;
use super::control::{Pulls, lock};
use super::grid::Grid;
use super::shape::{CENTRE, DENSITY, FREE, NUMBERS, ROTATION, SCALE, Shape, Slope};
use super::ssim::Ssim;
use super::stage::reshape;
use super::view::{Beam, Sight};
use conefield_core::backend::{Adam, BlockWork, Executable, StepStats, Work};
use conefield_core::error::{Error, Result};
use conefield_core::geometry::{Geometry, Vec3, norm, sub};
use conefield_core::loss::Loss;
use conefield_core::parallel;
use conefield_core::pipeline::Model;
use conefield_core::random::stream;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::Scene;
use conefield_core::simd::{self, Op, Select, Simd, SimdBase, SimdFloat, V, WIDEST, load, store};
use conefield_core::stage::{UnitGrid, UnitRay};
use rand::seq::SliceRandom;
use std::sync::{Arc, Mutex};

/// Rays that a worker renders at once.
const TOGETHER: usize = 64;
/// Shapes or points per task.
const PART: usize = 256;
/// Period of the parameter kinds: a whole number of vectors.
const PATTERN: usize = NUMBERS * WIDEST;

/// Settings of a training step.
#[derive(Debug, Clone, Copy)]
pub struct Rule {
    /// Views per step.
    pub views: usize,
    /// Weight of the structural dissimilarity relative to the mean loss of a pixel.
    pub ssim: f64,
    /// Learning rates of centre, scale and rotation relative to that of the density.
    pub rates: [f64; 3],
    /// Bounds of the standard deviations, in cube sides.
    pub widths: [f64; 2],
}

/// The views of a scan as training sees them.
pub struct Views {
    /// Their rays.
    pub beams: Vec<Beam>,
    /// Rows and columns.
    pub detector: [usize; 2],
    /// Measured line integrals in the scale that stages see, view after view, in padded rows.
    pub measured: Vec<f32>,
    /// The largest of them: what counts as a view's range.
    pub top: f64,
}

impl Views {
    /// The views of `scan`, with this many zeros after each row.
    pub fn new(scan: &Scan, scene: &Scene, padding: usize) -> Self {
        let g = &scan.geometry;
        let beams: Vec<Beam> = (0..g.views.len()).map(|view| beam(g, view, scene)).collect();
        let stride = g.detector[1] + padding;
        let mut measured = vec![0.0; g.views.len() * g.detector[0] * stride];
        let rows = scan.projections.rows().into_iter();
        for (out, row) in measured.chunks_mut(stride).zip(rows) {
            out.iter_mut().zip(row).for_each(|(out, a)| *out = scene.line_to_unit(*a));
        }
        let top = measured.iter().fold(1e-12, |top: f64, x| top.max(f64::from(*x)));
        Self { beams, detector: g.detector, measured, top }
    }

    /// The measured line integrals of a view.
    pub fn image(&self, view: usize) -> &[f32] {
        let size = self.measured.len() / self.beams.len();
        &self.measured[view * size..(view + 1) * size]
    }

    /// The shift of a centre in the cube that moves its projection by half the detector.
    pub fn half_detector(&self) -> f64 {
        let beam = &self.beams[0];
        let [rows, columns] = beam.detector.map(|n| n as f64);
        let middle: Vec3 = std::array::from_fn(|k| beam.first[k] + 0.5 * (columns * beam.u[k] + rows * beam.v[k]));
        let to_cube = norm(std::array::from_fn(|k| 0.5 - beam.source[k]));
        0.5 * (columns * norm(beam.u)).max(rows * norm(beam.v)) * to_cube / norm(middle)
    }
}

/// Training on the CPU: the views of a scan, with the working memory of a step.
pub struct ViewTraining {
    rule: Rule,
    views: Views,
    pulls: Arc<Mutex<Pulls>>,
    rates: [f32; PATTERN],
    shapes: Vec<Shape>,
    sight: Sight<f32>,
    slopes: Vec<Slope>,
    found: Vec<f32>,
    gradient: Vec<f32>,
    ssim: Ssim,
    grid: Grid,
}

/// The rays of `view` in the unit cube of `scene`.
pub fn beam(geometry: &Geometry, view: usize, scene: &Scene) -> Beam {
    let w = &geometry.views[view];
    let unit = |v: Vec3| v.map(|x| x / scene.side);
    Beam {
        source: std::array::from_fn(|k| (w.source[k] - scene.origin[k]) / scene.side),
        first: unit(sub(w.pixel(geometry.detector, 0.0, 0.0), w.source)),
        u: unit(w.u),
        v: unit(w.v),
        detector: geometry.detector,
    }
}

impl ViewTraining {
    /// Zeros after each row of the views: vectors reach past the last pixel.
    pub const PADDING: usize = WIDEST;

    /// Training on `views`, which are padded by [`Self::PADDING`]; the pulls on centres are added to `pulls`.
    pub fn new(rule: Rule, views: Views, pulls: Arc<Mutex<Pulls>>) -> Self {
        let mut rates = [1.0; PATTERN];
        for (i, rate) in rates.iter_mut().enumerate() {
            *rate = match i % NUMBERS {
                CENTRE..SCALE => rule.rates[0] as f32,
                SCALE..ROTATION => rule.rates[1] as f32,
                ROTATION..DENSITY => rule.rates[2] as f32,
                _ => 1.0,
            };
        }
        let [rows, columns] = views.detector;
        let images = || vec![0.0; rows * (columns + WIDEST)];
        Self {
            rule,
            views,
            pulls,
            rates,
            shapes: vec![],
            sight: Sight::default(),
            slopes: vec![],
            found: images(),
            gradient: images(),
            ssim: Ssim::default(),
            grid: Grid::default(),
        }
    }

    /// Bytes for a scan of this size and this many slots.
    pub fn bytes(header: &ScanHeader, places: u64) -> u64 {
        let image = (header.detector[0] * (header.detector[1] + WIDEST)) as u64;
        let each = size_of::<Shape>() + size_of::<Slope>() + Sight::<f32>::BYTES;
        4 * image * (header.views as u64 + 2) + Ssim::bytes(image) + each as u64 * places
    }

    /// The mean loss of a view's pixels and the weighted dissimilarity; `slopes` gets the derivatives with respect to
    /// the shapes of the view's share of the step.
    fn view(&mut self, view: usize, loss: &dyn Loss) -> [f64; 2] {
        let Self { rule, views, shapes, sight, slopes, found, gradient, ssim, .. } = self;
        let beam = &views.beams[view];
        let [rows, columns] = beam.detector;
        let stride = columns + WIDEST;
        let wanted = views.image(view);
        sight.project(beam, shapes, found);
        let share = 1.0 / rule.views as f64;
        let scale = share / (rows * columns) as f64;
        let rows_of = found.chunks_mut(stride).zip(gradient.chunks_mut(stride)).zip(wanted.chunks(stride));
        let sums = parallel::map(rows_of, |_, ((found, gradient), wanted)| {
            let mut sum = 0.0;
            for ((a, g), p) in found.iter().zip(gradient.iter_mut()).zip(wanted).take(columns) {
                let (value, slope) = loss.at(f64::from(*a), f64::from(*p));
                sum += value;
                *g = (slope * scale) as f32;
            }
            // Vectors reach past the last pixel.
            found[columns..].fill(0.0);
            gradient[columns..].fill(0.0);
            sum
        });
        let mut unlike = 0.0;
        if rule.ssim > 0.0 {
            let weight = -rule.ssim * share;
            unlike = rule.ssim * (1.0 - ssim.add([found, wanted], [columns, stride], views.top, weight, gradient));
        }
        sight.backproject(beam, shapes, gradient, slopes);
        [sums.iter().sum::<f64>() * scale, unlike * share]
    }

    /// Adds the gradient of `work` to `grads`; returns its weighted penalty.
    fn prior(&mut self, work: &BlockWork<'_>, params: &[f32], grads: &mut [f32]) -> f64 {
        let Self { grid, shapes, .. } = self;
        let blocks = work.prior.blocks();
        let (scale, n) = (work.scale(), blocks.points());
        let mut penalty = 0.0;
        let (mut values, mut by) = (vec![0.0f32; n], vec![0.0f32; n]);
        for corner in work.corners {
            let points = UnitGrid {
                first: corner.map(f64::from),
                spacing: work.spacing.map(f64::from),
                shape: [blocks.edge; 3],
            };
            grid.look(&points, shapes);
            grid.values(&points, shapes, &mut values);
            let wide: Vec<f64> = values.iter().map(|x| f64::from(*x)).collect();
            let mut slopes = vec![0.0; n];
            penalty += scale * work.prior.block(&wide, scale, &mut slopes);
            by.iter_mut().zip(&slopes).for_each(|(by, s)| *by = *s as f32);
            for (i, slope) in grid.slopes(&points, shapes, &by) {
                let own = i * NUMBERS..(i + 1) * NUMBERS;
                let more = slope.by_parameters(&params[own.clone()], &shapes[i]);
                grads[own].iter_mut().zip(more).for_each(|(g, more)| *g += more as f32);
            }
        }
        penalty
    }
}

/// The views of step `step` (from 0): every view once before any repeats, in a new order each time.
pub(super) fn drawn(seed: u64, step: u64, views: usize, count: usize) -> impl Iterator<Item = usize> {
    (0..views as u64).map(move |i| {
        let turn = step * views as u64 + i;
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut stream(seed ^ 0x71e3_5a0d, turn / count as u64));
        order[(turn % count as u64) as usize]
    })
}

impl Executable for ViewTraining {
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        let arena = &mut model.arena;
        reshape(&arena.params, &mut self.shapes);
        self.slopes.resize(self.shapes.len(), Slope::default());
        arena.grads.fill(0.0);
        let mut stats = StepStats::default();
        for view in drawn(work.seed, work.step, self.rule.views, self.views.beams.len()) {
            let [loss, unlike] = self.view(view, work.loss);
            stats.loss += loss;
            stats.prior += unlike;
            stats.samples += self.views.detector.iter().product::<usize>() as u64;
            let (slopes, shapes) = (&self.slopes, &self.shapes);
            let parts = arena.grads.chunks_mut(PART * NUMBERS).zip(arena.params.chunks(PART * NUMBERS));
            parallel::over(parts, |n, (grads, params)| {
                let those = slopes[n * PART..].iter().zip(&shapes[n * PART..]);
                for ((g, p), (slope, shape)) in grads.chunks_mut(NUMBERS).zip(params.chunks(NUMBERS)).zip(those) {
                    if shape.density > 0.0 {
                        let more = slope.by_parameters(p, shape);
                        g.iter_mut().zip(more).for_each(|(g, more)| *g += more as f32);
                    }
                }
            });
        }
        for prior in work.priors {
            stats.prior += self.prior(prior, &arena.params, &mut arena.grads);
        }
        work.fault()?;
        Ok(stats)
    }

    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()> {
        lock(&self.pulls).add(&model.arena.grads);
        let bias = [adam.beta1, adam.beta2].map(|b| 1.0 - b.powf(adam.step as f64));
        let rule = AdamRule {
            rate: (adam.lr / bias[0]) as f32,
            betas: [adam.beta1 as f32, adam.beta2 as f32],
            root: (1.0 / bias[1].sqrt()) as f32,
            eps: adam.eps as f32,
            rates: &self.rates,
        };
        let [least, widest] = self.rule.widths.map(|w| w.ln() as f32);
        let arena = &mut model.arena;
        const SIZE: usize = 64 * PATTERN;
        let parts = arena.params.chunks_mut(SIZE).zip(arena.grads.chunks_mut(SIZE));
        let moments = arena.first.chunks_mut(SIZE).zip(arena.second.chunks_mut(SIZE));
        parallel::over(parts.zip(moments), |_, ((p, g), (m, v))| {
            let parts = p.chunks_mut(PATTERN).zip(g.chunks_mut(PATTERN));
            for ((p, g), (m, v)) in parts.zip(m.chunks_mut(PATTERN).zip(v.chunks_mut(PATTERN))) {
                simd::run(AdamStep { rule, p: &mut *p, g, m, v });
                for p in p.chunks_mut(NUMBERS).filter(|p| p[DENSITY] > FREE) {
                    p[CENTRE..SCALE].iter_mut().for_each(|x| *x = x.clamp(0.0, 1.0));
                    p[SCALE..ROTATION].iter_mut().for_each(|x| *x = x.clamp(least, widest));
                }
            }
        });
        Ok(())
    }

    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        reshape(&model.arena.params, &mut self.shapes);
        let (shapes, cells) = (&self.shapes, Cells::new(&self.shapes));
        parallel::over(out.chunks_mut(PART).zip(points.chunks(PART)), |_, (out, points)| {
            for (out, p) in out.iter_mut().zip(points) {
                *out = cells.value(shapes, p.map(f64::from)) as f32;
            }
        });
        Ok(())
    }

    fn encode(&mut self, _: &Model, _: &[[f32; 3]]) -> Result<Vec<f32>> {
        Err(Error::unsupported("gaussians", "there is no encoder"))
    }

    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        if let Some(lines) = model.pipeline.field.lines() {
            let parts = out.chunks_mut(TOGETHER).zip(rays.chunks(TOGETHER));
            parallel::over(parts, |_, (out, rays)| lines.project(&model.arena.params, rays, out));
        }
        Ok(())
    }
}

/// Adam (Kingma and Ba 2015, algorithm 1) with a learning rate per kind of parameter.
#[derive(Clone, Copy)]
struct AdamRule<'a> {
    rate: f32,
    betas: [f32; 2],
    root: f32,
    eps: f32,
    rates: &'a [f32; PATTERN],
}

struct AdamStep<'a> {
    rule: AdamRule<'a>,
    p: &'a mut [f32],
    g: &'a [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
}

impl Op for AdamStep<'_> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { rule, p, g, m, v } = self;
        let zero = V::<S, f32>::splat(s, 0.0);
        let [beta1, beta2] = rule.betas;
        let mut i = 0;
        while i < p.len() {
            let grad = load::<S, f32>(s, g, i);
            let first = load(s, m, i) * beta1 + grad * (1.0 - beta1);
            let second = load(s, v, i) * beta2 + grad * grad * (1.0 - beta2);
            let rate = load(s, rule.rates, i) * rule.rate;
            let step = first * rate / (second.sqrt() * rule.root + rule.eps);
            store::<S, f32>(load(s, p, i) - step, p, i);
            // Decaying moments are set to zero before they become denormal numbers, which are slow.
            store::<S, f32>(first.abs().simd_gt(V::<S, f32>::splat(s, 1e-30)).select(first, zero), m, i);
            store::<S, f32>(second.simd_gt(V::<S, f32>::splat(s, 1e-36)).select(second, zero), v, i);
            i += V::<S, f32>::LEN;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_view_is_drawn_once_before_one_comes_again() {
        for views in [1, 3] {
            let mut all: Vec<usize> = (0..7).flat_map(|step| drawn(5, step, views, 7)).collect();
            assert_eq!(all.len(), 7 * views);
            all.chunks_mut(7).for_each(|turn| {
                turn.sort_unstable();
                assert_eq!(*turn, [0, 1, 2, 3, 4, 5, 6]);
            });
        }
    }
}
