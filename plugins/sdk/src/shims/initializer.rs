//! Initializers.

use super::*;
use crate::built::{Filling, Waiting};
use conefield_core::arena::Block;

table! {
    ConefieldInitializer: apply check weights with_weights volume;
    initializer(keys, _) { Waiting::build(settings(keys)?)? };
    Filling: "initializer that fills parameters", Waiting: "initializer that waits for weights"
}

unsafe fn layout(blocks: *const ConefieldBlock, count: usize) -> Result<Layout> {
    let block = |b: &ConefieldBlock| -> Result<Block> {
        // SAFETY: see `shims/mod.rs`.
        let (name, shape) = unsafe { (text(b.name)?, many(b.shape, b.dimensions)) };
        Ok(Block { name: name.into(), shape: shape.to_vec(), range: b.start..b.start + b.length })
    };
    // SAFETY: see `shims/mod.rs`.
    Ok(Layout { blocks: unsafe { many(blocks, count) }.iter().map(block).collect::<Result<_>>()? })
}

shims! {
    fn apply(
        filling: Filling, blocks: *const ConefieldBlock, block_count: usize, params: *mut f32, length: usize,
        filled: *mut u8; error
    ) {
        let layout = layout(blocks, block_count)?;
        let (params, filled) = (many_mut(params, length), many_mut(filled, block_count));
        let mut arena = Arena::new(length);
        arena.params.copy_from_slice(params);
        let report = filling.initializer.apply(&layout, &mut arena)?;
        params.copy_from_slice(&arena.params);
        for (filled, b) in filled.iter_mut().zip(&layout.blocks) {
            *filled = report.loaded.contains(&b.name).into();
        }
    }

    fn check(filling: Filling, blocks: *const ConefieldBlock, block_count: usize; error) {
        filling.initializer.check(&layout(blocks, block_count)?)?;
    }

    fn weights(waiting: Waiting, path: *mut ConefieldStr) {
        // The stage owns the text.
        *path = ConefieldStr::of(&waiting.path);
    }

    fn with_weights(waiting: Waiting, tensors: *const ConefieldTensor, count: usize, out: *mut *mut c_void; error) {
        let mut weights = Weights::default();
        for t in many(tensors, count) {
            let (shape, values) = (many(t.shape, t.dimensions), many(t.values, t.length));
            weights.tensors.insert(text(t.name)?.into(), (shape.to_vec(), values.to_vec()));
        }
        *out = hand_over(waiting.with(&weights)?);
    }

    fn volume(filling: Filling, path: *mut ConefieldStr, steps: *mut u64) {
        let known = filling.volume.as_ref().ok_or_else(|| Error::unsupported("this stage", "it names no volume"))?;
        (*path, *steps) = (ConefieldStr::of(&known.path), known.steps);
    }
}
