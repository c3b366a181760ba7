//! Parameters, gradients and moments on the device, in one buffer each or in several, as its limits require.

use crate::compose::Chain;
use crate::device::Gpu;
use crate::kernel::Buffers;
use conefield_core::arena::Arena;
use conefield_core::error::Result;

/// The arena's parts, by their names in kernels.
pub const PARTS: [&str; 4] = ["params", "grads", "first", "second"];

/// Bytes that are copied to or from the device at once.
pub(crate) const PIECE: u64 = 16 << 20;

/// Creates buffers for the parameters of `chain`.
pub fn allocate(gpu: &Gpu, buffers: &mut Buffers, chain: &Chain) -> Result<()> {
    use wgpu::BufferUsages as U;
    for part in PARTS {
        for s in 0..chain.segments() {
            let bytes = 4 * chain.segment(s).len() as u64;
            buffers.reserve(gpu, &format!("{part}_{s}"), bytes, U::STORAGE | U::COPY_SRC | U::COPY_DST)?;
        }
    }
    if chain.dense_bytes() > 0 {
        buffers.reserve(gpu, "dense", chain.dense_bytes(), U::UNIFORM | U::STORAGE | U::COPY_DST)?;
    }
    Ok(())
}

/// Uploads the arena.
pub fn upload(gpu: &Gpu, buffers: &Buffers, chain: &Chain, arena: &Arena) -> Result<()> {
    let parts = [&arena.params, &arena.grads, &arena.first, &arena.second];
    for (part, data) in PARTS.iter().zip(parts) {
        for s in 0..chain.segments() {
            let Some(buffer) = buffers.get(&format!("{part}_{s}")) else { continue };
            let bytes: &[u8] = bytemuck::cast_slice(&data[chain.segment(s)]);
            for (i, piece) in bytes.chunks(PIECE as usize).enumerate() {
                gpu.write(buffer, i as u64 * PIECE, piece);
                // Submits the piece, so that not all pieces wait in memory at once.
                gpu.queue.submit([]);
            }
        }
    }
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    refresh(buffers, chain, &mut encoder);
    gpu.queue.submit([encoder.finish()]);
    gpu.fault()
}

/// Updates the copy of the parameters that every row reads.
pub fn refresh(buffers: &Buffers, chain: &Chain, encoder: &mut wgpu::CommandEncoder) {
    let size = chain.target.segment;
    let Some(dense) = buffers.get("dense") else { return };
    for (first, range) in chain.dense_ranges() {
        let (mut at, mut from) = (4 * first as u64, range.start);
        while from < range.end {
            let (s, end) = (from / size, range.end.min((from / size + 1) * size));
            let bytes = 4 * (end - from) as u64;
            if let Some(params) = buffers.get(&format!("params_{s}")) {
                encoder.copy_buffer_to_buffer(params, 4 * (from - s * size) as u64, dense, at, bytes);
            }
            (from, at) = (end, at + bytes);
        }
    }
}

/// Downloads the arena.
pub fn download(gpu: &Gpu, buffers: &mut Buffers, chain: &Chain, arena: &mut Arena) -> Result<()> {
    let staging = buffers.staging(gpu, PIECE.min(4 * arena.params.len() as u64))?;
    let parts = [&mut arena.params, &mut arena.grads, &mut arena.first, &mut arena.second];
    for (part, data) in PARTS.iter().zip(parts) {
        for s in 0..chain.segments() {
            let Some(buffer) = buffers.get(&format!("{part}_{s}")) else { continue };
            gpu.download(buffer, 0, &staging, bytemuck::cast_slice_mut(&mut data[chain.segment(s)]))?;
        }
    }
    Ok(())
}
