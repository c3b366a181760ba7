//! One training step: losses and their gradients over rays, points and blocks.

use crate::rows::{Belong, DenseGrads, Encoded, Kernels, Log, Scratch, even_tiles};
use conefield_core::backend::{BlockWork, StepStats, Work};
use conefield_core::random::mix;
use conefield_core::simd::Real;
use conefield_core::stage::{Backward, Grads, Projector, Samples, Tile, TileMut};
use rayon::prelude::*;
use std::ops::Range;
use std::time::Instant;

/// Maximum rows of a wave: enough to use every entry of a large table several times while it is in the cache.
const WAVE_ROWS: usize = 393_216;
/// Maximum bytes of a wave, for stages with many numbers per row.
const WAVE_BYTES: usize = 64 << 20;
/// Rows that a worker takes through forward and backward at once: those of a group, or a part of a larger one.
const GROUP_ROWS: usize = 512;
/// Maximum number of slots, each with its own sums, among which the groups of a wave are distributed.
const SLOTS: usize = 16;
/// Bytes per row of a sample: position, weight, and index of its ray.
const SAMPLE_BYTES: usize = 4 * size_of::<f32>();
/// Maximum total bytes of all slots' copies of dense gradients.
const DENSE_BYTES: usize = 128 << 20;

/// A group of rows that runs forward and backward together.
#[derive(Debug, Clone)]
enum Group {
    Rays(Range<usize>),
    Points(Range<usize>),
    /// Blocks of the prior with this index.
    Blocks(usize, Range<usize>),
}

/// What the slots work on.
#[derive(Clone, Copy)]
struct Task<'a, R: Real> {
    kernels: &'a Kernels<'a, R>,
    projector: &'a dyn Projector,
    params: &'a [R],
    work: &'a Work<'a>,
}

/// Data of one slot.
#[derive(Debug, Default)]
struct Slot<R> {
    encoded: Encoded<R>,
    scratch: Scratch<R>,
    samples: Samples,
    /// Rows of each ray of the slot's groups.
    counts: Vec<usize>,
    /// Rows and counts of each group.
    placed: Vec<[Range<usize>; 2]>,
    mu: Vec<f64>,
    dmu: Vec<f64>,
    back: Vec<R>,
    dense: DenseGrads<R>,
    logs: Vec<Log<R>>,
    loss: f64,
    prior: f64,
    rows: u64,
}

/// The working memory of steps.
#[derive(Debug)]
pub struct Slots<R> {
    slots: Vec<Slot<R>>,
}

impl<R: Real> Slots<R> {
    /// Slots for `kernels`. Their number depends on the plan only, since it determines the order of sums.
    pub fn new(kernels: &Kernels<'_, R>) -> Self {
        let dense = DenseGrads::new(kernels);
        let count = Self::count(DenseGrads::numbers(kernels));
        let slot = || Slot { dense: dense.clone(), logs: vec![Log::default(); kernels.steps.len()], ..Slot::default() };
        Self { slots: std::iter::repeat_with(slot).take(count).collect() }
    }

    /// Number of slots, for `dense` dense gradients.
    fn count(dense: usize) -> usize {
        (DENSE_BYTES / (dense * size_of::<R>()).max(1)).clamp(1, SLOTS)
    }

    /// Bytes held by the slots for `kernels` during training.
    pub fn bytes(kernels: &Kernels<'_, R>) -> usize {
        let dense = DenseGrads::numbers(kernels);
        let numbers = Self::count(dense) * (dense + GROUP_ROWS * kernels.scratch_numbers());
        numbers * size_of::<R>() + wave_rows(kernels) * row_bytes(kernels)
    }

    /// Adds the gradients of `work`'s loss to `grads`.
    pub fn step(
        &mut self,
        kernels: &Kernels<'_, R>,
        projector: &dyn Projector,
        params: &[R],
        grads: &mut [R],
        work: &Work<'_>,
    ) -> StepStats {
        let task = Task { kernels, projector, params, work };
        let mut stats = StepStats::default();
        for slot in &mut self.slots {
            slot.dense.clear();
            (slot.loss, slot.prior, slot.rows) = (0.0, 0.0, 0);
        }
        for wave in waves(kernels, projector, work) {
            let start = Instant::now();
            let share = wave.len().div_ceil(self.slots.len()).max(1);
            let groups = |i: usize| &wave[(i * share).min(wave.len())..((i + 1) * share).min(wave.len())];
            self.slots.par_iter_mut().enumerate().for_each(|(i, slot)| slot.begin(task, groups(i)));
            for pass in 0..kernels.encoder_passes() {
                self.slots.par_iter_mut().for_each(|slot| slot.encoded.pass(kernels, params, pass));
            }
            self.slots.par_iter_mut().enumerate().for_each(|(i, slot)| slot.learn_all(task, groups(i)));
            let dense_done = Instant::now();
            self.scatter(kernels, params, grads);
            stats.dense_s += (dense_done - start).as_secs_f64();
            stats.scatter_s += dense_done.elapsed().as_secs_f64();
        }
        for slot in &self.slots {
            slot.dense.merge(kernels, grads);
            stats.loss += slot.loss;
            stats.prior += slot.prior;
            stats.samples += slot.rows;
        }
        stats
    }

    /// The second pass: each worker owns a range of scattered parameters and processes the logs in order.
    fn scatter(&mut self, kernels: &Kernels<'_, R>, params: &[R], grads: &mut [R]) {
        let slots = &self.slots;
        let mut rest = grads;
        let mut taken = 0;
        let mut tasks = vec![];
        for (k, s) in kernels.steps.iter().enumerate() {
            for range in &s.partition {
                let (from, to) = (s.params.start + range.start, s.params.start + range.end);
                let (own, after) = std::mem::take(&mut rest)[from - taken..].split_at_mut(to - from);
                (rest, taken) = (after, to);
                tasks.push((k, range.clone(), own));
            }
        }
        // The last ranges are the largest (finest levels): start with them to balance the load.
        tasks.into_par_iter().rev().with_max_len(1).for_each(|(k, range, values)| {
            let s = &kernels.steps[k];
            for log in slots.iter().map(|slot| if k == 0 { slot.encoded.log() } else { &slot.logs[k] }) {
                let mut data = &log.data[..];
                for &n in &log.rows {
                    let (x, after) = data.split_at(s.info.input * n);
                    let (dy, after) = after.split_at(s.info.output * n);
                    data = after;
                    s.kernel.backward(Backward {
                        params: &params[s.params.clone()],
                        x: Tile::new(x, n),
                        tape: TileMut::new(&mut [], n),
                        dy: Tile::new(dy, n),
                        grads: Grads { values: &mut values[..], range: range.clone() },
                        dx: None,
                    });
                }
            }
        });
        for slot in &mut self.slots {
            slot.encoded.clear();
            slot.logs.iter_mut().for_each(Log::clear);
        }
    }
}

/// Rows of a wave. They depend on the plan only, since they determine the order of sums.
fn wave_rows<R: Real>(kernels: &Kernels<'_, R>) -> usize {
    (WAVE_BYTES / row_bytes(kernels)).clamp(GROUP_ROWS, WAVE_ROWS)
}

/// Bytes per row kept until its wave is finished.
fn row_bytes<R: Real>(kernels: &Kernels<'_, R>) -> usize {
    (kernels.encoded_numbers() + kernels.logged_numbers()) * size_of::<R>() + SAMPLE_BYTES
}

/// Splits the work into groups, and these into waves.
fn waves<R: Real>(kernels: &Kernels<'_, R>, projector: &dyn Projector, work: &Work<'_>) -> Vec<Vec<Group>> {
    let mut groups: Vec<(Group, usize)> = vec![];
    let (mut start, mut rows) = (0, 0);
    for (i, ray) in work.rays.iter().enumerate() {
        let n = projector.max_samples(&ray.ray);
        if i > start && (rows + n > GROUP_ROWS || !kernels.mixes_rays()) {
            groups.push((Group::Rays(start..i), rows));
            (start, rows) = (i, 0);
        }
        rows += n;
    }
    if start < work.rays.len() {
        groups.push((Group::Rays(start..work.rays.len()), rows));
    }
    for start in (0..work.points.len()).step_by(GROUP_ROWS) {
        let end = (start + GROUP_ROWS).min(work.points.len());
        groups.push((Group::Points(start..end), end - start));
    }
    for (number, BlockWork { prior, corners, .. }) in work.priors.iter().enumerate() {
        let points = prior.blocks().points();
        let each = (GROUP_ROWS / points).max(1);
        for start in (0..corners.len()).step_by(each) {
            let end = (start + each).min(corners.len());
            groups.push((Group::Blocks(number, start..end), (end - start) * points));
        }
    }
    let most = wave_rows(kernels);
    let mut waves = vec![vec![]];
    let mut rows = 0;
    for (group, n) in groups {
        if rows > 0 && rows + n > most {
            waves.push(vec![]);
            rows = 0;
        }
        rows += n;
        if let Some(wave) = waves.last_mut() {
            wave.push(group);
        }
    }
    waves
}

/// Splits `rows` into parts no longer than [`GROUP_ROWS`].
fn cut(rows: Range<usize>) -> impl Iterator<Item = Range<usize>> {
    rows.clone().step_by(GROUP_ROWS).map(move |start| start..(start + GROUP_ROWS).min(rows.end))
}

impl<R: Real> Slot<R> {
    /// Samples `groups`, as input of the encoder.
    fn begin(&mut self, task: Task<'_, R>, groups: &[Group]) {
        self.samples.points.clear();
        self.samples.weights.clear();
        self.counts.clear();
        self.placed.clear();
        for group in groups {
            self.place(task, group);
        }
        self.encoded.begin(task.kernels, &self.samples.points);
    }

    /// Forward and backward of all stages after the encoder, group by group.
    fn learn_all(&mut self, task: Task<'_, R>, groups: &[Group]) {
        for (i, group) in groups.iter().enumerate() {
            self.learn(task, group, i);
        }
        self.encoded.backward(task.kernels, task.params, &mut self.dense);
    }

    /// Appends the samples of `group`.
    fn place(&mut self, Task { kernels, projector, work, .. }: Task<'_, R>, group: &Group) {
        let points = &mut self.samples.points;
        let (start, counted) = (points.len(), self.counts.len());
        match group {
            Group::Rays(range) => {
                for i in range.clone() {
                    let before = self.samples.points.len();
                    let seed = mix(mix(work.seed, work.step), i as u64);
                    projector.sample(&work.rays[i].ray, Some(seed), &mut self.samples);
                    self.counts.push(self.samples.points.len() - before);
                }
            }
            Group::Points(range) => points.extend(work.points[range.clone()].iter().map(|p| p.0)),
            Group::Blocks(prior, range) => {
                for i in range.clone() {
                    block_points(&work.priors[*prior], i, points);
                }
            }
        }
        let points = &mut self.samples.points;
        self.rows += (points.len() - start) as u64;
        if let Some(&last) = points.last()
            && kernels.mixes_rays()
        {
            // Whole vectors: the last row is repeated with weight 0.
            let padded = start + (points.len() - start).next_multiple_of(16);
            points.resize(padded, last);
        }
        self.samples.weights.resize(points.len(), 0.0);
        self.placed.push([start..points.len(), counted..self.counts.len()]);
    }

    /// All stages after the encoder, for the group with index `at`.
    fn learn(&mut self, task: Task<'_, R>, group: &Group, at: usize) {
        let Task { kernels, params, work, .. } = task;
        let [rows, counts] = self.placed[at].clone();
        if rows.is_empty() {
            // Rays without samples still have a measured value that they do not explain.
            if let Group::Rays(range) = group {
                self.mu.clear();
                self.dmu.clear();
                self.ray_loss(task, range.clone(), rows.start, counts);
            }
            return;
        }
        let belong = match group {
            Group::Rays(_) => Belong::ToRays,
            Group::Points(_) | Group::Blocks(..) => Belong::Nowhere,
        };
        // A ray or block larger than a group is processed in parts, so that a worker's memory does not grow with it.
        let parts: Vec<(usize, Vec<usize>)> = match (group, kernels.mixes_rays()) {
            (Group::Rays(_), false) => vec![(rows.start, self.counts[counts.clone()].to_vec())],
            _ => cut(rows.clone()).map(|part| (part.start, even_tiles(part.len()))).collect(),
        };
        self.mu.clear();
        for (start, tiles) in &parts {
            self.scratch.forward(kernels, params, &self.encoded, *start, tiles, belong);
            self.mu.extend(self.scratch.outputs().iter().map(|m| m.f64()));
        }
        self.dmu.clear();
        self.dmu.resize(self.mu.len(), 0.0);
        match group {
            Group::Rays(range) => self.ray_loss(task, range.clone(), rows.start, counts),
            Group::Points(range) => {
                let scale = 1.0 / work.points.len() as f64;
                for (i, (_, target)) in work.points[range.clone()].iter().enumerate() {
                    let (loss, slope) = work.loss.at(self.mu[i], f64::from(*target));
                    self.loss += loss * scale;
                    self.dmu[i] = slope * scale;
                }
            }
            Group::Blocks(number, range) => {
                let work = &work.priors[*number];
                let (points, scale) = (work.prior.blocks().points(), work.scale());
                let blocks = self.mu.chunks_exact(points).zip(self.dmu.chunks_exact_mut(points));
                // Rows after the last block are padding.
                for (mu, dmu) in blocks.take(range.len()) {
                    self.prior += scale * work.prior.block(mu, scale, dmu);
                }
            }
        }
        for (start, tiles) in &parts {
            if parts.len() > 1 {
                self.scratch.forward(kernels, params, &self.encoded, *start, tiles, belong);
            }
            let from = start - rows.start;
            self.back.clear();
            self.back.extend(self.dmu[from..from + tiles.iter().sum::<usize>()].iter().map(|&d| R::of(d)));
            self.scratch.backward(kernels, params, &self.back, &mut self.dense, &mut self.logs, &mut self.encoded);
        }
    }

    /// Losses of `rays`, whose rows begin at `first` of the slot.
    fn ray_loss(&mut self, task: Task<'_, R>, rays: Range<usize>, first: usize, counts: Range<usize>) {
        let Task { projector, work, .. } = task;
        let scale = 1.0 / work.rays.len() as f64;
        let mut at = 0;
        for (i, &n) in rays.zip(&self.counts[counts]) {
            let rows = at..at + n;
            let weights = &self.samples.weights[first..][rows.clone()];
            let line = projector.integrate(weights, &self.mu[rows.clone()]);
            let (loss, slope) = work.loss.at(line, f64::from(work.rays[i].target));
            self.loss += loss * scale;
            projector.adjoint(weights, slope * scale, &mut self.dmu[rows]);
            at += n;
        }
    }
}

/// Appends the points of block `i`, z fastest.
fn block_points(work: &BlockWork<'_>, i: usize, out: &mut Vec<[f32; 3]>) {
    let (corner, edge) = (work.corners[i], work.prior.blocks().edge);
    for x in 0..edge {
        for y in 0..edge {
            for z in 0..edge {
                let i = [x, y, z];
                out.push(std::array::from_fn(|k| corner[k] + i[k] as f32 * work.spacing[k]));
            }
        }
    }
}
