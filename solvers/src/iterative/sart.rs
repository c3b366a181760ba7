//! SART: `x ← x + λ·D·A_sᵀ·W·(p_s − A_s·x)` over subsets s of the views, with W the inverse row sums of A and D the
//! inverse column sums of the subset (Andersen and Kak, Ultrasonic Imaging 6, 1984). One view per subset is SART, all
//! views at once are SIRT, anything in between is OS-SART.

use super::norms::change;
use super::order::{Order, Subsets, summary};
use super::plan::{Iterative, IterativePlan};
use super::problem::{images_mut, invert, room};
use super::shared::Shared;
use super::{Iteration, Pass, Problem, Stop, drive::drive, flat_mut};
use conefield_core::error::{Result, ensure};
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Method, Observer, Plan, Solution};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Axis, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `sart`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Sart {
    /// Voxel projector.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn VoxelProjectorSpec>")]
    pub projector: Box<dyn VoxelProjectorSpec>,
    /// Support of the object, and attenuation beyond the volume.
    pub scene: VoxelScene,
    /// File of a known volume to start from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<InputFile>,
    /// Stopping criteria.
    pub stop: Stop,
    /// Number of ordered subsets of the views, or "views" for one view at a time. 1 uses all views at once.
    pub subsets: Subsets,
    /// Relaxation λ of the first pass, above 0 and below 2.
    pub relaxation: f64,
    /// Factor of λ after each pass.
    pub decay: f64,
    /// Order of the subsets.
    pub order: Order,
    /// Set negative attenuation to 0 after each update.
    pub nonnegative: bool,
}

impl Default for Sart {
    fn default() -> Self {
        Self {
            projector: Box::new(Joseph {}),
            scene: VoxelScene::default(),
            start: None,
            stop: Stop::after(15),
            subsets: Subsets::VIEWS,
            relaxation: 0.3,
            decay: 0.9,
            order: Order::Golden,
            nonnegative: true,
        }
    }
}

conefield_core::stage_type!(Method, "sart", Sart, "simultaneous algebraic reconstruction by subsets of the views");

#[typetag::serde(name = "sart")]
impl Method for Sart {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        Ok(Box::new(IterativePlan(self.built()?)))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

impl Sart {
    fn built(&self) -> Result<Built> {
        let updates = Updates {
            subsets: self.subsets,
            relaxation: self.relaxation,
            decay: self.decay,
            order: self.order,
            nonnegative: self.nonnegative,
        };
        updates.validate()?;
        Ok(Built { shared: Shared::of(self.projector.as_ref(), self.scene, &self.start, &self.stop)?, updates })
    }
}

/// The update rule of a [`Sweep`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Updates {
    pub(super) subsets: Subsets,
    pub(super) relaxation: f64,
    pub(super) decay: f64,
    pub(super) order: Order,
    pub(super) nonnegative: bool,
}

impl Updates {
    pub(super) fn validate(&self) -> Result<()> {
        self.subsets.validate()?;
        let r = self.relaxation;
        ensure(r > 0.0 && r < 2.0, "spec", "relaxation", r, "a number above 0 and below 2")?;
        let d = self.decay;
        ensure(d > 0.0 && d <= 1.0, "spec", "decay", d, "a number above 0 and at most 1")
    }
}

/// The stages that [`Sart`] builds.
struct Built {
    shared: Shared,
    updates: Updates,
}

impl Built {
    fn iterate(&self, space: &Space, x: Array3<f32>) -> Iterate {
        let before = self.shared.stop.change.map(|_| space.volume());
        Iterate { before, sweep: Sweep::new(self.updates, space, x) }
    }
}

impl Iterative for Built {
    fn kind(&self) -> &'static str {
        "sart"
    }

    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = self.shared.open(&self.describe(), job, observer)?;
        let job = &opened.job(job);
        let problem = opened.problem(job);
        let space = Space::new(job.scan.header());
        let mut iterate = self.iterate(&space, self.shared.start(job, &problem, &space)?);
        iterate.sweep.prepare(&problem);
        drive(job, &self.shared.stop, begun, &problem, &space, &mut iterate, observer)
    }

    fn found(&self, scan: &Scan) -> Vec<String> {
        vec![summary(&self.updates.subsets.of(scan.geometry.views.len()))]
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        self.iterate(&space, space.volume());
        self.shared.price(&space, self.updates.subsets)
    }

    fn describe(&self) -> String {
        let Updates { subsets, relaxation, decay, .. } = self.updates;
        format!("sart: {subsets}, relaxation {relaxation} times {decay} per pass")
    }
}

/// The iterate with its buffers.
pub(super) struct Sweep {
    updates: Updates,
    subsets: Vec<Vec<usize>>,
    pub(super) x: Array3<f32>,
    /// Inverse row sums, `[view, row, column]`.
    rows: Array3<f32>,
    /// Inverse column sums of the current subset.
    columns: Array3<f32>,
    /// Working memory, free between sweeps.
    pub(super) work: Array3<f32>,
    /// The pixels of a subset.
    pixels: Array3<f32>,
}

impl Sweep {
    /// The buffers of a sweep that starts from `x`.
    pub(super) fn new(updates: Updates, space: &Space, x: Array3<f32>) -> Self {
        let views = space.header().views;
        Self {
            updates,
            subsets: updates.subsets.of(views),
            x,
            rows: space.projections(views),
            columns: space.volume(),
            work: space.volume(),
            pixels: room(space, updates.subsets.count(views)),
        }
    }

    /// Computes the sums that do not change.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>) {
        problem.ones(&mut self.work);
        // One subset at a time, as in every pass.
        for views in &self.subsets {
            problem.forward(views, &self.work, &mut self.pixels);
            for (image, &v) in self.pixels.outer_iter().zip(views) {
                self.rows.index_axis_mut(Axis(0), v).assign(&image);
            }
        }
        invert(&mut self.rows);
        if let [all] = &self.subsets[..] {
            column_sums(problem, all, &mut self.pixels, &mut self.columns);
        }
    }

    /// Makes pass `pass`, counted from 0; returns `‖p − A·x‖²`.
    pub(super) fn sweep(&mut self, problem: &Problem<'_>, pass: u64) -> f64 {
        let Updates { relaxation, decay, order, nonnegative, .. } = self.updates;
        let relaxation = (relaxation * decay.powi(pass.min(1 << 20) as i32)) as f32;
        let floor = if nonnegative { 0.0 } else { f32::NEG_INFINITY };
        let mut square = 0.0;
        for s in order.of(self.subsets.len(), problem.seed, pass) {
            let views = &self.subsets[s];
            square += problem.residual(views, &self.x, &mut self.pixels);
            for (mut image, &v) in self.pixels.axis_iter_mut(Axis(0)).zip(views) {
                image.zip_mut_with(&self.rows.index_axis(Axis(0), v), |r, w| *r *= w);
            }
            problem.back(views, &self.pixels, &mut self.work);
            if self.subsets.len() > 1 {
                column_sums(problem, views, &mut self.pixels, &mut self.columns);
            }
            Zip::from(&mut self.x)
                .and(&self.work)
                .and(&self.columns)
                .par_for_each(|x, u, d| *x = (*x + relaxation * d * u).max(floor));
        }
        square
    }
}

/// Overwrites `sums` with the inverse column sums of some views; `pixels` is a buffer for their images.
fn column_sums(problem: &Problem<'_>, views: &[usize], pixels: &mut Array3<f32>, sums: &mut Array3<f32>) {
    images_mut(pixels, views.len()).fill(1.0);
    problem.back(views, pixels, sums);
    invert(sums);
}

struct Iterate {
    sweep: Sweep,
    /// The volume before a pass, if its change is needed.
    before: Option<Array3<f32>>,
}

impl Iteration for Iterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        if let Some(before) = &mut self.before {
            before.assign(&self.sweep.x);
        }
        let residual = self.sweep.sweep(problem, pass);
        let change = self.before.as_ref().map(|before| change(&self.sweep.x, before));
        Ok(Pass { residual, change, prior: None })
    }

    fn volume(&mut self, _: &Problem<'_>) -> &Array3<f32> {
        &self.sweep.x
    }

    fn take(&mut self, _: &Problem<'_>) -> Array3<f32> {
        std::mem::take(&mut self.sweep.x)
    }

    fn state(&mut self) -> Result<Vec<(String, &mut [f32])>> {
        Ok(vec![("x".into(), flat_mut(&mut self.sweep.x))])
    }
}
