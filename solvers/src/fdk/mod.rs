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
use crate::support::Blocks;
use crate::surround::{self, Within};
use axis::{Axis as OrbitAxis, upright};
use conefield_core::Error;
use conefield_core::backend::Backend;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, Vec3, View, VoxelGrid, dot, norm, sub};
use conefield_core::method::{
    Context, Findings, Job, Line, Method, Needs, Observer, Outline, Plan, Reconstruction, Record, Solution,
};
use conefield_core::scan::{Scan, ScanHeader, Volume};
use conefield_core::scene::SurroundRule;
use conefield_core::space::Space;
use conefield_core::voxel::VoxelView;
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::backproject::backproject;
use conefield_projectors::voxel::layout::{ColumnMajor, Pinhole, column_major_bytes};
use filter::{Ramp, Window};
use ndarray::{Array3, ArrayViewMut3, Axis, s};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;
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

#[typetag::serde(name = "fdk")]
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
        let within = Within::of(job, self.scene.surround, observer)?;
        let job = &Within::job(within.as_ref(), job);
        let axis = OrbitAxis::of(&job.scan.geometry);
        let upright = upright(&job.scan.geometry, axis.as_ref());
        let orbit = FdkOrbit::of(&upright);
        check(&orbit, &upright, job.scan.geometry.volume, axis.as_ref())?;
        axis.iter().for_each(|axis| observer.note(&axis.describe()));
        observer.note(&orbit.describe());
        doubts(job.scan, &orbit, &upright, axis.as_ref()).iter().for_each(|line| observer.warn(line));
        let (geometry, measured) = orbit.symmetric(&job.scan.geometry);
        let upright = &orbit.symmetric(&upright).0;
        let (scan, backend) = (job.scan, job.backend);
        let run =
            Backprojection { settings: self, scan, backend, orbit: &orbit, upright, geometry: &geometry, measured };
        let mut volume = run.all(start, observer)?;
        let floor = if self.nonnegative { 0.0 } else { f32::NEG_INFINITY };
        // A comparison, not a maximum, which would turn NaN into the floor.
        volume.par_mapv_inplace(|x| if x < floor { floor } else { x });
        finite(&volume, 1)?;
        let train_s = start.elapsed().as_secs_f64();
        let mm = job.scan.unit.mm as f32;
        let monitor = VolumeMonitor::new(job);
        let psnr = monitor.psnr(&volume, mm);
        let held_out = match job.held_out {
            Some(_) => monitor.held_out(job.backend.place(Box::new(Joseph {}))?.operator(), &volume)?,
            None => None,
        };
        observer.record(&Record { step: 1, seconds: train_s, psnr, held_out, ..Record::default() });
        volume.par_mapv_inplace(|x| x * mm);
        let volume = Volume { data: volume, grid: geometry.volume, affine: None };
        let result = Reconstruction::Volume(volume);
        Ok(Solution { result, steps: 1, train_s, samples: 0, sampling_s: 0.0, rollbacks: 0, best: None })
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
        let at_once = views_at_once(header.detector, held(header));
        images(&space, header.detector, at_once);
        space.pass(column_major_bytes::<f32>(header.detector, at_once.min(header.views)));
        let [surround, subtracted] = surround::bytes(self.scene.surround, header);
        Needs { surround, subtracted, working: space.bytes(), volume: true, ..Needs::default() }
    }
}

/// Buffer for the filtered images of at most `views` views.
fn images(space: &Space, [rows, columns]: [usize; 2], views: usize) -> Array3<f32> {
    space.array([views.min(space.header().views), rows, columns])
}

/// The filtered back-projection of one scan.
struct Backprojection<'a> {
    settings: &'a Fdk,
    scan: &'a Scan,
    backend: &'a dyn Backend,
    orbit: &'a FdkOrbit,
    /// Like [`geometry`](Self::geometry), rotated so that the orbit's axis is z.
    upright: &'a Geometry,
    /// Includes the columns added for an offset detector.
    geometry: &'a Geometry,
    /// The measured columns.
    measured: Range<usize>,
}

impl Backprojection<'_> {
    /// Back-projects all views, in batches. Reports progress since `start`.
    fn all(&self, start: Instant, observer: &mut dyn Observer) -> Result<Array3<f32>> {
        let space = Space::new(self.scan.header());
        let mut volume = space.volume();
        let at_once = views_at_once(self.geometry.detector, held(space.header()));
        let mut images = images(&space, self.geometry.detector, at_once);
        let all: Vec<usize> = (0..self.geometry.views.len()).collect();
        let mut done = 0;
        for views in all.chunks(at_once) {
            if observer.cancelled() {
                return Err(Error::Interrupted { step: done as u64 });
            }
            self.some(views, images.slice_mut(s![..views.len(), .., ..]), &mut volume)?;
            done += views.len();
            let share = done as f64 / all.len() as f64;
            let spent = start.elapsed().as_secs_f64();
            observer.progress(done as u64, share, spent * (1.0 - share) / share);
        }
        Ok(volume)
    }

    /// Adds the consecutive views `views` to `volume`; `images` is their buffer.
    fn some(&self, views: &[usize], mut images: ArrayViewMut3<'_, f32>, volume: &mut Array3<f32>) -> Result<()> {
        let g = self.geometry;
        let measured = self.scan.projections.slice_axis(Axis(0), (views[0]..views[0] + views.len()).into());
        images.fill(0.0);
        images.slice_axis_mut(Axis(2), self.measured.clone().into()).assign(&measured);
        images.axis_iter_mut(Axis(0)).into_par_iter().zip(views).for_each(|(mut image, &view)| {
            let pixels = image.as_slice_mut().unwrap_or_else(|| unreachable!("images follow each other"));
            self.filter(view, pixels);
        });
        let scales: Vec<f64> = views.iter().map(|&v| self.orbit.steps[v] * self.orbit.radius[v].powi(2)).collect();
        let seen = views.iter().zip(&scales).map(|(&v, &scale)| Pinhole::of(g, v).voxels(&g.volume, scale));
        let seen: Vec<VoxelView> = seen.collect();
        if !self.backend.backproject(&seen, images.view(), volume.view_mut())? {
            let pixels = ColumnMajor::new(g, views, images.view(), |_, _, _, x| x);
            backproject(g, views, &pixels, &scales, volume.view_mut());
        }
        Ok(())
    }

    /// Weights and filters the image of a view.
    fn filter(&self, view: usize, pixels: &mut [f32]) {
        let (g, v) = (self.upright, &self.upright.views[view]);
        let columns = g.detector[1];
        let (normal, distance) = v.normal();
        let radius = self.orbit.radius[view];
        let ramp = Ramp::new(columns, norm(v.u) * radius / distance, self.settings.window, self.settings.cutoff);
        let count = |c| self.orbit.weight(view, place(g, view, c as f64, radius)) * lean(g, view, c as f64, radius);
        let counts: Vec<f64> = (0..columns).map(count).collect();
        pixels.par_chunks_mut(16 * columns).enumerate().for_each(|(n, strip)| {
            for (r, line) in strip.chunks_mut(columns).enumerate() {
                for (c, x) in line.iter_mut().enumerate() {
                    let d = sub(v.pixel(g.detector, (16 * n + r) as f64, c as f64), v.source);
                    *x *= (counts[c] * dot(normal, d) / norm(d)) as f32;
                }
            }
            ramp.filter(strip, columns);
        });
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
    let shadows = Blocks::of_every(scan, every).columns().into_iter().map(|(view, [first, last])| {
        let places = [first as f64 - 0.5, (last as f64 - 0.5).min(columns - 0.5)];
        (view, places.map(|c| place(upright, view, c, orbit.radius[view])))
    });
    orbit.disc(&shadows.collect::<Vec<_>>())
}

/// Angles between the plane of the sources and the nearest and the farthest part of the volume, seen from the far side
/// of the circle through the axis, rad.
fn cone(orbit: &FdkOrbit, volume: VoxelGrid, axis: Option<&OrbitAxis>) -> [f64; 2] {
    let [low, high] = volume.bounds();
    let heights = (0..8usize).map(|k| {
        let corner: Vec3 = std::array::from_fn(|i| if k >> i & 1 == 0 { low[i] } else { high[i] });
        orbit.height(axis.map_or(corner, |a| a.point(corner)))
    });
    let [low, high] = heights.fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], z| [l.min(z), h.max(z)]);
    let radius = orbit.radius.iter().sum::<f64>() / orbit.radius.len() as f64;
    let nearest = if low < 0.0 && high > 0.0 { 0.0 } else { low.abs().min(high.abs()) };
    [nearest, low.abs().max(high.abs())].map(|z| (z / radius).atan())
}

/// Bytes of views to hold at once: 1/16 of scan and volume, within 1 and 256 MiB. The whole volume passes through memory,
/// and from and to a device, once for all views held.
fn held(header: &ScanHeader) -> u64 {
    (header.pixels().saturating_add(header.voxels()) / 4).clamp(1 << 20, 256 << 20)
}

/// Number of views that fit into `bytes`.
fn views_at_once(detector: [usize; 2], bytes: u64) -> usize {
    (bytes / column_major_bytes::<f32>(detector, 1).max(1)).clamp(1, 64) as usize
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
