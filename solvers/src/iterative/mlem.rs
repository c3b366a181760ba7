//! MLEM: `x ← x·A_sᵀ(p_s/(A_s·x))/A_sᵀ1` over subsets s of the views (Shepp and Vardi, IEEE Trans. Med. Imaging 1(2),
//! 1982; ordered subsets as OSEM, Hudson and Larkin, IEEE Trans. Med. Imaging 13(4), 1994). It maximizes the likelihood
//! of line integrals with Poisson's distribution. Those of a CT scan do not have it, but the update is multiplicative:
//! attenuation stays positive, and errors are relative.

use super::norms::change;
use super::order::{Order, Subsets};
use super::plan::{Iterative, IterativePlan};
use super::problem::{copy, room};
use super::sart::column_sums;
use super::shared::Shared;
use super::{Iteration, Pass, Problem, Stop, drive::drive};
use conefield_core::data_term::Misfit;
use conefield_core::error::{Result, ensure};
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Method, Observer, Plan, Solution};
use conefield_core::place::{Array, Bounds, CLIP, MULTIPLY, RELAX, Reduction, StatePart};
use conefield_core::scan::ScanHeader;
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::VoxelProjectorSpec;
use conefield_core::wgsl::Fragment;
use conefield_projectors::voxel::Joseph;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `mlem`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Mlem {
    /// Voxel projector.
    #[schemars(schema_with = "stage::schema::<dyn VoxelProjectorSpec>")]
    pub projector: Box<dyn VoxelProjectorSpec>,
    /// Support of the object, and attenuation beyond the volume.
    pub scene: VoxelScene,
    /// File of a known volume to start from. Voxels below a thousandth of the uniform start are raised to it: a voxel of 0
    /// would stay 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<InputFile>,
    /// Stopping criteria.
    pub stop: Stop,
    /// Number of ordered subsets of the views, or "views" for one view at a time. 1 is MLEM, more is OSEM.
    pub subsets: Subsets,
    /// Order of the subsets.
    pub order: Order,
}

impl Default for Mlem {
    fn default() -> Self {
        Self {
            projector: Box::new(Joseph {}),
            scene: VoxelScene::default(),
            start: None,
            stop: Stop::after(20),
            subsets: Subsets::Count(10),
            order: Order::Golden,
        }
    }
}

conefield_core::stage_type!(Method, "mlem", Mlem, "maximum likelihood by expectation maximization, in ordered subsets");

impl Method for Mlem {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        self.subsets.validate()?;
        let shared = Shared::of(self.projector.as_ref(), &self.scene, &self.start, &self.stop)?;
        Ok(Box::new(IterativePlan(MlemMethod { shared, subsets: self.subsets, order: self.order })))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

/// The stages that [`Mlem`] builds.
struct MlemMethod {
    shared: Shared,
    subsets: Subsets,
    order: Order,
}

impl MlemMethod {
    fn iterate(&self, space: &Space, x: Array) -> Result<MlemIterate> {
        let views = space.header().views;
        Ok(MlemIterate {
            subsets: self.subsets.of(views),
            order: self.order,
            likelihood: Likelihood { least: 0.0 },
            x,
            columns: space.volume()?,
            work: space.volume()?,
            pixels: room(space, self.subsets.count(views))?,
            before: self.shared.stop.change.map(|_| space.volume()).transpose()?,
        })
    }
}

impl Iterative for MlemMethod {
    fn kind(&self) -> &'static str {
        "mlem"
    }

    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = self.shared.open(self, job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        let space = opened.space(job.scan.header());
        let mut iterate = self.iterate(&space, self.shared.known(job, &space)?)?;
        iterate.prepare(&problem, self.shared.has_start(job))?;
        problem.settle()?;
        drive(job, &self.shared.stop, begun, &problem, &space, Box::new(iterate), observer)
    }

    fn subsets(&self) -> Subsets {
        self.subsets
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let space = Space::tally(*header);
        let _ = space.volume().and_then(|x| self.iterate(&space, x));
        self.shared.price(&space, self.subsets)
    }

    fn describe(&self) -> String {
        format!("mlem: {}", self.subsets)
    }
}

/// Share of the uniform start to which voxels of a known volume are raised.
const RAISED: f64 = 1e-3;

struct MlemIterate {
    subsets: Vec<Vec<usize>>,
    order: Order,
    likelihood: Likelihood,
    x: Array,
    /// Inverse column sums of the current subset.
    columns: Array,
    /// Working memory, free between passes.
    work: Array,
    /// The pixels of a subset.
    pixels: Array,
    /// The volume before a pass, if its change is needed.
    before: Option<Array>,
}

impl MlemIterate {
    /// Makes the start positive inside the object's support, and computes the sums that do not change.
    fn prepare(&mut self, problem: &Problem<'_>, known: bool) -> Result<()> {
        let place = problem.place;
        problem.ones(&mut self.work)?;
        let mut longest = 0.0f64;
        for views in &self.subsets {
            problem.forward(views, &self.work, &mut self.pixels)?;
            longest = longest.max(place.reduce(Reduction::Maximum, &self.pixels, &self.pixels)?);
        }
        ensure(longest > 0.0, "scan", "geometry", "rays that all miss the object's support", "rays through it")?;
        let top = f64::from(problem.scan.projections.iter().fold(0.0f32, |m, p| m.max(*p)));
        // The first update has the same result for a uniform start of any size.
        let uniform = if top > 0.0 { top / longest } else { 0.0 };
        if known {
            place.map(&CLIP, [RAISED * uniform, f64::from(f32::MAX)], &mut self.x, &[])?;
        } else {
            place.fill(&mut self.x, uniform as f32)?;
        }
        problem.outside(&mut self.x, 0.0)?;
        self.likelihood.least = (1e-6 * top) as f32;
        match &self.subsets[..] {
            [all] => column_sums(problem, all, &mut self.pixels, &mut self.columns),
            _ => Ok(()),
        }
    }

    /// Processes one subset. Returns `‖p − A·x‖²`.
    fn update(&mut self, problem: &Problem<'_>, subset: usize) -> Result<f64> {
        let (views, place) = (&self.subsets[subset], problem.place);
        problem.forward(views, &self.x, &mut self.pixels)?;
        let [square, _] = place.compare(&problem.by(Some(&self.likelihood), None), views, &mut self.pixels)?;
        problem.back(views, &self.pixels, &mut self.work)?;
        if self.subsets.len() > 1 {
            column_sums(problem, views, &mut self.pixels, &mut self.columns)?;
        }
        let bounds = Bounds { low: problem.bounds.low.max(0.0), ..problem.bounds };
        place.map(&MULTIPLY, [1.0, 0.0], &mut self.work, &[&self.x])?;
        place.map(&RELAX, [1.0, 0.0], &mut self.x, &[&self.columns, &self.work])?;
        if bounds != Bounds::default() || !problem.regions.is_empty() {
            problem.clip(&mut self.x, bounds)?;
            problem.outside(&mut self.x, 0.0)?;
        }
        Ok(square)
    }
}

impl Iteration for MlemIterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        if let Some(before) = &mut self.before {
            copy(problem.place, &self.x, before)?;
        }
        let mut residual = 0.0;
        for s in self.order.of(self.subsets.len(), problem.seed, pass) {
            residual += self.update(problem, s)?;
        }
        let change = self.before.as_ref().map(|before| change(problem.place, &self.x, before)).transpose()?;
        Ok(Pass { residual, change, prior: None })
    }

    fn volume(&mut self, _: &Problem<'_>) -> Result<&Array> {
        Ok(&self.x)
    }

    fn take(self: Box<Self>, _: &Problem<'_>) -> Result<Array> {
        Ok(self.x)
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        vec![("x".into(), StatePart::Placed(&mut self.x))]
    }
}

/// The negative logarithm of Poisson's likelihood, less its minimum: `p·ln(p/a) − p + a` for a line integral a. Its
/// derivative by the residual `r = p − a` is `r/a`: back-projected, it is MLEM's update. Rays of at most `least` count as
/// missing the object.
struct Likelihood {
    least: f32,
}

impl Misfit for Likelihood {
    fn differentiate(&self, _: usize, measured: &[f32], residuals: &mut [f32]) -> f64 {
        let mut sum = 0.0;
        for (r, p) in residuals.iter_mut().zip(measured) {
            let a = *p - *r;
            if a <= self.least {
                *r = 0.0;
                continue;
            }
            let p = f64::from(p.max(0.0));
            let logarithm = if p > 0.0 { p * (p / f64::from(a)).ln() } else { 0.0 };
            sum += logarithm - p + f64::from(a);
            *r /= a;
        }
        sum
    }

    /// Multiplies by φ'' where the line integral is the measured one. MLEM's step does not depend on it.
    fn curve(&self, _: usize, measured: &[f32], values: &mut [f32]) {
        values.iter_mut().zip(measured).for_each(|(x, p)| *x /= p.max(self.least));
    }

    fn spread(&self, _: usize, measured: &[f32], values: &mut [f32]) {
        values.iter_mut().zip(measured).for_each(|(x, p)| *x /= p.max(self.least).sqrt());
    }

    fn wgsl(&self) -> Option<Fragment> {
        let least = format!("const stage_least: f32 = {:?};", self.least);
        Some(Fragment::new(&[&least, include_str!("mlem.wgsl")]))
    }

    fn noise(&self) -> f64 {
        1.0
    }

    fn describe(&self) -> String {
        "Poisson's likelihood of the line integrals".into()
    }
}
