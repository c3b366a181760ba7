//! One stage, projector, loss or prior alone on a device, to compare its WGSL with its Rust.

use crate::Wgpu;
use crate::compose::{self, Chain, GROUP};
use crate::executable::Step;
use crate::programs::Programs;
use crate::wave::GpuRay;
use conefield_core::device::{Device, Program, Source};
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::prior::Prior;
use conefield_core::runner::Runner;
use conefield_core::stage::{Projector, Samples, Stage, UnitRay};

/// Shares of the rows in the sums of a stage.
const SHARES: usize = 3;
/// Groups of a stage's kernels at most: some take several pieces of the rows.
const GROUPS: usize = 7;

impl Runner for Wgpu {
    fn pass(&self, stage: &dyn Stage, params: &[f32], x: &[f32], dy: &[f32], rows: usize) -> Result<[Vec<f32>; 3]> {
        let chain = Chain::single(stage, self.shared.target())?;
        let info = stage.info();
        let step = Step { rows: rows as u32, stride: rows as u32, ..Step::default() };
        let mut device = begun(self, step)?;
        let segments = (0..chain.segments()).map(|s| (s, chain.segment(s)));
        for (s, range) in segments.clone() {
            device.reserve(&format!("grads_{s}"), 4 * range.len() as u64)?;
            write(&mut device, &format!("params_{s}"), &params[range])?;
        }
        if chain.dense_bytes() > 0 {
            write(&mut device, "dense", params)?;
        }
        // No row is left out.
        for (name, data) in [("x", x), ("dy", dy), ("dmu", &vec![1.0; rows])] {
            write(&mut device, name, data)?;
        }
        let (inputs, outputs) = (info.input * rows, info.output * rows);
        for (name, count) in
            [("y", outputs), ("dx", inputs), ("tape", rows * chain.tape), ("partial", SHARES * chain.summed())]
        {
            device.reserve(name, 4 * count as u64)?;
        }
        let groups = rows.div_ceil(GROUP as usize).min(GROUPS);
        let mut kernels =
            vec![("forward", chain.single_forward(), groups), ("backward", chain.single_backward(), groups)];
        if chain.summed() > 0 {
            kernels.push(("sums", chain.sums(), chain.summing(SHARES)));
            kernels.push(("merge", chain.merge(), chain.merging(SHARES)));
        }
        for (label, source, groups) in kernels {
            run(&mut device, label, source, groups)?;
        }
        let mut grads = vec![];
        for (s, range) in segments {
            grads.extend(read(&mut device, &format!("grads_{s}"), range.len())?);
        }
        Ok([read(&mut device, "y", outputs)?, grads, read(&mut device, "dx", inputs)?])
    }

    fn samples(&self, projector: &dyn Projector, rays: &[(UnitRay, Option<u64>)]) -> Result<Vec<Samples>> {
        let source = compose::sample(projector)?;
        let of = |(ray, seed): &(UnitRay, Option<u64>)| {
            let rows = projector.max_samples(ray);
            if rows == 0 {
                return Ok(Samples::default());
            }
            let (count, training) = (rows as u32, u32::from(seed.is_some()));
            let mut device = begun(self, Step { rows: count, ray_rows: count, rays: 1, training, ..Step::default() })?;
            device.reserve("samples", 16 * rows as u64)?;
            let ray = GpuRay::new(ray, 0.0, seed.unwrap_or(0), 0, count);
            device.write("rays", bytemuck::bytes_of(&ray))?;
            run(&mut device, "sample", source.clone(), rows.div_ceil(GROUP as usize))?;
            let found = read(&mut device, "samples", 4 * rows)?;
            let found = found.chunks_exact(4).map(|s| ([s[0], s[1], s[2]], s[3]));
            let (points, weights) = found.unzip();
            Ok(Samples { points, weights })
        };
        rays.iter().map(of).collect()
    }

    fn losses(&self, loss: &dyn Loss, pairs: &[[f32; 2]]) -> Result<Vec<[f32; 2]>> {
        // A kernel adds up the losses of 64 points: each pair stands for as many.
        let each = GROUP as usize;
        let of = |k: usize| pairs.iter().flat_map(|p| vec![p[k]; each]).collect::<Vec<f32>>();
        let rows = (each * pairs.len()) as u32;
        let step = Step { rows, point_rows: rows, point_scale: 1.0, ..Step::default() };
        let inputs = [("mu", of(0)), ("targets", of(1))];
        let [sums, slopes] = derivatives(self, compose::loss_of_points(loss)?, step, &inputs, pairs.len())?;
        Ok(sums.iter().zip(slopes.iter().step_by(each)).map(|(sum, slope)| [sum / each as f32, *slope]).collect())
    }

    fn penalty(&self, prior: &dyn Prior, values: &[f32]) -> Result<(f32, Vec<f32>)> {
        let rows = values.len() as u32;
        let step = Step { rows, blocks: 1, edge: prior.blocks().edge as u32, block_scale: 1.0, ..Step::default() };
        let inputs = [("mu", values.to_vec())];
        let [sum, slopes] = derivatives(self, compose::penalty_of_blocks(prior)?, step, &inputs, 1)?;
        Ok((sum[0], slopes))
    }
}

/// Runs a kernel that makes derivatives by μ, a group for each of the `losses`. Returns these and the derivatives.
fn derivatives(
    backend: &Wgpu,
    source: Source,
    step: Step,
    inputs: &[(&str, Vec<f32>)],
    losses: usize,
) -> Result<[Vec<f32>; 2]> {
    let mut device = begun(backend, step)?;
    for (name, values) in inputs {
        write(&mut device, name, values)?;
    }
    let rows = step.rows as usize;
    device.reserve("losses", 4 * losses as u64)?;
    device.reserve("dmu", 4 * rows as u64)?;
    run(&mut device, "derivatives", source, losses)?;
    Ok([read(&mut device, "losses", losses)?, read(&mut device, "dmu", rows)?])
}

/// A device with the uniform values `step`.
fn begun(backend: &Wgpu, step: Step) -> Result<Programs> {
    let mut device = Programs::new(backend.shared.clone());
    device.write("step", bytemuck::bytes_of(&step))?;
    Ok(device)
}

fn write(device: &mut Programs, name: &str, data: &[f32]) -> Result<()> {
    device.write(name, bytemuck::cast_slice(data))
}

fn run(device: &mut Programs, label: &str, source: Source, groups: usize) -> Result<()> {
    device.run(&[(&Program { label: label.into(), source }, groups)])
}

/// The first `count` numbers of a buffer.
fn read(device: &mut Programs, name: &str, count: usize) -> Result<Vec<f32>> {
    let mut out = vec![0.0; count];
    device.read(name, 0, bytemuck::cast_slice_mut(&mut out))?;
    Ok(out)
}
