//! Training on whole views, on a device.

use super::programs::Training;
use super::{Bins, DeviceMixture, Grid, TILE};
use crate::gaussians::control::{Pulls, lock};
use crate::gaussians::shape::NUMBERS;
use crate::gaussians::view::Beam;
use crate::gaussians::views::{Rule, Views, drawn};
use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, cast_slice_mut};
use conefield_core::backend::{Adam, BlockWork, Executable, StepStats, Work};
use conefield_core::device::{Device, Launch};
use conefield_core::error::{Error, Result};
use conefield_core::geometry::{Vec3, cross, dot};
use conefield_core::loss::Loss;
use conefield_core::pipeline::Model;
use conefield_core::prior::Prior;
use conefield_core::scan::ScanHeader;
use conefield_core::stage::{OnDevice, UnitGrid, UnitRay};
use std::sync::{Arc, Mutex};

/// Pixels of a bin per axis.
const PIXELS: usize = 16;
/// The arena's parts, by their names in kernels.
const PARTS: [&str; 4] = ["params", "grads", "first", "second"];

/// `View` in `kernels/view.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct View {
    across: [f32; 4],
    down: [f32; 4],
    ahead: [f32; 4],
    source: [f32; 3],
    columns: u32,
    first: [f32; 3],
    rows: u32,
    u: [f32; 3],
    opens: u32,
    v: [f32; 3],
    scale: f32,
    constants: [f32; 2],
    ssim_scale: f32,
    pad: f32,
}

/// `Rule` in `kernels/adam.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct AdamRule {
    rates: [f32; 4],
    betas: [f32; 2],
    root: f32,
    eps: f32,
    widths: [f32; 2],
    pad: [f32; 2],
}

impl View {
    /// The rays of `beam`, relative to the length of the first.
    fn of(beam: &Beam) -> Self {
        let length = dot(beam.first, beam.first).sqrt();
        let unit = |v: Vec3| v.map(|x| x / length);
        let [first, u, v] = [beam.first, beam.u, beam.v].map(unit);
        // y = t·first + (t·column)·u + (t·row)·v: Cramer's rule.
        let whole = dot(cross(u, v), first);
        let solve = |a: Vec3, b: Vec3| -> [f32; 4] {
            let by = cross(a, b).map(|x| x / whole);
            let middle: Vec3 = std::array::from_fn(|k| 0.5 - beam.source[k]);
            [by[0] as f32, by[1] as f32, by[2] as f32, dot(by, middle) as f32]
        };
        let narrow = |v: Vec3| v.map(|x| x as f32);
        Self {
            across: solve(v, first),
            down: solve(first, u),
            ahead: solve(u, v),
            source: narrow(beam.source),
            columns: beam.detector[1] as u32,
            first: narrow(first),
            rows: beam.detector[0] as u32,
            u: narrow(u),
            v: narrow(v),
            ..Self::zeroed()
        }
    }
}

/// The views of a scan on a device, and a mixture that is trained on them.
pub struct DeviceTraining {
    mixture: DeviceMixture,
    programs: Training,
    rule: Rule,
    views: Views,
    /// The buffers of the measured views; none if the device has no room for them beside the mixture.
    buffers: Vec<String>,
    pulls: Arc<Mutex<Pulls>>,
    /// Whether the arena is on the device.
    loaded: bool,
}

impl DeviceTraining {
    /// Refuses a device, a loss or a prior that cannot run there.
    pub fn check(device: &dyn Device, loss: &dyn Loss, priors: &[Box<dyn Prior>], ssim: f64) -> Result<()> {
        Training::new(loss, priors, ssim > 0.0)?.all().try_for_each(|program| device.admits(program))
    }

    /// Training of up to `most` Gaussians on `views`, without padding, which are kept on the device if they are `resident`.
    pub fn new(
        device: Box<dyn Device>,
        most: usize,
        rule: Rule,
        (mut views, resident): (Views, bool),
        (loss, priors): (&dyn Loss, &[Box<dyn Prior>]),
        pulls: Arc<Mutex<Pulls>>,
    ) -> Result<Self> {
        let programs = Training::new(loss, priors, rule.ssim > 0.0)?;
        let mut mixture = DeviceMixture::new(device, most)?;
        let mut buffers = vec![];
        if resident {
            for view in 0..views.beams.len() {
                let name = format!("view {view}");
                mixture.device.write(&name, cast_slice(views.image(view)))?;
                buffers.push(name);
            }
            views.measured = vec![];
        }
        Ok(Self { mixture, programs, rule, views, buffers, pulls, loaded: false })
    }

    /// Bytes on the device for a scan of this size and this many slots, without its views.
    pub fn bytes(header: &ScanHeader, slots: u64) -> u64 {
        let image = (header.detector[0] * header.detector[1]) as u64;
        // Measured, found, gradient, and the images of the similarity.
        4 * image * (3 + 8) + slots * (super::SLOT_BYTES + 4 * (3 * NUMBERS as u64 + 2) + 16)
    }

    /// Uploads the arena unless it is on the device.
    fn load(&mut self, model: &Model) -> Result<()> {
        if self.loaded {
            return Ok(());
        }
        let arena = &model.arena;
        self.mixture.load(&arena.params)?;
        let most = self.mixture.most as u64;
        let pairs: Vec<[f32; 2]> = {
            let pulls = lock(&self.pulls);
            pulls.sums.iter().zip(&pulls.counts).map(|(sum, count)| [*sum, *count]).collect()
        };
        let device = &mut self.mixture.device;
        for (name, values) in PARTS.iter().zip([&arena.params, &arena.grads, &arena.first, &arena.second]).skip(1) {
            device.write(name, cast_slice(values))?;
        }
        device.reserve("pulls", 8 * most)?;
        if !pairs.is_empty() {
            device.write("pulls", cast_slice(&pairs))?;
        }
        let [rows, columns] = self.views.detector;
        let image = 4 * (rows * columns) as u64;
        for (name, images) in [("wanted", 1), ("found", 1), ("gradient", 1), ("between", 5), ("slopes", 3)] {
            if images == 1 || !self.programs.ssim.is_empty() {
                device.reserve(name, images * image)?;
            }
        }
        for (name, bytes) in [("seen", 48), ("moments", 48)] {
            device.reserve(name, bytes * most)?;
        }
        device.reserve("stats", 16)?;
        self.loaded = true;
        Ok(())
    }

    /// Bins of points, with room for their partial sums.
    fn bins(&mut self, shape: [usize; 3], tile: [usize; 3]) -> Result<Bins> {
        let bins = self.mixture.bin(shape, tile)?;
        self.mixture.device.reserve("partial", 8 * u64::from(bins.count))?;
        Ok(bins)
    }

    /// Loss and gradient of a view; `opens` for the first one of a step.
    fn view(&mut self, view: usize, opens: bool) -> Result<()> {
        let [rows, columns] = self.views.detector;
        let (pixels, share, top) = (rows * columns, 1.0 / self.rule.views as f64, self.views.top);
        let uniform = View {
            opens: opens.into(),
            scale: (share / pixels as f64) as f32,
            constants: [0.01, 0.03].map(|k: f64| ((k * top).powi(2)) as f32),
            ssim_scale: (-self.rule.ssim * share / pixels as f64) as f32,
            ..View::of(&self.views.beams[view])
        };
        let bins = self.bins([1, rows, columns], [1, PIXELS, PIXELS])?;
        let device = &mut self.mixture.device;
        device.write("view", bytes_of(&uniform))?;
        match self.buffers.get(view) {
            Some(name) => device.copy(name, 0, "wanted", 4 * pixels as u64)?,
            None => device.write("wanted", cast_slice(self.views.image(view)))?,
        }
        let (p, tiles) = (&self.programs, bins.count as usize);
        let (each, slots) = (DeviceMixture::groups(self.mixture.most), self.mixture.most);
        let mut launches: Vec<Launch<'_>> = vec![(&p.look, each)];
        launches.extend(self.mixture.programs.lists(each));
        launches.push((&p.project, tiles));
        launches.extend(p.ssim.iter().map(|program| (program, tiles)));
        launches.extend([(&p.gather, slots), (&p.learn_view, each), (&p.finish_view, 1)]);
        self.mixture.device.run(&launches)
    }

    /// The penalty of a prior's blocks and its gradient.
    fn prior(&mut self, which: usize, work: &BlockWork<'_>) -> Result<()> {
        let blocks = work.prior.blocks();
        let points = blocks.points() as u64;
        for name in ["values", "by"] {
            self.mixture.device.reserve(name, 4 * points)?;
        }
        for corner in work.corners {
            let (first, spacing) = (corner.map(f64::from), work.spacing.map(f64::from));
            let grid = Grid::of(&UnitGrid { first, spacing, shape: [blocks.edge; 3] }, work.scale());
            let bins = self.bins([blocks.edge; 3], [TILE; 3])?;
            self.mixture.device.write("grid", bytes_of(&grid))?;
            let (p, q, tiles) = (&self.programs, &self.mixture.programs, bins.count as usize);
            let (each, slots) = (DeviceMixture::groups(self.mixture.most), self.mixture.most);
            let mut launches: Vec<Launch<'_>> = vec![(&q.reach, each)];
            launches.extend(q.lists(each));
            launches.extend([(&q.paint, tiles), (&p.penalties[which], tiles), (&p.collect, slots)]);
            launches.extend([(&p.learn_block, each), (&p.finish_block, 1)]);
            self.mixture.device.run(&launches)?;
        }
        Ok(())
    }
}

impl Executable for DeviceTraining {
    fn step(&mut self, model: &mut Model, work: &Work<'_>) -> Result<StepStats> {
        self.load(model)?;
        self.mixture.decode()?;
        loop {
            let views = drawn(work.seed, work.step, self.rule.views, self.views.beams.len());
            for (n, view) in views.enumerate() {
                self.view(view, n == 0)?;
            }
            for (which, prior) in work.priors.iter().enumerate() {
                self.prior(which, prior)?;
            }
            let mut stats = [0u32; 4];
            self.mixture.device.read("stats", 0, cast_slice_mut(&mut stats))?;
            let [loss, alike, penalty, listed] = stats;
            // Lists without room are incomplete: the step is computed again.
            if listed > self.mixture.room {
                self.mixture.grow(listed.saturating_add(listed / 4))?;
                continue;
            }
            let [loss, alike, penalty] = [loss, alike, penalty].map(|bits| f64::from(f32::from_bits(bits)));
            let samples = (self.rule.views * self.views.detector.iter().product::<usize>()) as u64;
            let unlike = self.rule.ssim * (1.0 - alike / self.rule.views as f64);
            return Ok(StepStats { loss, prior: unlike + penalty, samples, ..StepStats::default() });
        }
    }

    fn update(&mut self, _: &mut Model, adam: &Adam) -> Result<()> {
        let bias = [adam.beta1, adam.beta2].map(|b| 1.0 - b.powf(adam.step as f64));
        let rate = adam.lr / bias[0];
        let [centre, scale, rotation] = self.rule.rates;
        let rule = AdamRule {
            rates: [centre, scale, rotation, 1.0].map(|factor| (factor * rate) as f32),
            betas: [adam.beta1 as f32, adam.beta2 as f32],
            root: (1.0 / bias[1].sqrt()) as f32,
            eps: adam.eps as f32,
            widths: self.rule.widths.map(|w| w.ln() as f32),
            pad: [0.0; 2],
        };
        self.mixture.device.write("rule", bytes_of(&rule))?;
        self.mixture.decoded = false;
        let each = DeviceMixture::groups(self.mixture.most);
        self.mixture.device.run(&[(&self.programs.adam, each)])
    }

    fn evaluate(&mut self, model: &Model, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        self.load(model)?;
        self.mixture.evaluate(points, out)
    }

    fn encode(&mut self, _: &Model, _: &[[f32; 3]]) -> Result<Vec<f32>> {
        Err(Error::unsupported("gaussians", "there is no encoder"))
    }

    fn values(&mut self, model: &Model, grid: &UnitGrid, out: &mut [f32]) -> Result<()> {
        self.load(model)?;
        self.mixture.values(grid, out)
    }

    fn render(&mut self, model: &Model, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        self.load(model)?;
        self.mixture.project(rays, out)
    }

    fn fetch(&mut self, model: &mut Model) -> Result<()> {
        if !self.loaded {
            return Ok(());
        }
        let arena = &mut model.arena;
        let parts = [&mut arena.params, &mut arena.grads, &mut arena.first, &mut arena.second];
        for (name, values) in PARTS.iter().zip(parts) {
            self.mixture.device.read(name, 0, cast_slice_mut(values))?;
        }
        let mut pairs = vec![[0.0f32; 2]; lock(&self.pulls).sums.len()];
        if !pairs.is_empty() {
            self.mixture.device.read("pulls", 0, cast_slice_mut(&mut pairs))?;
        }
        let mut pulls = lock(&self.pulls);
        let Pulls { sums, counts } = &mut *pulls;
        for ((sum, count), pair) in sums.iter_mut().zip(counts).zip(pairs) {
            [*sum, *count] = pair;
        }
        Ok(())
    }

    fn renew(&mut self) {
        self.loaded = false;
    }
}
