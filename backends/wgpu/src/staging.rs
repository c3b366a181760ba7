//! Large writes through staging buffers that stay: a new one for each write would have to be allocated and pinned.

use crate::device::Gpu;
use conefield_core::error::Result;
use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, channel};
use wgpu::BufferUsages as U;

/// Bytes of a staging buffer, and how many there are: the host fills one while the device reads others.
const BYTES: usize = 64 << 20;
const BUFFERS: usize = 4;
/// Smaller writes are left to the queue.
const WORTH_IT: usize = 1 << 20;

/// The staging buffers of a device.
#[derive(Default)]
pub(crate) struct Staging(VecDeque<Stage>);

struct Stage {
    buffer: wgpu::Buffer,
    /// The copy that reads it.
    index: wgpu::SubmissionIndex,
    /// The message that it can be written again.
    mapped: Receiver<std::result::Result<(), wgpu::BufferAsyncError>>,
}

impl Staging {
    /// Overwrites `data.len()` bytes of `to` from byte `at` on. Both are multiples of 4.
    pub(crate) fn write(&mut self, gpu: &Gpu, to: &wgpu::Buffer, at: u64, data: &[u8]) -> Result<()> {
        if data.len() < WORTH_IT {
            gpu.queue.write_buffer(to, at, data);
            return Ok(());
        }
        for (k, piece) in data.chunks(BYTES).enumerate() {
            let stage = self.free(gpu)?;
            let bytes = piece.len() as u64;
            let mut view = stage.slice(..bytes).get_mapped_range_mut().map_err(|e| gpu.error(e.to_string()))?;
            view.copy_from_slice(piece);
            drop(view);
            stage.unmap();
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(&stage, 0, to, at + (k * BYTES) as u64, bytes);
            let index = gpu.submit(encoder);
            let (sender, receiver) = channel();
            stage.slice(..).map_async(wgpu::MapMode::Write, move |r| drop(sender.send(r)));
            self.0.push_back(Stage { buffer: stage, index, mapped: receiver });
        }
        Ok(())
    }

    /// A buffer that can be written.
    fn free(&mut self, gpu: &Gpu) -> Result<wgpu::Buffer> {
        if self.0.len() < BUFFERS {
            return gpu.checked("staging", || {
                gpu.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("staging"),
                    size: BYTES as u64,
                    usage: U::MAP_WRITE | U::COPY_SRC,
                    mapped_at_creation: true,
                })
            });
        }
        let Some(Stage { buffer, index, mapped }) = self.0.pop_front() else {
            return Err(gpu.error("no staging buffer"));
        };
        gpu.wait_for(index)?;
        gpu.heard(&mapped)?;
        Ok(buffer)
    }
}
