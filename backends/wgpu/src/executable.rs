//! A pipeline on a device: steps, updates, evaluation.

use crate::arena;
use crate::compose::{self, Chain, GROUP};
use crate::kernel::{Kernel, admit};
use crate::pace::Pace;
use crate::profile::Profile;
use crate::programs::Programs;
use crate::wave::{self, GpuRay, MOST_GROUPS, Wave};
use crate::{Gpu, Shared};
use conefield_core::backend::{Adam, BlockWork, Executable, StepStats, Work};
use conefield_core::device::Source;
use conefield_core::error::Result;
use conefield_core::loss::Loss;
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

/// A pipeline on a device.
pub struct Wgpu {
    programs: Programs,
    chain: Chain,
    /// The kernels by their labels, checked; they are compiled at their first use. The first step adds those of loss and
    /// priors.
    sources: HashMap<String, Source>,
    /// The WGSL of the current kernels of loss and priors, with the edges of blocks.
    learned: Vec<(Option<Fragment>, usize)>,
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
    /// Composes all kernels. Refuses invalid WGSL and kernels that exceed the device's limits.
    pub(crate) fn new(shared: Arc<Shared>, chain: Chain, projector: &dyn Projector) -> Result<Self> {
        let mut all = vec![
            ("sample", compose::sample(projector)?),
            ("blocks", compose::blocks()),
            ("forward", chain.forward(true)),
            ("evaluate", chain.forward(false)),
            ("encode", chain.encode()),
            ("lines", compose::lines()),
            ("adam", compose::adam()),
        ];
        if chain.params > 0 {
            all.push(("backward", chain.backward()));
        }
        if chain.scatters() {
            all.push(("scatter", chain.scatter()));
        }
        if chain.summed() > 0 {
            all.extend([("sums", chain.sums()), ("merge", chain.merge())]);
        }
        all.iter().try_for_each(|(label, source)| admit(&shared.gpu, label, source))?;
        let sources = all.into_iter().map(|(label, source)| (label.to_owned(), source)).collect();
        let adapter = &shared.gpu.adapter;
        let tape = TAPE_BYTES[usize::from(!adapter.software)].min(adapter.bound_bytes());
        let rows = tape / (4 * chain.tape.max(1) as u64);
        let most = rows.clamp(u64::from(LEAST_ROWS), u64::from(MOST_ROWS)) as u32;
        Ok(Self {
            programs: Programs::new(shared),
            chain,
            sources,
            learned: vec![],
            loaded: false,
            clean: false,
            update: None,
            pace: Pace::new(FIRST_ROWS.min(most), LEAST_ROWS, most),
            most,
            room: 0,
            profile: None,
        })
    }

    /// Peak memory on the device in bytes.
    pub fn device_bytes(&self) -> u64 {
        let rows = u64::from(self.most) * self.row_bytes();
        16 * self.chain.params as u64 + rows + self.partial_bytes()
    }

    /// Peak host memory for copies in bytes.
    pub fn host_bytes(&self) -> usize {
        self.most as usize * 20 + (32 << 20)
    }

    /// Bytes per row: position and weight, μ and its derivative, target, features, kept channels.
    fn row_bytes(&self) -> u64 {
        let channels = self.chain.kept().max(self.chain.features()) + self.chain.tape;
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
        self.programs.gpu()
    }

    /// Uploads the arena unless it is on the device.
    fn load(&mut self, model: &Model) -> Result<()> {
        if self.loaded {
            return Ok(());
        }
        let shared = self.programs.shared.clone();
        let buffers = &mut self.programs.buffers;
        arena::allocate(&shared.gpu, buffers, &self.chain)?;
        arena::upload(&shared.gpu, buffers, &self.chain, &model.arena)?;
        let rules = (0..self.chain.segments()).map(|s| (format!("rule_{s}"), size_of::<Rule>()));
        for (name, bytes) in rules.chain([("step".into(), size_of::<Step>())]) {
            buffers.reserve(&shared.gpu, &name, bytes as u64, U::UNIFORM | U::COPY_DST)?;
        }
        if self.chain.summed() > 0 {
            let bytes = self.partial_bytes();
            self.programs.buffers.reserve(&shared.gpu, "partial", bytes, U::STORAGE | U::COPY_DST)?;
        }
        if shared.profile && self.profile.is_none() {
            self.profile = Profile::new(&shared.gpu)?;
        }
        (self.loaded, self.clean) = (true, false);
        Ok(())
    }

    /// Makes room for `rows` rows, and for one where all rays miss the scene: kernels then still bind the buffers.
    fn reserve_rows(&mut self, rows: u32) -> Result<()> {
        let rows = rows.max(1);
        if rows <= self.room {
            return Ok(());
        }
        let n = u64::from(rows);
        self.programs.reserve_as("samples", 16 * n, U::STORAGE | U::COPY_DST)?;
        self.programs.reserve_as("mu", 4 * n, U::STORAGE | U::COPY_SRC)?;
        self.programs.reserve_as("dmu", 4 * n, U::STORAGE)?;
        self.programs.reserve_as("targets", 4 * n, U::STORAGE | U::COPY_DST)?;
        self.programs.reserve_as("features", 4 * n * self.chain.kept().max(1) as u64, U::STORAGE | U::COPY_SRC)?;
        self.programs.reserve_as("tape", 4 * n * self.chain.tape.max(1) as u64, U::STORAGE)?;
        self.room = rows;
        Ok(())
    }

    /// The kernel called `label` with its buffers; see [`Programs::ready`].
    fn ready(
        &mut self,
        label: &str,
        bound: &str,
        name: impl Fn(&str) -> String,
    ) -> Result<(Arc<Kernel>, wgpu::BindGroup)> {
        let kernel = self.sources.get_key_value(label);
        let kernel = kernel.ok_or_else(|| self.programs.gpu().error(format!("no kernel {label}")))?;
        self.programs.ready(kernel, bound, name)
    }

    /// Composes the kernels of the work's loss and priors, unless the last step had the same.
    fn learn_by(&mut self, work: &Work<'_>) -> Result<()> {
        let mut fragments = vec![(work.loss.wgsl(), 0)];
        fragments.extend(work.priors.iter().map(|p| (p.prior.wgsl(), p.prior.blocks().edge)));
        if self.learned == fragments {
            return Ok(());
        }
        for (label, source) in sources(work.loss, work.priors.iter().map(|p| p.prior))? {
            admit(self.gpu(), &label, &source)?;
            self.programs.forget(&label);
            self.sources.insert(label, source);
        }
        self.learned = fragments;
        Ok(())
    }

    /// Launches kernels one after the other, each with its number of groups.
    fn launch(&mut self, encoder: &mut wgpu::CommandEncoder, launches: &[(&str, usize)]) -> Result<()> {
        for &(label, groups) in launches.iter().filter(|(_, groups)| *groups > 0) {
            let (kernel, bound) = self.ready(label, label, str::to_owned)?;
            let timestamp_writes = self.profile.as_mut().and_then(|p| p.around(label));
            let mut pass = encoder
                .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(&kernel.label), timestamp_writes });
            kernel.launch(&mut pass, &bound, groups.min(MOST_GROUPS) as u32);
        }
        Ok(())
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let buffer = self.programs.buffer(name)?;
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
    fn copy(&self, encoder: &mut wgpu::CommandEncoder, name: &str, bytes: u64, at: u64) -> Result<()> {
        if bytes > 0 {
            let [from, to] = [self.programs.buffer(name)?, self.programs.buffer("staging")?];
            encoder.copy_buffer_to_buffer(from, 0, to, at, bytes);
        }
        Ok(())
    }

    fn read(&self, bytes: u64, read: impl FnOnce(&[u8])) -> Result<()> {
        self.gpu().read(self.programs.buffer("staging")?, bytes, read)
    }

    /// Makes room for `bytes` that are read.
    fn stage(&mut self, bytes: u64) -> Result<()> {
        self.programs.buffers.staging(&self.programs.shared.gpu, bytes).map(drop)
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
            // Whole workgroups, since all of their invocations may write.
            let stride = rows.next_multiple_of(GROUP).min(self.room);
            let bytes = 4 * u64::from(stride) * width as u64;
            self.programs.reserve_as(result, bytes, U::STORAGE | U::COPY_SRC)?;
            // The result ends with the last channel's rows.
            let wanted = 4 * (u64::from(stride) * (width as u64 - 1) + u64::from(rows));
            self.stage(wanted)?;
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
        self.profile.as_mut().map_or(Ok(()), |p| p.collect(&self.programs.shared.gpu))
    }

    /// Makes room for a wave and writes its rays.
    fn place(&mut self, wave: &Wave) -> Result<()> {
        self.reserve_rows(wave.rows)?;
        self.programs.reserve_as(
            "rays",
            (wave.rays.len().max(1) * size_of::<GpuRay>()) as u64,
            U::STORAGE | U::COPY_DST,
        )?;
        self.programs.reserve_as("losses", 4 * wave.losses().max(1) as u64, U::STORAGE | U::COPY_SRC)?;
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
            let (buffer, at) = (self.programs.buffer("samples")?, 16 * u64::from(wave.ray_rows));
            self.gpu().write(buffer, at, bytemuck::cast_slice(&samples));
            self.write("targets", bytemuck::cast_slice(&targets))?;
        }
        let mut block_rows = 0;
        if let (Some(work), false) = (work.priors.get(wave.prior), wave.blocks.is_empty()) {
            let corners: Vec<[f32; 4]> =
                work.corners[wave.blocks.clone()].iter().map(|c| [c[0], c[1], c[2], 0.0]).collect();
            self.programs.reserve_as("corners", 16 * corners.len() as u64, U::STORAGE | U::COPY_DST)?;
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
        let backward = if self.chain.params > 0 { groups(wave.rows as usize) } else { 0 };
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
        all.iter().try_for_each(|(label, source)| admit(self.gpu(), label, source))
    }

    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        self.learn_by(work)?;
        self.load(model)?;
        let of_step = |(label, _): &(&String, &Source)| !["evaluate", "encode", "lines"].contains(&label.as_str());
        self.programs.compile(self.sources.iter().filter(of_step))?;
        let started = Instant::now();
        let mut encoder = self.encoder();
        if !self.clean {
            for s in 0..self.chain.segments() {
                self.programs.buffers.get(&format!("grads_{s}")).inspect(|b| encoder.clear_buffer(b, 0, None));
            }
        }
        self.programs.buffers.get("partial").inspect(|b| encoder.clear_buffer(b, 0, None));
        self.clean = false;
        let waves = wave::of_step(model.pipeline.projector.as_ref(), work, self.pace.size());
        let losses: usize = waves.iter().map(Wave::losses).sum();
        self.stage(4 * losses.max(1) as u64)?;
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
        let mut encoder = self.encoder();
        for s in 0..self.chain.segments() {
            let count = self.chain.segment(s).len();
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
            let (kernel, bound) = self.ready("adam", &format!("adam_{s}"), |part| format!("{part}_{s}"))?;
            let timestamp_writes = self.profile.as_mut().and_then(|p| p.around("adam"));
            let mut pass =
                encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("adam"), timestamp_writes });
            kernel.launch(&mut pass, &bound, count.div_ceil(256).clamp(1, MOST_GROUPS) as u32);
        }
        arena::refresh(&self.programs.buffers, &self.chain, &mut encoder);
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
            self.stage(bytes)?;
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
        let Programs { shared, buffers, .. } = &mut self.programs;
        arena::download(&shared.gpu, buffers, &self.chain, &mut model.arena)
    }

    fn renew(&mut self) {
        (self.loaded, self.update) = (false, None);
        self.programs.unbind();
    }
}
