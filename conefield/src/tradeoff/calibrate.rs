//! Measures the duration of a run's parts on this machine in a second or a few: real training steps on some views of
//! the scan, or real passes over a coarser scan, and the work after training.

use conefield_core::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::method::{Job, Limits, Observer, Plan, Record};
use conefield_core::parts::Voxels;
use conefield_core::scan::{Scan, Volume};
use ndarray::{Array3, s};
use serde::Serialize;
use std::time::Instant;

/// Views for measuring training steps, whose duration does not depend on the number of views.
const VIEWS: usize = 8;
/// Voxels for measuring evaluation and compression.
const VOXELS: usize = 1 << 18;
/// Longest side of the part of the reference on which scoring is measured.
const SCORED: usize = 128;
/// Write speed of a slow disk, in compressed bytes per second, as a run syncs its output.
const DISK: f64 = 2e8;
/// First coarsening factor of pixels and voxels, and their minimum number per side.
const COARSEST: usize = 8;
const FEWEST: usize = 8;
/// Expected growth of the duration when the coarsening factor is halved: eight times the work, which matters less for
/// small scans.
const GROWTH: f64 = 5.0;

/// Inputs of the measurements.
pub struct Bench<'a> {
    /// The run that is planned.
    pub job: Job<'a>,
    /// Whether to end after the current step.
    pub cancelled: &'a dyn Fn() -> bool,
}

/// Durations of a run's parts on this machine, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Costs {
    /// Time before the first step.
    pub prepare_s: f64,
    /// Time of a step or pass.
    pub step_s: f64,
    /// Time of the solvers after training, if they make all their steps.
    pub then_s: f64,
    /// Their minimum useful time.
    pub then_least_s: f64,
    /// Steps and passes of the methods after the first.
    pub then_steps: f64,
    /// Time for writing weights and for evaluating, compressing and writing voxels.
    pub export_s: f64,
    /// Time for drawing slices.
    pub picture_s: f64,
    /// Time for comparing with the reference.
    pub score_s: f64,
}

impl Costs {
    /// Time after training.
    pub fn after_s(&self) -> f64 {
        self.then_s + self.export_s + self.picture_s + self.score_s
    }

    /// Duration of a run without reading the scan. All its methods together make `steps`; the first one makes
    /// the share `share` of its own.
    pub fn run_s(&self, steps: f64, share: f64) -> f64 {
        self.prepare_s + share * (steps - self.then_steps).max(1.0) * self.step_s + self.after_s()
    }
}

/// Measures the costs of a plan in about `seconds`.
pub fn calibrate(bench: &Bench<'_>, plan: &mut dyn Plan, seconds: f64) -> Result<Costs> {
    // Passes get all of it, divided among the methods of a chain: a single coarse scan cannot separate proportional from
    // constant costs, and passes would seem three times as expensive.
    let passes = seconds / plan.links().len().max(1) as f64;
    let measured = |plan: &mut dyn Plan, share: f64, later: bool| match plan.pipeline() {
        Some(_) => field(bench, plan, share * seconds, later),
        None => voxels(bench, plan, passes),
    };
    let solved = match plan.links() {
        [] => measured(plan, 0.5, false)?,
        [first, later @ ..] => {
            let mut costs = measured(first.as_mut(), 0.25, false)?;
            for link in later {
                let next = measured(link.as_mut(), 0.25, true)?;
                // Its start volume must be evaluated first.
                let before = costs.export_s + next.prepare_s;
                let passes = link.passes().unwrap_or(1) as f64;
                costs.then_s += before + passes * next.step_s;
                costs.then_least_s += before + next.step_s;
                costs.then_steps += passes;
                costs.export_s = next.export_s;
            }
            costs
        }
    };
    Ok(Costs { picture_s: picture(bench)?, score_s: score(bench)?, ..solved })
}

/// Measures steps on some of the views, then evaluation of some layers of the field. A `later` method of a chain gets a
/// start volume.
fn field(bench: &Bench<'_>, plan: &mut dyn Plan, seconds: f64, later: bool) -> Result<Costs> {
    let n = bench.job.scan.geometry.views.len();
    let every = n.div_ceil(VIEWS);
    let some: Vec<usize> = (0..n).step_by(every).collect();
    let scan = bench.job.scan.select(&some);
    let mut laps = Laps::new(bench.cancelled);
    let limits = Limits { at_most: Some(seconds), ..Limits::default() };
    let start = later.then(|| uniform(&scan));
    let begin = Instant::now();
    let solution = plan.run(&Job { start: start.as_ref(), ..job(bench, &scan, limits) }, &mut laps)?;
    // The work before the first step visits all pixels of all views.
    let fewer = n as f64 / scan.geometry.views.len() as f64;
    let prepare_s = fewer * (begin.elapsed().as_secs_f64() - solution.train_s).max(0.0);
    let step_s = laps.typical().unwrap_or(solution.train_s / solution.steps.max(1) as f64);
    let mut export_s = 0.0;
    if let Some(field) = solution.result.field() {
        let whole = field.scene.grid;
        let few = layers(whole, VOXELS);
        let mut voxels = field.voxels(bench.job.backend, few)?;
        export_s = packing(&mut voxels, whole)? + 4.0 * field.model.pipeline.layout().len() as f64 / DISK;
    }
    Ok(Costs { prepare_s, step_s, export_s, ..Costs::default() })
}

/// Measures two passes on a coarser detector and volume, then on finer ones while time permits: all views, so that
/// they and the work on them stay in proportion.
fn voxels(bench: &Bench<'_>, plan: &mut dyn Plan, seconds: f64) -> Result<Costs> {
    let mut factor = COARSEST;
    let mut coarser = None;
    loop {
        let scan = coarse(bench.job.scan, factor);
        let share = plan.work(&scan.header()) / plan.work(&bench.job.scan.header());
        let mut laps = Laps::new(bench.cancelled);
        let limits = Limits { steps: Some(2), ..Limits::default() };
        let start = uniform(&scan);
        let begin = Instant::now();
        let solution = plan.run(&Job { start: Some(&start), ..job(bench, &scan, limits) }, &mut laps)?;
        let took = begin.elapsed().as_secs_f64();
        let step_s = match (solution.steps, laps.typical()) {
            (2.., Some(lap)) => lap,
            _ => solution.train_s / solution.steps.max(1) as f64,
        };
        let measured = Passes { share, step_s, prepare_s: (took - step_s * solution.steps as f64).max(0.0) };
        if GROWTH * took < seconds && factor > 1 {
            factor /= 2;
            coarser = Some(measured);
            continue;
        }
        let volume = solution.result.volume(bench.job.backend)?;
        let export_s = packing(&mut &volume, bench.job.scan.geometry.volume)?;
        let Passes { step_s, prepare_s, .. } = measured.whole(coarser);
        return Ok(Costs { prepare_s, step_s, export_s, ..Costs::default() });
    }
}

/// Measured durations of passes on a scan with a share of the work.
#[derive(Clone, Copy)]
struct Passes {
    share: f64,
    step_s: f64,
    prepare_s: f64,
}

impl Passes {
    /// Durations for all of the work: two shares separate proportional from constant costs.
    fn whole(self, coarser: Option<Self>) -> Self {
        let scaled = |of: fn(&Self) -> f64| match &coarser {
            Some(less) if less.share < self.share => {
                let slope = (of(&self) - of(less)).max(0.0) / (self.share - less.share);
                of(&self) + slope * (1.0 - self.share)
            }
            _ => of(&self) / self.share,
        };
        Self { share: 1.0, step_s: scaled(|p| p.step_s), prepare_s: scaled(|p| p.prepare_s) }
    }
}

/// The job on `scan`, without what is measured apart from it.
fn job<'a>(bench: &'a Bench<'_>, scan: &'a Scan, limits: Limits) -> Job<'a> {
    Job { scan, limits, held_out: None, reference: None, ..bench.job }
}

/// A start volume: what it contains hardly changes the durations. It is positive, because Gaussians need that.
fn uniform(scan: &Scan) -> Volume {
    let grid = scan.geometry.volume;
    let longest = grid.size().into_iter().fold(0.0, f64::max);
    let mean = scan.projections.mean().unwrap_or(0.0) as f64 / longest;
    Volume { data: Array3::from_elem(grid.shape, (mean as f32).max(f32::MIN_POSITIVE)), grid, affine: None }
}

/// The scan with pixels and voxels `factor` times as large, as far as some remain.
fn coarse(scan: &Scan, factor: usize) -> Scan {
    let ([rows, columns], volume) = (scan.geometry.detector, scan.geometry.volume);
    let longest = volume.shape.into_iter().max().unwrap_or(1);
    let factor = factor.min(rows.min(columns).min(longest) / FEWEST).max(1);
    let mut coarse = scan.binned(factor);
    let (shape, size) = (volume.shape.map(|n| (n / factor).max(1)), volume.size());
    coarse.geometry.volume = VoxelGrid { shape, spacing: std::array::from_fn(|k| size[k] / shape[k] as f64), ..volume };
    coarse
}

/// The same box with fewer layers along z: at most about `voxels` voxels.
fn layers(grid: VoxelGrid, voxels: usize) -> VoxelGrid {
    let [x, y, z] = grid.shape;
    let fewer = (voxels / (x * y).max(1)).clamp(1, z);
    let spacing = [grid.spacing[0], grid.spacing[1], grid.spacing[2] * z as f64 / fewer as f64];
    VoxelGrid { shape: [x, y, fewer], spacing, ..grid }
}

/// Time for computing, compressing and writing all voxels of `whole`, extrapolated from `some`.
fn packing(some: &mut dyn Voxels, whole: VoxelGrid) -> Result<f64> {
    let count = |g: VoxelGrid| g.len().unwrap_or(usize::MAX) as f64;
    let larger = count(whole) / count(some.grid()).max(1.0);
    let begin = Instant::now();
    let bytes = conefield_io::packed_bytes(some)?;
    Ok(larger * (begin.elapsed().as_secs_f64() + bytes as f64 / DISK))
}

/// Time to draw the slices.
#[cfg(feature = "plots")]
pub(crate) fn picture(bench: &Bench<'_>) -> Result<f64> {
    use conefield_core::Error;
    use conefield_evaluation::report::{MiddleSlices, result_png};
    let result = MiddleSlices::new(bench.job.scan.geometry.volume);
    let reference = bench.job.reference.map(MiddleSlices::of);
    let folder = tempfile::tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))?;
    let begin = Instant::now();
    result_png(folder.path().join("slices.png"), reference.as_ref(), &result)?;
    Ok(begin.elapsed().as_secs_f64())
}

/// Without plots, there is nothing to draw.
#[cfg(not(feature = "plots"))]
pub(crate) fn picture(_: &Bench<'_>) -> Result<f64> {
    Ok(0.0)
}

/// Time to compare with the reference.
pub(crate) fn score(bench: &Bench<'_>) -> Result<f64> {
    let Some(reference) = bench.job.reference else { return Ok(0.0) };
    // The middle part: half of every side, within limits.
    let [x, y, z] = reference.grid.shape.map(|n| {
        let part = (n / 2).clamp(32.min(n), SCORED);
        (n - part) / 2..(n - part) / 2 + part
    });
    let share = (x.len() * y.len() * z.len()) as f64 / reference.data.len() as f64;
    let some = reference.data.slice(s![x, y, z]);
    let begin = Instant::now();
    conefield_evaluation::metrics::evaluate(some, some, bench.job.peak)?;
    Ok(begin.elapsed().as_secs_f64() / share)
}

/// The time at which each step was first completed.
pub(crate) struct Laps<'a> {
    steps: u64,
    done: Vec<Instant>,
    cancelled: &'a dyn Fn() -> bool,
}

impl<'a> Laps<'a> {
    pub(crate) fn new(cancelled: &'a dyn Fn() -> bool) -> Self {
        Self { steps: 0, done: vec![], cancelled }
    }

    /// The median of the later half: the first steps touch memory for the first time.
    pub(crate) fn typical(&self) -> Option<f64> {
        let all: Vec<f64> = self.done.windows(2).map(|w| (w[1] - w[0]).as_secs_f64()).collect();
        let mut late = all[all.len() / 2..].to_vec();
        late.sort_by(f64::total_cmp);
        late.get(late.len() / 2).copied()
    }
}

impl Observer for Laps<'_> {
    /// A finished solver reports its last step once more.
    fn progress(&mut self, step: u64, _: f64, _: f64) {
        if step > self.steps {
            self.steps = step;
            self.done.push(Instant::now());
        }
    }

    fn record(&mut self, _: &Record) {}

    fn note(&mut self, _: &str) {}

    fn cancelled(&self) -> bool {
        (self.cancelled)()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_projectors::simulate::{PhantomKind, Protocol, phantom_of, simulate};

    #[test]
    fn a_coarse_scan_is_of_the_same_box() {
        let truth = phantom_of(PhantomKind::Head, 32);
        let scan = simulate(&truth, &Protocol::r2(&truth.grid).with_detector([48, 64]).with_views(3)).unwrap();
        let half = coarse(&scan, 2);
        assert_eq!((half.geometry.detector, half.geometry.volume.shape), ([24, 32], [16; 3]));
        assert_eq!(half.geometry.volume.size(), scan.geometry.volume.size());
        let mean = |s: &Scan| s.projections.mean().unwrap();
        assert!((mean(&half) - mean(&scan)).abs() < 1e-5 * mean(&scan));
        let corner = |s: &Scan, r, c| s.geometry.views[1].pixel(s.geometry.detector, r, c);
        let (a, b) = (corner(&half, -0.5, -0.5), corner(&scan, -0.5, -0.5));
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
        half.validate("coarse").unwrap();
        let least = coarse(&scan, 64);
        assert_eq!(least.geometry.volume.shape, [8; 3]);
        assert_eq!(coarse(&scan, 1).projections, scan.projections);
    }

    #[test]
    fn costs_independent_of_the_work_are_separated() {
        // 0.05 s whatever the work, and 6 s for all of it; passes take 3 s.
        let of = |share: f64| Passes { share, prepare_s: 0.05 + 6.0 * share, step_s: 3.0 * share };
        let whole = of(1.0 / 64.0).whole(Some(of(1.0 / 512.0)));
        assert!((whole.prepare_s - 6.05).abs() < 1e-9 && (whole.step_s - 3.0).abs() < 1e-9);
        // A single share cannot separate the costs, nor can two equal ones.
        assert_eq!(of(0.5).whole(None).prepare_s, 6.1);
        assert_eq!(of(0.5).whole(Some(of(0.5))).prepare_s, 6.1);
        // Never less than measured.
        let odd = Passes { prepare_s: 0.01, ..of(0.5) }.whole(Some(of(0.1)));
        assert_eq!(odd.prepare_s, 0.01);
    }

    #[test]
    fn fewer_layers_fill_the_same_box() {
        let grid = VoxelGrid { shape: [64, 64, 48], spacing: [1.0, 1.0, 2.0], center: [0.0; 3] };
        let few = layers(grid, 4096 * 12);
        assert_eq!((few.shape, few.size()), ([64, 64, 12], grid.size()));
        assert_eq!(layers(grid, usize::MAX), grid);
    }

    #[test]
    fn a_step_reported_twice_counts_once() {
        let mut laps = Laps::new(&|| false);
        let pause = std::time::Duration::from_millis(20);
        for step in [1, 2, 2] {
            std::thread::sleep(pause);
            laps.progress(step, 0.0, 0.0);
        }
        laps.progress(2, 1.0, 0.0);
        assert_eq!(laps.done.len(), 2);
        assert!(laps.typical().unwrap() >= pause.as_secs_f64());
    }
}
