//! What lies beyond the volume: where a body is wider than the detector or longer than the volume, rays absorb outside of what
//! is reconstructed, and that ends up as a bright rim inside.
//!
//! Total variation on coarse cells, over the volume and a margin around it, first finds about what there is outside. Its line
//! integrals are taken off the measured ones, and every method works on the rest as if the body ended at the volume's sides
//! (the idea of region-of-interest reconstruction by subtraction: Ziegler, Nielsen and Grass, Med. Phys. 35(4), 2008). Outside
//! the volume nothing finer than these cells is modelled, once.

use crate::iterative::Stop;
use crate::iterative::fista::Fista;
use crate::iterative::regularizers::TotalVariation;
use crate::support::Blocks;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::{Geometry, View, VoxelGrid, norm};
use conefield_core::method::{Job, Observer, Record};
use conefield_core::scan::{Scan, ScanHeader, Unit};
use conefield_core::scene::{CoarseSurround, SurroundRule};
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Axis, Zip, s};

/// Cells at most.
const MOST: usize = 1 << 24;
/// Views that are projected together.
const TOGETHER: usize = 8;
/// Share of an axis of the detector's pixels along a world axis from which the body is looked for along it.
const ALONG: f64 = 0.1;

/// A job's scan, and its views kept aside, without what lies beyond the volume.
pub(crate) struct Within {
    scan: Scan,
    held_out: Option<Scan>,
}

impl Within {
    /// Looks beyond the volume where the spec asks for it; `None` where there is nothing to look for.
    pub(crate) fn of(job: &Job<'_>, rule: SurroundRule, observer: &mut dyn Observer) -> Result<Option<Self>> {
        let SurroundRule::Coarse(settings) = rule else { return Ok(None) };
        let (around, said) = Around::of(job.scan, settings)?;
        observer.note(&format!("surround: {said}"));
        let Some(around) = around else { return Ok(None) };
        let outside = around.find(job, settings.passes, observer)?;
        let less = |scan: &Scan| -> Result<Scan> {
            let mut scan = scan.clone();
            around.project(job, &outside, &scan.geometry.clone(), |view, lines| {
                scan.projections.index_axis_mut(Axis(0), view).zip_mut_with(&lines, |p, a| *p -= a);
            })?;
            Ok(scan)
        };
        let scan = less(job.scan)?;
        let sum = |scan: &Scan| scan.projections.iter().map(|p| f64::from(*p)).sum::<f64>();
        let share = 1.0 - sum(&scan) / sum(job.scan);
        observer.note(&format!("surround: {:.0}% of what is measured lies beyond the volume", 100.0 * share));
        let held_out = job.held_out.map(less).transpose()?;
        Ok(Some(Self { scan, held_out }))
    }

    /// The job without it.
    pub(crate) fn job<'a>(within: Option<&'a Self>, job: &Job<'a>) -> Job<'a> {
        match within {
            Some(Self { scan, held_out }) => Job { scan, held_out: held_out.as_ref(), ..*job },
            None => *job,
        }
    }
}

/// The scan of `job` without what lies beyond the volume, as its method sees it; `None` where the spec does not ask for it or
/// nothing is there to look for.
pub fn subtracted(job: &Job<'_>, rule: SurroundRule, observer: &mut dyn Observer) -> Result<Option<Scan>> {
    Ok(Within::of(job, rule, observer)?.map(|within| within.scan))
}

/// What lies beyond the volume of this scan, in words; nothing where the rule asks for nothing.
pub fn found(scan: &Scan, rule: SurroundRule) -> Result<Vec<String>> {
    let SurroundRule::Coarse(settings) = rule else { return Ok(vec![]) };
    Ok(vec![format!("surround: {}", Around::of(scan, settings)?.1)])
}

/// Bytes that looking beyond the volume takes at most; and that what it leaves of a scan of these sizes takes, until the
/// volume is made. The coarse pixels are not counted: how many there are only the scan itself tells.
pub fn bytes(rule: SurroundRule, header: &ScanHeader) -> [u64; 2] {
    let SurroundRule::Coarse(settings) = rule else { return [0; 2] };
    let side = (settings.cells as f64 * (1.0 + 2.0 * settings.margin)) as usize + 2;
    let side = side.min((MOST as f64).cbrt() as usize);
    let cells = ScanHeader { views: 0, detector: [0; 2], volume: [side; 3] };
    let finding = method(settings.passes).bytes(&cells);
    [4 * cells.voxels() + finding, 4 * header.pixels()]
}

/// What finds the cells.
fn method(passes: u64) -> Fista {
    let stop = Stop { passes: Some(passes), ..Stop::default() };
    Fista { stop, prior: Box::new(TotalVariation::default()), ..Fista::default() }
}

/// Coarse cells over the volume and around it.
struct Around {
    cells: VoxelGrid,
    /// How many of them the volume's sides are away from the grid's.
    margin: [usize; 3],
}

impl Around {
    /// Of a scan whose object reaches the sides of views, and what was found in words.
    fn of(scan: &Scan, settings: CoarseSurround) -> Result<(Option<Self>, String)> {
        let (g, blocks) = (&scan.geometry, Blocks::of(scan));
        let n = g.views.len();
        let cut: Vec<[bool; 2]> = (0..n).map(|v| [blocks.cut(v, 0), blocks.cut(v, 1)]).collect();
        let some = cut.iter().filter(|c| c.contains(&true)).count();
        if some == 0 {
            return Ok((None, "nothing, as the object reaches the sides of no view".into()));
        }
        let mut along = [false; 3];
        for (view, [rows, columns]) in g.views.iter().zip(cut) {
            for (axis, reached) in [(view.v, rows), (view.u, columns)] {
                (0..3).for_each(|k| along[k] |= reached && axis[k].abs() > ALONG * norm(axis));
            }
        }
        let mut margin = settings.margin;
        let (cells, margin) = loop {
            let (cells, beyond) = grid(&g.volume, settings, along, margin);
            if apart(g, &cells) {
                break (cells, beyond);
            }
            margin *= 0.75;
            if beyond.iter().all(|n| *n <= 1) {
                let said = format!("not looked for, as sources or detectors of {n} views stand at the volume's sides");
                return Ok((None, said));
            }
        };
        let [x, y, z] = cells.shape;
        if cells.len().is_none_or(|n| n > MOST) {
            let (found, expected) = (format!("{x} x {y} x {z} cells in all"), format!("at most {MOST}"));
            return Err(Error::invalid("spec", "scene.surround.coarse", found, expected));
        }
        let mm = cells.spacing.into_iter().fold(0.0, f64::max);
        let said = format!(
            "the object reaches the sides of {some} of {n} views: {x} x {y} x {z} cells of {mm:.3} mm in and around the volume"
        );
        Ok((Some(Self { cells, margin }), said))
    }

    /// What is in the cells beyond the volume, in 1/mm.
    fn find(&self, job: &Job<'_>, passes: u64, observer: &mut dyn Observer) -> Result<Array3<f32>> {
        let scan = coarse(job.scan, self.cells);
        let alone = Job { seed: job.seed, ..Job::new(&scan, job.backend) };
        let mut data = method(passes).solve(&alone, &mut Quiet(observer))?.result.volume(job.backend)?.data;
        let [x, y, z]: [_; 3] = std::array::from_fn(|k| self.margin[k]..self.cells.shape[k] - self.margin[k]);
        data.slice_mut(s![x, y, z]).fill(0.0);
        Ok(data)
    }

    /// Hands `take` the line integrals through the cells for each view of `geometry`.
    fn project(
        &self,
        job: &Job<'_>,
        cells: &Array3<f32>,
        geometry: &Geometry,
        mut take: impl FnMut(usize, ndarray::ArrayView2<'_, f32>),
    ) -> Result<()> {
        let projector = job.backend.place(Box::new(Joseph {}))?;
        let (operator, [rows, columns]) = (projector.operator(), geometry.detector);
        let whole = Geometry { volume: self.cells, ..geometry.clone() };
        let views: Vec<usize> = (0..geometry.views.len()).collect();
        for some in views.chunks(TOGETHER) {
            let mut lines = Array3::zeros((some.len(), rows, columns));
            operator.forward(&whole, some, cells.view(), lines.view_mut());
            operator.fault()?;
            Zip::indexed(lines.outer_iter()).for_each(|i, image| take(some[i], image));
        }
        Ok(())
    }
}

/// Cells that fill the volume exactly, and as many more of them along the axes `along` as `margin` of its longest side has
/// room for; how many more.
fn grid(volume: &VoxelGrid, settings: CoarseSurround, along: [bool; 3], margin: f64) -> (VoxelGrid, [usize; 3]) {
    let size = volume.size();
    let longest = size.into_iter().fold(0.0, f64::max);
    let inside: [usize; 3] =
        std::array::from_fn(|k| ((size[k] / longest * settings.cells as f64).round() as usize).max(1));
    let spacing: [f64; 3] = std::array::from_fn(|k| size[k] / inside[k] as f64);
    let beyond: [usize; 3] =
        std::array::from_fn(|k| if along[k] { (margin * longest / spacing[k]).ceil() as usize } else { 0 });
    let shape = std::array::from_fn(|k| inside[k] + 2 * beyond[k]);
    (VoxelGrid { shape, spacing, center: volume.center }, beyond)
}

/// Whether every source and every detector's middle stands outside the cells.
fn apart(g: &Geometry, cells: &VoxelGrid) -> bool {
    let [low, high] = cells.bounds();
    let outside = |p: &[f64; 3]| (0..3).any(|k| p[k] <= low[k] || p[k] >= high[k]);
    g.views.iter().all(|v| outside(&v.source) && outside(&v.detector))
}

/// The scan with pixels of about a cell's size at the volume's centre, and the cells as its volume.
fn coarse(scan: &Scan, cells: VoxelGrid) -> Scan {
    let g = &scan.geometry;
    let [rows, columns] = g.detector;
    let side = cells.spacing.into_iter().fold(f64::INFINITY, f64::min);
    let seen = |w: &View| {
        let to_axis = norm(std::array::from_fn(|k| cells.center[k] - w.source[k]));
        norm(w.u).max(norm(w.v)) * to_axis / w.normal().1
    };
    let pixel = g.views.iter().map(seen).fold(0.0, f64::max);
    let size = ((side / pixel) as usize).clamp(1, rows.min(columns));
    let mut coarse = scan.binned(size);
    coarse.geometry.volume = cells;
    // What comes of it is in 1/mm.
    coarse.unit = Unit::default();
    coarse
}

/// Says nothing of the work before the work, but can be stopped.
pub(crate) struct Quiet<'a>(pub(crate) &'a dyn Observer);

impl Observer for Quiet<'_> {
    fn progress(&mut self, _: u64, _: f64, _: f64) {}

    fn record(&mut self, _: &Record) {}

    fn note(&mut self, _: &str) {}

    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}
