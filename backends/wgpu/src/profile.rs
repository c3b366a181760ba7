//! Time on the device for each kernel.

use crate::device::Gpu;
use conefield_core::error::Result;
use std::collections::BTreeMap;

/// Launches that are timed before their times are read.
const LAUNCHES: u32 = 512;

/// Times kernels by timestamps around their passes.
pub struct Profile {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    waiting: Vec<String>,
    seconds: BTreeMap<String, f64>,
}

impl Profile {
    /// A profile, if the device has timestamps.
    pub fn new(gpu: &Gpu) -> Result<Option<Self>> {
        use wgpu::BufferUsages as U;
        if !gpu.adapter.timestamps {
            return Ok(None);
        }
        let bytes = 16 * u64::from(LAUNCHES);
        let queries = gpu.checked("timestamps", || {
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: 2 * LAUNCHES,
            })
        })?;
        Ok(Some(Self {
            queries,
            resolved: gpu.buffer("timestamps", bytes, U::QUERY_RESOLVE | U::COPY_SRC)?,
            staging: gpu.buffer("timestamps", bytes, U::MAP_READ | U::COPY_DST)?,
            waiting: vec![],
            seconds: BTreeMap::new(),
        }))
    }

    /// Timestamps for the pass of `label`. At most 512 between two calls of [`Profile::collect`]; further ones
    /// are not timed.
    pub fn around(&mut self, label: &str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let at = self.waiting.len() as u32;
        if at == LAUNCHES {
            return None;
        }
        self.waiting.push(label.into());
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * at),
            end_of_pass_write_index: Some(2 * at + 1),
        })
    }

    /// Collects the measured times. Waits for the device.
    pub fn collect(&mut self, gpu: &Gpu) -> Result<()> {
        let n = self.waiting.len() as u32;
        if n == 0 {
            return Ok(());
        }
        let bytes = 16 * u64::from(n);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.resolve_query_set(&self.queries, 0..2 * n, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, bytes);
        gpu.queue.submit([encoder.finish()]);
        let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-9;
        let Self { waiting, seconds, staging, .. } = self;
        gpu.read(staging, bytes, |found| {
            for (label, t) in waiting.drain(..).zip(bytemuck::cast_slice::<u8, [u64; 2]>(found)) {
                *seconds.entry(label).or_default() += t[1].saturating_sub(t[0]) as f64 * period;
            }
        })
    }

    /// Seconds of each kernel since the last call.
    pub fn take(&mut self) -> Vec<(String, f64)> {
        std::mem::take(&mut self.seconds).into_iter().collect()
    }
}
