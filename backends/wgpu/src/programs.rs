//! Programs of others on the device: [`conefield_core::device::Device`].

use crate::Shared;
use crate::arena::PIECE;
use crate::kernel::{Buffers, Kernel, fits};
use crate::source::validate;
use crate::wave::MOST_GROUPS;
use conefield_core::backend::{Adam, Executable, StepStats, Work};
use conefield_core::device::{Device, Launch, Program};
use conefield_core::error::{Error, Result};
use conefield_core::parallel;
use conefield_core::pipeline::Model;
use conefield_core::stage::{OnDevice, UnitGrid, UnitRay};
use std::collections::HashMap;
use std::sync::Arc;
use wgpu::BufferUsages as U;

/// Named buffers, and the programs that ran on them.
pub struct Programs {
    shared: Arc<Shared>,
    buffers: Buffers,
    kernels: HashMap<String, Arc<Kernel>>,
    /// Kernels with their buffers; none of them is outdated.
    bound: HashMap<String, wgpu::BindGroup>,
}

impl Programs {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared, buffers: Buffers::default(), kernels: HashMap::new(), bound: HashMap::new() }
    }

    fn buffer(&self, name: &str) -> Result<&wgpu::Buffer> {
        self.buffers.get(name).ok_or_else(|| self.shared.gpu.error(format!("no buffer {name}")))
    }

    fn reserve_as(&mut self, name: &str, bytes: u64, usage: U) -> Result<()> {
        let gpu = &self.shared.gpu;
        let most = gpu.adapter.bound_bytes();
        if bytes > most {
            return Err(gpu.error(format!("{name} takes {bytes} bytes, more than the {most} that a kernel may read")));
        }
        if self.buffers.reserve(gpu, name, bytes, usage | U::COPY_SRC | U::COPY_DST)? {
            self.bound.clear();
        }
        Ok(())
    }

    /// Compiles the programs that run for the first time, in parallel, because drivers compile slowly.
    fn compile(&mut self, launches: &[Launch<'_>]) -> Result<()> {
        let mut missing: Vec<&Program> = vec![];
        for (program, _) in launches {
            let known = self.kernels.contains_key(&program.label) || missing.iter().any(|p| p.label == program.label);
            if !known {
                missing.push(program);
            }
        }
        let Shared { gpu, kernels, .. } = &*self.shared;
        let compiled = parallel::map(missing, |_, program| {
            Ok((program.label.clone(), kernels.get(gpu, &program.label, &program.source)?))
        });
        self.kernels.extend(compiled.into_iter().collect::<Result<Vec<_>>>()?);
        Ok(())
    }
}

impl Device for Programs {
    fn name(&self) -> String {
        self.shared.gpu.adapter.to_string()
    }

    fn is_software(&self) -> bool {
        self.shared.gpu.adapter.software
    }

    fn most_bytes(&self) -> u64 {
        self.shared.gpu.adapter.bound_bytes()
    }

    fn admits(&self, program: &Program) -> Result<()> {
        validate(&program.source)?;
        fits(&self.shared.gpu, &program.label, &program.source)
    }

    fn reserve(&mut self, name: &str, bytes: u64) -> Result<()> {
        self.reserve_as(name, bytes, U::STORAGE)
    }

    fn write(&mut self, name: &str, data: &[u8]) -> Result<()> {
        self.reserve_as(name, data.len() as u64, U::STORAGE | U::UNIFORM)?;
        self.shared.gpu.upload(self.buffer(name)?, 0, data)
    }

    fn read(&mut self, name: &str, at: u64, out: &mut [u8]) -> Result<()> {
        let gpu = &self.shared.gpu;
        let staging = self.buffers.staging(gpu, PIECE.min(out.len() as u64))?;
        gpu.download(self.buffer(name)?, at, &staging, out)
    }

    fn copy(&mut self, from: &str, at: u64, to: &str, bytes: u64) -> Result<()> {
        let gpu = &self.shared.gpu;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(self.buffer(from)?, at, self.buffer(to)?, 0, bytes);
        gpu.submit(encoder);
        Ok(())
    }

    fn run(&mut self, launches: &[Launch<'_>]) -> Result<()> {
        self.compile(launches)?;
        for (program, _) in launches {
            if let (false, Some(kernel)) = (self.bound.contains_key(&program.label), self.kernels.get(&program.label)) {
                let bound = kernel.bind(&self.shared.gpu, &self.buffers)?;
                self.bound.insert(program.label.clone(), bound);
            }
        }
        let gpu = &self.shared.gpu;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        for (program, groups) in launches {
            if let (Some(kernel), Some(bound)) = (self.kernels.get(&program.label), self.bound.get(&program.label)) {
                kernel.launch(&mut pass, bound, (*groups).clamp(1, MOST_GROUPS) as u32);
            }
        }
        drop(pass);
        gpu.submit(encoder);
        gpu.fault()
    }
}

/// A field with its own line integrals. Its method trains it.
pub(crate) struct Alone {
    pub(crate) field: Box<dyn OnDevice>,
    /// Whether the parameters are on the device.
    pub(crate) loaded: bool,
}

impl Alone {
    fn load(&mut self, model: &Model) -> Result<&mut dyn OnDevice> {
        if !self.loaded {
            self.field.load(&model.arena.params)?;
            self.loaded = true;
        }
        Ok(self.field.as_mut())
    }

    fn refuse(model: &Model, why: &str) -> Error {
        Error::unsupported(model.pipeline.field.describe(), why)
    }
}

impl Executable for Alone {
    fn step(&mut self, model: &mut Model, _: &Work<'_>) -> Result<StepStats> {
        Err(Self::refuse(model, "its method trains it"))
    }

    fn update(&mut self, model: &mut Model, _: &Adam) -> Result<()> {
        Err(Self::refuse(model, "its method trains it"))
    }

    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        self.load(model)?.evaluate(points, out)
    }

    fn encode(&mut self, model: &Model, _: &[[f32; 3]]) -> Result<Vec<f32>> {
        Err(Self::refuse(model, "there is no encoder"))
    }

    fn values(&mut self, model: &Model, grid: &UnitGrid, out: &mut [f32]) -> Result<()> {
        self.load(model)?.values(grid, out)
    }

    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        self.load(model)?.project(rays, out)
    }

    fn renew(&mut self) {
        self.loaded = false;
    }
}
