//! Radiative Gaussians: a volume as a sum of Gaussians, trained on whole views (R²-Gaussian, Zha et al., NeurIPS 2024).
//!
//! - [`shape`]: a Gaussian and its parameters. [`stage`]: a mixture of Gaussians as a field.
//! - [`view`]: line integrals for a view, in closed form and exact for cone beams. [`grid`], [`cells`]: values at
//!   points of a grid, and at scattered points. [`lists`]: which Gaussian reaches what.
//! - [`start`]: initial Gaussians. [`control`]: density control. [`ssim`]: structural similarity of views.
//! - [`views`]: a training step. The training loop is the same as for every field. [`device`]: all of it on a GPU.

pub mod cells;
pub mod control;
pub mod device;
pub mod grid;
pub mod lists;
pub mod shape;
pub mod ssim;
pub mod stage;
pub mod start;
pub mod view;
pub mod views;

#[cfg(test)]
mod tests;

use crate::fdk::Fdk;
use crate::fdk::filter::Window;
use crate::field_parts::{FieldParts, complete};
use crate::field_plan::{l1, rollback};
use crate::fit::{Fitted, fit};
use crate::iterative::known_volume;
use crate::optimizer::Optimizer;
use crate::priors::Places;
use crate::schedule::Clock;
use crate::surround::Corrected;
use crate::training::{Callback, CallbackSpec, Draw, Run, Task};
use conefield_core::backend::Executable;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::method::{
    Context, Findings, Job, Limits, Line, Method, Needs, Observer, Outline, Plan, Quiet, Solution, StageLine,
};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::scan::{Scan, ScanHeader, Volume};
use conefield_core::scene::{Scene, SceneSettings};
use conefield_core::settings::{LossSpec, PriorSpec};
use conefield_core::spec::stage as stages;
use conefield_core::trained::{Placement, TrainedField};
use conefield_core::words::counted;
use control::{Control, DensityControl, Pulls};
use device::training::DeviceTraining;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use stage::Mixture;
use start::Start;
use std::sync::{Arc, Mutex};
use views::{Rule, ViewTraining, Views};

/// Most slots for Gaussians: 11 GiB with gradients and moments.
const MOST: usize = 1 << 26;
/// The smallest standard deviation, in voxels: a narrower Gaussian falls between voxels and pixels.
const NARROWEST: f64 = 0.4;
/// The largest standard deviation, in sides of the unit cube.
const WIDEST: f64 = 0.25;

/// Settings of `gaussians`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gaussians {
    /// How the scan is mapped to the Gaussians' unit cube.
    #[serde(default)]
    pub scene: SceneSettings,
    /// Average blocks of this many pixels per side before training.
    #[serde(default = "one")]
    pub bin: usize,
    /// Number of slots: the largest possible number of Gaussians.
    #[serde(default = "places")]
    pub most: usize,
    /// Initial Gaussians: at voxels of an FDK reconstruction, or of the method's start volume.
    #[serde(default)]
    pub start: Start,
    /// Loss between predicted and measured line integrals.
    #[serde(default = "l1")]
    #[schemars(schema_with = "stages::schema::<dyn LossSpec>")]
    pub loss: Box<dyn LossSpec>,
    /// Weight of a view's structural dissimilarity relative to the mean loss of a pixel.
    #[serde(default)]
    pub ssim: f64,
    /// Priors on the volume, independent of the measurements.
    #[serde(default, deserialize_with = "stages::list")]
    #[schemars(schema_with = "stages::schema_of_list::<dyn PriorSpec>")]
    pub priors: Vec<Box<dyn PriorSpec>>,
    /// Optimizer of the densities.
    #[serde(default)]
    pub optimizer: Optimizer,
    /// Learning rates of other parameters relative to that of the densities.
    #[serde(default)]
    pub rates: Rates,
    /// Views per step, and the end of training.
    #[serde(default)]
    pub training: Steps,
    /// Adds and removes Gaussians; without it their number stays constant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub density_control: Option<Control>,
    /// Callbacks during training.
    #[serde(default = "rollback", deserialize_with = "stages::list")]
    #[schemars(schema_with = "stages::schema_of_list::<dyn CallbackSpec>")]
    pub callbacks: Vec<Box<dyn CallbackSpec>>,
}

/// Learning rates relative to that of the densities; the published ones relative to 0.01.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Rates {
    /// Rate of centres, in sides of the unit cube.
    pub centre: f64,
    /// Rate of the logarithms of standard deviations.
    pub scale: f64,
    /// Rate of quaternions.
    pub rotation: f64,
}

impl Default for Rates {
    fn default() -> Self {
        Self { centre: 0.01, scale: 0.5, rotation: 0.1 }
    }
}

/// Views per step, and the end of training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Steps {
    /// Ends training after this many steps.
    pub steps: Option<u64>,
    /// Ends training after this many seconds. The first limit reached ends the run.
    pub seconds: Option<f64>,
    /// Views per step.
    pub views: usize,
    /// Most steps between two records of the metrics; a run has at least ten.
    pub report_every: u64,
}

impl Default for Steps {
    fn default() -> Self {
        Self { steps: Some(1500), seconds: None, views: 1, report_every: 100 }
    }
}

impl Steps {
    fn validate(&self) -> Result<()> {
        ensure((1..=1024).contains(&self.views), "spec", "views", self.views, "1 to 1024")?;
        ensure(self.report_every > 0, "spec", "report_every", 0, "at least 1")?;
        ensure(self.steps.is_some() || self.seconds.is_some(), "spec", "", "no end", "one of steps or seconds")?;
        ensure(self.steps != Some(0), "spec", "steps", 0, "at least 1")?;
        let x = self.seconds.unwrap_or(1.0);
        ensure(x.is_finite() && x > 0.0, "spec", "seconds", x, "a positive finite number")
    }
}

fn one() -> usize {
    1
}

fn places() -> usize {
    100_000
}

conefield_core::stage_type!(Method, "gaussians", Gaussians, "a sum of Gaussians, trained on whole views");

impl Method for Gaussians {
    fn plan(&self, context: &Context<'_>) -> Result<Box<dyn Plan>> {
        ensure((1..=64).contains(&self.bin), "spec", "bin", self.bin, "1 to 64 pixels")?;
        ensure((8..=MOST).contains(&self.most), "spec", "most", self.most, format!("8 to {MOST}"))?;
        self.start.validate(self.most).map_err(|e| e.within("start"))?;
        ensure(self.ssim.is_finite() && self.ssim >= 0.0, "spec", "ssim", self.ssim, "0 or more")?;
        let Rates { centre, scale, rotation } = self.rates;
        for (key, x) in [("rates.centre", centre), ("rates.scale", scale), ("rates.rotation", rotation)] {
            ensure(x.is_finite() && x >= 0.0, "spec", key, x, "a finite number, 0 or more")?;
        }
        self.training.validate().map_err(|e| e.within("training"))?;
        if let Some(control) = &self.density_control {
            control.validate().map_err(|e| e.within("density_control"))?;
        }
        let pipeline = Pipeline::alone(Box::new(Mixture { most: self.most }))?;
        let Self { scene, optimizer, loss, priors, callbacks, start, training, .. } = self;
        let (mut parts, beside) = FieldParts::build(scene, optimizer, pipeline, loss.as_ref(), priors, callbacks)?;
        let learns = if parts.loss.needs_scan() { "one that is fitted to the scan" } else { "" };
        ensure(learns.is_empty(), "spec", "loss", learns, "a loss that does not depend on the scan, such as l1")?;
        // Fails on a backend that does not support fields with their own line integrals.
        let (exe, compiled) = context.backend.compile(&parts.pipeline)?;
        exe.admits(parts.loss.as_ref(), &parts.priors)?;
        let device = context.backend.device();
        if let Some(device) = &device {
            DeviceTraining::check(device.as_ref(), parts.loss.as_ref(), &parts.priors, self.ssim)?;
        }
        let memory = match &device {
            None => Memory::Host,
            Some(device) if device.is_software() => Memory::Software,
            Some(_) => Memory::Device,
        };
        // The field has kernels of its own in place of a fragment.
        let field = StageLine::new("field", "gaussians", parts.pipeline.field.as_ref());
        let stages = vec![StageLine { wgsl: true, ..field }];
        let views = counted(training.views, "view");
        let what = format!("{} from the start, {views} per step, Adam {}", start.count, optimizer.lr);
        let method = Line::new("method", "gaussians", &what);
        parts.kept += self.density_control.map_or(0, |_| DensityControl::bytes(self.most));
        Ok(Box::new(GaussianPlan {
            parts,
            bin: self.bin,
            most: self.most,
            start: *start,
            rates: [centre, scale, rotation],
            ssim: self.ssim,
            training: *training,
            control: self.density_control,
            memory,
            outline: Outline { method, stages, beside, compiled: Some(compiled), links: vec![] },
        }))
    }
}

/// The plan of [`Gaussians`].
struct GaussianPlan {
    parts: FieldParts,
    bin: usize,
    most: usize,
    start: Start,
    rates: [f64; 3],
    ssim: f64,
    training: Steps,
    control: Option<Control>,
    memory: Memory,
    outline: Outline,
}

/// Whose memory training takes.
#[derive(Clone, Copy)]
enum Memory {
    Host,
    /// A device's that is the host's.
    Software,
    Device,
}

impl Plan for GaussianPlan {
    fn outline(&self) -> Outline {
        self.outline.clone()
    }

    fn needs(&self, scan: &ScanHeader) -> Needs {
        let seen = scan.binned(self.bin);
        let bins = if self.bin > 1 { 4 * seen.pixels() } else { 0 };
        let begun = first().needs(scan).working + self.start.bytes(scan.voxels());
        let slots = self.most as u64;
        // On their way to a device, the views are here.
        let views = 4 * seen.pixels();
        let training = match self.memory {
            Memory::Host => ViewTraining::bytes(&seen, slots),
            Memory::Software => 2 * views + DeviceTraining::bytes(&seen, slots),
            Memory::Device => views,
        };
        // The first volume is freed before training begins.
        self.parts.needs(scan, &self.outline, bins + begun.max(training))
    }

    fn passes(&self) -> Option<u64> {
        self.training.steps
    }

    fn inspect(&self, scan: &Scan) -> Result<Findings> {
        self.parts.inspect(scan)
    }

    fn run(&mut self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        job.scan.validate("scan")?;
        let (mut pipeline, settings) = (self.parts.pipeline.clone(), &self.parts.scene);
        let Fitted { scene, solid, found, .. } = fit(job.scan, settings, Some(job.volumes), &mut pipeline)?;
        found.iter().for_each(|line| observer.note(line));
        let [rows, columns] = job.scan.geometry.detector;
        let room = format!("1 to {}, the detector's longer side", rows.max(columns));
        ensure(self.bin <= rows.max(columns), "spec", "bin", self.bin, room)?;
        let corrected = Corrected::of(job, settings.surround, solid.as_ref(), observer)?;
        let job = &Corrected::job(corrected.as_ref(), job);
        let widths = [NARROWEST * scene.voxel_mm() / scene.side, WIDEST];
        let widths = [widths[0].min(WIDEST / 2.0), widths[1]];
        let mut model = Model::random(pipeline, job.seed);
        match job.resume {
            Some(resume) => resume.restore(&mut model)?,
            None => {
                let (volume, from) = self.first(job, observer)?;
                let count = self.start.fill(&volume, &scene, job.seed, widths, &mut model.arena.params)?;
                observer.note(&format!("{count} Gaussians at voxels of {from}"));
            }
        }
        let rule = Rule { views: self.training.views, ssim: self.ssim, rates: self.rates, widths };
        let pulls = Arc::new(Mutex::new(Pulls::new(self.control.map_or(0, |_| self.most))));
        let device = job.backend.device();
        let padding = device.as_ref().map_or(ViewTraining::PADDING, |_| 0);
        let views = match self.bin {
            1 => Views::new(job.scan, &scene, padding),
            bin => Views::new(&job.scan.binned(bin), &scene, padding),
        };
        let scale = views.half_detector() / views.top;
        let exe: Box<dyn Executable> = match device {
            Some(device) => {
                let header = job.scan.header().binned(self.bin);
                let bytes = DeviceTraining::bytes(&header, self.most as u64) + size_of_val(&*views.measured) as u64;
                let parts = (self.parts.loss.as_ref(), &self.parts.priors[..]);
                let resident = job.backend.place().holds(bytes);
                if !resident {
                    observer.note("the views do not fit on the device beside the Gaussians: each step loads its own");
                }
                Box::new(DeviceTraining::new(device, self.most, rule, (views, resident), parts, pulls.clone())?)
            }
            None => Box::new(ViewTraining::new(rule, views, pulls.clone())),
        };
        let control =
            self.control.map(|control| -> Box<dyn Callback> { Box::new(DensityControl::new(control, pulls, scale)) });
        let callbacks = self.parts.callbacks(job, &scene, &model.pipeline, control)?;
        observer.note(&self.outline.backend().backend);
        let spent = job.resume.map_or(0.0, |r| r.standing.seconds);
        let Steps { steps, seconds, .. } = self.training;
        let ends = Limits { steps, seconds, ..Limits::default() };
        let views = job.scan.geometry.views.len();
        let run = Run {
            clock: Clock::new(ends, job.limits, spent),
            loss: self.parts.loss.clone(),
            optimizer: self.parts.optimizer.clone(),
            steps_an_epoch: views.div_ceil(self.training.views) as u64,
            report_every: self.training.report_every,
            ..Run::new(job, &scene, observer, model, exe)
        };
        complete(run, &mut Whole { scene: &scene, places: Places::new(&self.parts.priors) }, callbacks)
    }

    fn restore(&self, placement: &Placement, load: &mut dyn FnMut(&mut Model) -> Result<()>) -> Result<TrainedField> {
        TrainedField::restore(self.parts.pipeline.clone(), &self.parts.scene, placement, load)
    }

    fn pipeline(&self) -> Option<&Pipeline> {
        Some(&self.parts.pipeline)
    }

    fn needs_held_out(&self) -> Option<String> {
        self.parts.held_out.clone()
    }
}

/// The FDK for the initial Gaussians. It is smooth, because noise would place Gaussians in empty regions.
fn first() -> Fdk {
    Fdk { window: Window::Hann, nonnegative: true, ..Fdk::default() }
}

impl GaussianPlan {
    /// The volume for the initial Gaussians, in 1/mm, and its description.
    fn first(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<(Volume, String)> {
        if let Some((volume, _, from)) = known_volume(job, None)? {
            return Ok((volume, from));
        }
        let alone = Job { seed: job.seed, ..Job::new(job.scan, job.backend) };
        let help = |e: Error| match e {
            Error::Interrupted { .. } => Error::Interrupted { step: 0 },
            Error::Invalid { place, field, found, expected } if place == "scan" => {
                let start = "gaussians start from fdk, or in a chain from the volume of the method before";
                Error::invalid(place, field, found, format!("{expected} ({start})"))
            }
            e => e.within("start"),
        };
        let solution = first().run(&alone, &mut Quiet(&|| observer.cancelled())).map_err(help)?;
        let mm = job.scan.unit.mm as f32;
        Ok((solution.result.volume(job.backend)?.mapped(|x| x / mm), "an FDK".into()))
    }
}

/// Training on whole views.
struct Whole<'a> {
    scene: &'a Scene,
    places: Places<'a>,
}

impl Task for Whole<'_> {
    fn draw(&mut self, seed: u64, step: u64) -> Draw<'_> {
        let priors = self.places.draw(self.scene, seed, step);
        Draw { rays: &[], priors, ahead: Box::new(|| ()) }
    }
}
