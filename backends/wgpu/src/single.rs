//! One stage, projector, loss or prior alone on a device, to compare its WGSL with its Rust.

use crate::Shared;
use crate::arena;
use crate::compose::{self, Chain, GROUP};
use crate::executable::Step;
use crate::kernel::Buffers;
use crate::wave::{GpuRay, MOST_GROUPS};
use conefield_core::arena::Arena;
use conefield_core::device::Source;
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::prior::Prior;
use conefield_core::runner::Runner;
use conefield_core::stage::{Projector, Samples, Stage, UnitRay};
use wgpu::BufferUsages as U;

impl Runner for Shared {
    fn pass(&self, stage: &dyn Stage, params: &[f32], x: &[f32], dy: &[f32], rows: usize) -> Result<[Vec<f32>; 3]> {
        let (gpu, target) = (&self.gpu, self.target());
        let chain = Chain::single(stage, target)?;
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
        let shares = 3;
        buffers.reserve(gpu, "partial", 4 * (shares * chain.summed()) as u64, usage)?;
        buffers.reserve(gpu, "tape", 4 * (rows * chain.tape()) as u64, usage)?;
        // No row is left out.
        buffers.reserve(gpu, "dmu", 4 * rows as u64, usage)?;
        for (name, data) in [("x", x), ("dy", dy), ("dmu", &vec![1.0; rows])] {
            buffers.get(name).inspect(|b| gpu.write(b, 0, bytemuck::cast_slice(data)));
        }
        buffers.reserve(gpu, "step", size_of::<Step>() as u64, U::UNIFORM | U::COPY_DST)?;
        let run = |label: &str, source: &Source, step: Step, groups: usize| -> Result<()> {
            buffers.get("step").inspect(|b| gpu.write(b, 0, bytemuck::bytes_of(&step)));
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
        if chain.summed() > 0 {
            run("sums", &chain.sums(), step, chain.summing(shares).min(MOST_GROUPS))?;
            run("merge", &chain.merge(), step, chain.merging(shares).min(MOST_GROUPS))?;
        }
        arena::download(gpu, &mut buffers, &chain, &mut arena, target.segment)?;
        let [y, dx] =
            [("y", info.output * rows), ("dx", info.input * rows)].map(|(name, n)| self.fetch(&buffers, name, n));
        Ok([y?, arena.grads.to_vec(), dx?])
    }

    fn samples(&self, projector: &dyn Projector, rays: &[(UnitRay, Option<u64>)]) -> Result<Vec<Samples>> {
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
            buffers.get("rays").inspect(|b| gpu.write(b, 0, bytemuck::bytes_of(&on_device)));
            buffers.get("step").inspect(|b| gpu.write(b, 0, bytemuck::bytes_of(&step)));
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

    fn losses(&self, loss: &dyn Loss, pairs: &[[f32; 2]]) -> Result<Vec<[f32; 2]>> {
        // A kernel adds up the losses of 64 points: each pair stands for as many.
        let each = GROUP as usize;
        let of = |k: usize| pairs.iter().flat_map(|p| vec![p[k]; each]).collect::<Vec<f32>>();
        let rows = (each * pairs.len()) as u32;
        let step = Step { rows, point_rows: rows, point_scale: 1.0, ..Step::default() };
        let source = compose::loss_of_points(loss)?;
        let inputs = [("mu", of(0)), ("targets", of(1))];
        let [sums, slopes] = self.derivatives("loss of points", &source, step, &inputs, pairs.len())?;
        Ok(sums.iter().zip(slopes.iter().step_by(each)).map(|(sum, slope)| [sum / each as f32, *slope]).collect())
    }

    fn penalty(&self, prior: &dyn Prior, values: &[f32]) -> Result<(f32, Vec<f32>)> {
        let rows = values.len() as u32;
        let step = Step { rows, blocks: 1, edge: prior.blocks().edge as u32, block_scale: 1.0, ..Step::default() };
        let source = compose::penalty_of_blocks(prior)?;
        let inputs = [("mu", values.to_vec())];
        let [sum, slopes] = self.derivatives("penalty of blocks", &source, step, &inputs, 1)?;
        Ok((sum[0], slopes))
    }
}

impl Shared {
    /// Runs a kernel that makes derivatives by μ, a group for each of the `losses`. Returns these and the derivatives.
    fn derivatives(
        &self,
        label: &str,
        source: &Source,
        step: Step,
        inputs: &[(&str, Vec<f32>)],
        losses: usize,
    ) -> Result<[Vec<f32>; 2]> {
        let gpu = &self.gpu;
        let mut buffers = Buffers::default();
        buffers.reserve(gpu, "step", size_of::<Step>() as u64, U::UNIFORM | U::COPY_DST)?;
        buffers.get("step").inspect(|b| gpu.write(b, 0, bytemuck::bytes_of(&step)));
        for (name, values) in inputs {
            buffers.reserve(gpu, name, 4 * values.len() as u64, U::STORAGE | U::COPY_DST)?;
            buffers.get(name).inspect(|b| gpu.write(b, 0, bytemuck::cast_slice(values)));
        }
        let outputs = [("losses", losses), ("dmu", step.rows as usize)];
        for (name, count) in outputs {
            buffers.reserve(gpu, name, 4 * count as u64, U::STORAGE | U::COPY_SRC)?;
        }
        let kernel = self.kernels.get(gpu, label, source)?;
        let bound = kernel.bind(gpu, &buffers)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        kernel.launch(&mut encoder.begin_compute_pass(&Default::default()), &bound, losses as u32);
        gpu.queue.submit([encoder.finish()]);
        let [losses, slopes] = outputs.map(|(name, count)| self.fetch(&buffers, name, count));
        Ok([losses?, slopes?])
    }

    /// The first `count` numbers of a buffer.
    fn fetch(&self, buffers: &Buffers, name: &str, count: usize) -> Result<Vec<f32>> {
        let (gpu, bytes) = (&self.gpu, 4 * count as u64);
        let staging = gpu.buffer("staging", bytes, U::MAP_READ | U::COPY_DST)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        buffers.get(name).inspect(|b| encoder.copy_buffer_to_buffer(b, 0, &staging, 0, bytes));
        gpu.queue.submit([encoder.finish()]);
        let mut out = vec![0.0; count];
        gpu.read(&staging, bytes, |found| out.copy_from_slice(bytemuck::cast_slice(found)))?;
        Ok(out)
    }
}
