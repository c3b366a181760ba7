//! One stage alone on a device, by which its WGSL is compared with its Rust.

use crate::Shared;
use crate::arena;
use crate::compose::{self, Chain, GROUP};
use crate::executable::Step;
use crate::kernel::Buffers;
use crate::wave::GpuRay;
use conefield_core::arena::Arena;
use conefield_core::error::Result;
use conefield_core::precision::Tables;
use conefield_core::stage::{Projector, Samples, Stage, UnitRay};
use wgpu::BufferUsages as U;

impl Shared {
    /// Runs a stage forward and backward on `x` and `dy`, channel-major with `rows` rows. Returns its outputs, the
    /// gradients of its parameters and those of its inputs.
    pub fn pass(
        &self,
        stage: &dyn Stage,
        tables: Tables,
        params: &[f32],
        x: &[f32],
        dy: &[f32],
        rows: usize,
    ) -> Result<[Vec<f32>; 3]> {
        let (gpu, target) = (&self.gpu, self.target());
        let chain = Chain::single(stage, tables, target)?;
        let info = stage.info();
        let mut buffers = Buffers::default();
        let mut arena = Arena::new(params.len());
        arena.params.copy_from_slice(params);
        arena::allocate(gpu, &mut buffers, &chain, params.len(), target.segment)?;
        arena::upload(self, &buffers, &chain, &arena)?;
        let groups = rows.div_ceil(GROUP as usize).min(7);
        let (inputs, outputs) = (4 * (info.input * rows) as u64, 4 * (info.output * rows) as u64);
        let usage = U::STORAGE | U::COPY_DST | U::COPY_SRC;
        for (name, bytes) in [("x", inputs), ("dx", inputs), ("y", outputs), ("dy", outputs)] {
            buffers.reserve(gpu, name, bytes, usage)?;
        }
        buffers.reserve(gpu, "partial", 4 * (groups * chain.dense) as u64, usage)?;
        for (name, data) in [("x", x), ("dy", dy)] {
            buffers.get(name).inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::cast_slice(data)));
        }
        buffers.reserve(gpu, "step", size_of::<Step>() as u64, U::UNIFORM | U::COPY_DST)?;
        let run = |label: &str, source: &crate::source::Source, step: Step, groups: usize| -> Result<()> {
            buffers.get("step").inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::bytes_of(&step)));
            let kernel = self.kernels.get(gpu, label, source)?;
            let bound = kernel.bind(gpu, &buffers)?;
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), &bound, groups as u32);
            gpu.queue.submit([encoder.finish()]);
            gpu.wait()
        };
        let step = Step { rows: rows as u32, stride: rows as u32, ..Step::default() };
        run("forward", &chain.single_forward(), step, groups)?;
        run("backward", &chain.single_backward(), step, groups)?;
        if chain.dense > 0 {
            let step = Step { rows: groups as u32, ..step };
            run("merge", &chain.merge(), step, chain.dense.div_ceil(GROUP as usize))?;
        }
        arena::download(gpu, &buffers, &chain, &mut arena, target.segment)?;
        let read = |name: &str, n: usize| -> Result<Vec<f32>> {
            let bytes = 4 * n as u64;
            let staging = gpu.buffer("staging", bytes, U::MAP_READ | U::COPY_DST)?;
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            buffers.get(name).inspect(|b| encoder.copy_buffer_to_buffer(b, 0, &staging, 0, bytes));
            gpu.queue.submit([encoder.finish()]);
            let mut out = vec![0.0; n];
            gpu.read(&staging, bytes, |found| out.copy_from_slice(bytemuck::cast_slice(found)))?;
            Ok(out)
        };
        Ok([read("y", info.output * rows)?, arena.grads.to_vec(), read("dx", info.input * rows)?])
    }

    /// The samples of `rays`, each with its seed where positions are random.
    pub fn samples(&self, projector: &dyn Projector, rays: &[(UnitRay, Option<u64>)]) -> Result<Vec<Samples>> {
        let gpu = &self.gpu;
        let mut all = vec![];
        let source = compose::sample(projector)?;
        for (ray, seed) in rays {
            let count = projector.max_samples(ray);
            let mut buffers = Buffers::default();
            buffers.reserve(gpu, "samples", 16 * count as u64, U::STORAGE | U::COPY_SRC)?;
            buffers.reserve(gpu, "rays", size_of::<GpuRay>() as u64, U::STORAGE | U::COPY_DST)?;
            buffers.reserve(gpu, "step", size_of::<Step>() as u64, U::UNIFORM | U::COPY_DST)?;
            let on_device = GpuRay::new(ray, 0.0, seed.unwrap_or(0), 0, count as u32);
            let (rows, training) = (count as u32, u32::from(seed.is_some()));
            let step = Step { rows, ray_rows: rows, rays: 1, training, ..Step::default() };
            buffers.get("rays").inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::bytes_of(&on_device)));
            buffers.get("step").inspect(|b| gpu.queue.write_buffer(b, 0, bytemuck::bytes_of(&step)));
            let kernel = self.kernels.get(gpu, "sample", &source)?;
            let bound = kernel.bind(gpu, &buffers)?;
            let staging = gpu.buffer("staging", 16 * count as u64, U::MAP_READ | U::COPY_DST)?;
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if count > 0 {
                kernel.launch(
                    &mut encoder.begin_compute_pass(&Default::default()),
                    &bound,
                    count.div_ceil(GROUP as usize) as u32,
                );
                buffers.get("samples").inspect(|b| encoder.copy_buffer_to_buffer(b, 0, &staging, 0, 16 * count as u64));
            }
            gpu.queue.submit([encoder.finish()]);
            let mut samples = Samples::default();
            gpu.read(&staging, 16 * count as u64, |found| {
                for s in bytemuck::cast_slice::<u8, [f32; 4]>(found) {
                    samples.points.push([s[0], s[1], s[2]]);
                    samples.weights.push(s[3]);
                }
            })?;
            all.push(samples);
        }
        Ok(all)
    }
}
