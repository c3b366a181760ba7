//! Ordered-subset FISTA: `min_{x ≥ 0} D(p − A·B·x) + λ·R(x)` with any basis B, data term D and prior R (Beck and
//! Teboulle, SIAM J. Imaging Sci. 2(1), 2009; ordered subsets with momentum as in Kim, Ramani and Fessler, IEEE Trans.
//! Med. Imaging 34(1), 2015).
//!
//! With n subsets the step is `1/L`, with L slightly above the largest eigenvalue of every `n·(A_s·B)ᵀW(A_s·B)` and W
//! the largest curvature of the data term. L comes from a few power iterations, each on another subset: line integrals
//! of a smooth volume hardly depend on the views, so few subsets represent all.
//!
//! Subsets and unbounded momentum are incompatible: momentum amplifies the difference between one subset's gradient and
//! the full one, and the iterates diverge. FISTA's t is therefore bounded. After a pass that increases the objective,
//! pairs of subsets are merged, down to plain FISTA, which converges.

use super::bases::Voxels;
use super::data::NoiseWeighted;
use super::model::{Model, projected};
use super::norms::{change, distance, norm2};
use super::order::{Order, Subsets, split, summary};
use super::plan::{Iterative, IterativePlan};
use super::problem::{images, images_mut, room};
use super::regularizers::Nonnegative;
use super::shared::Shared;
use super::{Iteration, Pass, Problem, Stop, drive::drive, flat, flat_mut};
use conefield_core::Error;
use conefield_core::basis::{Basis, BasisSpec, Expansion};
use conefield_core::data_term::{DataTerm, DataTermSpec, Misfit};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::input_file::InputFile;
use conefield_core::method::StartFile;
use conefield_core::method::{Context, Job, Line, Method, Observer, Plan, Solution};
use conefield_core::random::stream;
use conefield_core::regularizer::{Penalty, Regularizer, RegularizerSpec, Update};
use conefield_core::resident::{Factors, Resident, Volumes};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::VoxelScene;
use conefield_core::space::Space;
use conefield_core::spec::stage;
use conefield_core::voxel::{VoxelProjector, VoxelProjectorSpec};
use conefield_projectors::voxel::Joseph;
use ndarray::{Array3, Axis, Zip};
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of `fista`.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Fista {
    /// Voxel projector.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn VoxelProjectorSpec>")]
    pub projector: Box<dyn VoxelProjectorSpec>,
    /// Basis of the volume.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn BasisSpec>")]
    pub basis: Box<dyn BasisSpec>,
    /// Data term: misfit between computed and measured line integrals.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn DataTermSpec>")]
    pub data: Box<dyn DataTermSpec>,
    /// Regularizer of the volume.
    #[serde(deserialize_with = "stage::needed")]
    #[schemars(schema_with = "stage::schema::<dyn RegularizerSpec>")]
    pub prior: Box<dyn RegularizerSpec>,
    /// Support of the object, and attenuation beyond the volume.
    pub scene: VoxelScene,
    /// File of a known volume to start from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<InputFile>,
    /// Stopping criteria.
    pub stop: Stop,
    /// Set pixels outside the object's shadow to 0, whatever noise they have. If negative values were clipped, noise
    /// has a mean above 0, which causes a haze around the object.
    pub air: bool,
    /// Average this many detector rows and columns to one pixel.
    pub bin: usize,
    /// Number of ordered subsets of the views, or "views" for one view at a time.
    pub subsets: Subsets,
    /// Order of the subsets.
    pub order: Order,
    /// Strength of the pull towards the start volume: the weight μ of a third term `½μ‖x − x₀‖²`, relative to the
    /// largest eigenvalue L of the data term. With 0, the volume is only the start.
    pub pull: f64,
}

impl Default for Fista {
    fn default() -> Self {
        Self {
            projector: Box::new(Joseph {}),
            basis: Box::new(Voxels {}),
            data: Box::new(NoiseWeighted {}),
            prior: Box::new(Nonnegative {}),
            scene: VoxelScene::default(),
            start: None,
            stop: Stop { change: Some(1e-3), ..Stop::after(16) },
            air: true,
            bin: 1,
            subsets: Subsets::Count(10),
            order: Order::Golden,
            pull: 0.0,
        }
    }
}

/// Bound of FISTA's t, to be divided by the number of subsets. On 50 views of abdomen_128 with 10 subsets, 100, 200 and
/// 400 gave 34.2, 34.5 and 34.7 dB after 15 passes.
const MOMENTUM: f64 = 400.0;

conefield_core::stage_type!(Method, "fista", Fista, "ordered-subset FISTA with any basis, data term and prior");

#[typetag::serde(name = "fista")]
impl Method for Fista {
    fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
        Ok(Box::new(IterativePlan(self.built()?)))
    }

    fn start_setting(&self, file: &StartFile) -> Option<(String, serde_json::Value)> {
        file.as_volume()
    }
}

impl Fista {
    /// Bytes for a scan of this size, besides the resulting volume.
    pub(crate) fn bytes(&self, scan: &ScanHeader) -> u64 {
        self.built().map_or(0, |built| Iterative::bytes(&built, scan))
    }

    /// Reconstructs without a plan.
    pub(crate) fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        self.built()?.solve(job, observer)
    }

    fn built(&self) -> Result<Built> {
        self.subsets.validate()?;
        let pull = self.pull;
        ensure(pull.is_finite() && pull >= 0.0, "spec", "pull", pull, "a finite number, 0 or more")?;
        ensure((1..=64).contains(&self.bin), "spec", "bin", self.bin, "1 to 64")?;
        Ok(Built {
            shared: Shared::of(self.projector.as_ref(), self.scene, &self.start, &self.stop)?,
            basis: self.basis.build().map_err(|e| e.within("basis"))?,
            data: self.data.build().map_err(|e| e.within("data"))?,
            prior: self.prior.build().map_err(|e| e.within("prior"))?,
            kinds: [self.basis.typetag_name(), self.data.typetag_name(), self.prior.typetag_name()],
            air: self.air,
            bin: self.bin,
            subsets: self.subsets,
            order: self.order,
            pull,
        })
    }
}

/// The stages that [`Fista`] builds.
struct Built {
    shared: Shared,
    basis: Box<dyn Basis>,
    data: Box<dyn DataTerm>,
    prior: Box<dyn Regularizer>,
    /// The type names of basis, data term and prior.
    kinds: [&'static str; 3],
    air: bool,
    bin: usize,
    subsets: Subsets,
    order: Order,
    pull: f64,
}

impl Built {
    /// The basis on voxels of any size; `None` if it refuses the grid.
    fn expansion(&self, volume: [usize; 3]) -> Option<(Box<dyn Expansion>, VoxelGrid)> {
        let grid = VoxelGrid { shape: volume, spacing: [1.0; 3], center: [0.0; 3] };
        Some((self.basis.on(&grid).ok()?, grid))
    }
}

impl Iterative for Built {
    fn kind(&self) -> &'static str {
        "fista"
    }

    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        if self.pull > 0.0 && !self.shared.has_start(job) {
            let expected = "0, or a volume to start from and pull towards";
            return Err(Error::invalid("spec", "pull", self.pull, expected));
        }
        let stages = [self.data.describe(), self.prior.describe(), self.basis.describe()].join("; ");
        let voxels = job.scan.geometry.volume;
        let expansion = self.basis.on(&voxels).map_err(|e| e.within("basis"))?;
        let longest = job.scan.geometry.detector[0].max(job.scan.geometry.detector[1]);
        let room = format!("at most {longest}, the detector's longer side");
        ensure(self.bin <= longest, "spec", "bin", self.bin, room)?;
        let grid = projected(expansion.as_ref(), voxels);
        let opened = self.shared.open_on(grid, self.bin, &format!("{}; {stages}", self.describe()), job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        if self.air {
            problem.clear_air();
            let air = 100.0 * problem.air_share();
            observer.note(&format!("{air:.0} % of the pixels are air (views binned by {})", self.bin));
        }
        let data = self.data.of(problem.scan.projections.view()).map_err(|e| e.within("data"))?;
        let space = Space::new(job.scan.header().binned(self.bin));
        let start = self.shared.known(job, &space)?;
        let mut arrays = Arrays::new(self, expansion, &voxels, &space, start)?;
        arrays.begin(&problem);
        let mut iterate = Iterate::new(self, &problem, data, arrays, opened.projector())?;
        observer.note(&iterate.description());
        iterate.settle(&problem, observer);
        drive(job, &self.shared.stop, begun, &problem, &space, &mut iterate, observer)
    }

    fn found(&self, scan: &Scan) -> Vec<String> {
        let noise = self.data.of(scan.projections.view());
        vec![
            summary(&self.subsets.of(scan.geometry.views.len())),
            noise.map_or_else(|e| e.to_string(), |n| n.describe()),
        ]
    }

    fn stages(&self) -> Vec<Line> {
        let [basis, data, prior] = self.kinds;
        vec![
            Line::new("basis", basis, &self.basis.describe()),
            Line::new("data", data, &self.data.describe()),
            Line::new("prior", prior, &self.prior.describe()),
        ]
    }

    fn seen(&self, header: &ScanHeader) -> ScanHeader {
        let volume = self.expansion(header.volume).map_or(header.volume, |(e, grid)| projected(e.as_ref(), grid).shape);
        ScanHeader { volume, ..header.binned(self.bin) }
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let header = &header.binned(self.bin);
        let space = Space::tally(*header);
        if self.air {
            space.hold(Problem::air_bytes(header));
        }
        if self.bin > 1 {
            space.hold(4 * header.pixels());
        }
        space.hold(self.data.held(header));
        space.pass(self.data.scratch(header));
        // If a stage refuses the grid, the run is refused and needs no memory.
        if let Some((expansion, grid)) = self.expansion(header.volume) {
            let _ = Arrays::new(self, expansion, &grid, &space, space.volume());
        }
        self.shared.price(&space, self.subsets)
    }

    fn describe(&self) -> String {
        let held = if self.pull > 0.0 { format!(", pull {} to a volume", self.pull) } else { String::new() };
        format!("fista: {}{held}", self.subsets)
    }
}

/// FISTA's working memory.
struct Arrays {
    model: Model,
    penalty: Box<dyn Penalty>,
    x: Array3<f32>,
    /// The extrapolated point, at which the next gradient is computed.
    ahead: Array3<f32>,
    gradient: Array3<f32>,
    /// The coefficients before a pass.
    before: Array3<f32>,
    /// The target of the pull, if there is one.
    towards: Option<Array3<f32>>,
    /// The pixels of a subset. After subsets have been merged, their views are processed in parts.
    pixels: Array3<f32>,
    /// The volumes on a device, which are then newer than `ahead` and the penalty's state here.
    resident: Option<Box<dyn Resident>>,
}

/// The callback of [`Arrays::part_by_part`]: computes images of some views for back-projection.
type Images<'a> = &'a mut dyn FnMut(&mut Model, &[usize], &mut Array3<f32>);

impl Arrays {
    /// Arrays for a volume on the grid `voxels`, initially `start`.
    fn new(
        settings: &Built,
        expansion: Box<dyn Expansion>,
        voxels: &VoxelGrid,
        space: &Space,
        start: Array3<f32>,
    ) -> Result<Self> {
        let (model, x) = Model::new(expansion, voxels, space, start);
        let grid = model.grid();
        let coefficients = || space.array(grid.shape);
        Ok(Self {
            model,
            penalty: settings.prior.on(&grid, space).map_err(|e| e.within("prior"))?,
            x,
            ahead: coefficients(),
            gradient: coefficients(),
            before: coefficients(),
            towards: (settings.pull > 0.0).then(coefficients),
            pixels: room(space, settings.subsets.count(space.header().views)),
            resident: None,
        })
    }

    /// Takes the volumes to the projector's device, if it has one.
    fn settle(&mut self, problem: &Problem<'_>, projector: &dyn VoxelProjector) -> Option<Result<()>> {
        if !self.model.projects_coefficients() {
            return None;
        }
        let Self { model, penalty, x, ahead, towards, .. } = self;
        let shape = x.dim().into();
        let (inside, towards) = (model.inside(problem), towards.as_ref().map(flat));
        let volumes = Volumes { shape, x: flat(x), ahead: flat(ahead), towards, inside, dual: penalty.dual() };
        let placed = projector.resident(volumes)?;
        Some(placed.map(|resident| self.resident = Some(resident)))
    }

    /// Overwrites the gradient with that of the data term at `ahead`. Returns `‖p − A·x‖²` and the data term.
    fn differentiate(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> Result<[f64; 2]> {
        let (mut residual, mut misfit) = (0.0, 0.0);
        let mut differentiate = |views: &[usize], pixels: &mut Array3<f32>| {
            residual += problem.subtract(views, pixels);
            let misfits = problem.each_image(views, pixels, |view, measured, r| data.differentiate(view, measured, r));
            misfit += misfits.iter().sum::<f64>();
        };
        if let Some(resident) = &mut self.resident {
            for part in views.chunks(self.pixels.len_of(Axis(0)).max(1)) {
                resident.forward(problem.geometry, part, images_mut(&mut self.pixels, part.len()))?;
                differentiate(part, &mut self.pixels);
                resident.adjoint(problem.geometry, part, images(&self.pixels, part.len()))?;
            }
            return Ok([residual, misfit]);
        }
        let ahead = std::mem::take(&mut self.ahead);
        self.part_by_part(problem, views, &mut |model, views, pixels| {
            model.forward(problem, views, &ahead, pixels);
            differentiate(views, pixels);
        });
        self.ahead = ahead;
        Ok([residual, misfit])
    }

    /// Makes an update with the gradient.
    fn update(&mut self, problem: &Problem<'_>, factors: Factors) -> Result<()> {
        if let Some(resident) = &mut self.resident {
            return resident.update(factors);
        }
        let Self { model, penalty, x, ahead, gradient, towards, .. } = self;
        let update = Update {
            gradient: flat_mut(gradient),
            ahead: flat_mut(ahead),
            x: flat_mut(x),
            step: factors.step,
            momentum: factors.momentum,
            towards: towards.as_ref().map(|towards| (flat(towards), factors.pull)),
            inside: model.inside(problem),
        };
        penalty.update(update, factors.tau);
        Ok(())
    }

    /// Adapts the penalty to the coefficients before a pass. Returns its value if it changed.
    fn adapt(&mut self) -> Result<Option<f64>> {
        let value = self.penalty.adapt(self.x.view());
        if let (Some(_), Some(resident)) = (value, &mut self.resident)
            && let Some(guide) = self.penalty.dual().and_then(|dual| dual.guide)
        {
            resident.guide(guide)?;
        }
        Ok(value)
    }

    /// Brings the state here up to date, and gives up the volumes on the device.
    fn unsettle(&mut self) -> Result<()> {
        match (self.resident.take(), self.penalty.dual()) {
            (Some(mut resident), Some(dual)) => resident.rest(flat_mut(&mut self.ahead), dual.p),
            _ => Ok(()),
        }
    }

    /// Clears coefficients outside the object's support and restarts from the rest.
    fn begin(&mut self, problem: &Problem<'_>) {
        self.model.prepare(problem, &mut self.gradient);
        self.model.outside(problem, &mut self.x, 0.0);
        for copy in [Some(&mut self.ahead), self.towards.as_mut()].into_iter().flatten() {
            copy.assign(&self.x);
        }
    }

    /// Overwrites `gradient` with the adjoint of the images that `images` computes for `views`, in parts that fit the
    /// buffer.
    fn part_by_part(&mut self, problem: &Problem<'_>, views: &[usize], images: Images<'_>) {
        let Self { model, gradient, pixels, .. } = self;
        gradient.par_mapv_inplace(|_| 0.0);
        for part in views.chunks(pixels.len_of(Axis(0)).max(1)) {
            images(model, part, pixels);
            model.back(problem, part, pixels, gradient);
        }
        model.outside(problem, gradient, 0.0);
    }

    /// Root mean square of `(A·B)ᵀ·n` over the coefficients that rays meet, for noise n as `data` spreads it; computed
    /// from `views` and scaled to all views.
    fn noise_gain(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> f64 {
        let mut rng = stream(problem.seed ^ 0x0000_7e57_0015_e000, 0);
        self.part_by_part(problem, views, &mut |_, views, pixels| {
            let mut signs = images_mut(pixels, views.len());
            signs.iter_mut().for_each(|sign| *sign = if rng.random::<bool>() { 1.0 } else { -1.0 });
            problem.each_image(views, pixels, |view, measured, signs| data.spread(view, measured, signs));
        });
        let met = self.gradient.iter().filter(|x| **x != 0.0).count();
        let all = problem.geometry.views.len() as f64 / views.len().max(1) as f64;
        (all * norm2(&self.gradient) / met.max(1) as f64).sqrt()
    }

    /// An upper bound for the largest eigenvalue of `n·(A_s·B)ᵀW(A_s·B)` over n subsets, W the curvature of `data`.
    /// Uses `before` as working memory.
    fn largest_eigenvalue(&mut self, problem: &Problem<'_>, data: &dyn Misfit, subsets: &[Vec<usize>]) -> f64 {
        let Some(first) = subsets.first() else { return 0.0 };
        self.before.fill(1.0);
        self.model.outside(problem, &mut self.before, 0.0);
        self.curved(problem, data, first);
        let mut worst = 0.0f64;
        for probe in 0..PROBES {
            let size = norm2(&self.gradient).sqrt();
            if size == 0.0 {
                return 0.0;
            }
            Zip::from(&mut self.before).and(&self.gradient).par_for_each(|v, g| *v = (f64::from(*g) / size) as f32);
            self.model.outside(problem, &mut self.before, 0.0);
            self.curved(problem, data, &subsets[probe * subsets.len() / PROBES]);
            worst = worst.max(norm2(&self.gradient).sqrt());
        }
        SAFETY * subsets.len() as f64 * worst
    }

    /// Overwrites `gradient` with `(A_s·B)ᵀW(A_s·B)·v`, v in `before`.
    fn curved(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) {
        let v = std::mem::take(&mut self.before);
        self.part_by_part(problem, views, &mut |model, views, pixels| {
            model.forward(problem, views, &v, pixels);
            problem.each_image(views, pixels, |view, measured, values| data.curve(view, measured, values));
        });
        self.before = v;
    }
}

/// Number of subsets for the power iteration, and the safety factor on the eigenvalue found.
const PROBES: usize = 3;
const SAFETY: f64 = 1.15;

struct Iterate<'a> {
    arrays: Arrays,
    projector: &'a dyn VoxelProjector,
    /// Whether the volumes stay on a device.
    resides: bool,
    data: Box<dyn Misfit>,
    views: usize,
    /// Current number of subsets.
    subsets: f64,
    order: Order,
    /// λ in mm.
    lambda: f64,
    /// L, including the pull.
    lipschitz: f64,
    /// Factor by which the pull increases L.
    pulled: f64,
    /// Share of the pull in a step.
    pull: f32,
    /// FISTA's t.
    t: f64,
    /// The last pass's objective, and its part without the prior.
    objective: f64,
    misfit: f64,
}

impl<'a> Iterate<'a> {
    fn new(
        settings: &Built,
        problem: &Problem<'_>,
        data: Box<dyn Misfit>,
        mut arrays: Arrays,
        projector: &'a dyn VoxelProjector,
    ) -> Result<Self> {
        let views = problem.scan.geometry.views.len();
        let subsets = settings.subsets.of(views);
        let grid = arrays.model.grid();
        let lambda = settings
            .prior
            .weight(&grid, &mut |k| k * data.noise() * arrays.noise_gain(problem, data.as_ref(), &subsets[0]))
            .map_err(|e| e.within("prior"))?;
        let lipschitz = arrays.largest_eigenvalue(problem, data.as_ref(), &subsets);
        arrays.model.fault()?;
        data.fault()?;
        ensure(lipschitz > 0.0, "scan", "geometry", "rays that all miss the volume", "rays through the volume")?;
        Ok(Self {
            arrays,
            projector,
            resides: false,
            data,
            views,
            subsets: subsets.len() as f64,
            order: settings.order,
            lambda,
            lipschitz: lipschitz * (1.0 + settings.pull),
            pulled: 1.0 + settings.pull,
            pull: (settings.pull / (1.0 + settings.pull)) as f32,
            t: 1.0,
            objective: f64::INFINITY,
            misfit: f64::INFINITY,
        })
    }

    /// The noise and the prior's weight, for attenuation counted per coefficient.
    fn description(&self) -> String {
        let side = self.arrays.model.grid().spacing.iter().product::<f64>().cbrt();
        format!("{}: the prior's weight is {:.3e}", self.data.describe(), self.lambda / side)
    }

    /// Takes the volumes to the projector's device, if it has one; otherwise they travel to it for each projection.
    fn settle(&mut self, problem: &Problem<'_>, observer: &mut dyn Observer) {
        match self.arrays.settle(problem, self.projector) {
            None => {}
            Some(Ok(())) => {
                self.resides = true;
                observer.note("the volumes stay on the device");
            }
            Some(Err(why)) => {
                observer.note(&format!("the volumes are copied to the device for each projection: {why}"))
            }
        }
    }

    /// Processes one subset: a gradient step and the prior's proximal map. Returns `‖p − A·x‖²` and the data term.
    fn update(&mut self, problem: &Problem<'_>, views: &[usize]) -> Result<[f64; 2]> {
        let misfits = self.arrays.differentiate(problem, self.data.as_ref(), views)?;
        let t = 0.5 * (1.0 + (1.0 + 4.0 * self.t * self.t).sqrt());
        let momentum = ((self.t - 1.0) / t) as f32;
        self.t = t.min((MOMENTUM / self.subsets).max(1.0));
        let (step, tau) = ((self.subsets / self.lipschitz) as f32, (self.lambda / self.lipschitz) as f32);
        self.arrays.update(problem, Factors { step, momentum, pull: self.pull, tau })?;
        Ok(misfits)
    }
}

impl Iteration for Iterate<'_> {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        Zip::from(&mut self.arrays.before).and(&self.arrays.x).par_for_each(|before, x| *before = *x);
        // A changed penalty must not count as progress or regress.
        if let Some(value) = self.arrays.adapt()? {
            self.objective = self.misfit + self.lambda * value;
        }
        // After a checkpoint.
        if self.resides && self.arrays.resident.is_none() {
            self.arrays.settle(problem, self.projector).transpose()?;
        }
        let (mut residual, mut misfit) = (0.0, 0.0);
        let subsets = split(self.views, self.subsets as usize);
        for s in self.order.of(subsets.len(), problem.seed, pass) {
            let [r, m] = self.update(problem, &subsets[s])?;
            residual += r;
            misfit += m;
        }
        if let Some(resident) = &mut self.arrays.resident {
            resident.coefficients(flat_mut(&mut self.arrays.x))?;
        }
        let Arrays { penalty, x, before, towards, .. } = &self.arrays;
        let change = change(x, before);
        let prior = self.lambda * penalty.value(x.view());
        let held = |towards: &Array3<f32>| 0.5 * f64::from(self.pull) * self.lipschitz * distance(x, towards).powi(2);
        self.misfit = misfit + towards.as_ref().map_or(0.0, held);
        let objective = self.misfit + prior;
        if objective > self.objective {
            let fewer = (0.5 * self.subsets).ceil();
            // For unions of the previous subsets their bound still holds.
            if self.subsets % fewer != 0.0 {
                let fewer = split(self.views, fewer as usize);
                self.lipschitz = self.pulled * self.arrays.largest_eigenvalue(problem, self.data.as_ref(), &fewer);
            }
            self.subsets = fewer;
        }
        self.objective = objective;
        Ok(Pass { residual, change: Some(change), prior: Some(prior) })
    }

    fn volume(&mut self, problem: &Problem<'_>) -> &Array3<f32> {
        self.arrays.model.volume(problem, &self.arrays.x)
    }

    fn take(&mut self, problem: &Problem<'_>) -> Array3<f32> {
        let x = std::mem::take(&mut self.arrays.x);
        self.arrays.model.take(problem, x)
    }

    fn fault(&self) -> Result<()> {
        self.arrays.model.fault()?;
        self.arrays.penalty.fault()?;
        self.data.fault()
    }

    fn state(&mut self) -> Result<Vec<(String, &mut [f32])>> {
        self.arrays.unsettle()?;
        let own = [("x", &mut self.arrays.x), ("ahead", &mut self.arrays.ahead)];
        let own = own.map(|(name, x)| (name.to_owned(), flat_mut(x)));
        let prior = self.arrays.penalty.state().into_iter().map(|(name, x)| (format!("prior.{name}"), x));
        Ok(own.into_iter().chain(prior).collect())
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.t, &mut self.subsets, &mut self.objective, &mut self.misfit, &mut self.lipschitz]
    }
}
