//! Attenuation beyond the volume: if a body is wider than the detector or longer than the volume, rays are also
//! attenuated outside the reconstructed volume, which causes a bright rim inside.
//!
//! A total-variation reconstruction on coarse cells, over the volume and a margin, first estimates the attenuation
//! outside. Its line integrals are subtracted from the measured ones, and every method then reconstructs as if the body
//! ended at the volume's sides (the idea of region-of-interest reconstruction by subtraction: Ziegler, Nielsen and
//! Grass, Med. Phys. 35(4), 2008). Outside the volume nothing finer than these cells is modelled, and only once.

use crate::iterative::Stop;
use crate::iterative::fista::Fista;
use crate::iterative::regularizers::TotalVariation;
use crate::solid::Solid;
use crate::support::Blocks;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, View, VoxelGrid, norm, sub};
use conefield_core::method::{Job, Observer, Quiet};
use conefield_core::outside::Outside;
use conefield_core::place::ViewRays;
use conefield_core::scan::{Scan, ScanHeader, Unit};
use conefield_core::scene::{CoarseSurround, SurroundRule};
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Axis, s};

/// Most cells.
const MOST: usize = 1 << 24;
/// Views projected together.
const TOGETHER: usize = 8;
/// Component of a detector axis along a world axis, as a share of its length, from which the body is extended along
/// that axis.
const ALONG: f64 = 0.1;

/// A job's scan and held-out views as its method uses them: without attenuation beyond the volume, or corrected for the
/// beam hardening of a solid.
pub(crate) struct Corrected {
    scan: Scan,
    held_out: Option<Scan>,
}

impl Corrected {
    /// Corrects the views for a solid, or estimates attenuation beyond the volume if the spec asks for it; `None` if
    /// there is nothing to correct.
    pub(crate) fn of(
        job: &Job<'_>,
        rule: SurroundRule,
        solid: Option<&Solid>,
        observer: &mut dyn Observer,
    ) -> Result<Option<Self>> {
        if let Some(solid) = solid {
            let linear = |scan: &Scan| solid.linearize(scan);
            return Ok(Some(Self { scan: linear(job.scan), held_out: job.held_out.map(linear) }));
        }
        let SurroundRule::Coarse(settings) = rule else { return Ok(None) };
        let (around, said) = Around::of(job.scan, settings)?;
        observer.note(&format!("surround: {said}"));
        let Some(around) = around else { return Ok(None) };
        let outside = around.find(job, settings.passes, observer)?;
        let less = |scan: &Scan| around.less(job, &outside, scan);
        let scan = less(job.scan)?;
        let sum = |scan: &Scan| scan.projections.iter().map(|p| f64::from(*p)).sum::<f64>();
        let share = 1.0 - sum(&scan) / sum(job.scan);
        observer.note(&format!("surround: {:.0}% of the measured attenuation lies beyond the volume", 100.0 * share));
        let held_out = job.held_out.map(less).transpose()?;
        Ok(Some(Self { scan, held_out }))
    }

    /// The job with the corrected views.
    pub(crate) fn job<'a>(corrected: Option<&'a Self>, job: &Job<'a>) -> Job<'a> {
        match corrected {
            Some(Self { scan, held_out }) => Job { scan, held_out: held_out.as_ref(), ..*job },
            None => *job,
        }
    }
}

/// The scan of `job` without attenuation beyond the volume, as its method sees it; `None` if the spec does not ask for
/// it or there is none to estimate.
pub fn subtracted(job: &Job<'_>, rule: SurroundRule, observer: &mut dyn Observer) -> Result<Option<Scan>> {
    Ok(Corrected::of(job, rule, None, observer)?.map(|corrected| corrected.scan))
}

/// Log lines about attenuation beyond the volume of this scan; none if the rule does not ask for it.
pub fn found(scan: &Scan, rule: SurroundRule) -> Result<Vec<String>> {
    let SurroundRule::Coarse(settings) = rule else { return Ok(vec![]) };
    Ok(vec![format!("surround: {}", Around::of(scan, settings)?.1)])
}

/// Upper bounds in bytes: for estimating attenuation beyond the volume, and for the corrected scan until the volume is
/// complete. Excludes the coarse pixels, whose number only the scan itself determines.
pub fn bytes(rule: SurroundRule, header: &ScanHeader) -> [u64; 2] {
    let SurroundRule::Coarse(settings) = rule else { return [0; 2] };
    let side = (settings.cells as f64 * (1.0 + 2.0 * settings.margin)) as usize + 2;
    let side = side.min((MOST as f64).cbrt() as usize);
    let cells = ScanHeader { views: 0, detector: [0; 2], volume: [side; 3] };
    let finding = method(settings.passes).bytes(&cells);
    [4 * cells.voxels() + finding, 4 * header.pixels()]
}

/// The method that reconstructs the cells.
fn method(passes: u64) -> Fista {
    let stop = Stop { passes: Some(passes), ..Stop::default() };
    Fista { stop, prior: Box::new(TotalVariation::default()), ..Fista::default() }
}

/// Coarse cells over the volume and its margin.
struct Around {
    cells: VoxelGrid,
    /// Number of margin cells along each axis.
    margin: [usize; 3],
}

impl Around {
    /// The cells for a scan whose object reaches the borders of views, and a log line.
    fn of(scan: &Scan, settings: CoarseSurround) -> Result<(Option<Self>, String)> {
        let (g, blocks) = (&scan.geometry, Blocks::of(scan, 1));
        let n = g.views.len();
        // A detector of one row says nothing about what is above and below.
        let tall = g.detector[0] > 1;
        let cut: Vec<[bool; 2]> = (0..n).map(|v| [tall && blocks.cut(v, 0), blocks.cut(v, 1)]).collect();
        let some = cut.iter().filter(|c| c.contains(&true)).count();
        let outside = Outside::of(scan, blocks.object());
        if some == 0 && !outside.is_seen() {
            let said = "nothing, as the object reaches the sides of no view and lies within the volume";
            return Ok((None, said.into()));
        }
        let mut along = if outside.is_seen() { outside.along } else { [false; 3] };
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
                let said = format!("none, as sources or detectors of {n} views are at the volume's sides");
                return Ok((None, said));
            }
        };
        let [x, y, z] = cells.shape;
        let (few, found) = (cells.len().is_some_and(|n| n <= MOST), format!("{x} x {y} x {z} cells in all"));
        ensure(few, "spec", "scene.surround.coarse", found, format!("at most {MOST}"))?;
        let mm = cells.spacing.into_iter().fold(0.0, f64::max);
        let beside = if outside.is_seen() { ", as rays beside it are attenuated too" } else { "" };
        let said = format!(
            "the object reaches the sides of {some} of {n} views: {x} x {y} x {z} cells of {mm:.3} mm in and around the volume\
             {beside}"
        );
        Ok((Some(Self { cells, margin }), said))
    }

    /// Reconstructs the cells beyond the volume, in 1/mm.
    fn find(&self, job: &Job<'_>, passes: u64, observer: &mut dyn Observer) -> Result<Array3<f32>> {
        let scan = coarse(job.scan, self.cells);
        let alone = Job { seed: job.seed, ..Job::new(&scan, job.backend) };
        let mut data =
            method(passes).solve(&alone, &mut Quiet(&|| observer.cancelled()))?.result.volume(job.backend)?.data;
        let [x, y, z]: [_; 3] = std::array::from_fn(|k| self.margin[k]..self.cells.shape[k] - self.margin[k]);
        data.slice_mut(s![x, y, z]).fill(0.0);
        Ok(data)
    }

    /// `scan` less the line integrals through `cells`.
    fn less(&self, job: &Job<'_>, cells: &Array3<f32>, scan: &Scan) -> Result<Scan> {
        let (place, mut scan) = (job.backend.place(), scan.clone());
        let whole = Geometry { volume: self.cells, ..scan.geometry.clone() };
        let cells = place.adopt(cells.clone())?;
        let ([rows, columns], views) = (whole.detector, (0..whole.views.len()).collect::<Vec<_>>());
        let mut lines = place.zeros([TOGETHER.min(views.len()), rows, columns])?;
        for some in views.chunks(TOGETHER) {
            let rays = ViewRays { projector: &Joseph {}, geometry: &whole, views: some };
            place.forward(rays, &cells, &mut lines)?;
            for (&view, image) in some.iter().zip(place.read(&lines)?.outer_iter()) {
                scan.projections.index_axis_mut(Axis(0), view).zip_mut_with(&image, |p, a| *p -= a);
            }
        }
        Ok(scan)
    }
}

/// Cells that fill the volume exactly, plus a margin along the axes `along` of `margin` times the volume's longest
/// side; and the number of margin cells.
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

/// Whether every source and every detector centre is outside the cells.
fn apart(g: &Geometry, cells: &VoxelGrid) -> bool {
    let [low, high] = cells.bounds();
    let outside = |p: &[f64; 3]| (0..3).any(|k| p[k] <= low[k] || p[k] >= high[k]);
    g.views.iter().all(|v| outside(&v.source) && outside(&v.detector))
}

/// The scan binned to about a cell's size at the volume's centre, with the cells as its volume.
fn coarse(scan: &Scan, cells: VoxelGrid) -> Scan {
    let g = &scan.geometry;
    let [rows, columns] = g.detector;
    let side = cells.spacing.into_iter().fold(f64::INFINITY, f64::min);
    let seen = |w: &View| {
        let to_axis = norm(sub(cells.center, w.source));
        norm(w.u).max(norm(w.v)) * to_axis / w.normal().1
    };
    let pixel = g.views.iter().map(seen).fold(0.0, f64::max);
    let size = ((side / pixel) as usize).clamp(1, rows.min(columns));
    let mut coarse = scan.binned(size);
    coarse.geometry.volume = cells;
    // The result is in 1/mm.
    coarse.unit = Unit::default();
    coarse
}
