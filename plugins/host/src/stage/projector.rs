//! Projectors.

use super::*;
use conefield_core::stage::Lengths;

/// Maximum number of samples per ray: more than any detector resolves.
const MOST: usize = 1 << 24;

settings! {
    projector ProjectorSpec(self) -> dyn Projector { self.build(0, ProjectorStage::tried) }
}

/// A projector from a library.
pub struct ProjectorStage(Foreign<ConefieldProjector>);

impl ProjectorStage {
    /// The projector of `handle`, after a trial.
    pub(crate) fn tried(handle: Handle) -> Result<Self> {
        let stage = Self(Foreign::new(handle)?);
        for (ray, seed) in rays().into_iter().flat_map(|ray| [(ray, None), (ray, Some(3))]) {
            let mut samples = Samples::default();
            stage.sample_guarded(&ray, seed, GUARD, &mut samples)?;
            let mut dmu = Guarded::<f64>::new(samples.weights.len());
            stage.derive(&samples.weights, 1.0, dmu.inner());
            stage.0.settled(dmu.complaint("derivatives"))?;
            let line = stage.integrate(&samples.weights, &vec![1.0; samples.weights.len()]);
            stage.0.settled((!line.is_finite()).then(|| format!("the line integral of ones is {line}")))?;
        }
        Ok(stage)
    }

    /// Appends the samples of `ray`, written with `guard` guard numbers behind them. Wrong samples are an error, and
    /// nothing is appended.
    fn sample_guarded(&self, ray: &UnitRay, seed: Option<u64>, guard: usize, out: &mut Samples) -> Result<()> {
        let capacity = self.max_samples(ray);
        self.0.fault.take()?;
        if capacity == 0 {
            return Ok(());
        }
        let start = out.points.len();
        out.points.resize(start + capacity + guard, [f32::MARK; 3]);
        out.weights.resize(start + capacity + guard, f32::MARK);
        let done = self.fill(ray, seed, capacity, &mut out.points[start..], &mut out.weights[start..]);
        let n = *done.as_ref().unwrap_or(&0);
        out.points.truncate(start + n);
        out.weights.truncate(start + n);
        done.map(drop)
    }

    /// Writes the adjoint of a line integral.
    fn derive(&self, weights: &[f32], dline: f64, dmu: &mut [f64]) {
        match self.0.functions.adjoint {
            // SAFETY: the stage is alive, both slices have that length.
            Some(f) => unsafe {
                f(self.0.handle.stage, weights.as_ptr(), dline, dmu.as_mut_ptr(), weights.len().min(dmu.len()));
            },
            None => dmu.iter_mut().zip(weights).for_each(|(d, &w)| *d = f64::from(w) * dline),
        }
    }

    fn fill(
        &self,
        ray: &UnitRay,
        seed: Option<u64>,
        capacity: usize,
        points: &mut [[f32; 3]],
        weights: &mut [f32],
    ) -> Result<usize> {
        let (ray, seed) = (raw_ray(ray), seed.as_ref().map_or(ptr::null(), ptr::from_ref));
        let mut count = 0;
        let (to, by) = (points.as_mut_ptr().cast(), weights.as_mut_ptr());
        call!(self.0, sample(&ray, seed, to, by, capacity, &mut count))?;
        let require = |holds, what: &dyn Fn() -> String| self.0.require(holds, "sample", what);
        require(count <= capacity, &|| format!("{count} samples, more than its maximum of {capacity}"))?;
        let within = points[capacity..].iter().flatten().chain(&weights[capacity..]).all(|v| v.is_mark());
        require(within, &|| format!("it writes past the {capacity} samples that there is room for"))?;
        let bad = |i: &usize| !points[*i].iter().chain([&weights[*i]]).all(|v| v.is_finite());
        match (0..count).find(bad) {
            Some(i) => {
                Err(self.0.wrong("sample", &format!("sample {i} is at {:?} with weight {}", points[i], weights[i])))
            }
            None => Ok(count),
        }
    }
}

impl Projector for ProjectorStage {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        // SAFETY: the stage is alive, the ray lives during the call.
        let most = self.0.functions.max_samples.map_or(0, |f| unsafe { f(self.0.handle.stage, &raw_ray(ray)) });
        let few = self.0.require(most <= MOST, "max_samples", || format!("{most} samples for one ray"));
        self.0.noted(few.map(|()| most), 0)
    }

    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
        self.0.noted(self.sample_guarded(ray, seed, 0, out), ());
    }

    fn integrate(&self, weights: &[f32], mu: &[f64]) -> f64 {
        match self.0.functions.integrate {
            // SAFETY: the stage is alive, both slices have that length.
            Some(f) => unsafe { f(self.0.handle.stage, weights.as_ptr(), mu.as_ptr(), weights.len().min(mu.len())) },
            None => weights.iter().zip(mu).map(|(&w, &m)| f64::from(w) * m).sum(),
        }
    }

    fn adjoint(&self, weights: &[f32], dline: f64, dmu: &mut [f64]) {
        // What the library leaves unwritten, as after a panic, is not taken for a derivative of 0.
        dmu.fill(f64::NAN);
        self.derive(weights, dline, dmu);
        if dmu.iter().any(|d| d.is_nan()) && dline.is_finite() {
            self.0.fault.set(self.0.wrong("adjoint", "a derivative is left unwritten or is NaN"));
        }
    }

    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let Lengths { voxel_mm, cell_mm } = lengths;
        let lengths = ConefieldLengths { voxel_mm, cell_mm: cell_mm.unwrap_or(0.0) };
        let Some(handle) = make!(self.0, fitted(&lengths))? else { return Ok(None) };
        Ok(Some(Box::new(timed(self.0.ty(), move || Self::tried(handle))?)))
    }

    said! { 0: describe fault wgsl }
}

/// Rays along an axis, across the cube, in the opposite direction, and past the cube.
fn rays() -> [UnitRay; 4] {
    let ray = |origin, direction: [f32; 3], inside| UnitRay {
        origin,
        direction,
        inside,
        published: [0.5, 3.0],
        per_mm: 0.01,
    };
    let third = (1.0f32 / 3.0).sqrt();
    [
        ray([-1.0, 0.5, 0.5], [1.0, 0.0, 0.0], [1.0, 2.0]),
        ray([-third; 3], [third; 3], [1.0, 1.0 + 1.0 / third]),
        ray([0.5, 2.0, 0.25], [0.0, -1.0, 0.0], [1.0, 2.0]),
        ray([-1.0, 5.0, 0.5], [1.0, 0.0, 0.0], [0.0, 0.0]),
    ]
}
