//! The criterion: the error of held-out views, predicted from a quick reconstruction of the others.

use crate::calibration::parameters::{Correction, Parameter};
use crate::calibration::{FINER, Settings};
use crate::diagnosis::setup;
use conefield_core::backend::Backend;
use conefield_core::finite::range;
use conefield_core::geometry::{Geometry, Vec3, View, VoxelGrid, norm};
use conefield_core::method::{Context, Job, Method, Plan, Quiet, Reconstruction};
use conefield_core::parallel;
use conefield_core::place::ViewRays;
use conefield_core::scan::{Scan, ScanHeader, Unit};
use conefield_core::{Error, Result};
use conefield_projectors::voxel::Joseph;
use conefield_solvers::iterative::Stop;
use conefield_solvers::iterative::order::Subsets;
use conefield_solvers::iterative::sart::Sart;
use ndarray::{Array3, ArrayView2, s};

/// Copies of a level's views during the search: two folds of every level, those of the corrected geometry, and the
/// predictions for changes of all parameters. And such copies of the pixels that pairs of views compare.
const SEARCHED: u64 = 10;
const PAIRED: u64 = 17;
/// One in this many views is held out.
const EVERY: usize = 4;
/// Subsets of the views and passes of the quick reconstruction.
const SUBSETS: usize = 8;
const PASSES: u64 = 3;
/// More views than this add little information on the geometry.
const MOST_VIEWS: usize = 120;
/// The volume grows if rays that miss it have more than this share of the views' sum of squares; the growth factor, and
/// the largest number of such steps.
const BESIDE: f64 = 0.01;
const GROWTH: f64 = 1.4;
const GROWN: usize = 3;
/// Share of the highest line integral; a larger value at a side of the detector is not air.
const AIR: f32 = 0.05;

/// A scan with larger pixels and voxels, and its folds of held-out views.
pub(crate) struct Level {
    /// The geometry of all views, before correction.
    pub geometry: Geometry,
    /// Pixels of the scan along the side of a pixel of the level.
    pub bin: usize,
    folds: Vec<Fold>,
    magnification: f64,
    /// The largest line integral of the held-out views.
    pub top: f64,
    /// Root mean square difference of adjacent columns in the held-out views.
    pub slope: f64,
    /// Whether the object reaches the first or last columns.
    pub cut: bool,
}

/// One split into training views and held-out views.
struct Fold {
    train: Scan,
    training: Vec<usize>,
    test: Scan,
    held_out: Vec<usize>,
}

/// The residuals of the held-out views.
pub(crate) struct Prediction {
    /// Measured minus predicted, a list for each view.
    pub views: Vec<Vec<f32>>,
    /// Their root mean square, divided by the largest line integral.
    pub error: f64,
}

impl Level {
    /// The level of `scan` with about `width` pixels along the longer side of the detector and `folds` folds. Each fold
    /// holds out another quarter of the views. The voxels cover the object in the geometry corrected by `known`.
    pub fn new(scan: &Scan, width: usize, folds: usize, known: &Correction) -> Result<Self> {
        let bin = bin(scan.geometry.detector, width);
        Self::of(spread(scan.binned(bin)), bin, width, folds, known)
    }

    /// The level of all views of `scan`, each of them held out once.
    pub fn whole(scan: &Scan, width: usize) -> Result<Self> {
        let bin = bin(scan.geometry.detector, width);
        Self::of(scan.binned(bin), bin, width, EVERY, &Correction::default())
    }

    fn of(binned: Scan, bin: usize, width: usize, folds: usize, known: &Correction) -> Result<Self> {
        let mut binned = Scan { unit: Unit::default(), ..binned };
        let given = binned.geometry.views.clone();
        binned.geometry.views = known.views(&given);
        let cut = cut(&binned, 2);
        let volume = grid(&binned, width, cut);
        let magnification = setup(&binned.geometry).magnification;
        let geometry = Geometry { views: given, volume, ..binned.geometry };
        binned.geometry = geometry.clone();
        let n = geometry.views.len();
        let every = EVERY.min(n / 2).max(2);
        let folds: Vec<Fold> = (0..folds.min(every))
            .map(|f| {
                let first = (1 + f * every / folds) % every;
                let (held_out, training): (Vec<usize>, Vec<usize>) = (0..n).partition(|v| v % every == first);
                let (train, test) = binned.split(&held_out)?;
                Ok(Fold { train, training, test, held_out })
            })
            .collect::<Result<_>>()?;
        let all = || folds.iter().map(|f| &f.test.projections);
        let top = all().flatten().copied().fold(0.0f32, f32::max);
        if top <= 0.0 {
            let expected = "line integrals of an object, positive where it absorbs";
            return Err(Error::invalid("scan", "projections", "no positive line integral", expected));
        }
        let slope = all().map(slope).sum::<f64>() / folds.len() as f64;
        Ok(Self { geometry, bin, folds, magnification, top: top.into(), slope, cut })
    }

    /// Approximate work of a prediction, to compare levels.
    pub fn work(&self) -> f64 {
        self.folds.iter().map(|f| f.train.header().samples()).sum()
    }

    /// Predicts the held-out views in the corrected geometry.
    pub fn predict(
        &self,
        correction: &Correction,
        backend: &dyn Backend,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Prediction> {
        let views = correction.views(&self.geometry.views);
        let folds = self.residuals(&views, self.following(correction), backend, cancelled)?;
        Ok(self.prediction(&folds))
    }

    /// The residuals of each fold's held-out views, measured minus predicted, with these views and voxels.
    pub fn residuals(
        &self,
        views: &[View],
        volume: VoxelGrid,
        backend: &dyn Backend,
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Array3<f32>>> {
        let of = |fold: &Fold| -> Result<Array3<f32>> {
            let among = |list: &[usize]| Geometry {
                views: list.iter().map(|&v| views[v]).collect(),
                detector: self.geometry.detector,
                volume,
            };
            let scan = Scan { geometry: among(&fold.training), ..fold.train.clone() };
            let volume = reconstruct(&scan, backend, cancelled)?;
            let place = backend.place();
            let all: Vec<usize> = (0..fold.held_out.len()).collect();
            let (volume, mut lines) = (place.adopt(volume)?, place.zeros(fold.test.projections.dim().into())?);
            let rays = ViewRays { projector: &Joseph {}, geometry: &among(&fold.held_out), views: &all };
            place.forward(rays, &volume, &mut lines)?;
            let mut residual = place.take(lines)?;
            residual.zip_mut_with(&fold.test.projections, |a, p| *a = p - *a);
            Ok(residual)
        };
        parallel::map(&self.folds, |_, fold| of(fold)).into_iter().collect()
    }

    /// The residuals of each held-out view, and their size.
    pub fn prediction(&self, folds: &[Array3<f32>]) -> Prediction {
        let views: Vec<Vec<f32>> =
            folds.iter().flat_map(|f| f.outer_iter()).map(|view| view.iter().copied().collect()).collect();
        let pixels: usize = views.iter().map(Vec::len).sum();
        let square: f64 = views.iter().flatten().map(|x| f64::from(*x).powi(2)).sum();
        Prediction { views, error: (square / pixels as f64).sqrt() / self.top }
    }

    /// The held-out views in the order of [`Level::residuals`]: their numbers and measured line integrals.
    pub fn held_out(&self) -> impl Iterator<Item = (usize, ArrayView2<'_, f32>)> {
        self.folds.iter().flat_map(|f| f.held_out.iter().copied().zip(f.test.projections.outer_iter()))
    }
}

/// The side of a level's pixels, in pixels of the scan.
pub(crate) fn bin([rows, columns]: [usize; 2], width: usize) -> usize {
    let (shorter, longer) = (rows.min(columns), rows.max(columns));
    // Some rows remain, unless there are hardly any.
    let most = if shorter < 8 { longer } else { shorter } / 4;
    longer.div_ceil(width).clamp(1, most.max(1))
}

impl Level {
    /// Voxels that follow the object: it moves along z when the detector moves along v. Its position on the voxels then
    /// stays the same; otherwise the error would oscillate with every voxel.
    fn following(&self, correction: &Correction) -> VoxelGrid {
        let mut grid = self.geometry.volume;
        let v = self.geometry.views[0].v;
        if self.magnification > 0.0 {
            grid.center[2] += correction.get(Parameter::OffsetV) * v[2] / norm(v) / self.magnification;
        }
        grid
    }
}

/// The quick reconstruction.
fn plan(backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    let subsets = Subsets::Count(SUBSETS);
    let sart = Sart { subsets, relaxation: 1.0, decay: 0.7, stop: Stop::after(PASSES), ..Sart::default() };
    sart.plan(&Context::new(backend))
}

/// Bytes that [`crate::calibration::calibrate`], [`crate::calibration::directions`] and, for `shifts`,
/// [`crate::calibration::jitter()`] take besides a scan of this size, with `settings`: those of the largest arrays, for voxels
/// as fine as the pixels.
pub fn bytes(scan: &ScanHeader, settings: &Settings, shifts: bool, backend: &dyn Backend) -> Result<u64> {
    let plan = plan(backend)?;
    let views = scan.views.min(MOST_VIEWS);
    let level = |views: usize, width: usize| {
        let header = ScanHeader { views, ..*scan }.binned(bin(scan.detector, width));
        let longest = header.detector.into_iter().max().unwrap_or(0) as f64;
        let shrink = longest / scan.volume.into_iter().max().unwrap_or(1).max(1) as f64;
        ScanHeader { volume: scan.volume.map(|n| (shrink * n as f64).ceil() as usize), ..header }
    };
    // Its training views, and what the solver takes.
    let solving = |whole: ScanHeader| {
        let train = ScanHeader { views: whole.views - whole.views / EVERY, ..whole };
        let needs = plan.needs(&train);
        4 * (train.pixels() + train.voxels()) + needs.backend + needs.working
    };
    let threads = rayon::current_num_threads() as u64;
    let (few, all) = (level(views, settings.width), level(scan.views, settings.width));
    let paired = settings.parameters.iter().any(|p| p.by_pairs());
    let pairs = if paired { PAIRED * 4 * level(views, FINER * settings.width).pixels() } else { 0 };
    // The whole views are kept for the rays that two of them share.
    let searching = 4 * (all.pixels() + SEARCHED * few.pixels()) + threads * solving(few) + pairs;
    // Each fold has all views, at every level; the finest ones are binned beside them, and predicted.
    let shifting =
        4 * (EVERY as u64 * all.pixels() * 4 / 3 + 2 * all.pixels()) + threads.min(EVERY as u64) * solving(all);
    Ok(if shifts { searching.max(shifting) } else { searching })
}

/// A quick reconstruction, in 1/mm.
fn reconstruct(scan: &Scan, backend: &dyn Backend, cancelled: &(dyn Fn() -> bool + Sync)) -> Result<Array3<f32>> {
    let solution = plan(backend)?.run(&Job::new(scan, backend), &mut Quiet(cancelled));
    let solution = solution.map_err(|e| match e {
        Error::Interrupted { .. } => Error::Aborted { part: "calibration".into() },
        e => e,
    })?;
    match solution.result {
        Reconstruction::Volume(volume) => Ok(volume.data),
        other => other.volume(backend).map(|v| v.data),
    }
}

/// The scan, reduced to at most [`MOST_VIEWS`] evenly spaced views.
pub(crate) fn spread(scan: Scan) -> Scan {
    let n = scan.geometry.views.len();
    if n <= MOST_VIEWS {
        return scan;
    }
    let kept: Vec<usize> = (0..MOST_VIEWS).map(|i| i * n / MOST_VIEWS).collect();
    scan.select(&kept)
}

/// Voxels as fine as the pixels, in the volume of the scan. If the object extends beyond the detector or the volume,
/// the box is larger than the volume.
fn grid(scan: &Scan, width: usize, wide: bool) -> VoxelGrid {
    let asked = scan.geometry.volume;
    let mut size = asked.size();
    if wide {
        size = [size[0] * GROWTH, size[1] * GROWTH, size[2]];
    }
    if cut(scan, 1) {
        size[2] *= GROWTH;
    }
    for _ in 0..GROWN {
        if beside(scan, &VoxelGrid { spacing: per(size, asked.shape), ..asked }) < BESIDE {
            break;
        }
        size = size.map(|s| s * GROWTH);
    }
    let voxel = setup(&scan.geometry).supported_voxel_mm.into_iter().fold(f64::INFINITY, f64::min);
    let longest = size.into_iter().fold(0.0, f64::max);
    let most = (1.5 * width as f64) as usize;
    let n = if voxel > 0.0 { ((longest / voxel).ceil() as usize).clamp(8, most.max(8)) } else { width };
    VoxelGrid { spacing: per(size, asked.shape), ..asked }.with_longest(n)
}

/// Whether the object reaches the first or last line of the views along `axis`: 1 for rows, 2 for columns.
fn cut(scan: &Scan, axis: usize) -> bool {
    let top = range(&scan.projections)[1].max(0.0);
    let last = scan.projections.len_of(ndarray::Axis(axis)) - 1;
    [0, last].into_iter().any(|i| {
        let line = scan.projections.index_axis(ndarray::Axis(axis), i);
        line.iter().filter(|x| **x > AIR * top).count() as f64 > 0.02 * line.len() as f64
    })
}

fn per(size: Vec3, shape: [usize; 3]) -> Vec3 {
    std::array::from_fn(|k| size[k] / shape[k] as f64)
}

/// Share of the views' sum of squares that belongs to rays that miss the box.
fn beside(scan: &Scan, grid: &VoxelGrid) -> f64 {
    let g = &scan.geometry;
    let bounds = grid.bounds();
    let some = g.views.len().div_ceil(16);
    let (mut out, mut all) = (0.0, 0.0);
    for ((view, row, column), p) in scan.projections.indexed_iter().filter(|((v, ..), _)| v % some == 0) {
        let square = f64::from(p.max(0.0)).powi(2);
        all += square;
        if square > 0.0 && g.ray(view, row, column).clip(bounds).is_none() {
            out += square;
        }
    }
    if all > 0.0 { out / all } else { 0.0 }
}

/// Root mean square difference of adjacent columns.
fn slope(p: &Array3<f32>) -> f64 {
    let columns = p.dim().2;
    if columns < 2 {
        return 0.0;
    }
    let (a, b) = (p.slice(s![.., .., 1..]), p.slice(s![.., .., ..columns - 1]));
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    (sum / a.len() as f64).sqrt()
}
