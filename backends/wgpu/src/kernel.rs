//! A cache of compiled kernels, and their launch on named buffers.

use crate::device::Gpu;
use crate::source::validate;
use conefield_core::device::{Access, Source};
use conefield_core::error::{Error, Result};
use conefield_core::wgsl::FOREIGN;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// A compiled kernel.
pub struct Kernel {
    /// Its name.
    pub label: String,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    /// Names of its buffers, in order.
    buffers: Vec<String>,
}

/// Compiled kernels by their text.
#[derive(Default)]
pub struct Cache(Mutex<HashMap<String, Arc<Kernel>>>);

impl Cache {
    /// The kernel of `source`, compiled unless it is in the cache.
    pub fn get(&self, gpu: &Gpu, label: &str, source: &Source) -> Result<Arc<Kernel>> {
        let known = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kernel) = known().get(source.text()) {
            return Ok(kernel.clone());
        }
        // The lock is free, so that other threads can compile.
        let kernel = Arc::new(compile(gpu, label, source)?);
        known().insert(source.text().into(), kernel.clone());
        Ok(kernel)
    }

    /// Labels of all kernels, in alphabetical order.
    pub fn labels(&self) -> Vec<String> {
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut labels: Vec<_> = known.values().map(|kernel| kernel.label.clone()).collect();
        labels.sort();
        labels
    }
}

/// Refuses invalid WGSL, and a kernel that uses more buffers than the device binds.
pub fn admit(gpu: &Gpu, label: &str, source: &Source) -> Result<()> {
    validate(source)?;
    let (needs, has) = (source.storage_buffers(), gpu.adapter.storage_buffers);
    if needs <= has {
        return Ok(());
    }
    Err(Error::unsupported(
        format!("kernel {label} on {}", gpu.adapter),
        format!("it reads and writes {needs} storage buffers, the adapter binds {has}; smaller tables need fewer"),
    ))
}

/// Run-time checks of a kernel. A counter that ends every loop keeps drivers from unrolling it, so only kernels with a
/// plugin's text have one.
fn checks(source: &Source) -> wgpu::ShaderRuntimeChecks {
    wgpu::ShaderRuntimeChecks {
        force_loop_bounding: source.text().contains(FOREIGN),
        ..wgpu::ShaderRuntimeChecks::checked()
    }
}

fn compile(gpu: &Gpu, label: &str, source: &Source) -> Result<Kernel> {
    admit(gpu, label, source)?;
    let started = Instant::now();
    let entry = |(i, access): (usize, Access)| wgpu::BindGroupLayoutEntry {
        binding: i as u32,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer {
            ty: match access {
                Access::Uniform => wgpu::BufferBindingType::Uniform,
                Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                Access::Write => wgpu::BufferBindingType::Storage { read_only: false },
            },
            has_dynamic_offset: false,
            min_binding_size: None,
        },
        count: None,
    };
    let entries: Vec<_> = source.bindings().iter().map(|b| b.access).enumerate().map(entry).collect();
    let (pipeline, layout) = gpu.checked(&format!("kernel {label}"), || {
        let descriptor =
            wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.text().into()) };
        // SAFETY: all other checks stay, and every loop of the program's own WGSL ends.
        #[expect(unsafe_code, reason = "wgpu asks for it where a check is left out")]
        let module = unsafe { gpu.device.create_shader_module_trusted(descriptor, checks(source)) };
        let layout = gpu
            .device
            .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries });
        let whole = gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(label),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(label),
            layout: Some(&whole),
            module: &module,
            entry_point: Some("main"),
            // Kernels write workgroup memory before they read it.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        (pipeline, layout)
    })?;
    tracing::debug!("kernel {label} compiled in {:.2} s", started.elapsed().as_secs_f64());
    Ok(Kernel {
        label: label.into(),
        pipeline,
        layout,
        buffers: source.bindings().iter().map(|b| b.name.clone()).collect(),
    })
}

/// Buffers by their names in kernels.
#[derive(Default)]
pub struct Buffers(HashMap<String, wgpu::Buffer>);

impl Buffers {
    /// The buffer called `name`.
    pub fn get(&self, name: &str) -> Option<&wgpu::Buffer> {
        self.0.get(name)
    }

    /// Ensures a buffer `name` of at least `bytes`. Returns whether it is new.
    pub fn reserve(&mut self, gpu: &Gpu, name: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<bool> {
        if self.get(name).is_some_and(|b| b.size() >= bytes) {
            return Ok(false);
        }
        let buffer = gpu.buffer(name, bytes, usage)?;
        self.0.insert(name.into(), buffer);
        Ok(true)
    }

    /// The same buffer, new or not.
    pub fn of(&mut self, gpu: &Gpu, name: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer> {
        self.reserve(gpu, name, bytes, usage)?;
        Ok(self.0[name].clone())
    }

    /// The buffer `staging`, of at least `bytes`, through which results come back to the host.
    pub fn staging(&mut self, gpu: &Gpu, bytes: u64) -> Result<wgpu::Buffer> {
        self.of(gpu, "staging", bytes, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST)
    }
}

impl Kernel {
    /// A bind group of the buffers that `find` returns for its names.
    pub fn bind<'a>(&self, gpu: &Gpu, find: impl Fn(&str) -> Option<&'a wgpu::Buffer>) -> Result<wgpu::BindGroup> {
        let mut entries = vec![];
        for (i, name) in self.buffers.iter().enumerate() {
            let buffer = find(name).ok_or_else(|| gpu.error(format!("kernel {}: no buffer {name}", self.label)))?;
            entries.push(wgpu::BindGroupEntry { binding: i as u32, resource: buffer.as_entire_binding() });
        }
        gpu.checked(&format!("buffers of kernel {}", self.label), || {
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(&self.label),
                layout: &self.layout,
                entries: &entries,
            })
        })
    }

    /// Adds a launch of `groups` groups to a pass.
    pub fn launch(&self, pass: &mut wgpu::ComputePass<'_>, bound: &wgpu::BindGroup, groups: u32) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, bound, &[]);
        pass.dispatch_workgroups(groups, 1, 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_own_loops_run_unchecked() {
        let mut source = Source::default();
        source.add("field (own)", "fn own() {}");
        assert!(
            !checks(&source).force_loop_bounding && checks(&source).bounds_checks && checks(&source).int_div_checks
        );
        source.add("field (plugin)", &format!("fn other() {{}}\n{FOREIGN}"));
        assert!(checks(&source).force_loop_bounding);
    }
}
