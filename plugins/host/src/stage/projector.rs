//! Projectors.

#![allow(unsafe_code)]

use super::{Fault, fragment};
use crate::library::{Functions, Handle, Text, Type};
use crate::trial;
use conefield_core::error::Result;
use conefield_core::stage::{Lengths, Projector, Samples, UnitRay};
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::ptr;
use std::sync::Arc;

/// Most samples of one ray: more than any detector resolves.
const MOST: usize = 1 << 24;

/// A projector of a library.
pub struct ProjectorStage {
    handle: Handle,
    functions: ConefieldProjector,
    describe: String,
    fault: Fault,
}

/// Makes a projector and tries it out.
pub(crate) fn build(ty: &Arc<Type>, settings: &Value) -> Result<ProjectorStage> {
    let (own, settings) = (ty.clone(), settings.clone());
    trial::timed(ty, move || ProjectorStage::tried(own.create(&settings, 0)?))
}

fn raw(ray: &UnitRay) -> ConefieldRay {
    let UnitRay { origin, direction, inside, published, per_mm } = *ray;
    ConefieldRay { origin, direction, inside, published, per_mm }
}

impl ProjectorStage {
    /// The projector behind `handle`, tried out.
    fn tried(handle: Handle) -> Result<Self> {
        let Functions::Projector(functions) = handle.ty.functions else {
            return Err(handle.ty.failed("create", CONEFIELD_FAILED, "it is no projector"));
        };
        let describe = handle.describe();
        let stage = Self { handle, functions, describe, fault: Fault::default() };
        trial::projector(stage.ty(), |ray, seed, guard| {
            let mut samples = Samples::default();
            stage.sample_guarded(ray, seed, guard, &mut samples)?;
            Ok(stage.integrate(&samples.weights, &vec![1.0; samples.weights.len()]))
        })?;
        Ok(stage)
    }

    /// The type that it is of.
    fn ty(&self) -> &Type {
        &self.handle.ty
    }

    /// Appends the samples of `ray`, written with `guard` untouchable numbers behind them. What is wrong with them is an
    /// error, and nothing is appended.
    fn sample_guarded(&self, ray: &UnitRay, seed: Option<u64>, guard: usize, out: &mut Samples) -> Result<()> {
        let capacity = self.max_samples(ray);
        self.fault.take()?;
        if capacity == 0 {
            return Ok(());
        }
        let (start, mark) = (out.points.len(), f32::from_bits(trial::UNTOUCHED));
        out.points.resize(start + capacity + guard, [mark; 3]);
        out.weights.resize(start + capacity + guard, mark);
        let done = self.fill(ray, seed, capacity, &mut out.points[start..], &mut out.weights[start..]);
        let n = *done.as_ref().unwrap_or(&0);
        out.points.truncate(start + n);
        out.weights.truncate(start + n);
        done.map(drop)
    }

    fn fill(
        &self,
        ray: &UnitRay,
        seed: Option<u64>,
        capacity: usize,
        points: &mut [[f32; 3]],
        weights: &mut [f32],
    ) -> Result<usize> {
        let Some(sample) = self.functions.sample else { return Ok(0) };
        let failed = |what: &str| Err(self.ty().failed("sample", CONEFIELD_FAILED, what));
        let mut count = 0;
        let mut error = Text::new();
        // SAFETY: the stage is alive, both slices have room for `capacity`, the rest lives for the time of the call.
        let status = unsafe {
            sample(
                self.handle.stage,
                &raw(ray),
                seed.as_ref().map_or(ptr::null(), ptr::from_ref),
                points.as_mut_ptr().cast(),
                weights.as_mut_ptr(),
                capacity,
                &mut count,
                error.room(),
            )
        };
        if status != CONEFIELD_OK {
            return Err(self.ty().failed("sample", status, &error.text()));
        }
        if count > capacity {
            return failed(&format!("{count} samples where it said that {capacity} are the most"));
        }
        let untouched = |v: f32| v.to_bits() == trial::UNTOUCHED;
        if points[capacity..].iter().flatten().chain(&weights[capacity..]).any(|&v| !untouched(v)) {
            return failed(&format!("it writes past the {capacity} samples that there is room for"));
        }
        let bad = |i: &usize| !points[*i].iter().chain([&weights[*i]]).all(|v| v.is_finite());
        match (0..count).find(bad) {
            Some(i) => failed(&format!("sample {i} is at {:?} with weight {}", points[i], weights[i])),
            None => Ok(count),
        }
    }
}

impl Projector for ProjectorStage {
    fn max_samples(&self, ray: &UnitRay) -> usize {
        // SAFETY: the stage is alive, the ray lives for the time of the call.
        let most = self.functions.max_samples.map_or(0, |f| unsafe { f(self.handle.stage, &raw(ray)) });
        if most > MOST {
            self.fault.set(self.ty().failed("max_samples", CONEFIELD_FAILED, &format!("{most} samples for one ray")));
            return 0;
        }
        most
    }

    fn sample(&self, ray: &UnitRay, seed: Option<u64>, out: &mut Samples) {
        if let Err(e) = self.sample_guarded(ray, seed, 0, out) {
            self.fault.set(e);
        }
    }

    fn integrate(&self, weights: &[f32], mu: &[f64]) -> f64 {
        match self.functions.integrate {
            // SAFETY: the stage is alive, both slices have that length.
            Some(f) => unsafe { f(self.handle.stage, weights.as_ptr(), mu.as_ptr(), weights.len().min(mu.len())) },
            None => weights.iter().zip(mu).map(|(&w, &m)| f64::from(w) * m).sum(),
        }
    }

    fn adjoint(&self, weights: &[f32], dline: f64, dmu: &mut [f64]) {
        match self.functions.adjoint {
            // SAFETY: the stage is alive, both slices have that length.
            Some(f) => unsafe {
                f(self.handle.stage, weights.as_ptr(), dline, dmu.as_mut_ptr(), weights.len().min(dmu.len()));
            },
            None => dmu.iter_mut().zip(weights).for_each(|(d, &w)| *d = f64::from(w) * dline),
        }
    }

    fn fitted(&self, lengths: Lengths) -> Result<Option<Box<dyn Projector>>> {
        let Some(fitted) = self.functions.fitted else { return Ok(None) };
        let Lengths { voxel_mm, cell_mm } = lengths;
        let lengths = ConefieldLengths { voxel_mm, cell_mm: cell_mm.unwrap_or(0.0) };
        let mut stage = ptr::null_mut();
        let mut error = Text::new();
        // SAFETY: the stage is alive; everything handed over lives for the time of the call.
        let status = unsafe { fitted(self.handle.stage, &lengths, &mut stage, error.room()) };
        if status != CONEFIELD_OK {
            return Err(self.ty().refusal("fitted", status, &error.text()));
        }
        let Some(handle) = self.handle.made(stage, "fitted")? else { return Ok(None) };
        let ty = handle.ty.clone();
        Ok(Some(Box::new(trial::timed(&ty, move || Self::tried(handle))?)))
    }

    fn fault(&self) -> Result<()> {
        self.fault.take()
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }

    fn wgsl(&self) -> Option<Fragment> {
        fragment(&self.handle, self.functions.wgsl)
    }
}
