//! What the parts of a run take on this machine, measured for about a second: real training steps on some views of the
//! scan, or real passes over a slab of it, and what comes after the training.

use crate::commands::Parts;
use crate::files;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::Voxels;
use conefield_core::scan::{Scan, Volume};
use conefield_core::solver::{Job, Limits, Observer, Record};
use conefield_core::spec::load::Loaded;
use conefield_io::MiddleSlices;
use ndarray::s;
use serde::Serialize;
use std::time::Instant;

/// Views that training steps are measured on; a step takes as long on few as on many.
const VIEWS: usize = 8;
/// Voxels that evaluating and packing are measured on.
const VOXELS: usize = 1 << 18;
/// Voxels that scoring is measured on.
const SCORED: usize = 1 << 20;
/// Bytes a second that files grow by, once packed: of a slow disk, as a run syncs what it writes.
const DISK: f64 = 2e8;
/// Fewest detector rows and layers of voxels of a slab.
const ROWS: usize = 8;
const LAYERS: usize = 4;

/// What is measured on.
pub struct Bench<'a> {
    pub scan: &'a Scan,
    pub reference: Option<&'a Volume>,
    pub peak: f64,
    pub backend: &'a dyn Backend,
    pub seed: u64,
}

/// Seconds that the parts of a run take here.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Costs {
    /// Before the first step.
    pub prepare_s: f64,
    /// A step or pass.
    pub step_s: f64,
    /// Writing weights, and evaluating, packing and writing voxels.
    pub export_s: f64,
    /// Drawing slices.
    pub picture_s: f64,
    /// Comparing with the reference.
    pub score_s: f64,
}

impl Costs {
    /// What comes after the training.
    pub fn after_s(&self) -> f64 {
        self.export_s + self.picture_s + self.score_s
    }
}

/// Measures what `loaded` takes, in about `seconds`.
pub fn calibrate(bench: &Bench<'_>, loaded: &Loaded, parts: &Parts, seconds: f64) -> Result<Costs> {
    let solved = match &parts.pipeline {
        Some(_) => field(bench, loaded, parts, 0.5 * seconds)?,
        None => voxels(bench, loaded, parts, 0.5 * seconds)?,
    };
    Ok(Costs { picture_s: picture(bench)?, score_s: score(bench)?, ..solved })
}

/// Steps on some of the views, then some layers of the field.
fn field(bench: &Bench<'_>, loaded: &Loaded, parts: &Parts, seconds: f64) -> Result<Costs> {
    let n = bench.scan.geometry.views.len();
    let every = n.div_ceil(VIEWS);
    let others: Vec<usize> = (0..n).filter(|v| v % every != 0).collect();
    let scan = bench.scan.split(&others)?.0;
    let mut laps = Laps::default();
    let limits = Limits { at_most: Some(seconds), ..Limits::default() };
    let begin = Instant::now();
    let solution = parts.solver.solve(&job(bench, loaded, &scan, limits), &mut laps)?;
    let prepare_s = (begin.elapsed().as_secs_f64() - solution.train_s).max(0.0);
    let step_s = laps.typical().unwrap_or(solution.train_s / solution.steps.max(1) as f64);
    let mut export_s = 0.0;
    if let Some(field) = solution.result.field() {
        let whole = field.scene.grid;
        let few = layers(whole, VOXELS);
        let mut voxels = field.voxels(bench.backend, few)?;
        export_s = packing(&mut voxels, whole)? + 4.0 * field.model.pipeline.layout().len() as f64 / DISK;
    }
    Ok(Costs { prepare_s, step_s, export_s, ..Costs::default() })
}

/// Two passes over the middle of the volume and the detector rows that look at it: once or, where the first slab was
/// done too soon to tell, over a thicker one.
fn voxels(bench: &Bench<'_>, loaded: &Loaded, parts: &Parts, seconds: f64) -> Result<Costs> {
    let mut wanted = 0.0;
    loop {
        let (scan, share) = slab(bench.scan, wanted);
        let mut laps = Laps::default();
        let limits = Limits { steps: Some(2), ..Limits::default() };
        let begin = Instant::now();
        let solution = parts.solver.solve(&job(bench, loaded, &scan, limits), &mut laps)?;
        let took = begin.elapsed().as_secs_f64();
        if took < 0.3 * seconds && share < 1.0 {
            wanted = (share * (0.7 * seconds / took).clamp(2.0, 16.0)).min(1.0);
            continue;
        }
        let step_s = match (solution.steps, laps.typical()) {
            (2.., Some(lap)) => lap,
            _ => solution.train_s / solution.steps.max(1) as f64,
        };
        let prepare_s = (took - step_s * solution.steps as f64).max(0.0) / share;
        let volume = solution.result.volume(bench.backend)?;
        let export_s = packing(&mut &volume, bench.scan.geometry.volume)?;
        return Ok(Costs { prepare_s, step_s: step_s / share, export_s, ..Costs::default() });
    }
}

fn job<'a>(bench: &'a Bench<'_>, loaded: &'a Loaded, scan: &'a Scan, limits: Limits) -> Job<'a> {
    Job {
        seed: bench.seed,
        limits,
        weights: &|path| files::read_weights(path),
        volumes: &files::volume,
        ..Job::new(scan, &loaded.spec, bench.backend)
    }
}

/// About this share of the detector rows and of the layers of the volume, both from the middle, and the share it is.
fn slab(scan: &Scan, share: f64) -> (Scan, f64) {
    // As many left as are there, but for an even number: the middle stays where it is.
    let part = |all: usize, least: usize| {
        let wanted = ((all as f64 * share).round() as usize).max(least);
        if wanted >= all { all } else { all - 2 * ((all - wanted) / 2) }
    };
    let mut geometry = scan.geometry.clone();
    let (all, deep) = (geometry.detector[0], geometry.volume.shape[2]);
    geometry.detector[0] = part(all, ROWS);
    geometry.volume.shape[2] = part(deep, LAYERS);
    let first = (all - geometry.detector[0]) / 2;
    let projections = scan.projections.slice(s![.., first..first + geometry.detector[0], ..]).to_owned();
    let share = 0.5 * (geometry.detector[0] as f64 / all as f64 + geometry.volume.shape[2] as f64 / deep as f64);
    (Scan { geometry, projections, unit: scan.unit.clone(), provenance: scan.provenance.clone() }, share)
}

/// The same box in fewer layers along z: at most about so many voxels.
fn layers(grid: VoxelGrid, voxels: usize) -> VoxelGrid {
    let [x, y, z] = grid.shape;
    let fewer = (voxels / (x * y).max(1)).clamp(1, z);
    let spacing = [grid.spacing[0], grid.spacing[1], grid.spacing[2] * z as f64 / fewer as f64];
    VoxelGrid { shape: [x, y, fewer], spacing, ..grid }
}

/// Seconds of making, packing and writing all voxels of `whole`, by those of `some`.
fn packing(some: &mut dyn Voxels, whole: VoxelGrid) -> Result<f64> {
    let count = |g: VoxelGrid| g.len().unwrap_or(usize::MAX) as f64;
    let larger = count(whole) / count(some.grid()).max(1.0);
    let begin = Instant::now();
    let bytes = conefield_io::packed_bytes(some)?;
    Ok(larger * (begin.elapsed().as_secs_f64() + bytes as f64 / DISK))
}

fn picture(bench: &Bench<'_>) -> Result<f64> {
    let result = MiddleSlices::new(bench.scan.geometry.volume);
    let reference = bench.reference.map(MiddleSlices::of);
    let path = std::env::temp_dir().join(format!("conefield-{}.png", std::process::id()));
    let begin = Instant::now();
    let drawn = files::picture(&path, reference.as_ref(), &result);
    let seconds = begin.elapsed().as_secs_f64();
    let _ = std::fs::remove_file(&path);
    drawn.map(|()| seconds)
}

fn score(bench: &Bench<'_>) -> Result<f64> {
    let Some(reference) = bench.reference else { return Ok(0.0) };
    let [x, y, z] = reference.grid.shape;
    let deep = (SCORED / (x * y).max(1)).clamp(16.min(z), z);
    let first = (z - deep) / 2;
    let some = reference.data.slice(s![.., .., first..first + deep]);
    let begin = Instant::now();
    conefield_metrics::evaluate(some, some, bench.peak)?;
    Ok(begin.elapsed().as_secs_f64() * z as f64 / deep as f64)
}

/// When each step was done.
#[derive(Default)]
struct Laps {
    done: Vec<Instant>,
}

impl Laps {
    /// The median of the later half: the first steps touch memory for the first time.
    fn typical(&self) -> Option<f64> {
        let all: Vec<f64> = self.done.windows(2).map(|w| (w[1] - w[0]).as_secs_f64()).collect();
        let mut late = all[all.len() / 2..].to_vec();
        late.sort_by(f64::total_cmp);
        late.get(late.len() / 2).copied()
    }
}

impl Observer for Laps {
    fn progress(&mut self, _: u64, _: f64, _: f64) {
        self.done.push(Instant::now());
    }

    fn record(&mut self, _: &Record) {}

    fn note(&mut self, _: &str) {}

    fn cancelled(&self) -> bool {
        crate::signals::caught().is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::specs;
    use conefield_backend_cpu::Cpu;
    use conefield_projectors::simulate::{PhantomKind, Protocol, phantom_of, simulate};

    #[test]
    fn a_slab_keeps_the_middle() {
        let truth = phantom_of(PhantomKind::Head, 33);
        let scan = simulate(&truth, &Protocol::r2(&truth.grid).with_detector([40, 40]).with_views(3)).unwrap();
        let (thin, share) = slab(&scan, 0.0);
        assert_eq!((thin.geometry.detector, thin.geometry.volume.shape), ([8, 40], [33, 33, 5]));
        assert!((share - 0.5 * (8.0 / 40.0 + 5.0 / 33.0)).abs() < 1e-12);
        assert_eq!(thin.projections.slice(s![1, 0, ..]), scan.projections.slice(s![1, 16, ..]));
        thin.validate("slab").unwrap();
        let (all, share) = slab(&scan, 2.0);
        assert_eq!((all.projections.dim(), share), (scan.projections.dim(), 1.0));
    }

    #[test]
    fn fewer_layers_fill_the_same_box() {
        let grid = VoxelGrid { shape: [64, 64, 48], spacing: [1.0, 1.0, 2.0], center: [0.0; 3] };
        let few = layers(grid, 4096 * 12);
        assert_eq!((few.shape, few.size()), ([64, 64, 12], grid.size()));
        assert_eq!(layers(grid, usize::MAX), grid);
    }

    #[test]
    fn every_kind_of_solver_is_measured() {
        let truth = phantom_of(PhantomKind::Head, 24);
        let scan = simulate(&truth, &Protocol::r2(&truth.grid).with_detector([24, 24]).with_views(12)).unwrap();
        let backend = Cpu::new();
        let bench = Bench { scan: &scan, reference: Some(&truth), peak: 1.0, backend: &backend, seed: 0 };
        for spec in ["fast", "fdk", "sart", "cgls", "fista-tv", "asd-pocs"] {
            let loaded = specs::read(spec, &[]).unwrap();
            let parts = Parts::of(&loaded, &backend).unwrap();
            let costs = calibrate(&bench, &loaded, &parts, 0.05).unwrap();
            let all = [costs.step_s, costs.export_s, costs.picture_s, costs.score_s];
            assert!(all.iter().all(|s| *s > 0.0 && s.is_finite()) && costs.prepare_s >= 0.0, "{spec}: {costs:?}");
        }
    }
}
