//! Adapters and their features; an open device and its errors.

use crate::staging::Staging;
use conefield_core::error::{Error, Result};
use conefield_core::pages::copy;
use conefield_core::place::Moved;
use serde::Serialize;
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::Duration;

/// How gradients of scattered parameters are added.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Atomics {
    /// The device adds `f32` atomically.
    Native,
    /// Compare and exchange, repeated until it succeeds. Every device can do this.
    CompareExchange,
}

impl Atomics {
    /// The type, in WGSL, of a number that is added to atomically.
    pub fn number(self) -> &'static str {
        match self {
            Self::Native => "f32",
            Self::CompareExchange => "u32",
        }
    }

    /// Adds `v` to `place`, in WGSL.
    pub fn sum(self, place: &str) -> String {
        match self {
            Self::Native => format!("    atomicAdd(&{place}, v);\n"),
            Self::CompareExchange => format!(
                "    var old = atomicLoad(&{place});
    loop {{
        let found = atomicCompareExchangeWeak(&{place}, old, bitcast<u32>(bitcast<f32>(old) + v));
        if found.exchanged {{ break; }}
        old = found.old_value;
    }}
"
            ),
        }
    }
}

impl fmt::Display for Atomics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Native => "native f32 atomics",
            Self::CompareExchange => "f32 sums by compare and exchange",
        })
    }
}

/// An available device and its limits.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Adapter {
    /// Its position in the list, by which users choose it.
    pub index: usize,
    /// Name of the device.
    pub name: String,
    /// Vulkan, Metal or DX12.
    pub api: String,
    /// Discrete, integrated, virtual, or a CPU that acts as one.
    pub kind: String,
    /// Driver and its version.
    pub driver: String,
    /// Whether a CPU does the work.
    pub software: bool,
    /// Bytes of the largest buffer that a kernel may read or write.
    pub binding_bytes: u64,
    /// Bytes of the largest buffer.
    pub buffer_bytes: u64,
    /// Bytes of the largest uniform buffer that a kernel may read.
    pub uniform_bytes: u64,
    /// Storage buffers that one kernel may use.
    pub storage_buffers: u32,
    /// Bytes of workgroup memory.
    pub workgroup_bytes: u32,
    /// How gradients of scattered parameters are added.
    pub atomics: Atomics,
    /// Minimum and maximum number of lanes of a subgroup, if kernels may use subgroup operations.
    pub subgroups: Option<[u32; 2]>,
    /// Whether kernels can be timed on the device.
    pub timestamps: bool,
    /// Sizes and types of the matrices that subgroups multiply together, where the driver lists some.
    pub cooperative_matrices: Vec<String>,
    /// Names of all optional features, as wgpu has them.
    pub features: Vec<String>,
}

impl Adapter {
    fn of(index: usize, adapter: &wgpu::Adapter) -> Self {
        let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
        let atomics = if features.contains(wgpu::Features::SHADER_FLOAT32_ATOMIC) {
            Atomics::Native
        } else {
            Atomics::CompareExchange
        };
        let lanes = [info.subgroup_min_size, info.subgroup_max_size];
        Self {
            index,
            name: info.name,
            api: info.backend.to_string(),
            kind: match info.device_type {
                wgpu::DeviceType::DiscreteGpu => "discrete GPU",
                wgpu::DeviceType::IntegratedGpu => "integrated GPU",
                wgpu::DeviceType::VirtualGpu => "virtual GPU",
                wgpu::DeviceType::Cpu => "software",
                wgpu::DeviceType::Other => "other",
            }
            .into(),
            driver: [info.driver, info.driver_info].join(" ").trim().into(),
            software: info.device_type == wgpu::DeviceType::Cpu,
            // Metal states more, but its kernels count bytes in 32 bits.
            binding_bytes: limits.max_storage_buffer_binding_size.min((1 << 31) - 16),
            uniform_bytes: limits.max_uniform_buffer_binding_size.min(1 << 16),
            buffer_bytes: limits.max_buffer_size,
            storage_buffers: limits.max_storage_buffers_per_shader_stage,
            workgroup_bytes: limits.max_compute_workgroup_storage_size,
            atomics,
            subgroups: features.contains(wgpu::Features::SUBGROUP).then_some(lanes),
            timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
            cooperative_matrices: adapter.cooperative_matrix_properties().iter().map(|m| format!("{m:?}")).collect(),
            features: features.iter_names().map(|(name, _)| name.to_owned()).collect(),
        }
    }

    /// Bytes that a kernel may read or write of one buffer at most.
    pub fn bound_bytes(&self) -> u64 {
        self.binding_bytes.min(self.buffer_bytes)
    }

    /// Preference among adapters; the highest number wins.
    pub fn rank(&self) -> Option<usize> {
        ["other", "virtual GPU", "integrated GPU", "discrete GPU"].iter().position(|kind| *kind == self.kind)
    }
}

impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {}, {})", self.name, self.kind, self.api, self.driver)
    }
}

fn found() -> Vec<wgpu::Adapter> {
    let mut description = wgpu::InstanceDescriptor::new_without_display_handle();
    description.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    let instance = wgpu::Instance::new(description);
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()))
}

/// All adapters of this machine.
pub fn adapters() -> Vec<Adapter> {
    found().iter().enumerate().map(|(i, a)| Adapter::of(i, a)).collect()
}

/// Artificial limits, which make a device behave like a lesser one in tests, and timing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Limits {
    /// Sums of scattered gradients by compare and exchange, even where the device adds by itself.
    pub compare_exchange: bool,
    /// Bytes of the largest binding, if fewer than the device allows.
    pub binding_bytes: Option<u64>,
    /// Bytes of the largest uniform buffer, if fewer than the device allows.
    pub uniform_bytes: Option<u64>,
    /// Bytes of arrays and other buffers together, if fewer than the device has.
    pub memory_bytes: Option<u64>,
    /// No subgroup operations, even where the device has them.
    pub no_subgroups: bool,
    /// Time every kernel, where the device has timestamps; every call then waits for the device.
    pub profile: bool,
}

/// An open device.
pub struct Gpu {
    /// The adapter.
    pub adapter: Adapter,
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    /// The first error outside of an error scope.
    failed: Arc<Mutex<Option<String>>>,
    /// See [`Limits::memory_bytes`]; with what the device holds at the start.
    memory: Option<u64>,
    /// Bytes to the device and from it.
    moved: [AtomicU64; 2],
    /// Buffers through which large arrays go to the device.
    staging: Mutex<Staging>,
}

impl Gpu {
    /// Opens adapter `index`, or the preferred one.
    pub fn open(index: Option<usize>, limits: Limits) -> Result<Self> {
        let all = found();
        let described: Vec<_> = all.iter().enumerate().map(|(i, a)| Adapter::of(i, a)).collect();
        let best = described.iter().max_by_key(|a| (a.rank(), std::cmp::Reverse(a.index))).map(|a| a.index);
        let chosen = index.or(best).and_then(|i| described.get(i));
        let Some(mut adapter) = chosen.cloned() else {
            return Err(match index {
                Some(i) if !all.is_empty() => Error::invalid(
                    "--backend",
                    "adapter",
                    i,
                    format!("0 to {}, as `conefield backends` lists them", all.len() - 1),
                ),
                _ => {
                    Error::unsupported("the wgpu backend", "no Vulkan, Metal or DX12 adapter was found on this machine")
                }
            });
        };
        if limits.no_subgroups {
            adapter.subgroups = None;
        }
        if limits.compare_exchange {
            adapter.atomics = Atomics::CompareExchange;
        }
        adapter.binding_bytes = adapter.binding_bytes.min(limits.binding_bytes.unwrap_or(u64::MAX));
        adapter.uniform_bytes = adapter.uniform_bytes.min(limits.uniform_bytes.unwrap_or(u64::MAX));
        let source = &all[adapter.index];
        let wanted = wgpu::Features::SHADER_FLOAT32_ATOMIC | wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::SUBGROUP;
        let description = wgpu::DeviceDescriptor {
            label: Some("conefield"),
            required_features: source.features() & wanted,
            required_limits: source.limits(),
            experimental_features: wgpu::ExperimentalFeatures::disabled(),
            memory_hints: wgpu::MemoryHints::Performance,
            trace: wgpu::Trace::Off,
        };
        let (device, queue) = pollster::block_on(source.request_device(&description))
            .map_err(|e| Error::unsupported(format!("the wgpu backend on {adapter}"), e.to_string()))?;
        let failed = Arc::new(Mutex::new(None));
        let keep = failed.clone();
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| note(&keep, in_words(&e))));
        let keep = failed.clone();
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                note(&keep, format!("the device was lost: {message}"));
            }
        });
        let memory = limits.memory_bytes.map(|bytes| bytes + allocated(&device));
        Ok(Self { adapter, device, queue, failed, memory, moved: Default::default(), staging: Mutex::default() })
    }

    /// The first error on the device since the last call.
    pub fn fault(&self) -> Result<()> {
        match self.failed.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(what) => Err(self.error(what)),
            None => Ok(()),
        }
    }

    pub(crate) fn error(&self, what: impl Into<String>) -> Error {
        Error::Device { device: self.adapter.to_string(), what: what.into() }
    }

    /// Overwrites `data.len()` bytes of a buffer from byte `at` on.
    pub(crate) fn write(&self, to: &wgpu::Buffer, at: u64, data: &[u8]) {
        self.moved[0].fetch_add(data.len() as u64, Ordering::Relaxed);
        self.queue.write_buffer(to, at, data);
    }

    /// The same for a part of an array, which may be large.
    pub(crate) fn upload(&self, to: &wgpu::Buffer, at: u64, data: &[u8]) -> Result<()> {
        self.moved[0].fetch_add(data.len() as u64, Ordering::Relaxed);
        self.staging.lock().unwrap_or_else(PoisonError::into_inner).write(self, to, at, data)
    }

    /// Bytes that crossed between the host and the device.
    pub fn moved(&self) -> Moved {
        let [to_device, from_device] = self.moved.each_ref().map(|bytes| bytes.load(Ordering::Relaxed));
        Moved { to_device, from_device }
    }

    /// Hands commands to the device.
    pub(crate) fn submit(&self, encoder: wgpu::CommandEncoder) -> wgpu::SubmissionIndex {
        self.queue.submit([encoder.finish()])
    }

    /// Waits until the device has finished a submission and all before it.
    pub(crate) fn wait_for(&self, index: wgpu::SubmissionIndex) -> Result<()> {
        self.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None })
    }

    /// Waits until the device has finished all submitted work.
    pub fn wait(&self) -> Result<()> {
        self.poll(wgpu::PollType::wait_indefinitely())
    }

    fn poll(&self, until: wgpu::PollType) -> Result<()> {
        let polled = self.device.poll(until);
        self.fault()?;
        polled.map(drop).map_err(|e| self.error(e.to_string()))
    }

    /// Runs `make` and returns its errors on the device.
    pub(crate) fn checked<T>(&self, what: &str, make: impl FnOnce() -> T) -> Result<T> {
        let scopes = [wgpu::ErrorFilter::OutOfMemory, wgpu::ErrorFilter::Validation, wgpu::ErrorFilter::Internal]
            .map(|filter| self.device.push_error_scope(filter));
        let made = make();
        let mut first = None;
        for scope in scopes.into_iter().rev() {
            first = pollster::block_on(scope.pop()).or(first);
        }
        first.map_or(Ok(made), |e| Err(self.error(format!("{what}: {}", in_words(&e)))))
    }

    /// A buffer of `bytes`, zero at first.
    pub(crate) fn buffer(&self, name: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer> {
        let size = bytes.max(16).next_multiple_of(16);
        if size > self.adapter.buffer_bytes {
            return Err(
                self.error(format!("{name} takes {size} bytes, more than a buffer's {}", self.adapter.buffer_bytes))
            );
        }
        if let Some(limit) = self.memory {
            // Buffers that are no longer used are freed when the device has finished.
            self.wait()?;
            if allocated(&self.device) + size > limit {
                return Err(self.error(format!("{name}, {size} bytes: {OUT_OF_MEMORY}")));
            }
        }
        self.checked(&format!("{name}, {size} bytes"), || {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(name),
                size,
                usage,
                mapped_at_creation: false,
            })
        })
    }

    /// Waits for the message that a buffer is mapped.
    pub(crate) fn heard(
        &self,
        message: &mpsc::Receiver<std::result::Result<(), wgpu::BufferAsyncError>>,
    ) -> Result<()> {
        // The callback may come from another thread's wait, shortly after this thread's wait ends.
        loop {
            match message.recv_timeout(CALLBACK) {
                Err(mpsc::RecvTimeoutError::Timeout) => self.wait()?,
                Err(mpsc::RecvTimeoutError::Disconnected) => return Err(self.error("a buffer cannot be mapped")),
                Ok(mapped) => return mapped.map_err(|e| self.error(e.to_string())),
            }
        }
    }

    /// Overwrites `out` with the bytes of `from` from byte `at` on, piece by piece through `staging`.
    pub(crate) fn download(&self, from: &wgpu::Buffer, at: u64, staging: &wgpu::Buffer, out: &mut [u8]) -> Result<()> {
        let most = staging.size();
        for (i, piece) in out.chunks_mut(most as usize).enumerate() {
            let bytes = piece.len() as u64;
            let mut encoder = self.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(from, at + i as u64 * most, staging, 0, bytes);
            self.submit(encoder);
            self.read(staging, bytes, |found| copy(piece, found))?;
        }
        Ok(())
    }

    /// Calls `read` with the first `bytes` of `from` when the device has written them.
    pub(crate) fn read(&self, from: &wgpu::Buffer, bytes: u64, read: impl FnOnce(&[u8])) -> Result<()> {
        if bytes == 0 {
            return self.wait();
        }
        let slice = from.slice(..bytes);
        let (sender, receiver) = mpsc::channel();
        slice.map_async(wgpu::MapMode::Read, move |r| drop(sender.send(r)));
        self.wait()?;
        self.heard(&receiver)?;
        self.moved[1].fetch_add(bytes, Ordering::Relaxed);
        let view = slice.get_mapped_range().map_err(|e| self.error(e.to_string()))?;
        read(&view);
        drop(view);
        from.unmap();
        Ok(())
    }
}

/// How long to wait for a call back before the device is asked again.
const CALLBACK: Duration = Duration::from_millis(20);

fn note(keep: &Mutex<Option<String>>, what: String) {
    keep.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(what);
}

/// Bytes of a device's buffers, as far as its allocator reports them.
fn allocated(device: &wgpu::Device) -> u64 {
    device.generate_allocator_report().map_or(0, |report| report.total_allocated_bytes)
}

const OUT_OF_MEMORY: &str = "out of memory on the device; a smaller volume, smaller tables, fewer rays per step, or several \
                             adapters that share a volume (--backend wgpu:0,1) may fit";

fn in_words(e: &wgpu::Error) -> String {
    match e {
        wgpu::Error::OutOfMemory { .. } => OUT_OF_MEMORY.into(),
        other => other.to_string(),
    }
}
