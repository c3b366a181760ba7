//! Conjugate gradients on the normal equations `AᵀA·x = Aᵀp` (Hestenes and Stiefel 1952; Björck, Numerical Methods for
//! Least Squares Problems, algorithm 7.4.1). Early passes recover smooth structure; later ones also fit noise.

use super::norms::norm2;
use super::order::Subsets;
use super::plan::{Iterative, IterativePlan};
use super::shared::Shared;
use super::{Iteration, Pass, Problem, Stop, drive::drive, flat_mut};
use conefield_core::error::Result;
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Method, Observer, Plan, Reconstruction, Solution};
use conefield_core::scan::ScanHeader;
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Zip};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `cgls`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cgls {
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
    /// Set negative attenuation to 0 at the end.
    pub nonnegative: bool,
}

impl Default for Cgls {
    fn default() -> Self {
        let (scene, stop) = (VoxelScene::default(), Stop::after(15));
        Self { projector: Box::new(Joseph {}), scene, start: None, stop, nonnegative: true }
    }
}

conefield_core::stage_type!(Method, "cgls", Cgls, "conjugate gradients for least squares");

#[typetag::serde(name = "cgls")]
impl Method for Cgls {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        let shared = Shared::of(self.projector.as_ref(), self.scene, &self.start, &self.stop)?;
        Ok(Box::new(IterativePlan(Built { shared, nonnegative: self.nonnegative })))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

/// The stages that [`Cgls`] builds.
struct Built {
    shared: Shared,
    nonnegative: bool,
}

impl Iterative for Built {
    fn kind(&self) -> &'static str {
        "cgls"
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
        let mut iterate = Iterate::new(&space, self.shared.start(job, &problem, &space)?);
        iterate.prepare(&problem);
        let mut solution = drive(job, &self.shared.stop, begun, &problem, &space, &mut iterate, observer)?;
        if let (true, Reconstruction::Volume(volume)) = (self.nonnegative, &mut solution.result) {
            volume.data.par_mapv_inplace(|x| x.max(0.0));
        }
        Ok(solution)
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        Iterate::new(&space, space.volume());
        self.shared.price(&space, Subsets::Count(1))
    }

    fn describe(&self) -> String {
        "cgls: conjugate gradients on the normal equations".into()
    }
}

struct Iterate {
    x: Array3<f32>,
    /// `p − A·x`.
    residual: Array3<f32>,
    /// The search direction.
    direction: Array3<f32>,
    /// `A·direction`.
    ahead: Array3<f32>,
    /// `Aᵀ·residual`.
    gradient: Array3<f32>,
    /// `‖gradient‖²`.
    gamma: f64,
}

impl Iterate {
    fn new(space: &Space, x: Array3<f32>) -> Self {
        let views = space.header().views;
        Self {
            x,
            residual: space.projections(views),
            direction: space.volume(),
            ahead: space.projections(views),
            gradient: space.volume(),
            gamma: 0.0,
        }
    }

    fn prepare(&mut self, problem: &Problem<'_>) {
        let views = problem.views();
        problem.residual(&views, &self.x, &mut self.residual);
        problem.back(&views, &self.residual, &mut self.gradient);
        self.direction.assign(&self.gradient);
        self.gamma = norm2(&self.gradient);
    }
}

impl Iteration for Iterate {
    fn pass(&mut self, problem: &Problem<'_>, _: u64) -> Result<Pass> {
        let views = problem.views();
        problem.forward(&views, &self.direction, &mut self.ahead);
        let square = norm2(&self.ahead);
        if square == 0.0 {
            return Ok(Pass { residual: norm2(&self.residual), change: Some(0.0), prior: None });
        }
        let alpha = (self.gamma / square) as f32;
        Zip::from(&mut self.x).and(&self.direction).par_for_each(|x, d| *x += alpha * d);
        Zip::from(&mut self.residual).and(&self.ahead).par_for_each(|r, q| *r -= alpha * q);
        problem.back(&views, &self.residual, &mut self.gradient);
        let gamma = norm2(&self.gradient);
        let beta = (gamma / self.gamma) as f32;
        self.gamma = gamma;
        let change = f64::from(alpha) * (norm2(&self.direction) / norm2(&self.x).max(1e-300)).sqrt();
        Zip::from(&mut self.direction).and(&self.gradient).par_for_each(|d, s| *d = s + beta * *d);
        Ok(Pass { residual: norm2(&self.residual), change: Some(change), prior: None })
    }

    fn volume(&mut self, _: &Problem<'_>) -> &Array3<f32> {
        &self.x
    }

    fn take(&mut self, _: &Problem<'_>) -> Array3<f32> {
        std::mem::take(&mut self.x)
    }

    fn state(&mut self) -> Result<Vec<(String, &mut [f32])>> {
        Ok(vec![
            ("x".into(), flat_mut(&mut self.x)),
            ("residual".into(), flat_mut(&mut self.residual)),
            ("direction".into(), flat_mut(&mut self.direction)),
        ])
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.gamma]
    }
}
