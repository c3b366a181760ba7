//! Pre-training of weights on known volumes.

use crate::memory::Memory;
use crate::specs::notes;
use conefield_core::Result;
use conefield_core::arena::Weights;
use conefield_core::method::{Observer, Outline, Plan, PretrainJob};
use conefield_core::spec::load::Loaded;

/// Refuses volumes of these sizes if they do not fit into memory: each has its own parameters and moments.
pub fn check_memory(voxels: &[u64], outline: &Outline) -> Result<()> {
    let (parameters, backend) = (outline.parameters() as u64, outline.backend().scratch_bytes as u64);
    let need = |voxels: &[u64]| {
        let half = 8 * parameters * voxels.len() as u64;
        let volume = 4 * voxels.iter().sum::<u64>();
        let training = Memory { volume, model: half, optimizer: half, buffers: backend, ..Memory::default() };
        Memory::most(&[Memory::of_volumes(voxels), training])
    };
    need(voxels).check_or(&|available| {
        let fewer = (1..voxels.len()).rev().find(|n| need(&voxels[..*n]).total <= available);
        fewer.map(|n| format!("the first {n} of the {} volumes", voxels.len())).into_iter().collect()
    })
}

/// The weights of a field after training, except those of its encoder, which belong to the training volume.
pub fn train(
    loaded: &Loaded,
    plan: &mut dyn Plan,
    job: &PretrainJob<'_>,
    observer: &mut dyn Observer,
) -> Result<Weights> {
    let model = plan.pretrain(job, observer).map_err(|e| loaded.locate(e))?;
    let keep = |name: &str| !name.starts_with("encoder.");
    let mut weights = Weights::from_arena(model.pipeline.layout(), &model.arena.params, keep);
    weights.notes = notes(loaded, job.seed)?;
    Ok(weights)
}
