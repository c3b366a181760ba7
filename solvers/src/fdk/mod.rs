//! FDK: filtered back-projection of a cone-beam scan (Feldkamp, Davis and Kress, JOSA A 1(6), 1984).
//!
//! `μ(x) = Σ_i Δβ_i · (R/U_i)² · w_i · [cos-weighted p_i * ramp]`, with R the distance of source and axis, U_i the depth of
//! the voxel, Δβ_i the view's share of the turn and w_i what its rays count ([`weights`]). Rows are filtered with the pitch
//! that they have at the axis. No factor is fitted: the scale is right for any number of views and any magnification.

pub mod filter;
pub mod weights;

use crate::iterative::watch::Watch;
use crate::iterative::{finite, voxels_only};
use crate::surround::Within;
use conefield_core::Error;
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, dot, norm, sub};
use conefield_core::scan::{Scan, Volume};
use conefield_core::solver::{Job, Observer, Reconstruction, Record, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use conefield_core::voxel::VoxelView;
use conefield_projectors::voxel::Joseph;
use conefield_projectors::voxel::backproject::backproject;
use conefield_projectors::voxel::layout::{AFTER, BEFORE, ColumnMajor, Pinhole};
use filter::{Ramp, Window};
use ndarray::{Array3, Axis};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use weights::{Coverage, FdkOrbit, place};

/// Settings of `fdk`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Fdk {
    /// What the ramp filter is multiplied with.
    pub window: Window,
    /// Where the window ends, as a share of the highest frequency; nothing beyond it passes.
    pub cutoff: f64,
    /// Set negative attenuation to 0 in the end.
    pub nonnegative: bool,
}

impl Default for Fdk {
    fn default() -> Self {
        Self { window: Window::Ramp, cutoff: 1.0, nonnegative: false }
    }
}

conefield_core::stage_type!(Solver, "fdk", Fdk, "filtered back-projection");

#[typetag::serde(name = "fdk")]
impl SolverSpec for Fdk {
    fn build(&self) -> Result<Box<dyn Solver>> {
        let c = self.cutoff;
        ensure(c > 0.0 && c <= 1.0, "spec", "solver.cutoff", c, "a number above 0 and at most 1")?;
        Ok(Box::new(self.clone()))
    }
}

impl Solver for Fdk {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let start = Instant::now();
        job.scan.validate("scan")?;
        alone(job.spec)?;
        let within = Within::of(job, observer)?;
        let job = &Within::job(within.as_ref(), job);
        let scan = job.scan;
        let orbit = FdkOrbit::of(&scan.geometry);
        check(&orbit, &scan.geometry)?;
        said(&orbit).iter().for_each(|line| observer.note(line));
        let (g, measured) = orbit.symmetric(&scan.geometry);
        let g = &g;
        let [rows, columns] = g.detector;
        let all: Vec<usize> = (0..g.views.len()).collect();
        let mut volume = Array3::<f32>::zeros(g.volume.shape);
        let mut done = 0;
        let values = scan.projections.len() + volume.len();
        for part in all.chunks(views_at_once(g, held(values as u64))) {
            if observer.cancelled() {
                return Err(Error::Interrupted { step: done as u64 });
            }
            let mut images = Array3::<f32>::zeros((part.len(), rows, columns));
            let views = scan.projections.slice_axis(Axis(0), (done..done + part.len()).into());
            images.slice_axis_mut(Axis(2), measured.clone().into()).assign(&views);
            let scales: Vec<f64> = part.iter().map(|&v| orbit.steps[v] * orbit.radius[v].powi(2)).collect();
            images.axis_iter_mut(Axis(0)).into_par_iter().zip(part).for_each(|(mut image, &view)| {
                let v = &g.views[view];
                let (normal, distance) = v.normal();
                let radius = orbit.radius[view];
                let ramp = Ramp::new(columns, norm(v.u) * radius / distance, self.window, self.cutoff);
                let counts: Vec<f64> =
                    (0..columns).map(|c| orbit.weight(view, place(g, view, c as f64, radius))).collect();
                let pixels = image.as_slice_mut().unwrap_or_else(|| unreachable!("this array was made here"));
                pixels.par_chunks_mut(16 * columns).enumerate().for_each(|(n, strip)| {
                    for (r, line) in strip.chunks_mut(columns).enumerate() {
                        for (c, x) in line.iter_mut().enumerate() {
                            let d = sub(v.pixel(g.detector, (16 * n + r) as f64, c as f64), v.source);
                            *x *= (counts[c] * dot(normal, d) / norm(d)) as f32;
                        }
                    }
                    ramp.filter(strip, columns);
                });
            });
            let seen = part.iter().zip(&scales).map(|(&v, &scale)| Pinhole::of(g, v).voxels(&g.volume, scale));
            let seen: Vec<VoxelView> = seen.collect();
            if !job.backend.backproject(&seen, images.view(), volume.view_mut())? {
                let pixels = ColumnMajor::new(g, part, images.view(), |_, _, _, x| x);
                drop(images);
                backproject(g, part, &pixels, &scales, volume.view_mut());
            }
            done += part.len();
            let share = done as f64 / all.len() as f64;
            let spent = start.elapsed().as_secs_f64();
            observer.progress(done as u64, share, spent * (1.0 - share) / share);
        }
        let floor = if self.nonnegative { 0.0 } else { f32::NEG_INFINITY };
        // A comparison, not a maximum, which would turn NaN into the floor.
        volume.par_mapv_inplace(|x| if x < floor { floor } else { x });
        finite(&volume, 1)?;
        let train_s = start.elapsed().as_secs_f64();
        let mm = scan.unit.mm as f32;
        let watch = Watch::new(job);
        let psnr = watch.psnr(&volume, mm);
        let held_out = match job.held_out {
            Some(_) => watch.held_out(job.backend.place(Box::new(Joseph {}))?.operator(), &volume)?,
            None => None,
        };
        observer.record(&Record { step: 1, seconds: train_s, psnr, held_out, ..Record::default() });
        volume.par_mapv_inplace(|x| x * mm);
        let volume = Volume { data: volume, grid: g.volume, affine: None };
        let result = Reconstruction::Volume(volume);
        Ok(Solution { result, steps: 1, train_s, samples: 0, sampling_s: 0.0, rollbacks: 0, best: None })
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        alone(spec)?;
        Ok(false)
    }

    fn plan(&self, scan: &Scan) -> Vec<String> {
        let orbit = FdkOrbit::of(&scan.geometry);
        check(&orbit, &scan.geometry).map_or_else(|e| vec![e.to_string()], |()| said(&orbit))
    }

    /// The views at hand, filtered and then once more column by column.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        2 * held(pixels.saturating_add(voxels))
    }

    fn describe(&self) -> String {
        format!("fdk: {:?} window to {} of the highest frequency", self.window, self.cutoff).to_lowercase()
    }
}

/// What is told of an orbit.
fn said(orbit: &FdkOrbit) -> Vec<String> {
    let mut lines = vec![orbit.describe()];
    if orbit.coverage == Coverage::Limited {
        lines.push("expect streaks along the missing directions; an iterative solver suits this scan better".into());
    }
    lines
}

/// Bytes of views to hold at once beside a scan and a volume of `values` numbers: a 32nd of theirs, but at least one MiB
/// and no more than stays in the last cache.
fn held(values: u64) -> u64 {
    (values / 8).clamp(1 << 20, 12 << 20)
}

/// How many views take up `bytes`.
fn views_at_once(geometry: &Geometry, bytes: u64) -> usize {
    let of_one = ((geometry.detector[0] + BEFORE + AFTER) * geometry.detector[1] * size_of::<f32>()).max(1);
    (bytes as usize / of_one).clamp(1, 64)
}

/// Refuses stages that would be passed over: FDK back-projects in its own way and starts from nothing.
fn alone(spec: &Spec) -> Result<()> {
    voxels_only(spec)?;
    let named = [
        ("projector.type", spec.projector.as_ref().map(|p| p.typetag_name())),
        ("initializer.type", spec.initializer.as_ref().map(|i| i.typetag_name())),
    ];
    for (field, name) in named {
        let found = name.map_or(String::new(), |n| format!("{n:?}"));
        ensure(name.is_none(), "spec", field, found, "none: fdk back-projects in its own way and starts from nothing")?;
    }
    Ok(())
}

/// Sources may lie along z by this share of the circle's radius, and rows of the detector rise by it: what calibrated scans
/// differ from a circle by is less, a helix and a detector on its side are more.
const TILT: f64 = 0.05;

/// FDK is for circles around z, whose rows of the detector lie across z.
fn check(orbit: &FdkOrbit, geometry: &Geometry) -> Result<()> {
    let span = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), r| (l.min(r), h.max(r)))
    };
    let circle = "a circular orbit around z for fdk; iterative solvers take any";
    let (low, high) = span(&mut orbit.radius.iter().copied());
    let found = format!("sources {low:.1} to {high:.1} mm from the axis z");
    ensure(low > 0.0 && high < 1.2 * low, "scan", "views", found, circle)?;
    let (bottom, top) = span(&mut geometry.views.iter().map(|v| v.source[2]));
    let found = format!("sources from {bottom:.1} to {top:.1} mm along z");
    ensure(top - bottom <= TILT * low, "scan", "views", found, circle)?;
    let steep = geometry.views.iter().position(|v| v.u[2].abs() > TILT * norm(v.u));
    let found = steep.map_or(String::new(), |v| format!("a detector whose rows rise along z in view {v}"));
    ensure(steep.is_none(), "scan", "views", found, "rows across z for fdk; iterative solvers take any")
}
