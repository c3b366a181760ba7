//! FDK: filtered back-projection of a cone-beam scan (Feldkamp, Davis and Kress, JOSA A 1(6), 1984).
//!
//! `μ(x) = Σ_i Δβ_i · (R/U_i)² · w_i · [cos-weighted p_i * ramp]`, with R the distance from source to axis, U_i the
//! depth of the voxel, Δβ_i the angular step of the view and w_i the weight of its rays ([`weights`]). Rows are
//! filtered with their pitch at the axis. No factor is fitted: the scale is right for any number of views and any
//! magnification.

mod axis;
pub mod filter;
pub mod weights;

use crate::iterative::drive::finite;
use crate::iterative::monitor::VolumeMonitor;
use crate::support::{Blocks, corners, meets_the_volume};
use crate::surround::{self, Corrected};
use axis::{Axis as OrbitAxis, upright};
use conefield_core::Error;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, Vec3, View, VoxelGrid, norm, sub};
use conefield_core::method::{
    Context, Findings, Job, Line, Method, Needs, Observer, Outline, Plan, Reconstruction, Record, Solution,
};
use conefield_core::parallel;
use conefield_core::place::{Array, CLIP, FilteredViews, Host, Place, RowWeights, zeros_with_spare};
use conefield_core::scan::{Scan, ScanHeader, Volume};
use conefield_core::scene::SurroundRule;
use conefield_core::simd::{Op, Simd, run};
use conefield_core::space::Space;
use conefield_core::voxel::VoxelView;
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::backproject::{TILE, backproject};
use conefield_projectors::voxel::layout::{ColumnMajor, Pinhole, column_major_bytes, views_within};
use filter::{Ramp, Window};
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, s};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;
use weights::{Disc, FdkOrbit, lean, place};

/// Settings of `fdk`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Fdk {
    /// Window of the ramp filter.
    pub window: Window,
    /// Cutoff of the window, as a share of the Nyquist frequency; nothing beyond it passes.
    pub cutoff: f64,
    /// Set negative attenuation to 0 at the end.
    pub nonnegative: bool,
    /// Attenuation beyond the volume.
    pub scene: FdkScene,
}

/// Scene settings of FDK.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FdkScene {
    /// Treatment of attenuation beyond the volume.
    #[serde(skip_serializing_if = "SurroundRule::is_none")]
    pub surround: SurroundRule,
}

impl Default for Fdk {
    fn default() -> Self {
        Self { window: Window::Ramp, cutoff: 1.0, nonnegative: false, scene: FdkScene::default() }
    }
}

conefield_core::stage_type!(Method, "fdk", Fdk, "filtered back-projection");

impl Method for Fdk {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        let c = self.cutoff;
        ensure(c > 0.0 && c <= 1.0, "spec", "cutoff", c, "a number above 0 and at most 1")?;
        self.scene.surround.validate()?;
        Ok(Box::new(self.clone()))
    }
}

impl Plan for Fdk {
    fn outline(&self) -> Outline {
        let what = format!("{:?} window to {} of the highest frequency", self.window, self.cutoff).to_lowercase();
        Outline { method: Line::new("method", "fdk", &what), ..Outline::default() }
    }

    fn starts_from_volume(&self) -> bool {
        false
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let start = Instant::now();
        job.scan.validate("scan")?;
        let corrected = Corrected::of(job, self.scene.surround, None, observer)?;
        let job = &Corrected::job(corrected.as_ref(), job);
        let axis = OrbitAxis::of(&job.scan.geometry);
        let upright = upright(&job.scan.geometry, axis.as_ref());
        let orbit = FdkOrbit::of(&upright);
        check(&orbit, &upright, job.scan.geometry.volume, axis.as_ref())?;
        // Otherwise the columns that the detector lacks beside the volume have no limit.
        meets_the_volume(&job.scan.geometry)?;
        axis.iter().for_each(|axis| observer.note(&axis.describe()));
        observer.note(&orbit.describe());
        if job.limits.steps.is_some() {
            observer.note("fdk is one step: a limit of steps does not change it");
        }
        doubts(job.scan, &orbit, &upright, axis.as_ref()).iter().for_each(|line| observer.warn(line));
        let (geometry, measured) = orbit.symmetric(&job.scan.geometry);
        let upright = &orbit.symmetric(&upright).0;
        let (scan, place) = (job.scan, job.backend.place());
        let run = Backprojection { settings: self, scan, orbit: &orbit, upright, geometry: &geometry, measured };
        let space = Space::new(scan.header(), place);
        let (mut volume, place) = run.all(&space, start, observer)?;
        if self.nonnegative {
            place.map(&CLIP, [0.0, f64::INFINITY], &mut volume, &[])?;
        }
        let monitor = VolumeMonitor::new(job);
        let mut train_s = start.elapsed().as_secs_f64();
        let held_out = monitor.held_out(place.as_ref(), &Joseph {}, &volume)?;
        let taken = Instant::now();
        let mut volume = place.take(volume)?;
        finite(&volume, 1)?;
        train_s += taken.elapsed().as_secs_f64();
        let mm = job.scan.unit.mm as f32;
        let psnr = monitor.psnr(volume.view(), mm);
        observer.record(&Record { step: 1, seconds: train_s, psnr, held_out, ..Record::default() });
        parallel::scale(&mut volume, mm);
        let volume = Volume { data: volume, grid: geometry.volume, affine: None };
        let result = Reconstruction::Volume(volume);
        Ok(Solution { result, steps: 1, train_s, samples: 0, sampling_s: 0.0, rollbacks: 0, best: None })
    }

    fn reads(&self, header: &ScanHeader, room: u64) -> Vec<String> {
        slabs(header.volume[0], planes_within(room, header.volume)).into_iter().collect()
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        let axis = OrbitAxis::of(&scan.geometry);
        let upright = upright(&scan.geometry, axis.as_ref());
        let orbit = FdkOrbit::of(&upright);
        let mut lines = surround::found(scan, self.scene.surround)?;
        match check(&orbit, &upright, scan.geometry.volume, axis.as_ref()) {
            Err(e) => lines.push(e.to_string()),
            Ok(()) => {
                lines.extend(axis.iter().map(OrbitAxis::describe));
                lines.push(orbit.describe());
                lines.extend(doubts(scan, &orbit, &upright, axis.as_ref()));
            }
        }
        Ok(Findings { lines, ..Findings::default() })
    }

    /// Without the columns added for an offset detector, which only the scan itself determines.
    fn needs(&self, header: &ScanHeader) -> Needs {
        let space = Space::tally(*header);
        let at_once = views_within::<f32>(header.detector, held(header));
        let _ = images(&space, header.detector, at_once);
        space.pass(column_major_bytes::<f32>(header.detector, at_once.min(header.views)));
        let [surround, corrected] = surround::bytes(self.scene.surround, header);
        Needs { surround, corrected, working: space.bytes(), volume: true, ..Needs::default() }
    }
}

/// Buffer for the filtered images of at most `views` views.
fn images(space: &Space, [rows, columns]: [usize; 2], views: usize) -> Result<Array> {
    space.array([views.min(space.header().views), rows, columns])
}

/// The filtered back-projection of one scan.
struct Backprojection<'a> {
    settings: &'a Fdk,
    scan: &'a Scan,
    orbit: &'a FdkOrbit,
    /// Like [`geometry`](Self::geometry), rotated so that the orbit's axis is z.
    upright: &'a Geometry,
    /// Includes the columns added for an offset detector.
    geometry: &'a Geometry,
    /// The measured columns.
    measured: Range<usize>,
}

impl Backprojection<'_> {
    /// Back-projects all views, in batches. A volume larger than the room of its place is computed in slabs, each from
    /// all views, and collected on the host. Reports progress since `start`. Returns the volume with its place.
    fn all(&self, space: &Space, start: Instant, observer: &mut dyn Observer) -> Result<(Array, Arc<dyn Place>)> {
        let (place, [nx, ny, nz]) = (space.place(), space.header().volume);
        let at_once = views_within::<f32>(self.geometry.detector, held(space.header()));
        let mut images = images(space, self.geometry.detector, at_once)?;
        let all: Vec<usize> = (0..self.geometry.views.len()).collect();
        let planes = planes(place.as_ref(), [nx, ny, nz])?;
        slabs(nx, planes).into_iter().for_each(|line| observer.note(&line));
        let mut volume = None;
        let (mut done, whole) = (0, nx.div_ceil(planes) * all.len());
        for first in (0..nx).step_by(planes) {
            let mut slab = space.array([planes.min(nx - first), ny, nz])?;
            for views in all.chunks(at_once) {
                let share = done as f64 / whole as f64;
                if place.agree(observer.cancelled()) {
                    return Err(Error::Interrupted { step: (share * all.len() as f64) as u64 });
                }
                self.load(space, views, &mut images)?;
                place.filtered(self, views, &mut images, &mut slab, first)?;
                done += views.len();
                let share = done as f64 / whole as f64;
                let spent = start.elapsed().as_secs_f64();
                observer.progress((share * all.len() as f64) as u64, share, spent * (1.0 - share) / share);
            }
            if planes >= nx {
                return Ok((slab, place.clone()));
            }
            let volume = volume.get_or_insert_with(|| Array3::zeros([nx, ny, nz]));
            place.store(&slab, 0, volume.slice_mut(s![first..first + slab.shape()[0], .., ..]))?;
        }
        Ok((Array::host(volume.unwrap_or_default()), Arc::new(Host)))
    }

    /// Overwrites the first of `images` with the measured images of the consecutive views `views`.
    fn load(&self, space: &Space, views: &[usize], images: &mut Array) -> Result<()> {
        let measured = self.scan.projections.slice_axis(Axis(0), (views[0]..views[0] + views.len()).into());
        let [rows, columns] = self.geometry.detector;
        if self.measured == (0..columns) {
            return space.place().load(measured, images, 0);
        }
        let mut wide = Array3::zeros((1, rows, columns));
        for (i, image) in measured.outer_iter().enumerate() {
            wide.slice_mut(s![0, .., self.measured.clone()]).assign(&image);
            space.place().load(wide.view(), images, i)?;
        }
        Ok(())
    }

    /// Length of a row's pixel at the axis, mm.
    fn pitch(&self, view: usize) -> f64 {
        let v = &self.upright.views[view];
        norm(v.u) * self.orbit.radius[view] / v.normal().1
    }

    /// The weight of each column.
    fn counts(&self, view: usize) -> impl Iterator<Item = f64> {
        let (g, radius) = (self.upright, self.orbit.radius[view]);
        let count =
            move |c| self.orbit.weight(view, place(g, view, c as f64, radius)) * lean(g, view, c as f64, radius);
        (0..g.detector[1]).map(count)
    }

    /// The factor of a view in mm².
    fn scale(&self, view: usize) -> f64 {
        self.orbit.steps[view] * self.orbit.radius[view].powi(2)
    }
}

/// Multiplies pixels by the weight of their column and the cosine between their ray and the detector's normal.
struct Weighting<'a> {
    view: &'a View,
    normal: Vec3,
    detector: [usize; 2],
    /// The row of the detector that `strip` begins with.
    first: usize,
    /// The weight of each column.
    counts: &'a [f64],
    strip: &'a mut [f32],
}

impl Op for Weighting<'_> {
    type Number = f32;
    type Out = ();
    const WIDE: bool = false;

    #[inline(always)]
    fn call<S: Simd>(self, _: S) {
        let ([a, b, c], [sx, sy, sz], [ux, uy, uz]) = (self.normal, self.view.source, self.view.u);
        let middle = (self.detector[1] as f64 - 1.0) / 2.0;
        for (r, line) in self.strip.chunks_mut(self.counts.len()).enumerate() {
            let [x, y, z] = self.view.pixel(self.detector, (self.first + r) as f64, middle);
            for (column, (value, count)) in line.iter_mut().zip(self.counts).enumerate() {
                let du = f64::from(column as i32) - middle;
                let (dx, dy, dz) = (x + du * ux - sx, y + du * uy - sy, z + du * uz - sz);
                let weighted = count * (a * dx + b * dy + c * dz) / (dx * dx + dy * dy + dz * dz).sqrt();
                *value *= weighted as f32;
            }
        }
    }
}

impl FilteredViews for Backprojection<'_> {
    fn filter(&self, view: usize, pixels: &mut [f32]) {
        let (g, v) = (self.upright, &self.upright.views[view]);
        let columns = g.detector[1];
        let (normal, _) = v.normal();
        let ramp = Ramp::new(columns, self.pitch(view), self.settings.window, self.settings.cutoff);
        let counts: Vec<f64> = self.counts(view).collect();
        parallel::over(pixels.chunks_mut(16 * columns), |n, strip| {
            run(Weighting { view: v, normal, detector: g.detector, first: 16 * n, counts: &counts, strip });
            ramp.filter(strip, columns);
        });
    }

    fn backproject(&self, views: &[usize], images: ArrayView3<'_, f32>, slab: ArrayViewMut3<'_, f32>, first: usize) {
        let scales: Vec<f64> = views.iter().map(|&v| self.scale(v)).collect();
        let pixels = ColumnMajor::new(self.geometry, views, images);
        backproject(self.geometry, views, &pixels, &scales, slab, first);
    }

    fn weights(&self, view: usize) -> RowWeights {
        let (g, v) = (self.upright, &self.upright.views[view]);
        // The ramp of a row is inversely proportional to its pitch.
        let pitch = self.pitch(view);
        RowWeights {
            columns: self.counts(view).map(|count| (count / pitch) as f32).collect(),
            corner: sub(v.pixel(g.detector, 0.0, 0.0), v.source),
            u: v.u,
            v: v.v,
            normal: v.normal().0,
        }
    }

    fn taps(&self) -> Vec<f32> {
        let columns = self.upright.detector[1];
        Ramp::new(columns, 1.0, self.settings.window, self.settings.cutoff).taps(columns)
    }

    fn seen(&self, view: usize) -> VoxelView {
        Pinhole::of(self.geometry, view).voxels(&self.geometry.volume, self.scale(view))
    }
}

/// Warnings about what FDK gets wrong in this scan.
fn doubts(scan: &Scan, orbit: &FdkOrbit, upright: &Geometry, axis: Option<&OrbitAxis>) -> Vec<String> {
    let mut lines = vec![];
    let missing = if orbit.twice() { 0.0 } else { object(scan, orbit, upright).map_or(0.0, |d| orbit.missing(d)) };
    if missing > MISSING {
        lines.push(format!(
            "no view measures {:.1} % of the rays through the object: expect streaks and wrong values; an iterative method \
             suits this scan better",
            100.0 * missing
        ));
    }
    let [_, farthest] = cone(orbit, scan.geometry.volume, axis);
    if farthest > CONE {
        lines.push(format!(
            "the volume extends to {:.0} degrees from the plane of the sources: beyond {:.0} degrees fdk loses attenuation; an \
             iterative method does not",
            farthest.to_degrees(),
            CONE.to_degrees()
        ));
    }
    lines
}

/// The disc in which the object lies, from its shadows in evenly spaced views. `None` if no view shows an object.
fn object(scan: &Scan, orbit: &FdkOrbit, upright: &Geometry) -> Option<Disc> {
    let every = scan.geometry.views.len().div_ceil(SHADOWS);
    let columns = scan.geometry.detector[1] as f64;
    let shadows = Blocks::of(scan, every).columns().into_iter().map(|(view, [first, last])| {
        let places = [first as f64 - 0.5, (last as f64 - 0.5).min(columns - 0.5)];
        (view, places.map(|c| place(upright, view, c, orbit.radius[view])))
    });
    orbit.disc(&shadows.collect::<Vec<_>>())
}

/// Angles between the plane of the sources and the nearest and the farthest part of the volume, seen from the far side
/// of the circle through the axis, rad.
fn cone(orbit: &FdkOrbit, volume: VoxelGrid, axis: Option<&OrbitAxis>) -> [f64; 2] {
    let heights = corners(&volume).map(|corner| orbit.height(axis.map_or(corner, |a| a.point(corner))));
    let [low, high] = heights.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], z| [l.min(z), h.max(z)]);
    let radius = orbit.radius.iter().sum::<f64>() / orbit.radius.len() as f64;
    let nearest = if low < 0.0 && high > 0.0 { 0.0 } else { low.abs().min(high.abs()) };
    [nearest, low.abs().max(high.abs())].map(|z| (z / radius).atan())
}

/// Bytes of views to hold at once: 1/16 of scan and volume, within 1 and 256 MiB. The whole volume passes through memory,
/// and from and to a device, once for all views held.
fn held(header: &ScanHeader) -> u64 {
    (header.pixels().saturating_add(header.voxels()) / 4).clamp(1 << 20, 256 << 20)
}

/// Planes along x of the largest slab within `room` bytes: whole tiles of the back-projection, at least one.
fn planes_within(room: u64, [nx, ny, nz]: [usize; 3]) -> usize {
    let plane = (4 * ny * nz).max(1) as u64;
    let planes = (room / plane).min(nx as u64) as usize;
    if planes < nx { (planes / TILE * TILE).max(TILE) } else { planes }
}

/// Text for people, if there are several slabs.
fn slabs(nx: usize, planes: usize) -> Option<String> {
    let count = nx.div_ceil(planes.max(1));
    (count > 1).then(|| format!("{count} slabs of at most {planes} planes along x: the views are read {count} times"))
}

/// Planes along x of the largest slab that `place` has room for.
fn planes(place: &dyn Place, [nx, ny, nz]: [usize; 3]) -> Result<usize> {
    let mut planes = planes_within(place.room(), [nx, ny, nz]);
    // A device does not say how much memory it has.
    let fits = |planes| match place.device() {
        None => place.zeros([planes, ny, nz]),
        Some(_) => zeros_with_spare(place, [planes, ny, nz]),
    };
    while let Err(e) = fits(planes) {
        if planes <= TILE {
            return Err(e);
        }
        planes = (planes / 2).next_multiple_of(TILE);
    }
    Ok(planes)
}

/// Largest spread of the sources along z and slope of the detector rows, as a share of the circle's radius. Calibrated
/// circles deviate less; a helix or a detector on its side deviates more.
const TILT: f64 = 0.05;

/// Largest angle, rad, between the plane of the sources and a part of the volume. The loss of attenuation grows with the
/// square of the angle: 0.7 % of a ball at 7 degrees, 22 % of an object at 30 degrees.
const CONE: f64 = 0.175;
/// Largest slope of the detector's normal against the plane of the sources.
const INCLINED: f64 = 0.1;
/// Largest share of the rays through the object that no view measures, about what sampling the disc resolves.
const MISSING: f64 = 0.002;
/// Views in which the object's shadow is sought.
const SHADOWS: usize = 120;

/// Refuses orbits other than a circle about z, detectors that do not stand along z, and volumes far from the plane of
/// the sources. `geometry` is upright; `volume` and `axis` are as scanned.
fn check(orbit: &FdkOrbit, geometry: &Geometry, volume: VoxelGrid, axis: Option<&OrbitAxis>) -> Result<()> {
    let span = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), r| (l.min(r), h.max(r)))
    };
    let circle = "a circular orbit around z for fdk; iterative methods accept any orbit";
    let (low, high) = span(&mut orbit.radius.iter().copied());
    let found = format!("sources {low:.1} to {high:.1} mm from the axis z");
    ensure(low > 0.0 && high < 1.2 * low, "scan", "views", found, circle)?;
    let (bottom, top) = span(&mut geometry.views.iter().map(|v| v.source[2]));
    let found = format!("sources from {bottom:.1} to {top:.1} mm along z");
    ensure(top - bottom <= TILT * low, "scan", "views", found, circle)?;
    let steep = geometry.views.iter().position(|v| v.u[2].abs() > TILT * norm(v.u));
    let found = steep.map_or(String::new(), |v| format!("a detector whose rows rise along z in view {v}"));
    ensure(steep.is_none(), "scan", "views", found, "rows across z for fdk; iterative methods accept any orbit")?;
    let slope = |v: &View| v.normal().0[2].abs();
    let most = geometry.views.iter().map(slope).fold(0.0, f64::max);
    let found = format!("a detector inclined by {:.0} degrees", most.asin().to_degrees());
    let stands = "a detector along z for fdk, to within 6 degrees; iterative methods accept any";
    ensure(most <= INCLINED, "scan", "views", found, stands)?;
    let [nearest, _] = cone(orbit, volume, axis);
    let found = format!("a volume at least {:.0} degrees from the plane of the sources", nearest.to_degrees());
    let near = format!("at most {:.0} degrees for fdk; iterative methods accept any", CONE.to_degrees());
    ensure(nearest <= CONE, "scan", "volume", found, &near)
}
