//! Programs of others on the device: [`conefield_core::device::Device`].

use crate::Shared;
use crate::arena::PIECE;
use crate::device::Gpu;
use crate::kernel::{Buffers, Kernel, admit};
use crate::wave::MOST_GROUPS;
use conefield_core::backend::{Adam, Executable, StepStats, Work};
use conefield_core::device::{Device, Launch, Program, Source};
use conefield_core::error::{Error, Result};
use conefield_core::parallel;
use conefield_core::pipeline::Model;
use conefield_core::stage::{OnDevice, UnitGrid, UnitRay};
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use wgpu::BufferUsages as U;

/// Named buffers, and the kernels that ran on them by their labels.
pub(crate) struct Programs {
    pub(crate) shared: Arc<Shared>,
    pub(crate) buffers: Buffers,
    kernels: HashMap<String, Arc<Kernel>>,
    /// Kernels with their buffers; none of them is outdated.
    bound: HashMap<String, wgpu::BindGroup>,
}

impl Programs {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared, buffers: Buffers::default(), kernels: HashMap::new(), bound: HashMap::new() }
    }

    pub(crate) fn gpu(&self) -> &Gpu {
        &self.shared.gpu
    }

    pub(crate) fn buffer(&self, name: &str) -> Result<&wgpu::Buffer> {
        self.buffers.get(name).ok_or_else(|| self.gpu().error(format!("no buffer {name}")))
    }

    /// Makes sure that there is a buffer `name` of at least `bytes`.
    pub(crate) fn reserve_as(&mut self, name: &str, bytes: u64, usage: U) -> Result<()> {
        if self.buffers.reserve(&self.shared.gpu, name, bytes, usage)? {
            self.bound.clear();
        }
        Ok(())
    }

    /// The same for a buffer of others, which a kernel must be able to read as a whole.
    fn reserve_whole(&mut self, name: &str, bytes: u64, usage: U) -> Result<()> {
        let most = self.most_bytes();
        if bytes > most {
            let what = format!("{name} takes {bytes} bytes, more than the {most} that a kernel may read");
            return Err(self.gpu().error(what));
        }
        self.reserve_as(name, bytes, usage | U::COPY_SRC | U::COPY_DST)
    }

    /// Compiles those kernels that are missing in parallel, because drivers compile slowly.
    pub(crate) fn compile<'a>(&mut self, all: impl Iterator<Item = (&'a String, &'a Source)>) -> Result<()> {
        let missing: BTreeMap<_, _> = all.filter(|(label, _)| !self.kernels.contains_key(*label)).collect();
        let Shared { gpu, kernels, .. } = &*self.shared;
        let compiled =
            parallel::map(missing, |_, (label, source)| Ok((label.clone(), kernels.get(gpu, label, source)?)));
        self.kernels.extend(compiled.into_iter().collect::<Result<Vec<_>>>()?);
        Ok(())
    }

    /// Forgets a kernel, whose text has changed.
    pub(crate) fn forget(&mut self, label: &str) {
        self.kernels.remove(label);
        self.bound.remove(label);
    }

    /// Forgets which buffers kernels use.
    pub(crate) fn unbind(&mut self) {
        self.bound.clear();
    }

    /// A kernel, compiled, with its buffers, which are bound once under `bound`. `name` returns the name of the buffer for
    /// one in the kernel.
    pub(crate) fn ready(
        &mut self,
        (label, source): (&String, &Source),
        bound: &str,
        name: impl Fn(&str) -> String,
    ) -> Result<(Arc<Kernel>, wgpu::BindGroup)> {
        if !self.kernels.contains_key(label) {
            self.compile([(label, source)].into_iter())?;
        }
        let kernel = self.kernels[label].clone();
        if !self.bound.contains_key(bound) {
            let group = kernel.bind(self.gpu(), |buffer| self.buffers.get(&name(buffer)))?;
            self.bound.insert(bound.into(), group);
        }
        Ok((kernel, self.bound[bound].clone()))
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
        admit(self.gpu(), &program.label, &program.source)
    }

    fn reserve(&mut self, name: &str, bytes: u64) -> Result<()> {
        self.reserve_whole(name, bytes, U::STORAGE)
    }

    fn write(&mut self, name: &str, data: &[u8]) -> Result<()> {
        self.reserve_whole(name, data.len() as u64, U::STORAGE | U::UNIFORM)?;
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
        self.compile(launches.iter().map(|(program, _)| (&program.label, &program.source)))?;
        let ready = |(program, groups): &Launch<'_>| {
            let Program { label, source } = program;
            Ok((self.ready((label, source), label, str::to_owned)?, *groups))
        };
        let ready = launches.iter().map(ready).collect::<Result<Vec<_>>>()?;
        let gpu = self.gpu();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        for ((kernel, bound), groups) in ready {
            kernel.launch(&mut pass, &bound, groups.clamp(1, MOST_GROUPS) as u32);
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
