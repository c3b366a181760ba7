//! Total variation by ordered-subset FISTA: `min_{x ≥ 0} ½Σw·(A·x − p)² + λ·TV(x)` (Beck and Teboulle, SIAM J. Imaging Sci.
//! 2(1), 2009; ordered subsets with momentum as in Kim, Ramani and Fessler, IEEE Trans. Med. Imaging 34(1), 2015).
//!
//! The weights w are inverse variances of the measured values up to a factor (penalised weighted least squares; Fessler,
//! IEEE Trans. Image Process. 3(4), 1994), from the noise that [`Noise`] finds in the scan.
//!
//! With n subsets the step is `1/L`, L an upper bound of the largest eigenvalue of every `n·A_sᵀWA_s`: for a matrix without
//! negative entries `max_j (AᵀWA·v)_j/v_j` is one for any positive v (Collatz and Wielandt), and power iterations make it
//! tight.
//!
//! Subsets and unbounded momentum do not go together: what one subset's gradient lacks of the others' is amplified, and
//! the iterates run away. FISTA's t is therefore bounded, and after a pass whose objective is above the last one's two
//! subsets become one, down to plain FISTA, which converges.

use super::noise::{self, Noise};
use super::order::{Order, subsets, told};
use super::tv::{TvProx, anisotropy, total_variation};
use super::{
    Method, Opened, Pass, Problem, Stop, change, distance, drive, flat, flat_mut, norm2, projecting, refuse_others,
};
use conefield_core::error::{Result, ensure};
use conefield_core::random::stream;
use conefield_core::scan::Scan;
use conefield_core::solver::{Job, Observer, Solution, Solver};
use conefield_core::spec::{SolverSpec, Spec};
use ndarray::{Array3, Zip};
use rand::RngExt;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// How strong the prior is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Weight {
    /// λ, for attenuation counted per voxel (geometric mean of its sides) and the projector's lengths in voxels.
    Fixed(f64),
    /// Times the root mean square of back-projected noise, whose strength is read from the scan.
    Noise(f64),
}

/// Settings of `fista-tv`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FistaTv {
    /// When it ends.
    pub stop: Stop,
    /// How strong the prior is.
    pub weight: Weight,
    /// Weigh measured values by how little noise they have, where the scan's noise grows with attenuation.
    pub weighted: bool,
    /// Take pixels that the object's shadow leaves out for 0, whatever noise they hold. Where negative values were cut off,
    /// noise has a mean above 0, which puts a haze around the object.
    pub air: bool,
    /// Subsets of the views.
    pub subsets: usize,
    /// The order of the subsets.
    pub order: Order,
    /// Dual steps of the prior for each update.
    pub inner: usize,
    /// How strongly the volume is held to the one that the initializer brings: the weight μ of a third term `½μ‖x − x₀‖²`, as
    /// a share of the largest eigenvalue L of the data's. 0 only starts from it.
    pub pull: f64,
}

impl Default for FistaTv {
    fn default() -> Self {
        let stop = Stop { passes: Some(16), change: Some(1e-3), ..Stop::default() };
        Self {
            stop,
            weight: Weight::Noise(1.2),
            weighted: true,
            air: true,
            subsets: 10,
            order: Order::Golden,
            inner: 4,
            pull: 0.0,
        }
    }
}

/// FISTA's t goes up to this over the number of subsets. On 50 views of abdomen_128 with 10 subsets 100, 200 and 400 gave
/// 34.2, 34.5 and 34.7 dB after 15 passes.
const MOMENTUM: f64 = 400.0;

conefield_core::stage_type!(Solver, "fista-tv", FistaTv, "total variation by ordered-subset FISTA");

#[typetag::serde(name = "fista-tv")]
impl SolverSpec for FistaTv {
    fn build(&self) -> Result<Box<dyn Solver>> {
        self.stop.validate()?;
        ensure(self.subsets > 0, "spec", "solver.subsets", 0, "at least 1")?;
        ensure((1..=1000).contains(&self.inner), "spec", "solver.inner", self.inner, "1 to 1000")?;
        let (Weight::Fixed(w) | Weight::Noise(w)) = self.weight;
        ensure(w.is_finite() && w >= 0.0, "spec", "solver.weight", w, "a finite number, 0 or more")?;
        let pull = self.pull;
        ensure(pull.is_finite() && pull >= 0.0, "spec", "solver.pull", pull, "a finite number, 0 or more")?;
        Ok(Box::new(self.clone()))
    }
}

impl Solver for FistaTv {
    fn solve(&self, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Solution> {
        let begun = Instant::now();
        let opened = Opened::of(&self.describe(), job, observer)?;
        let job = &opened.job(job);
        let mut problem = opened.problem(job);
        if self.air {
            problem.clear_air();
            observer.note(&format!("{:.0} % of the pixels are air", 100.0 * problem.air_share()));
        }
        let grid = &job.scan.geometry.volume;
        let voxel = grid.spacing.iter().product::<f64>().cbrt();
        // Attenuation a voxel x̂ = x·h and lengths in voxels Â = A/h: λ·TV(x) = λ̂·TV(x̂) = λ̂·h·TV(x).
        let noise = Noise::of(job.scan, self.weighted);
        let lambda = match self.weight {
            Weight::Fixed(w) => w * voxel,
            Weight::Noise(k) => k * noise.sigma * noise_gain(&problem, noise),
        };
        observer.note(&format!("{noise}: the prior's weight is {:.3e}", lambda / voxel));
        let mut iterate = Iterate::new(self, &problem, noise, problem.start(job)?, lambda)?;
        drive(job, &self.stop, begun, &problem, &mut iterate, observer)
    }

    fn trains_field(&self, spec: &Spec) -> Result<bool> {
        refuse_others(spec)?;
        let held = self.pull == 0.0 || spec.initializer.is_some();
        ensure(held, "spec", "solver.pull", self.pull, "0, or an initializer with a volume to be held to")?;
        Ok(false)
    }

    fn plan(&self, scan: &Scan) -> Vec<String> {
        let noise = Noise::of(scan, self.weighted).to_string();
        vec![told(&subsets(scan.geometry.views.len(), self.subsets)), noise]
    }

    fn needs_held_out(&self) -> Option<&'static str> {
        self.stop.needs_held_out()
    }

    /// Beside the volume there are the point ahead of it, the fresh and the last volume, a gradient and the dual of three
    /// components; and the residuals of a subset, which may come to be all views, and where there is air.
    fn working_memory(&self, pixels: u64, voxels: u64) -> u64 {
        let volumes = if self.pull > 0.0 { 8 } else { 7 };
        let passing = volumes * 4 * voxels + (4 + 1) * pixels + projecting(pixels);
        passing.max(noise::memory(pixels)) + self.stop.kept(voxels)
    }

    fn describe(&self) -> String {
        let weights = if self.weighted { "weighted by noise" } else { "unweighted" };
        let held = if self.pull > 0.0 { format!(", held to a volume by {}", self.pull) } else { String::new() };
        format!(
            "fista-tv: {} subsets, {} dual steps, weight {:?}, {weights}{held}",
            self.subsets, self.inner, self.weight
        )
        .to_lowercase()
    }
}

/// Root mean square of `AᵀWn` over the voxels that rays meet, for noise n whose variance is `1/w`.
fn noise_gain(problem: &Problem<'_>, noise: Noise) -> f64 {
    let g = &problem.scan.geometry;
    let mut rng = stream(problem.seed ^ 0x0000_7e57_0015_e000, 0);
    let mut signs = Array3::from_shape_simple_fn((g.views.len(), g.detector[0], g.detector[1]), || {
        if rng.random::<bool>() { 1.0 } else { -1.0 }
    });
    let mut back = problem.zeros();
    let views = problem.views();
    noise.weigh(0.5, problem, &views, &mut signs);
    problem.back(&views, &signs, &mut back);
    let met = back.iter().filter(|x| **x != 0.0).count();
    (norm2(&back) / met.max(1) as f64).sqrt()
}

/// An upper bound of the largest eigenvalue of `n·A_sᵀWA_s` over n subsets.
fn largest_eigenvalue(problem: &Problem<'_>, noise: Noise, subsets: &[Vec<usize>]) -> f64 {
    let mut next = problem.zeros();
    let mut worst = 0.0f64;
    for views in subsets {
        let mut v = problem.ones();
        let mut bound = f64::INFINITY;
        for _ in 0..2 {
            let mut projected = problem.forward(views, &v);
            noise.weigh(1.0, problem, views, &mut projected);
            problem.back(views, &projected, &mut next);
            let top = flat(&next).par_iter().copied().reduce(|| 0.0, f32::max);
            let ratio = |(a, b): (&f32, &f32)| if *b > 1e-6 { f64::from(a / b) } else { 0.0 };
            bound = bound.min(flat(&next).par_iter().zip(flat(&v)).map(ratio).reduce(|| 0.0, f64::max));
            Zip::from(&mut v).and(&next).par_for_each(|v, n| *v = n / top.max(f32::MIN_POSITIVE));
        }
        worst = worst.max(bound);
    }
    subsets.len() as f64 * worst
}

struct Iterate {
    views: usize,
    noise: Noise,
    /// How many subsets there are now.
    subsets: f64,
    order: Order,
    inner: usize,
    x: Array3<f32>,
    /// Where the next gradient is taken.
    ahead: Array3<f32>,
    scratch: Array3<f32>,
    fresh: Array3<f32>,
    prox: TvProx,
    anisotropy: [f32; 3],
    /// λ in mm.
    lambda: f64,
    lipschitz: f64,
    /// The share of a step that goes to a volume, and that volume, if there is a pull.
    pull: Option<(f32, Array3<f32>)>,
    /// FISTA's t.
    t: f64,
    /// The last pass' objective.
    objective: f64,
}

impl Iterate {
    fn new(settings: &FistaTv, problem: &Problem<'_>, noise: Noise, x: Array3<f32>, lambda: f64) -> Result<Self> {
        let grid = &problem.scan.geometry.volume;
        let views = problem.scan.geometry.views.len();
        let parts = subsets(views, settings.subsets);
        let lipschitz = largest_eigenvalue(problem, noise, &parts);
        ensure(lipschitz > 0.0, "scan", "geometry", "rays that all miss the volume", "rays through the volume")?;
        let pull = (settings.pull > 0.0).then(|| ((settings.pull / (1.0 + settings.pull)) as f32, x.clone()));
        Ok(Self {
            views,
            noise,
            subsets: parts.len() as f64,
            order: settings.order,
            inner: settings.inner,
            ahead: x.clone(),
            scratch: problem.zeros(),
            fresh: problem.zeros(),
            x,
            prox: TvProx::new(grid.shape, anisotropy(grid)),
            anisotropy: anisotropy(grid),
            lambda,
            lipschitz: lipschitz * (1.0 + settings.pull),
            pull,
            t: 1.0,
            objective: f64::INFINITY,
        })
    }
}

impl Method for Iterate {
    fn pass(&mut self, problem: &Problem<'_>, pass: u64) -> Result<Pass> {
        let before = self.x.clone();
        let (mut residual, mut weighted) = (0.0, 0.0);
        let subsets = subsets(self.views, self.subsets as usize);
        for s in self.order.of(subsets.len(), problem.seed, pass) {
            let views = &subsets[s];
            let mut difference = problem.residual(views, &self.ahead);
            residual += norm2(&difference);
            weighted += self.noise.weigh(1.0, problem, views, &mut difference);
            problem.back(views, &difference, &mut self.scratch);
            let step = (self.subsets / self.lipschitz) as f32;
            Zip::from(&mut self.scratch).and(&self.ahead).par_for_each(|g, z| *g = z + step * *g);
            if let Some((pull, towards)) = &self.pull {
                let toward = |g: &mut f32, z: &f32, to: &f32| *g += pull * (to - z);
                Zip::from(&mut self.scratch).and(&self.ahead).and(towards).par_for_each(toward);
            }
            // What is far below 0 stays at 0, whatever its neighbours are.
            problem.outside(&mut self.scratch, f32::MIN);
            let tau = (self.lambda / self.lipschitz) as f32;
            self.prox.apply(flat(&self.scratch), tau, self.inner, flat_mut(&mut self.fresh));
            let t = 0.5 * (1.0 + (1.0 + 4.0 * self.t * self.t).sqrt());
            let momentum = ((self.t - 1.0) / t) as f32;
            self.t = t.min((MOMENTUM / self.subsets).max(1.0));
            Zip::from(&mut self.ahead)
                .and(&self.fresh)
                .and(&self.x)
                .par_for_each(|z, new, old| *z = new + momentum * (new - old));
            std::mem::swap(&mut self.x, &mut self.fresh);
        }
        let change = change(&self.x, &before);
        let prior = self.lambda * total_variation(&self.x, self.anisotropy);
        let held = |(share, towards): &(f32, Array3<f32>)| {
            0.5 * f64::from(*share) * self.lipschitz * distance(&self.x, towards).powi(2)
        };
        let objective = 0.5 * weighted + prior + self.pull.as_ref().map_or(0.0, held);
        if objective > self.objective {
            self.subsets = (0.5 * self.subsets).ceil();
        }
        self.objective = objective;
        Ok(Pass { residual, change: Some(change), prior: Some(prior) })
    }

    fn volume(&self) -> &Array3<f32> {
        &self.x
    }

    fn take(&mut self) -> Array3<f32> {
        std::mem::take(&mut self.x)
    }

    fn state(&mut self) -> Vec<(&'static str, &mut [f32])> {
        let [a, b, c] = self.prox.state();
        vec![
            ("x", flat_mut(&mut self.x)),
            ("ahead", flat_mut(&mut self.ahead)),
            ("dual.x", a),
            ("dual.y", b),
            ("dual.z", c),
        ]
    }

    fn numbers(&mut self) -> Vec<&mut f64> {
        vec![&mut self.t, &mut self.subsets, &mut self.objective]
    }
}
