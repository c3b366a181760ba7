//! Conjugate gradients on the normal equations `AᵀA·x = Aᵀp` (Hestenes and Stiefel 1952; Björck, Numerical Methods for
//! Least Squares Problems, algorithm 7.4.1). Early passes recover smooth structure; later ones also fit noise.

use super::norms::norm2;
use super::order::Subsets;
use super::plan::{Iterative, IterativePlan};
use super::problem::copy;
use super::shared::Shared;
use super::{Iteration, Pass, Problem, Stop, drive::drive};
use conefield_core::error::Result;
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Method, Observer, Plan, Reconstruction, Solution};
use conefield_core::place::{ADD, Array, Bounds, StatePart};
use conefield_core::scan::ScanHeader;
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_projectors::voxel::Joseph;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `cgls`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cgls {
    /// Voxel projector.
    #[schemars(schema_with = "stage::schema::<dyn VoxelProjectorSpec>")]
    pub projector: Box<dyn VoxelProjectorSpec>,
    /// Support of the object, and attenuation beyond the volume.
    pub scene: VoxelScene,
    /// File of a known volume to start from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<InputFile>,
    /// Stopping criteria.
    pub stop: Stop,
    /// Raise attenuation to `scene.bounds.low`, by default 0, at the end.
    pub nonnegative: bool,
}

impl Default for Cgls {
    fn default() -> Self {
        let (scene, stop) = (VoxelScene::default(), Stop::after(15));
        Self { projector: Box::new(Joseph {}), scene, start: None, stop, nonnegative: true }
    }
}

conefield_core::stage_type!(Method, "cgls", Cgls, "conjugate gradients for least squares");

impl Method for Cgls {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        let shared = Shared::of(self.projector.as_ref(), &self.scene, &self.start, &self.stop)?;
        Ok(Box::new(IterativePlan(CglsMethod { shared, nonnegative: self.nonnegative })))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

/// The stages that [`Cgls`] builds.
struct CglsMethod {
    shared: Shared,
    nonnegative: bool,
}

impl Iterative for CglsMethod {
    fn kind(&self) -> &'static str {
        "cgls"
    }

    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        least_squares(self, self.nonnegative, job, observer, CglsIterate::new, CglsIterate::prepare)
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        let _ = space.volume().and_then(|x| CglsIterate::new(&space, x));
        self.shared.price(&space, Subsets::Count(1))
    }

    fn describe(&self) -> String {
        "cgls: conjugate gradients on the normal equations".into()
    }
}

/// Solves a least-squares problem from the known volume by the iterations that `make` allocates and `prepare` begins.
/// Clips the result to the bounds; without `nonnegative` to the upper one.
pub(super) fn least_squares<I: Iteration + 'static>(
    plan: &impl Iterative,
    nonnegative: bool,
    job: &Job<'_>,
    observer: &mut dyn Observer,
    make: impl FnOnce(&Space, Array) -> Result<I>,
    prepare: impl FnOnce(&mut I, &Problem<'_>) -> Result<()>,
) -> Result<Solution> {
    let (begun, shared) = (Instant::now(), plan.shared());
    let opened = shared.open(plan, job, observer)?;
    let job = &opened.job(job);
    let mut problem = opened.problem(job);
    let space = opened.space(job.scan.header());
    let mut iterate = make(&space, shared.start(job, &problem, &space)?)?;
    problem.settle()?;
    prepare(&mut iterate, &problem)?;
    let mut solution = drive(job, &shared.stop, begun, &problem, &space, Box::new(iterate), observer)?;
    if let Reconstruction::Volume(volume) = &mut solution.result {
        let bounds = Bounds { low: if nonnegative { problem.bounds.low } else { f32::MIN }, ..problem.bounds };
        // The volume is in the scan's unit.
        let factor = job.scan.unit.mm as f32;
        problem.regions.clip(&mut volume.data, &volume.grid, bounds, factor);
    }
    Ok(solution)
}

struct CglsIterate {
    x: Array,
    /// `p − A·x`.
    residual: Array,
    /// The search direction.
    direction: Array,
    /// `A·direction`.
    ahead: Array,
    /// `Aᵀ·residual`.
    gradient: Array,
    /// `‖gradient‖²`.
    gamma: f64,
}

impl CglsIterate {
    fn new(space: &Space, x: Array) -> Result<Self> {
        let views = space.header().views;
        Ok(Self {
            x,
            residual: space.projections(views)?,
            direction: space.volume()?,
            ahead: space.projections(views)?,
            gradient: space.volume()?,
            gamma: 0.0,
        })
    }

    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
        let views = problem.views();
        problem.residual(&views, &self.x, None, &mut self.residual)?;
        problem.back(&views, &self.residual, &mut self.gradient)?;
        copy(problem.place, &self.gradient, &mut self.direction)?;
        self.gamma = norm2(problem.place, &self.gradient)?;
        Ok(())
    }
}

impl Iteration for CglsIterate {
    fn pass(&mut self, problem: &Problem<'_>, _: u64) -> Result<Pass> {
        let (views, place) = (problem.views(), problem.place);
        let Self { x, residual, direction, ahead, gradient, gamma } = self;
        problem.forward(&views, direction, ahead)?;
        let square = norm2(place, ahead)?;
        if square == 0.0 {
            return Ok(Pass { residual: norm2(place, residual)?, change: Some(0.0), prior: None });
        }
        let alpha = f64::from((*gamma / square) as f32);
        place.map(&ADD, [alpha, 1.0], x, &[direction])?;
        place.map(&ADD, [-alpha, 1.0], residual, &[ahead])?;
        problem.back(&views, residual, gradient)?;
        let next = norm2(place, gradient)?;
        let beta = next / *gamma;
        *gamma = next;
        let change = alpha * (norm2(place, direction)? / norm2(place, x)?.max(1e-300)).sqrt();
        place.map(&ADD, [1.0, beta], direction, &[gradient])?;
        Ok(Pass { residual: norm2(place, residual)?, change: Some(change), prior: None })
    }

    fn volume(&mut self, _: &Problem<'_>) -> Result<&Array> {
        Ok(&self.x)
    }

    fn take(self: Box<Self>, _: &Problem<'_>) -> Result<Array> {
        Ok(self.x)
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        let Self { x, residual, direction, .. } = self;
        let all = [("x", x), ("residual", residual), ("direction", direction)];
        all.map(|(name, x)| (name.to_owned(), StatePart::Placed(x))).into()
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.gamma]
    }
}
