//! Launches of kernels on the arrays of a place.

use super::{Array, Chunk, Mask, parts};
use crate::Shared;
use crate::compose::GROUP;
use crate::kernel::Buffers;
use crate::pace::Pace;
use crate::wave::MOST_GROUPS;
use conefield_core::device::{Access, Source};
use conefield_core::error::Result;
use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Instant;
use wgpu::BufferUsages as U;

/// Usage of arrays by kernels and the host.
pub(super) const ARRAY: U = U::STORAGE.union(U::COPY_SRC).union(U::COPY_DST);
/// Elements of a launch at first, on a software device and on others, at least and at most.
const FIRST: [u32; 2] = [1 << 15, 1 << 20];
const LEAST: u32 = 1 << 10;
const MOST: u32 = 1 << 26;
/// Batches of launches on the device at once: one runs while the next one is prepared.
const AHEAD: usize = 2;
/// Elements per partial sum, and most partial sums of a launch.
const SUMMED: u32 = 4096;
const SUMS: u32 = 4096;

/// Buffers by their names in a kernel.
pub(super) type Named<'a> = [(&'a str, &'a wgpu::Buffer)];

/// A kernel, and arrays among its buffers.
pub(super) struct Task<'a> {
    /// Its name for messages.
    label: &'a str,
    pub(super) source: Source,
    /// The uniform buffer that says where a launch begins and ends.
    uniform: &'a str,
    /// Arrays by the names of their parts in the kernel.
    arrays: Vec<(&'a str, &'a [Chunk])>,
}

impl<'a> Task<'a> {
    /// Begins with the structures `text` and the uniform buffer `uniform`, of type `ty`.
    pub(super) fn new(label: &'a str, text: &str, uniform: &'a str, ty: &str) -> Self {
        let task = Self { label, source: Source::default(), uniform, arrays: vec![] };
        task.add(uniform, text).uniform(uniform, ty)
    }

    /// Declares a uniform buffer of WGSL type `ty`.
    pub(super) fn uniform(mut self, name: &str, ty: &str) -> Self {
        self.source.bind(name, Access::Uniform, ty);
        self
    }

    /// Declares a storage buffer with elements of WGSL type `ty`.
    pub(super) fn bind(mut self, name: &str, access: Access, ty: &str) -> Self {
        self.source.bind(name, access, &format!("array<{ty}>"));
        self
    }

    /// Declares a storage buffer of `f32`, and that it is a part of `x`.
    pub(super) fn with(mut self, name: &'a str, access: Access, x: &'a Array) -> Self {
        self.arrays.push((name, parts(x)));
        self.bind(name, access, "f32")
    }

    /// The same for the flags of a mask.
    pub(super) fn masked(mut self, name: &'a str, mask: &'a Mask) -> Self {
        self.arrays.push((name, parts(mask)));
        self.bind(name, Access::Read, "u32")
    }

    /// Appends a piece of text.
    pub(super) fn add(mut self, name: &str, text: &str) -> Self {
        self.source.add(name, text);
        self
    }

    /// Runs `body` for each i of a launch, from `begin` to `end` of the uniform buffer.
    pub(super) fn each(self, body: &str) -> Self {
        let text = include_str!("../kernels/each.wgsl").replace("LAUNCH", self.uniform).replace("BODY", body);
        let label = self.label;
        self.add(label, &text)
    }

    /// Adds up the pairs `v` that `body` computes for each i of a launch, or finds the largest, and writes a pair per group
    /// into `sums`.
    pub(super) fn summing(self, body: &str, largest: bool) -> Self {
        let [add, merge] = if largest {
            ["    total = max(total, v);", "partial[lane] = max(partial[lane], partial[lane + half]);"]
        } else {
            [include_str!("../kernels/add.wgsl"), "partial[lane] += partial[lane + half];"]
        };
        let text = include_str!("../kernels/summing.wgsl").replace("LAUNCH", self.uniform).replace("BODY", body);
        self.bind("sums", Access::Write, "vec2<f32>").add("sums", &text.replace("ADD", add).replace("MERGE", merge))
    }

    /// The buffers of the arrays' k-th parts.
    pub(super) fn parts(&self, k: usize) -> Vec<(&'a str, &'a wgpu::Buffer)> {
        self.arrays.iter().filter_map(|(name, parts)| Some((*name, &parts.get(k)?.buffer))).collect()
    }
}

/// A batch of launches on the device.
struct Batch {
    label: String,
    index: wgpu::SubmissionIndex,
    submitted: Instant,
    launches: usize,
    largest: u32,
}

/// Buffers that launches share, and the size of launches.
pub(super) struct Room {
    pub(super) shared: Arc<Shared>,
    pub(super) buffers: Buffers,
    paces: HashMap<String, Pace>,
    batches: VecDeque<Batch>,
    finished: Option<Instant>,
}

impl Room {
    pub(super) fn new(shared: Arc<Shared>) -> Self {
        let (buffers, paces, batches) = Default::default();
        Self { shared, buffers, paces, batches, finished: None }
    }

    /// Runs `task` over `0..count` in launches; `uniform` returns the buffer that says where a launch begins and ends.
    /// `bind` are its arrays; the other buffers are the room's. Does not wait for the device.
    pub(super) fn run<T: bytemuck::Pod>(
        &mut self,
        task: &Task<'_>,
        bind: &Named<'_>,
        uniform: impl Fn(u32, u32) -> T,
        count: u32,
    ) -> Result<()> {
        let first = FIRST[usize::from(!self.shared.gpu.adapter.software)];
        let size = self.paces.entry(task.label.into()).or_insert_with(|| Pace::new(first, LEAST, MOST)).size();
        let parts = (0..count).step_by(size as usize).map(|at| (at, count.min(at.saturating_add(size))));
        let parts: Vec<_> = parts.map(|(at, end)| (uniform(at, end), (end - at).div_ceil(GROUP))).collect();
        self.launch(task, bind, &parts, count.min(size))
    }

    /// Runs `task`, made by [`Task::summing`], over `0..count`. Returns the two sums, or the largest pair.
    pub(super) fn sum<T: bytemuck::Pod>(
        &mut self,
        task: &Task<'_>,
        bind: &Named<'_>,
        uniform: impl Fn(u32, u32) -> T,
        count: u32,
        largest: bool,
    ) -> Result<[f64; 2]> {
        let groups = count.div_ceil(SUMMED).clamp(1, SUMS);
        let sums = self.buffers.of(&self.shared.gpu, "sums", 8 * u64::from(groups), ARRAY)?;
        self.launch(task, bind, &[(uniform(0, count), groups)], 0)?;
        let mut total = [0.0f64; 2];
        self.read(&sums, 0, 2 * groups as usize, |found| {
            for pair in found.chunks_exact(2) {
                let merge = |k: usize| {
                    let (a, b) = (total[k], f64::from(pair[k]));
                    if largest { a.max(b) } else { a + b }
                };
                total = [merge(0), merge(1)];
            }
        })?;
        Ok(total)
    }

    fn launch<T: bytemuck::Pod>(
        &mut self,
        Task { label, source, uniform, .. }: &Task<'_>,
        bind: &Named<'_>,
        parts: &[(T, u32)],
        largest: u32,
    ) -> Result<()> {
        while self.batches.len() >= AHEAD {
            self.finish_one()?;
        }
        let Shared { gpu, kernels, .. } = &*self.shared;
        let values = self.buffers.of(gpu, uniform, size_of::<T>() as u64, U::UNIFORM | U::COPY_DST)?;
        let kernel = kernels.get(gpu, label, source)?;
        let find = |name: &str| {
            let given = bind.iter().find(|(n, _)| *n == name).map(|(_, buffer)| *buffer);
            given.or_else(|| self.buffers.get(name))
        };
        let bound = kernel.bind(gpu, find)?;
        let submitted = Instant::now();
        let mut last = None;
        for (value, groups) in parts {
            gpu.write(&values, 0, bytemuck::bytes_of(value));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let groups = (*groups).min(MOST_GROUPS as u32);
            kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), &bound, groups);
            last = Some(gpu.submit(encoder));
        }
        if let Some(index) = last {
            self.batches.push_back(Batch { label: (*label).into(), index, submitted, launches: parts.len(), largest });
        }
        Ok(())
    }

    /// Waits for the oldest batch, and adapts the size of such launches.
    fn finish_one(&mut self) -> Result<()> {
        let Some(batch) = self.batches.pop_front() else { return Ok(()) };
        self.shared.gpu.wait_for(batch.index)?;
        let now = Instant::now();
        let begun = self.finished.map_or(batch.submitted, |finished| finished.max(batch.submitted));
        self.finished = Some(now);
        if let (Some(pace), 1..) = (self.paces.get_mut(&batch.label), batch.largest) {
            pace.heard((now - begun).as_secs_f64(), batch.launches, batch.largest);
        }
        Ok(())
    }

    /// Overwrites the first numbers of the room's buffer `name`.
    pub(super) fn write<T: bytemuck::Pod>(&mut self, name: &str, data: &[T]) -> Result<()> {
        let buffer = self.buffers.of(&self.shared.gpu, name, size_of_val(data) as u64, ARRAY)?;
        self.shared.gpu.write(&buffer, 0, bytemuck::cast_slice(data));
        Ok(())
    }

    /// Calls `take` with `count` numbers of `from`, from number `first` on.
    pub(super) fn read(
        &mut self,
        from: &wgpu::Buffer,
        first: usize,
        count: usize,
        take: impl FnOnce(&[f32]),
    ) -> Result<()> {
        let bytes = 4 * count as u64;
        let gpu = &self.shared.gpu;
        let staging = self.buffers.staging(gpu, bytes)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(from, 4 * first as u64, &staging, 0, bytes);
        gpu.submit(encoder);
        while !self.batches.is_empty() {
            self.finish_one()?;
        }
        self.shared.gpu.read(&staging, bytes, |found| take(bytemuck::cast_slice(found)))
    }
}
