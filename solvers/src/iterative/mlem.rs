//! MLEM: `x ← x·A_sᵀ(p_s/(A_s·x))/A_sᵀ1` over subsets s of the views (Shepp and Vardi, IEEE Trans. Med. Imaging 1(2),
//! 1982; ordered subsets as OSEM, Hudson and Larkin, IEEE Trans. Med. Imaging 13(4), 1994). It maximizes the likelihood
//! of line integrals with Poisson's distribution. Those of a CT scan do not have it, but the update is multiplicative:
//! attenuation stays positive, and errors are relative.

use super::order::{Order, Subsets};
use super::plan::OnVoxels;
use super::problem::room;
use super::sart::column_sums;
use super::shared::{Shared, settings};
use super::{Iteration, Pass, Problem, Stop};
use conefield_core::data_term::Misfit;
use conefield_core::error::{Result, ensure};
use conefield_core::method::Method;
use conefield_core::place::{Array, Bounds, CLIP, MULTIPLY, RELAX, Reduction};
use conefield_core::wgsl::Fragment;

settings! {
    /// Settings of `mlem`.
    Mlem {
        /// File of a known volume to start from. Voxels below a thousandth of the uniform start are raised to it: a voxel
        /// of 0 would stay 0.
        start,
        stop: Stop::after(20),
        /// Number of ordered subsets of the views, or "views" for one view at a time. 1 is MLEM, more is OSEM.
        subsets: Subsets = Subsets::Count(10),
        /// Order of the subsets.
        order: Order = Order::Golden,
    }
}

conefield_core::stage_type!(Method, "mlem", Mlem, "maximum likelihood by expectation maximization, in ordered subsets");

impl Mlem {
    fn built(&self) -> Result<OnVoxels> {
        let Self { subsets, order, .. } = *self;
        subsets.validate()?;
        let shared = Shared { text: format!("mlem: {subsets}"), subsets, ..self.shared()? };
        Ok(OnVoxels::new(shared, move |space, x, _| {
            let views = space.header().views;
            Ok(Box::new(MlemIterate {
                subsets: subsets.of(views),
                order,
                likelihood: Likelihood { least: 0.0 },
                x,
                columns: space.volume()?,
                work: space.volume()?,
                pixels: room(space, subsets.count(views))?,
            }))
        }))
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
}

impl MlemIterate {
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
    fn knows_change(&self) -> bool {
        false
    }

    /// Makes the start positive inside the object's support, and computes the sums that do not change.
    fn prepare(&mut self, problem: &Problem<'_>) -> Result<()> {
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
        if problem.started {
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

    fn pass(&mut self, problem: &Problem<'_>, pass: u64, within: &mut dyn FnMut(f64)) -> Result<Pass> {
        let mut residual = 0.0;
        let count = self.subsets.len();
        for (i, s) in self.order.of(count, problem.seed, pass).into_iter().enumerate() {
            residual += self.update(problem, s)?;
            within((i + 1) as f64 / count as f64);
        }
        Ok(Pass { residual, ..Pass::default() })
    }

    fn x(&mut self) -> &mut Array {
        &mut self.x
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
            if *p < 0.0 {
                // Noise can make a line integral negative; the likelihood takes it as 0.
                *r = -a;
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise makes line integrals negative. Value and slope take them as 0, so that no factor of an update is negative.
    #[test]
    fn a_negative_line_integral_counts_as_zero() {
        let of = |p: f32| {
            let mut residuals = [p - 2.0];
            let value = Likelihood { least: 1e-6 }.differentiate(0, &[p], &mut residuals);
            (value, residuals[0])
        };
        assert_eq!(of(-3.0), (2.0, -1.0));
        assert_eq!(of(-3.0), of(0.0));
        assert_eq!(of(1.0).1, -0.5);
    }
}
