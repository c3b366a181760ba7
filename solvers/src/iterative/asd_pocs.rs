//! ASD-POCS (Sidky and Pan, Phys. Med. Biol. 53(17), 2008): a pass of ordered-subset SART towards the data, then steps
//! of steepest descent on total variation, whose length depends on the change of the data pass.

use super::noise::{self, Noise};
use super::norms::{change, distance, norm2};
use super::order::{Order, Subsets};
use super::plan::{Iterative, IterativePlan};
use super::problem::copy;
use super::sart::{Sweep, Updates};
use super::shared::Shared;
use super::tv::{anisotropy, descend};
use super::{Iteration, Pass, Problem, Stop, drive::drive};
use conefield_core::error::Result;
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Method, Observer, Plan, Solution};
use conefield_core::place::{Array, StatePart};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_projectors::voxel::Joseph;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `asd-pocs`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AsdPocs {
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
    /// Number of ordered subsets of the views, or "views" for one view at a time.
    pub subsets: Subsets,
    /// Descent steps per pass.
    pub descents: usize,
}

impl Default for AsdPocs {
    fn default() -> Self {
        Self {
            projector: Box::new(Joseph {}),
            scene: VoxelScene::default(),
            start: None,
            stop: Stop::after(20),
            subsets: Subsets::Count(50),
            descents: 20,
        }
    }
}

/// Relaxation of the data passes, and its factor after each pass.
const RELAXATION: f64 = 1.0;
const DECAY: f64 = 0.97;
/// Length of the first descent steps relative to the change of the first data pass.
const ALPHA: f64 = 0.05;
/// Factor of the step length, applied while the descent steps change more than [`RATIO`] of the data pass and the
/// residual exceeds what the scan's noise explains.
const ALPHA_DECAY: f64 = 0.95;
const RATIO: f64 = 0.95;

conefield_core::stage_type!(Method, "asd-pocs", AsdPocs, "alternates data passes and total-variation descent");

impl Method for AsdPocs {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        Ok(Box::new(IterativePlan(self.built()?)))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

impl AsdPocs {
    fn built(&self) -> Result<AsdPocsMethod> {
        let (subsets, order) = (self.subsets, Order::Golden);
        let updates = Updates { subsets, relaxation: RELAXATION, decay: DECAY, order, nonnegative: true };
        updates.validate()?;
        let shared = Shared::of(self.projector.as_ref(), &self.scene, &self.start, &self.stop)?;
        Ok(AsdPocsMethod { shared, updates, descents: self.descents })
    }
}

/// The stages that [`AsdPocs`] builds.
struct AsdPocsMethod {
    shared: Shared,
    updates: Updates,
    descents: usize,
}

impl Iterative for AsdPocsMethod {
    fn kind(&self) -> &'static str {
        "asd-pocs"
    }

    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = self.shared.open(self, job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        let sigma = Noise::of(job.scan.projections.view(), false).sigma;
        let space = opened.space(job.scan.header());
        let mut iterate = AsdPocsIterate::new(self, &space, self.shared.start(job, &problem, &space)?)?;
        iterate.target = sigma * (job.scan.projections.len() as f64).sqrt();
        iterate.sweep.prepare(&problem)?;
        problem.settle()?;
        drive(job, &self.shared.stop, begun, &problem, &space, Box::new(iterate), observer)
    }

    fn subsets(&self) -> Subsets {
        self.updates.subsets
    }

    fn found(&self, scan: &Scan) -> Vec<String> {
        vec![Noise::of(scan.projections.view(), false).to_string()]
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        space.pass(noise::scratch(header));
        let _ = space.volume().and_then(|x| AsdPocsIterate::new(self, &space, x));
        self.shared.price(&space, self.updates.subsets)
    }

    fn describe(&self) -> String {
        format!("asd-pocs: {}, {} descents per pass", self.updates.subsets, self.descents)
    }
}

struct AsdPocsIterate {
    descents: usize,
    sweep: Sweep,
    /// Norm of a residual of pure noise.
    target: f64,
    /// Length of a descent step.
    length: f64,
    /// The volume before a pass.
    before: Array,
    /// The volume after the data pass.
    fitted: Array,
}

impl AsdPocsIterate {
    fn new(built: &AsdPocsMethod, space: &Space, x: Array) -> Result<Self> {
        Ok(Self {
            descents: built.descents,
            sweep: Sweep::new(built.updates, space, x)?,
            target: 0.0,
            length: 0.0,
            before: space.volume()?,
            fitted: space.volume()?,
        })
    }
}

impl Iteration for AsdPocsIterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        let (grid, place) = (&problem.scan.geometry.volume, problem.place);
        copy(place, &self.sweep.x, &mut self.before)?;
        let residual = self.sweep.sweep(problem, pass)?;
        let data = distance(place, &self.sweep.x, &self.before)?;
        if pass == 0 {
            self.length = ALPHA * data / self.descents.max(1) as f64;
        }
        copy(place, &self.sweep.x, &mut self.fitted)?;
        let mean = (norm2(place, &self.fitted)? / self.fitted.len() as f64).sqrt();
        for _ in 0..self.descents {
            descend(place, &mut self.sweep.x, anisotropy(grid), self.length, 1e-3 * mean as f32, &mut self.sweep.work)?;
            problem.outside(&mut self.sweep.x, 0.0)?;
        }
        self.sweep.confine(problem)?;
        let prior = distance(place, &self.sweep.x, &self.fitted)?;
        if prior > RATIO * data && residual.sqrt() > self.target {
            self.length *= ALPHA_DECAY;
        }
        Ok(Pass { residual, change: Some(change(place, &self.sweep.x, &self.before)?), prior: None })
    }

    fn volume(&mut self, _: &Problem<'_>) -> Result<&Array> {
        Ok(&self.sweep.x)
    }

    fn take(self: Box<Self>, _: &Problem<'_>) -> Result<Array> {
        Ok(self.sweep.x)
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        vec![("x".into(), StatePart::Placed(&mut self.sweep.x))]
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.length]
    }
}
