//! Ordered-subset FISTA: `min_{l ≤ x ≤ h} D(p − A·B·x) + λ·R(x)` with bounds l and h, by default 0 and ∞, and any basis B, data term D and prior R (Beck and
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
use super::drive::{buffers, drive};
use super::model::{Model, projected};
use super::order::{Order, Subsets, split};
use super::plan::Iterative;
use super::problem::{change, copy, distance, norm2, room};
use super::regularizers::Nonnegative;
use super::shared::{Shared, settings};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::basis::{Basis, BasisSpec, Expansion};
use conefield_core::data_term::{DataTerm, DataTermSpec, Misfit};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid};
use conefield_core::method::{Job, Line, Method, Observer, Solution};
use conefield_core::orbit::Arcs;
use conefield_core::place::{Array, Bounds, DIVIDE, Host, ProximalStep, Reduction, StatePart};
use conefield_core::random::stream;
use conefield_core::regularizer::{Penalty, Regularizer, RegularizerSpec, penalty};
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::space::Space;
use conefield_core::spec::stage;
use ndarray::Array3;
use rand::RngExt;
use std::f64::consts::PI;
use std::sync::Arc;
use std::time::Instant;

settings! {
    /// Settings of `fista`.
    Fista {
        stages {
            /// Basis of the volume.
            #[schemars(schema_with = "stage::schema::<dyn BasisSpec>")]
            basis: Box<dyn BasisSpec> = Box::new(Voxels {}),
            /// Data term: misfit between computed and measured line integrals.
            #[schemars(schema_with = "stage::schema::<dyn DataTermSpec>")]
            data: Box<dyn DataTermSpec> = Box::new(NoiseWeighted {}),
            /// Regularizer of the volume.
            #[schemars(schema_with = "stage::schema::<dyn RegularizerSpec>")]
            prior: Box<dyn RegularizerSpec> = Box::new(Nonnegative {}),
        }
        /// File of a known volume to start from.
        start,
        stop: Stop { change: Some(1e-3), ..Stop::after(16) },
        /// Set pixels outside the object's shadow to 0, whatever noise they have. If negative values were clipped, noise
        /// has a mean above 0, which causes a haze around the object.
        air: bool = true,
        /// Average this many detector rows and columns to one pixel.
        bin: usize = 1,
        /// Number of ordered subsets of the views, or "views" for one view at a time.
        subsets: Subsets = Subsets::Count(10),
        /// Order of the subsets.
        order: Order = Order::Golden,
        /// Strength of the pull towards the start volume: the weight μ of a third term `½μ‖x − x₀‖²`, relative to the
        /// largest eigenvalue L of the data term. With 0, the volume is only the start.
        pull: f64 = 0.0,
    }
}

/// Bound of FISTA's t, to be divided by the number of subsets. On 50 views of abdomen_128 with 10 subsets, 100, 200 and
/// 400 gave 34.2, 34.5 and 34.7 dB after 15 passes.
const MOMENTUM: f64 = 400.0;

conefield_core::stage_type!(Method, "fista", Fista, "ordered-subset FISTA with any basis, data term and prior");

impl Fista {
    /// Bytes for a scan of this size, besides the resulting volume.
    pub(crate) fn bytes(&self, scan: &ScanHeader) -> u64 {
        self.built().map_or(0, |built| Iterative::bytes(&built, scan))
    }

    /// Reconstructs without a plan.
    pub(crate) fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        self.built()?.solve(job, observer)
    }

    fn built(&self) -> Result<FistaMethod> {
        self.subsets.validate()?;
        let pull = self.pull;
        ensure(pull.is_finite() && pull >= 0.0, "spec", "pull", pull, "a finite number, 0 or more")?;
        ensure((1..=64).contains(&self.bin), "spec", "bin", self.bin, "1 to 64")?;
        let shared = self.shared()?;
        let basis = self.basis.build().map_err(|e| e.within("basis"))?;
        let data = self.data.build().map_err(|e| e.within("data"))?;
        let prior = self.prior.build().map_err(|e| e.within("prior"))?;
        let stages = vec![
            Line::new("basis", self.basis.type_name(), &basis.describe()),
            Line::new("data", self.data.type_name(), &data.describe()),
            Line::new("prior", self.prior.type_name(), &prior.describe()),
        ];
        let held = if pull > 0.0 { format!(", pull {pull} to a volume") } else { String::new() };
        let text = format!("fista: {}{held}", self.subsets);
        let shared = Shared { text, stages, subsets: self.subsets, ..shared };
        Ok(FistaMethod { shared, basis, data, prior, air: self.air, bin: self.bin, order: self.order, pull })
    }
}

/// The stages that [`Fista`] builds.
struct FistaMethod {
    shared: Shared,
    basis: Box<dyn Basis>,
    data: Box<dyn DataTerm>,
    prior: Box<dyn Regularizer>,
    air: bool,
    bin: usize,
    order: Order,
    pull: f64,
}

impl FistaMethod {
    /// The basis on voxels of any size; `None` if it refuses the grid.
    fn expansion(&self, volume: [usize; 3]) -> Option<(Box<dyn Expansion>, VoxelGrid)> {
        let grid = VoxelGrid { shape: volume, spacing: [1.0; 3], center: [0.0; 3] };
        Some((self.basis.on(&grid).ok()?, grid))
    }
}

impl Iterative for FistaMethod {
    fn shared(&self) -> &Shared {
        &self.shared
    }

    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let held = self.pull == 0.0 || self.shared.has_start(job);
        ensure(held, "spec", "pull", self.pull, "0, or a volume to start from and pull towards")?;
        let stages = [self.data.describe(), self.prior.describe(), self.basis.describe()].join("; ");
        let voxels = job.scan.geometry.volume;
        let expansion = self.basis.on(&voxels).map_err(|e| e.within("basis"))?;
        let longest = job.scan.geometry.detector[0].max(job.scan.geometry.detector[1]);
        let room = format!("at most {longest}, the detector's longer side");
        ensure(self.bin <= longest, "spec", "bin", self.bin, room)?;
        let grid = projected(expansion.as_ref(), voxels);
        let text = format!("{}; {stages}", self.shared.text);
        let opened = self.shared.open(grid, self.bin, &text, self, job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        if self.air {
            let air = 100.0 * problem.clear_air()?;
            observer.note(&format!("{air:.0} % of the pixels are air (views binned by {})", self.bin));
        }
        let data = self.data.of(problem.scan.projections.view()).map_err(|e| e.within("data"))?;
        let space = opened.space(job.scan.header().binned(self.bin));
        let start = self.shared.known(job, &space)?;
        // A device's proximal maps have the same bounds everywhere.
        let there = problem.regions.is_empty();
        let mut arrays = Arrays::new(self, expansion, &voxels, &space, start, there)?;
        arrays.begin(&problem)?;
        arrays.confine(&problem)?;
        if let Some(middle) = limited(problem.geometry) {
            arrays.penalty.limited(middle);
        }
        let buffers = buffers(&self.shared.stop, true, &space)?;
        problem.settle()?;
        let mut iterate = FistaIterate::new(self, &problem, data, arrays)?;
        observer.note(&iterate.description());
        if problem.place.device().is_some() {
            iterate.elsewhere().into_iter().for_each(|what| {
                observer.note(&format!("{what} runs on the CPU: what it works on is moved in every update"));
            });
        }
        drive(job, &self.shared.stop, begun, &problem, buffers, Box::new(iterate), observer)
    }

    fn found(&self, scan: &Scan) -> Vec<String> {
        let noise = self.data.of(scan.projections.view());
        vec![noise.map_or_else(|e| e.to_string(), |n| n.describe())]
    }

    fn seen(&self, header: &ScanHeader) -> ScanHeader {
        let volume = self.expansion(header.volume).map_or(header.volume, |(e, grid)| projected(e.as_ref(), grid).shape);
        ScanHeader { volume, ..header.binned(self.bin) }
    }

    fn bytes(&self, header: &ScanHeader) -> u64 {
        let header = &header.binned(self.bin);
        let space = Space::tally(*header);
        if self.air {
            // The mask of [`Problem::clear_air`].
            space.hold(header.pixels());
        }
        if self.bin > 1 {
            space.hold(4 * header.pixels());
        }
        space.hold(self.data.held(header));
        space.pass(self.data.scratch(header));
        // If a stage refuses the grid, the run is refused and needs no memory.
        if let Some((expansion, grid)) = self.expansion(header.volume) {
            let coefficients: u64 = expansion.coefficients().shape.iter().map(|n| *n as u64).product();
            let _ = space.volume().and_then(|start| Arrays::new(self, expansion, &grid, &space, start, true));
            if !self.shared.scene.bounds.regions.is_empty() {
                space.hold(coefficients.saturating_mul(2 * size_of::<f32>() as u64));
            }
        }
        self.shared.price(&space, true)
    }
}

/// The unit vector along the middle of the arc of the sources about z, if the views cover less than half a turn.
fn limited(geometry: &Geometry) -> Option<Vec3> {
    let angles: Vec<f64> = geometry.views.iter().map(|view| view.source[1].atan2(view.source[0])).collect();
    let arcs = Arcs::of(&angles).arcs;
    let &[[start, length]] = arcs.as_slice() else { return None };
    let (sin, cos) = (start + length / 2.0).sin_cos();
    (length < PI - 1e-9).then_some([cos, sin, 0.0])
}

/// FISTA's working memory.
struct Arrays {
    model: Model,
    penalty: Box<dyn Penalty>,
    x: Array,
    /// The extrapolated point, at which the next gradient is computed.
    ahead: Array,
    gradient: Array,
    /// The coefficients before a pass.
    before: Array,
    /// The target of the pull, if there is one.
    towards: Option<Array>,
    /// The pixels of a subset. After subsets have been merged, their views are processed in parts.
    pixels: Array,
}

/// The callback of [`Arrays::part_by_part`]: computes images of some views for back-projection.
type Images<'a> = &'a mut dyn FnMut(&mut Model, &[usize], &mut Array) -> Result<()>;

impl Arrays {
    /// Arrays for a volume on the grid `voxels`, initially `start`.
    fn new(
        settings: &FistaMethod,
        expansion: Box<dyn Expansion>,
        voxels: &VoxelGrid,
        space: &Space,
        start: Array,
        there: bool,
    ) -> Result<Self> {
        let (model, x) = Model::new(expansion, voxels, space, start)?;
        let grid = model.grid();
        let host = Space::new(*space.header(), Arc::new(Host));
        let beside = if there || space.place().device().is_none() { space } else { &host };
        let coefficients = || space.array(grid.shape);
        Ok(Self {
            model,
            penalty: penalty(settings.prior.as_ref(), &grid, beside).map_err(|e| e.within("prior"))?,
            x,
            ahead: coefficients()?,
            gradient: coefficients()?,
            before: coefficients()?,
            towards: (settings.pull > 0.0).then(coefficients).transpose()?,
            pixels: room(space, settings.shared.subsets.count(space.header().views))?,
        })
    }

    /// Overwrites the gradient with that of the data term at `ahead`. Returns `‖p − A·x‖²` and the data term.
    fn differentiate(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> Result<[f64; 2]> {
        let ahead = std::mem::replace(&mut self.ahead, Array::nothing());
        let mut sums = [0.0; 2];
        let done = self.part_by_part(problem, views, &mut |model, views, pixels| {
            model.forward(problem, views, &ahead, pixels)?;
            let found = problem.place.compare(&problem.by(Some(data), None), views, pixels)?;
            sums = std::array::from_fn(|k| sums[k] + found[k]);
            Ok(())
        });
        self.ahead = ahead;
        done.map(|()| sums)
    }

    /// Gives the penalty the bounds of its coefficients.
    fn confine(&mut self, problem: &Problem<'_>) -> Result<()> {
        let bounds = problem.regions.widest(problem.bounds);
        if bounds != Bounds::default() {
            self.penalty.confine(bounds)?;
        }
        if problem.regions.is_empty() {
            return Ok(());
        }
        let grid = self.model.grid();
        let grid = self.penalty.slab().map_or(grid, |slab| grid.slab(slab.planes.clone()));
        self.penalty.confine_each(problem.regions.on(&grid, problem.bounds))
    }

    /// Clears coefficients outside the object's support and restarts from the rest.
    fn begin(&mut self, problem: &Problem<'_>) -> Result<()> {
        self.model.prepare(problem, &mut self.gradient)?;
        self.model.outside(problem, &mut self.x, 0.0)?;
        for to in [Some(&mut self.ahead), self.towards.as_mut()].into_iter().flatten() {
            copy(problem.place, &self.x, to)?;
        }
        Ok(())
    }

    /// Overwrites `gradient` with the adjoint of the images that `images` computes for `views`, in parts that fit the
    /// buffer.
    fn part_by_part(&mut self, problem: &Problem<'_>, views: &[usize], images: Images<'_>) -> Result<()> {
        let Self { model, gradient, pixels, .. } = self;
        problem.place.fill(gradient, 0.0)?;
        for part in views.chunks(pixels.shape()[0].max(1)) {
            images(model, part, pixels)?;
            model.back(problem, part, pixels, gradient)?;
        }
        model.outside(problem, gradient, 0.0)
    }

    /// Root mean square of `(A·B)ᵀ·n` over the coefficients that rays meet, for noise n as `data` spreads it; computed
    /// from `views` and scaled to all views.
    fn noise_gain(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> Result<f64> {
        let mut rng = stream(problem.seed ^ 0x0000_7e57_0015_e000, 0);
        let [rows, columns] = problem.scan.geometry.detector;
        let place = problem.place;
        self.part_by_part(problem, views, &mut |_, views, pixels| {
            for i in 0..views.len() {
                let mut sign = || if rng.random::<bool>() { 1.0 } else { -1.0 };
                place.load(Array3::from_shape_simple_fn((1, rows, columns), &mut sign).view(), pixels, i)?;
            }
            place.weigh(&problem.by(Some(data), None), true, views, pixels)
        })?;
        let met = place.reduce(Reduction::Nonzero, &self.gradient, &self.gradient)?;
        let all = problem.geometry.views.len() as f64 / views.len().max(1) as f64;
        Ok((all * norm2(place, &self.gradient)? / met.max(1.0)).sqrt())
    }

    /// An upper bound for the largest eigenvalue of `n·(A_s·B)ᵀW(A_s·B)` over n subsets, W the curvature of `data`, and
    /// the first subset whose rays meet the volume. Uses `before` as working memory.
    fn largest_eigenvalue(
        &mut self,
        problem: &Problem<'_>,
        data: &dyn Misfit,
        subsets: &[Vec<usize>],
    ) -> Result<(f64, usize)> {
        let place = problem.place;
        let mut first = 0;
        let mut size = self.curved_ones(problem, data, &subsets[first])?;
        while size == 0.0 && first + 1 < subsets.len() {
            first += 1;
            size = self.curved_ones(problem, data, &subsets[first])?;
        }
        ensure(size > 0.0, "scan", "geometry", "rays that all miss the volume", "rays through the volume")?;
        let mut worst = 0.0f64;
        for probe in 0..PROBES {
            if size == 0.0 {
                // The last subset's rays miss the volume.
                size = self.curved_ones(problem, data, &subsets[first])?;
            }
            place.map(&DIVIDE, [size, 0.0], &mut self.before, &[&self.gradient])?;
            self.model.outside(problem, &mut self.before, 0.0)?;
            self.curved(problem, data, &subsets[probe * subsets.len() / PROBES])?;
            size = norm2(place, &self.gradient)?.sqrt();
            worst = worst.max(size);
        }
        Ok((SAFETY * subsets.len() as f64 * worst, first))
    }

    /// [`Arrays::curved`] of a volume of ones, and the norm of the result.
    fn curved_ones(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> Result<f64> {
        problem.place.fill(&mut self.before, 1.0)?;
        self.model.outside(problem, &mut self.before, 0.0)?;
        self.curved(problem, data, views)?;
        Ok(norm2(problem.place, &self.gradient)?.sqrt())
    }

    /// Overwrites `gradient` with `(A_s·B)ᵀW(A_s·B)·v`, v in `before`.
    fn curved(&mut self, problem: &Problem<'_>, data: &dyn Misfit, views: &[usize]) -> Result<()> {
        let v = std::mem::replace(&mut self.before, Array::nothing());
        let done = self.part_by_part(problem, views, &mut |model, views, pixels| {
            model.forward(problem, views, &v, pixels)?;
            problem.place.weigh(&problem.by(Some(data), None), false, views, pixels)
        });
        self.before = v;
        done
    }
}

/// Number of subsets for the power iteration, and the safety factor on the eigenvalue found.
const PROBES: usize = 3;
const SAFETY: f64 = 1.15;

struct FistaIterate {
    arrays: Arrays,
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

impl FistaIterate {
    fn new(settings: &FistaMethod, problem: &Problem<'_>, data: Box<dyn Misfit>, mut arrays: Arrays) -> Result<Self> {
        let views = problem.scan.geometry.views.len();
        let subsets = settings.shared.subsets.of(views);
        let grid = arrays.model.grid();
        let (lipschitz, first) = arrays.largest_eigenvalue(problem, data.as_ref(), &subsets)?;
        // One back-projection, however many priors ask.
        let mut gain = None;
        let noise = &mut |k: f64| {
            let gain = gain.get_or_insert_with(|| arrays.noise_gain(problem, data.as_ref(), &subsets[first]));
            k * data.noise() * gain.as_ref().map_or(0.0, |gain| *gain)
        };
        let weights = settings.prior.weights(&grid, noise).map_err(|e| e.within("prior"))?;
        gain.transpose()?;
        let lambda: f64 = weights.iter().sum();
        if lambda > 0.0 {
            arrays.penalty.share(&weights.iter().map(|weight| weight / lambda).collect::<Vec<_>>());
        }
        arrays.model.fault()?;
        data.fault()?;
        Ok(Self {
            arrays,
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

    /// The stages that run on the host in every update, wherever the arrays are.
    fn elsewhere(&mut self) -> Vec<&'static str> {
        let Arrays { model, penalty, .. } = &mut self.arrays;
        let stages = [
            ("the basis", model.expands()),
            ("the prior", penalty.kernels().is_none()),
            ("the data term", self.data.wgsl().is_none()),
        ];
        stages.into_iter().filter(|(_, here)| *here).map(|(name, _)| name).collect()
    }

    /// Processes one subset: a gradient step and the prior's proximal map. Returns `‖p − A·x‖²` and the data term.
    fn update(&mut self, problem: &Problem<'_>, views: &[usize]) -> Result<[f64; 2]> {
        let misfits = self.arrays.differentiate(problem, self.data.as_ref(), views)?;
        let t = 0.5 * (1.0 + (1.0 + 4.0 * self.t * self.t).sqrt());
        let momentum = ((self.t - 1.0) / t) as f32;
        self.t = t.min((MOMENTUM / self.subsets).max(1.0));
        let (step, tau) = ((self.subsets / self.lipschitz) as f32, (self.lambda / self.lipschitz) as f32);
        let Arrays { model, penalty, x, ahead, gradient, towards, .. } = &mut self.arrays;
        let towards = towards.as_ref().map(|towards| (towards, self.pull));
        let inside = model.inside(problem);
        let by = ProximalStep { gradient, ahead, x, step, momentum, towards, inside };
        problem.place.update(by, tau, penalty.as_mut())?;
        Ok(misfits)
    }

    /// Merges pairs of subsets.
    fn merge(&mut self, problem: &Problem<'_>) -> Result<()> {
        let fewer = (0.5 * self.subsets).ceil();
        // For unions of the previous subsets their bound still holds.
        if self.subsets % fewer != 0.0 {
            let fewer = split(self.views, fewer as usize);
            let (lipschitz, _) = self.arrays.largest_eigenvalue(problem, self.data.as_ref(), &fewer)?;
            self.lipschitz = self.pulled * lipschitz;
        }
        self.subsets = fewer;
        Ok(())
    }
}

impl Iteration for FistaIterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        let place = problem.place;
        copy(place, &self.arrays.x, &mut self.arrays.before)?;
        // A changed penalty must not count as progress or regress.
        if self.arrays.penalty.adapts()
            && let Some(value) = place.adapt(self.arrays.penalty.as_mut(), &self.arrays.x)?
        {
            self.objective = self.misfit + self.lambda * value;
        }
        let (mut residual, mut misfit) = (0.0, 0.0);
        // A checkpoint says how many there are, and may be wrong.
        let subsets = split(self.views, (self.subsets as usize).clamp(1, self.views));
        for (i, s) in self.order.of(subsets.len(), problem.seed, pass).into_iter().enumerate() {
            let [r, m] = self.update(problem, &subsets[s])?;
            residual += r;
            misfit += m;
            within((i + 1) as f64 / subsets.len() as f64);
        }
        let Arrays { penalty, x, before, towards, .. } = &mut self.arrays;
        let change = change(place, x, before)?;
        let prior = self.lambda * place.penalty(penalty.as_mut(), x)?;
        let away = towards.as_ref().map(|towards| distance(place, x, towards)).transpose()?;
        self.misfit = misfit + away.map_or(0.0, |d| 0.5 * f64::from(self.pull) * self.lipschitz * d.powi(2));
        let objective = self.misfit + prior;
        if objective > self.objective {
            self.merge(problem)?;
        }
        self.objective = objective;
        Ok(Pass { residual, change: Some(change), prior: Some(prior) })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.arrays.x
    }

    fn volume(&mut self, problem: &Problem<'_>) -> Result<&Array> {
        self.arrays.model.volume(problem, &self.arrays.x)
    }

    fn take(self: Box<Self>, problem: &Problem<'_>) -> Result<Array> {
        let Arrays { model, x, .. } = self.arrays;
        model.take(problem, x)
    }

    fn fault(&self) -> Result<()> {
        self.arrays.model.fault()?;
        self.arrays.penalty.fault()?;
        self.data.fault()
    }

    fn state(&mut self) -> Vec<(String, StatePart<'_>)> {
        let Arrays { x, ahead, penalty, .. } = &mut self.arrays;
        let own = [("x", x), ("ahead", ahead)].map(|(name, x)| (name.to_owned(), StatePart::Placed(x)));
        let prior = penalty.state().into_iter().map(|(name, x)| (format!("prior.{name}"), x));
        own.into_iter().chain(prior).collect()
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.t, &mut self.subsets, &mut self.objective, &mut self.misfit, &mut self.lipschitz]
    }
}
