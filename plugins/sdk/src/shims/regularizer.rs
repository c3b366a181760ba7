//! Regularizers and their penalties on a grid.

use super::*;
use conefield_core::place::Host;
use std::sync::Arc;

table! {
    ConefieldRegularizer: bytes on weight value prox state adapt;
    regularizer(keys, _) { Box::new(settings::<dyn RegularizerSpec>(keys)?.build()?) };
    dyn Regularizer: "regularizer", On: "penalty on a grid"
}

/// What a regularizer makes for one grid.
type On = OnGrid<dyn Penalty>;

shims! {
    fn bytes(regularizer: dyn Regularizer, voxels: *const ConefieldGrid) -> u64, or u64::MAX, {
        let grid = grid(voxels);
        let space = Space::tally(header(grid.shape, [0; 3]));
        regularizer.on(&grid, &space)?;
        space.bytes()
    }

    fn on(regularizer: dyn Regularizer, voxels: *const ConefieldGrid, penalty: *mut *mut c_void; error) {
        let grid = grid(voxels);
        let space = Space::new(header(grid.shape, [0; 3]), Arc::new(Host));
        *penalty = hand_over(Box::new(OnGrid { shape: grid.shape, part: regularizer.on(&grid, &space)? }));
    }

    fn weight(
        regularizer: dyn Regularizer, voxels: *const ConefieldGrid,
        noise: Option<unsafe extern "C" fn(*mut c_void, f64) -> f64>, context: *mut c_void, weight: *mut f64; error
    ) {
        let mut measured = |k| noise.map_or(0.0, |noise| noise(context, k));
        *weight = regularizer.weight(&grid(voxels), &mut measured)?;
    }

    fn value(on: On, x: *const f32, _count: usize, value: *mut f64; error) {
        *value = on.part.value(array(on.shape, x)?);
        on.part.fault()?;
    }

    fn prox(mut on: On, v: *const f32, count: usize, tau: f32, u: *mut f32; error) {
        on.part.prox(many(v, count), tau, many_mut(u, count));
        on.part.fault()?;
    }

    fn adapt(mut on: On, x: *const f32, _count: usize, value: *mut f64; error) {
        let adapted = on.part.adapt(array(on.shape, x)?);
        on.part.fault()?;
        *value = adapted.ok_or_else(|| Error::unsupported("adapt", "the penalty stays as it is"))?;
    }

    fn state(mut on: On, index: usize, out: *mut ConefieldState) {
        let entry = on.part.state().into_iter().nth(index);
        let (name, values) = entry.ok_or_else(|| Error::unsupported("state", "the index is too large"))?;
        let values = match values {
            StatePart::Host(values) => values,
            StatePart::Placed(array) => array.slice_mut(),
        };
        *out = ConefieldState { name: ConefieldStr::of(name), data: values.as_mut_ptr(), length: values.len() };
    }
}
