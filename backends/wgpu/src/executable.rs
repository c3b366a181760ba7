//! A pipeline on a device: steps, updates, evaluation.

use crate::arena;
use crate::compose::{self, Chain, GROUP};
use crate::kernel::{Buffers, Kernel, fits};
use crate::pace::Pace;
use crate::profile::Profile;
use crate::source::validate;
use crate::wave::{self, GpuRay, MOST_GROUPS, Wave};
use crate::{Gpu, Shared};
use conefield_core::backend::{Adam, BlockWork, Executable, StepStats, Work};
use conefield_core::device::Source;
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::parallel;
use conefield_core::pipeline::Model;
use conefield_core::prior::Prior;
use conefield_core::stage::{Projector, UnitRay};
use conefield_core::wgsl::Fragment;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;
use wgpu::BufferUsages as U;

/// Bytes that all partial sums may take together.
const PARTIAL_BYTES: usize = 64 << 20;
/// Maximum number of partial sums of the rows, on a software device and on others.
const SHARES: [usize; 2] = [4, 256];
/// Bytes that the rows of a wave may keep, on a software device and on others.
const TAPE_BYTES: [u64; 2] = [16 << 20, 512 << 20];
/// Rows of a wave at first, at least, and at most.
const FIRST_ROWS: u32 = 1 << 14;
const LEAST_ROWS: u32 = 1 << 12;
const MOST_ROWS: u32 = 1 << 20;

/// Uniform values of a launch: `Step` in `kernels/step.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Step {
    pub rows: u32,
    pub ray_rows: u32,
    pub rays: u32,
    pub point_rows: u32,
    pub blocks: u32,
    pub edge: u32,
    pub stride: u32,
    pub training: u32,
    pub ray_scale: f32,
    pub point_scale: f32,
    pub block_scale: f32,
    pub pad: u32,
    pub spacing: [f32; 3],
    pub pad2: u32,
}

/// `Rule` in `kernels/adam.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Rule {
    count: u32,
    rate: f32,
    beta1: f32,
    beta2: f32,
    rest1: f32,
    rest2: f32,
    root: f32,
    eps: f32,
}

/// The kernels of a pipeline, composed and checked; they are compiled at their first use. The first step adds those of
/// loss and priors.
pub struct Kernels {
    sources: HashMap<String, Source>,
}

impl Kernels {
    /// Composes all kernels. Refuses invalid WGSL and kernels that exceed the device's limits.
    pub fn new(shared: &Shared, chain: &Chain, projector: &dyn Projector) -> Result<Self> {
        let mut kernels = Self { sources: HashMap::new() };
        let sources = [
            ("sample", compose::sample(projector)?),
            ("blocks", compose::blocks()),
            ("forward", chain.forward(true)),
            ("evaluate", chain.forward(false)),
            ("encode", chain.encode()),
            ("lines", compose::lines()),
            ("adam", compose::adam()),
        ];
        for (label, source) in sources {
            kernels.add(shared, label, source)?;
        }
        if chain.learns() {
            kernels.add(shared, "backward", chain.backward())?;
        }
        if chain.scatters() {
            kernels.add(shared, "scatter", chain.scatter())?;
        }
        if chain.summed() > 0 {
            kernels.add(shared, "sums", chain.sums())?;
            kernels.add(shared, "merge", chain.merge())?;
        }
        Ok(kernels)
    }

    /// Adds a kernel, or replaces the one with this label.
    fn add(&mut self, shared: &Shared, label: &str, source: Source) -> Result<()> {
        validate(&source)?;
        fits(&shared.gpu, label, &source)?;
        self.sources.insert(label.into(), source);
        Ok(())
    }
}

/// A pipeline on a device.
pub struct Wgpu {
    shared: Arc<Shared>,
    chain: Chain,
    kernels: Kernels,
    compiled: HashMap<String, Arc<Kernel>>,
    bound: HashMap<String, wgpu::BindGroup>,
    /// The WGSL of the current kernels of loss and priors, with the edges of blocks.
    learned: Vec<(Option<Fragment>, usize)>,
    buffers: Buffers,
    /// Whether the arena is on the device.
    loaded: bool,
    /// Whether the gradients on the device are known to be zero.
    clean: bool,
    /// The last update's commands, submitted with the next ones: a step is one submission.
    update: Option<wgpu::CommandEncoder>,
    /// Maximum number of rows of a wave now.
    pace: Pace,
    /// Maximum number of rows of a wave at any time.
    most: u32,
    /// Rows for which buffers have room.
    room: u32,
    profile: Option<Profile>,
}

impl Wgpu {
    pub(crate) fn new(shared: Arc<Shared>, chain: Chain, kernels: Kernels) -> Self {
        let adapter = &shared.gpu.adapter;
        let tape = TAPE_BYTES[usize::from(!adapter.software)].min(adapter.bound_bytes());
        let rows = tape / (4 * chain.tape().max(1) as u64);
        let most = rows.clamp(u64::from(LEAST_ROWS), u64::from(MOST_ROWS)) as u32;
        Self {
            shared,
            chain,
            kernels,
            compiled: HashMap::new(),
            bound: HashMap::new(),
            learned: vec![],
            buffers: Buffers::default(),
            loaded: false,
            clean: false,
            update: None,
            pace: Pace::new(FIRST_ROWS.min(most), LEAST_ROWS, most),
            most,
            room: 0,
            profile: None,
        }
    }

    /// Peak memory on the device in bytes.
    pub fn device_bytes(&self) -> u64 {
        let rows = u64::from(self.most) * self.row_bytes();
        16 * self.chain.params() as u64 + rows + self.partial_bytes()
    }

    /// Peak host memory for copies in bytes.
    pub fn host_bytes(&self) -> usize {
        self.most as usize * 20 + (32 << 20)
    }

    /// Bytes per row: position and weight, μ and its derivative, target, features, kept channels.
    fn row_bytes(&self) -> u64 {
        let channels = self.chain.kept().max(self.chain.features()) + self.chain.tape();
        16 + 4 + 4 + 4 + 4 * channels as u64
    }

    /// Number of partial sums of the rows in `sums`.
    fn shares(&self) -> usize {
        let each = 4 * self.chain.summed().max(1);
        (PARTIAL_BYTES / each).clamp(1, SHARES[usize::from(!self.gpu().adapter.software)])
    }

    fn partial_bytes(&self) -> u64 {
        4 * (self.shares() * self.chain.summed()) as u64
    }

    fn gpu(&self) -> &Gpu {
        &self.shared.gpu
    }

    /// Uploads the arena unless it is on the device.
    fn load(&mut self, model: &Model) -> Result<()> {
        if self.loaded {
            return Ok(());
        }
        let (shared, size) = (self.shared.clone(), self.shared.target().segment);
        let params = model.arena.params.len();
        arena::allocate(&shared.gpu, &mut self.buffers, &self.chain, params, size)?;
        arena::upload(&shared, &self.buffers, &self.chain, &model.arena)?;
        self.buffers.reserve(&shared.gpu, "step", size_of::<Step>() as u64, U::UNIFORM | U::COPY_DST)?;
        for s in 0..self.chain.segments() {
            let name = format!("rule_{s}");
            self.buffers.reserve(&shared.gpu, &name, size_of::<Rule>() as u64, U::UNIFORM | U::COPY_DST)?;
        }
        if self.chain.summed() > 0 {
            self.buffers.reserve(&shared.gpu, "partial", self.partial_bytes(), U::STORAGE | U::COPY_DST)?;
        }
        if shared.profile && self.profile.is_none() {
            self.profile = Profile::new(&shared.gpu)?;
        }
        (self.loaded, self.clean) = (true, false);
        Ok(())
    }

    fn reserve(&mut self, name: &str, bytes: u64, usage: U) -> Result<()> {
        if self.buffers.reserve(&self.shared.gpu, name, bytes, usage)? {
            self.bound.clear();
        }
        Ok(())
    }

    /// Makes room for `rows` rows.
    fn reserve_rows(&mut self, rows: u32) -> Result<()> {
        if rows <= self.room {
            return Ok(());
        }
        let n = u64::from(rows);
        self.reserve("samples", 16 * n, U::STORAGE | U::COPY_DST)?;
        self.reserve("mu", 4 * n, U::STORAGE | U::COPY_SRC)?;
        self.reserve("dmu", 4 * n, U::STORAGE)?;
        self.reserve("targets", 4 * n, U::STORAGE | U::COPY_DST)?;
        self.reserve("features", 4 * n * self.chain.kept().max(1) as u64, U::STORAGE | U::COPY_SRC)?;
        self.reserve("tape", 4 * n * self.chain.tape().max(1) as u64, U::STORAGE)?;
        self.room = rows;
        Ok(())
    }

    /// Compiles the kernels of a step in parallel, because drivers compile slowly.
    fn compile(&mut self) -> Result<()> {
        let Shared { gpu, kernels, .. } = &*self.shared;
        let of_step = |label: &str| !["evaluate", "encode", "lines"].contains(&label);
        let missing = |(label, _): &(&String, &Source)| of_step(label) && !self.compiled.contains_key(*label);
        let missing = self.kernels.sources.iter().filter(missing);
        let compiled =
            parallel::map(missing, |_, (label, source)| Ok((label.clone(), kernels.get(gpu, label, source)?)));
        self.compiled.extend(compiled.into_iter().collect::<Result<Vec<_>>>()?);
        Ok(())
    }

    /// The kernel called `label`, compiled.
    fn kernel(&mut self, label: &str) -> Result<Arc<Kernel>> {
        if let Some(kernel) = self.compiled.get(label) {
            return Ok(kernel.clone());
        }
        let source = self.kernels.sources.get(label);
        let source = source.ok_or_else(|| self.gpu().error(format!("no kernel {label}")))?;
        let kernel = self.shared.kernels.get(&self.shared.gpu, label, source)?;
        self.compiled.insert(label.into(), kernel.clone());
        Ok(kernel)
    }

    /// The buffers of `kernel`, bound once under `label`. `name` returns the name of the buffer for one in the kernel.
    fn bind(&mut self, kernel: &Kernel, label: &str, name: impl Fn(&str) -> String) -> Result<wgpu::BindGroup> {
        if !self.bound.contains_key(label) {
            let group = kernel.bind_as(&self.shared.gpu, |buffer| self.buffers.get(&name(buffer)))?;
            self.bound.insert(label.into(), group);
        }
        Ok(self.bound[label].clone())
    }

    /// The kernel called `label`, compiled, with its buffers.
    fn ready(&mut self, label: &str) -> Result<(Arc<Kernel>, wgpu::BindGroup)> {
        let kernel = self.kernel(label)?;
        let bound = self.bind(&kernel, label, str::to_owned)?;
        Ok((kernel, bound))
    }

    /// Composes the kernels of the work's loss and priors, unless the last step had the same.
    fn learn_by(&mut self, work: &Work<'_>) -> Result<()> {
        let mut fragments = vec![(work.loss.wgsl(), 0)];
        fragments.extend(work.priors.iter().map(|p| (p.prior.wgsl(), p.prior.blocks().edge)));
        if self.learned == fragments {
            return Ok(());
        }
        for (label, source) in sources(work.loss, work.priors.iter().map(|p| p.prior))? {
            self.compiled.remove(&label);
            self.bound.remove(&label);
            self.kernels.add(&self.shared, &label, source)?;
        }
        self.learned = fragments;
        Ok(())
    }

    /// Launches kernels one after the other, each with its number of groups.
    fn launch(&mut self, encoder: &mut wgpu::CommandEncoder, launches: &[(&str, usize)]) -> Result<()> {
        for &(label, groups) in launches.iter().filter(|(_, groups)| *groups > 0) {
            let (kernel, bound) = self.ready(label)?;
            let timestamp_writes = self.profile.as_mut().and_then(|p| p.around(label));
            let mut pass = encoder
                .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(kernel.label()), timestamp_writes });
            kernel.launch(&mut pass, &bound, groups.min(MOST_GROUPS) as u32);
        }
        Ok(())
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let buffer = self.buffers.get(name).ok_or_else(|| self.gpu().error(format!("no buffer {name}")))?;
        if !bytes.is_empty() {
            self.gpu().write(buffer, 0, bytes);
        }
        Ok(())
    }

    /// A command encoder. It begins with the commands of an update that waits.
    fn encoder(&mut self) -> wgpu::CommandEncoder {
        let waiting = self.update.take();
        waiting.unwrap_or_else(|| self.gpu().device.create_command_encoder(&Default::default()))
    }

    /// Submits an update that waits.
    fn flush(&mut self) {
        if let Some(update) = self.update.take() {
            self.gpu().queue.submit([update.finish()]);
        }
    }

    /// Adds a copy of the first `bytes` of `name` into the staging buffer, for [`Wgpu::read`].
    fn copy(&mut self, encoder: &mut wgpu::CommandEncoder, name: &str, bytes: u64, at: u64) -> Result<()> {
        let from = self.buffers.get(name).cloned().ok_or_else(|| self.gpu().error(format!("no buffer {name}")))?;
        if let Some(to) = self.buffers.get("staging")
            && bytes > 0
        {
            encoder.copy_buffer_to_buffer(&from, 0, to, at, bytes);
        }
        Ok(())
    }

    fn read(&self, bytes: u64, read: impl FnOnce(&[u8])) -> Result<()> {
        match self.buffers.get("staging") {
            Some(staging) => self.gpu().read(staging, bytes, read),
            None => self.gpu().wait(),
        }
    }

    /// Runs the kernel `label` on `points`, in waves.
    fn in_pieces(
        &mut self,
        points: &[[f32; 3]],
        label: &str,
        result: &str,
        width: usize,
        mut take: impl FnMut(usize, &[f32], usize),
    ) -> Result<()> {
        let mut at = 0;
        let mut samples: Vec<[f32; 4]> = vec![];
        while at < points.len() {
            let started = Instant::now();
            let piece = &points[at..(at + self.pace.size() as usize).min(points.len())];
            let rows = piece.len() as u32;
            self.reserve_rows(rows)?;
            let stride = self.room;
            let bytes = 4 * u64::from(stride) * width as u64;
            self.reserve(result, bytes, U::STORAGE | U::COPY_SRC)?;
            // The result ends with the last channel's rows.
            let wanted = 4 * (u64::from(stride) * (width as u64 - 1) + u64::from(rows));
            self.buffers.staging(&self.shared.gpu, wanted)?;
            samples.clear();
            samples.extend(piece.iter().map(|p| [p[0], p[1], p[2], 0.0]));
            self.write("samples", bytemuck::cast_slice(&samples))?;
            self.write("step", bytemuck::bytes_of(&Step { rows, stride, ..Step::default() }))?;
            let mut encoder = self.encoder();
            self.launch(&mut encoder, &[(label, piece.len().div_ceil(GROUP as usize))])?;
            self.copy(&mut encoder, result, wanted, 0)?;
            self.gpu().queue.submit([encoder.finish()]);
            self.read(wanted, |bytes| take(at, bytemuck::cast_slice(bytes), stride as usize))?;
            at += piece.len();
            self.collect()?;
            self.pace.heard(started.elapsed().as_secs_f64(), 1, rows);
        }
        Ok(())
    }

    /// Collects the times of finished kernels.
    fn collect(&mut self) -> Result<()> {
        self.profile.as_mut().map_or(Ok(()), |p| p.collect(&self.shared.gpu))
    }

    /// Makes room for a wave and writes its rays.
    fn place(&mut self, wave: &Wave) -> Result<()> {
        self.reserve_rows(wave.rows)?;
        self.reserve("rays", (wave.rays.len().max(1) * size_of::<GpuRay>()) as u64, U::STORAGE | U::COPY_DST)?;
        self.reserve("losses", 4 * wave.losses().max(1) as u64, U::STORAGE | U::COPY_SRC)?;
        self.write("rays", bytemuck::cast_slice(&wave.rays))
    }

    /// The kernels of one wave of a step.
    fn learn(&mut self, encoder: &mut wgpu::CommandEncoder, wave: &Wave, work: &Work<'_>, sums: u64) -> Result<()> {
        self.place(wave)?;
        let mut step = Step {
            rows: wave.rows,
            ray_rows: wave.ray_rows,
            rays: wave.rays.len() as u32,
            point_rows: wave.points.len() as u32,
            stride: self.room,
            training: 1,
            ray_scale: 1.0 / work.rays.len().max(1) as f32,
            point_scale: 1.0 / work.points.len().max(1) as f32,
            ..Step::default()
        };
        if !wave.points.is_empty() {
            let points = &work.points[wave.points.clone()];
            let samples: Vec<[f32; 4]> = points.iter().map(|(p, _)| [p[0], p[1], p[2], 0.0]).collect();
            let targets: Vec<f32> = points.iter().map(|p| p.1).collect();
            let buffer = self.buffers.get("samples").ok_or_else(|| self.gpu().error("no buffer samples"))?;
            self.gpu().write(buffer, 16 * u64::from(wave.ray_rows), bytemuck::cast_slice(&samples));
            self.write("targets", bytemuck::cast_slice(&targets))?;
        }
        let mut block_rows = 0;
        if let (Some(work), false) = (work.priors.get(wave.prior), wave.blocks.is_empty()) {
            let corners: Vec<[f32; 4]> =
                work.corners[wave.blocks.clone()].iter().map(|c| [c[0], c[1], c[2], 0.0]).collect();
            self.reserve("corners", 16 * corners.len() as u64, U::STORAGE | U::COPY_DST)?;
            self.write("corners", bytemuck::cast_slice(&corners))?;
            let blocks = work.prior.blocks();
            step.blocks = wave.blocks.len() as u32;
            step.edge = blocks.edge as u32;
            step.spacing = work.spacing;
            step.block_scale = work.scale() as f32;
            block_rows = wave.blocks.len() * blocks.points();
        }
        self.write("step", bytemuck::bytes_of(&step))?;
        let groups = |rows: usize| rows.div_ceil(GROUP as usize);
        let backward = if self.chain.learns() { groups(wave.rows as usize) } else { 0 };
        let scatter = if self.chain.scatters() { backward } else { 0 };
        self.launch(
            encoder,
            &[
                ("sample", groups(wave.ray_rows as usize)),
                ("blocks", groups(block_rows)),
                ("forward", groups(wave.rows as usize)),
                (OF_RAYS, wave.rays.len()),
                (OF_POINTS, groups(wave.points.len())),
                (&of_blocks(wave.prior), wave.blocks.len()),
                ("backward", backward),
                ("sums", self.chain.summing(self.shares())),
                ("scatter", scatter),
            ],
        )?;
        self.copy(encoder, "losses", 4 * wave.losses() as u64, sums)
    }
}

/// Labels of the kernels that compute derivatives with respect to μ.
const OF_RAYS: &str = "loss of rays";
const OF_POINTS: &str = "loss of points";

/// The kernels of loss and priors, by their labels.
fn sources<'a>(loss: &dyn Loss, priors: impl Iterator<Item = &'a dyn Prior>) -> Result<Vec<(String, Source)>> {
    let mut all = vec![
        (OF_RAYS.to_owned(), compose::loss_of_rays(loss)?),
        (OF_POINTS.to_owned(), compose::loss_of_points(loss)?),
    ];
    for (i, prior) in priors.enumerate() {
        all.push((of_blocks(i), compose::penalty_of_blocks(prior)?));
    }
    Ok(all)
}

fn of_blocks(prior: usize) -> String {
    format!("penalty of blocks {prior}")
}

impl Executable for Wgpu {
    fn admits(&self, loss: &dyn Loss, priors: &[Box<dyn Prior>]) -> Result<()> {
        let all = sources(loss, priors.iter().map(|p| p.as_ref()))?;
        all.iter().try_for_each(|(label, source)| validate(source).and_then(|()| fits(self.gpu(), label, source)))
    }

    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        self.learn_by(work)?;
        self.load(model)?;
        if !self.compiled.contains_key("forward") {
            self.compile()?;
        }
        let started = Instant::now();
        let mut encoder = self.encoder();
        if !self.clean {
            for s in 0..self.chain.segments() {
                self.buffers.get(&format!("grads_{s}")).inspect(|b| encoder.clear_buffer(b, 0, None));
            }
        }
        self.buffers.get("partial").inspect(|b| encoder.clear_buffer(b, 0, None));
        self.clean = false;
        let waves = wave::of_step(model.pipeline.projector.as_ref(), work, self.pace.size());
        let losses: usize = waves.iter().map(Wave::losses).sum();
        self.buffers.staging(&self.shared.gpu, 4 * losses.max(1) as u64)?;
        let mut at = 0;
        for (i, wave) in waves.iter().enumerate() {
            if i > 0 {
                // The host overwrites the inputs of the last wave.
                let last = std::mem::replace(&mut encoder, self.encoder());
                self.gpu().queue.submit([last.finish()]);
            }
            self.learn(&mut encoder, wave, work, at)?;
            at += 4 * wave.losses() as u64;
        }
        if self.chain.summed() > 0 {
            self.launch(&mut encoder, &[("merge", self.chain.merging(self.shares()))])?;
        }
        self.gpu().queue.submit([encoder.finish()]);
        let mut stats = StepStats { samples: waves.iter().map(|w| u64::from(w.rows)).sum(), ..StepStats::default() };
        let [ray_scale, point_scale] = [work.rays.len(), work.points.len()].map(|n| 1.0 / n.max(1) as f64);
        self.read(at, |bytes| {
            let mut sums = bytemuck::cast_slice::<u8, f32>(bytes).iter().map(|&l| f64::from(l));
            let mut next = |n: usize| sums.by_ref().take(n).sum::<f64>();
            for wave in &waves {
                let (rays, points, blocks) =
                    (next(wave.rays.len()), next(wave.points.len().div_ceil(GROUP as usize)), next(wave.blocks.len()));
                stats.loss += rays * ray_scale + points * point_scale;
                stats.prior += blocks * work.priors.get(wave.prior).map_or(0.0, BlockWork::scale);
            }
        })?;
        self.collect()?;
        let seconds = started.elapsed().as_secs_f64();
        stats.dense_s = seconds;
        self.pace.heard(seconds, waves.len(), waves.iter().map(|w| w.rows).max().unwrap_or(0));
        Ok(stats)
    }

    fn update(&mut self, model: &mut Model, adam: &Adam) -> Result<()> {
        self.load(model)?;
        // An update that waits uses the buffers that this one is about to overwrite.
        self.flush();
        let (bias1, bias2) = (1.0 - adam.beta1.powf(adam.step as f64), 1.0 - adam.beta2.powf(adam.step as f64));
        let size = self.shared.target().segment;
        let kernel = self.kernel("adam")?;
        let mut encoder = self.encoder();
        for s in 0..self.chain.segments() {
            let count = arena::segment(&self.chain, s, model.arena.params.len(), size).len();
            let rule = Rule {
                count: count as u32,
                rate: (adam.lr / bias1) as f32,
                beta1: adam.beta1 as f32,
                beta2: adam.beta2 as f32,
                rest1: (1.0 - adam.beta1) as f32,
                rest2: (1.0 - adam.beta2) as f32,
                root: (1.0 / bias2.sqrt()) as f32,
                eps: adam.eps as f32,
            };
            self.write(&format!("rule_{s}"), bytemuck::bytes_of(&rule))?;
            let bound = self.bind(&kernel, &format!("adam_{s}"), |part| format!("{part}_{s}"))?;
            let timestamp_writes = self.profile.as_mut().and_then(|p| p.around("adam"));
            let mut pass =
                encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("adam"), timestamp_writes });
            kernel.launch(&mut pass, &bound, count.div_ceil(256).clamp(1, MOST_GROUPS) as u32);
        }
        arena::refresh(&self.buffers, &self.chain, &mut encoder, self.shared.target().segment);
        self.update = Some(encoder);
        self.clean = true;
        self.gpu().fault()
    }

    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        self.load(model)?;
        self.in_pieces(points, "evaluate", "mu", 1, |at, found, _| {
            let n = found.len().min(out.len() - at);
            out[at..at + n].copy_from_slice(&found[..n]);
        })
    }

    fn encode(&mut self, model: &Model, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        self.load(model)?;
        let width = self.chain.features();
        let n = points.len();
        let mut out = vec![0.0; width * n];
        self.in_pieces(points, "encode", "features", width, |at, found, stride| {
            for (c, out) in out.chunks_exact_mut(n).enumerate() {
                let channel = &found[c * stride..];
                let rows = channel.len().min(stride).min(n - at);
                out[at..at + rows].copy_from_slice(&channel[..rows]);
            }
        })?;
        Ok(out)
    }

    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        self.load(model)?;
        let waves = wave::of_rays(model.pipeline.projector.as_ref(), rays, self.pace.size());
        let mut out = out.iter_mut();
        for wave in &waves {
            self.place(wave)?;
            let bytes = 4 * wave.rays.len() as u64;
            self.buffers.staging(&self.shared.gpu, bytes)?;
            let (rows, rays) = (wave.rows, wave.rays.len() as u32);
            let step = Step { rows, ray_rows: rows, rays, stride: self.room, ..Step::default() };
            self.write("step", bytemuck::bytes_of(&step))?;
            let groups = wave.rows.div_ceil(GROUP) as usize;
            let mut encoder = self.encoder();
            self.launch(&mut encoder, &[("sample", groups), ("evaluate", groups), ("lines", wave.rays.len())])?;
            self.copy(&mut encoder, "losses", bytes, 0)?;
            self.gpu().queue.submit([encoder.finish()]);
            self.read(bytes, |found| {
                for (out, line) in out.by_ref().zip(bytemuck::cast_slice::<u8, f32>(found)) {
                    *out = *line;
                }
            })?;
        }
        Ok(())
    }

    fn profile(&mut self) -> Vec<(String, f64)> {
        self.profile.as_mut().map(Profile::take).unwrap_or_default()
    }

    fn fetch(&mut self, model: &mut Model) -> Result<()> {
        if !self.loaded {
            return Ok(());
        }
        self.flush();
        let size = self.shared.target().segment;
        arena::download(&self.shared.gpu, &mut self.buffers, &self.chain, &mut model.arena, size)
    }

    fn renew(&mut self) {
        (self.loaded, self.update) = (false, None);
        self.bound.clear();
    }
}
