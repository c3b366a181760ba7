//! The wgpu backend: runs a pipeline as a few kernels on any GPU with Vulkan, Metal or DX12.
//!
//! - `device`: adapters and their features.
//! - `compose`, [`source`]: the text of kernels, put together from the stages' fragments.
//! - `kernel`: compiled kernels and the buffers that they use.
//! - `arena`: parameters, gradients and moments on the device.
//! - `wave`: a step's work cut into pieces of bounded size.
//! - `executable`: steps, updates, evaluation.
//! - `measure`: measured limits of a device.
//! - `profile`: time on the device.
//! - `programs`: programs of fields with their own line integrals.
//! - `single`: one stage alone, to compare it with the CPU.
//! - `place`: volumes and views on the device, and the kernels that combine them.
//!
//! Sums over rows have no fixed order. Results agree with the CPU's within rounding, and so do two runs.

mod arena;
mod compose;
mod device;
mod executable;
mod kernel;
mod measure;
mod pace;
mod place;
mod profile;
mod programs;
mod single;
pub mod source;
mod staging;
mod wave;

use compose::{Chain, Target};
use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::device::Device;
use conefield_core::error::Result;
use conefield_core::pipeline::Pipeline;
use conefield_core::place::{Moved, Place};
use conefield_core::stage::{GradKind, titled};
use device::Gpu;
pub use device::{Adapter, Atomics, Limits, adapters};
use executable::Wgpu as Running;
use kernel::Cache;
pub use measure::Ceiling;
use place::DevicePlace;
use programs::{Alone, Programs};
use std::sync::Arc;

/// An open device with the kernels compiled so far.
pub struct Wgpu {
    shared: Arc<Shared>,
    place: Arc<DevicePlace>,
}

/// State shared by all executables of a backend.
struct Shared {
    gpu: Gpu,
    /// Kernels by their text.
    kernels: Cache,
    /// Whether executables time their kernels.
    profile: bool,
}

impl Shared {
    /// Properties of the device on which the text of kernels depends.
    fn target(&self) -> Target {
        let adapter = &self.gpu.adapter;
        let bytes = adapter.bound_bytes();
        Target {
            atomics: adapter.atomics,
            subgroups: adapter.subgroups.is_some(),
            segment: ((bytes / 4) as usize / 64 * 64).max(64),
            uniform_bytes: adapter.uniform_bytes as usize,
        }
    }
}

impl Wgpu {
    /// Opens adapter `index`, or the preferred one.
    pub fn open(index: Option<usize>) -> Result<Self> {
        Self::with_limits(index, Limits::default())
    }

    /// The same with other limits than the adapter's.
    pub fn with_limits(index: Option<usize>, limits: Limits) -> Result<Self> {
        let gpu = Gpu::open(index, limits)?;
        let shared = Arc::new(Shared { gpu, kernels: Cache::default(), profile: limits.profile });
        Ok(Self { place: Arc::new(DevicePlace::new(shared.clone())), shared })
    }

    /// The device.
    pub fn adapter(&self) -> &Adapter {
        &self.shared.gpu.adapter
    }

    /// Labels of the kernels compiled so far, in alphabetical order.
    pub fn kernels(&self) -> Vec<String> {
        self.shared.kernels.labels()
    }
}

impl Backend for Wgpu {
    fn name(&self) -> &'static str {
        "wgpu"
    }

    fn describe(&self) -> String {
        format!("wgpu, {}", self.shared.gpu.adapter)
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        let shared = &self.shared;
        if let Some(lines) = pipeline.field.lines() {
            let field = lines.on_device(Box::new(Programs::new(shared.clone())))?;
            let notes = vec![format!("{}: kernels of its own", titled("field", &pipeline.field.describe()))];
            let explain = Explain { backend: self.describe(), notes, scratch_bytes: 0 };
            return Ok((Box::new(Alone { field, loaded: false }), explain));
        }
        let chain = Chain::new(pipeline, shared.target())?;
        let running = Running::new(shared.clone(), chain.clone(), pipeline.projector.as_ref())?;
        let adapter = &shared.gpu.adapter;
        let device_bytes = running.device_bytes();
        let mut notes: Vec<String> = vec![];
        for (name, stage) in pipeline.stages() {
            let info = stage.info();
            let name = titled(&name, &stage.describe());
            notes.push(match (info.identity, info.grads) {
                (true, _) => format!("{name}: identity, left out"),
                (_, GradKind::None) => format!("{name}: fused"),
                (_, GradKind::Dense) => format!("{name}: fused, gradients summed over rows by a kernel of their own"),
                (_, GradKind::Scatter) => {
                    let first = if chain.together() { ", summed in subgroups first" } else { "" };
                    format!("{name}: fused, gradients by {}{first}", adapter.atomics)
                }
            });
        }
        notes.push("split: samples and line integrals have their own kernels, because they work on whole rays".into());
        let after = if chain.scatters() { ", and the encoder's gradients after it" } else { "" };
        notes.push(match chain.kept() {
            0 => "split: forward and backward; the encoder is recomputed, which costs less than storing its features"
                .into(),
            n => format!("split: forward and backward{after}; {n} features per sample are kept in between"),
        });
        if chain.tape > 0 {
            notes.push(format!("stages keep {} numbers per sample between forward, backward and sums", chain.tape));
        }
        if chain.segments() > 1 {
            notes.push(format!(
                "parameters in {} buffers of at most {} bytes",
                chain.segments(),
                adapter.bound_bytes()
            ));
        }
        let explain = Explain {
            backend: self.describe(),
            notes,
            // A software device uses the machine's memory.
            scratch_bytes: running.host_bytes() + if adapter.software { device_bytes as usize } else { 0 },
        };
        Ok((Box::new(running), explain))
    }

    fn place(&self) -> Arc<dyn Place> {
        self.place.clone()
    }

    fn device(&self) -> Option<Box<dyn Device>> {
        Some(Box::new(Programs::new(self.shared.clone())))
    }

    fn moved(&self) -> Moved {
        self.shared.gpu.moved()
    }
}
