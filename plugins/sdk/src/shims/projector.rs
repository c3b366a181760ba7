//! Projectors.

use super::*;
use conefield_core::stage::Lengths;
use std::cell::RefCell;

table! {
    ConefieldProjector: max_samples sample integrate adjoint fitted wgsl;
    projector(keys, _) { Box::new(settings::<dyn ProjectorSpec>(keys)?.build()?) };
    dyn Projector: "projector"
}

/// A ray in the unit cube.
pub(super) fn ray(ray: &ConefieldRay) -> UnitRay {
    let ConefieldRay { origin, direction, inside, published, per_mm } = *ray;
    UnitRay { origin, direction, inside, published, per_mm }
}

thread_local! {
    /// Samples of a ray, before they are passed on.
    static SAMPLES: RefCell<Samples> = RefCell::default();
}

shims! {
    fn max_samples(projector: dyn Projector, at: *const ConefieldRay) -> usize, or usize::MAX, { projector.max_samples(&ray(&*at)) }

    fn sample(
        projector: dyn Projector, at: *const ConefieldRay, seed: *const u64, points: *mut f32, weights: *mut f32,
        capacity: usize, count: *mut usize; error
    ) {
        SAMPLES.with_borrow_mut(|samples| {
            samples.points.clear();
            samples.weights.clear();
            projector.sample(&ray(&*at), seed.as_ref().copied(), samples);
            projector.fault()?;
            let n = samples.points.len();
            if n > capacity || samples.weights.len() != n {
                let why = format!("{n} points and {} weights, room for {capacity}", samples.weights.len());
                return Err(Error::unsupported("the samples of a ray", why));
            }
            many_mut(points.cast::<[f32; 3]>(), n).copy_from_slice(&samples.points);
            many_mut(weights, n).copy_from_slice(&samples.weights);
            *count = n;
            Ok(())
        })?;
    }

    fn integrate(projector: dyn Projector, weights: *const f32, mu: *const f64, count: usize) -> f64, or f64::NAN, {
        projector.integrate(many(weights, count), many(mu, count))
    }

    fn adjoint(projector: dyn Projector, weights: *const f32, dline: f64, dmu: *mut f64, count: usize) -> (), or (), {
        projector.adjoint(many(weights, count), dline, many_mut(dmu, count));
    }

    fn fitted(projector: dyn Projector, lengths: *const ConefieldLengths, out: *mut *mut c_void; error) {
        let ConefieldLengths { voxel_mm, cell_mm } = *lengths;
        let lengths = Lengths { voxel_mm, cell_mm: (cell_mm > 0.0).then_some(cell_mm) };
        if let Some(fitted) = projector.fitted(lengths)? {
            *out = hand_over(fitted);
        }
    }

    fn wgsl(projector: dyn Projector; source) {
        write_wgsl(source, projector.wgsl())?;
    }
}
