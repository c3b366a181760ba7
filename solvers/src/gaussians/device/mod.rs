//! Gaussians on a device. Parameters stay there; a call brings back what it was asked for.
//!
//! As on the CPU, a view's pixels and a grid's points are put into bins, each with a list of the Gaussians that reach it; a
//! group computes a bin. Derivatives are gathered, a group for each Gaussian, so that no number is added atomically. The
//! lists have no fixed order, and so sums of a pixel differ by rounding from run to run.
//!
//! - `programs`: the kernels. [`training`]: a training step.

mod programs;
pub mod training;

use super::shape::NUMBERS;
use super::stage::Bundle;
use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, cast_slice_mut};
use conefield_core::device::Device;
use conefield_core::error::Result;
use conefield_core::stage::{OnDevice, UnitGrid, UnitRay};
use programs::Evaluation;

/// Lanes of a group.
const GROUP: usize = 64;
/// Points of a grid's bin per axis.
const TILE: usize = 4;
/// Cells per side of the unit cube for scattered points: the first whose lists the device holds. A software device ends a
/// lane after 65,535 iterations of its loops, and a lane visits every cell that a Gaussian reaches.
const SIDES: [usize; 4] = [32, 16, 4, 1];
/// Points or rays that are evaluated at once.
const TOGETHER: usize = 1 << 18;
/// Bytes per slot: parameters, shape, box, footprint, moments.
pub const SLOT_BYTES: u64 = 4 * NUMBERS as u64 + 64 + 16 + 48 + 48;

/// `Bins` in `kernels/bins.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Bins {
    shape: [u32; 3],
    count: u32,
    tile: [u32; 3],
    room: u32,
}

/// `Grid` in `kernels/grid.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Grid {
    first: [f32; 3],
    slack: f32,
    spacing: [f32; 3],
    scale: f32,
    shape: [u32; 3],
    count: u32,
}

/// `LineRay` in `kernels/lines.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct LineRay {
    origin: [f32; 3],
    meets: f32,
    direction: [f32; 3],
    spread: f32,
}

impl Grid {
    fn of(grid: &UnitGrid, scale: f64) -> Self {
        Self {
            first: grid.first.map(|x| x as f32),
            slack: 0.01,
            spacing: grid.spacing.map(|x| x as f32),
            scale: scale as f32,
            shape: grid.shape.map(|n| n as u32),
            count: grid.shape.iter().product::<usize>() as u32,
        }
    }

    /// `count` scattered points, in cells of the unit cube.
    fn scattered(count: usize, side: usize) -> Self {
        Self {
            first: [0.0; 3],
            slack: 1.0,
            spacing: [1.0 / side as f32; 3],
            scale: 0.0,
            shape: [side as u32; 3],
            count: count as u32,
        }
    }
}

/// A mixture of Gaussians on a device.
pub struct DeviceMixture {
    device: Box<dyn Device>,
    /// Slots.
    most: usize,
    programs: Evaluation,
    /// Whether the shapes are those of the parameters.
    decoded: bool,
    /// Room in the lists.
    room: u32,
}

impl DeviceMixture {
    /// A mixture of up to `most` Gaussians. Refuses a device that cannot run the kernels.
    pub fn new(device: Box<dyn Device>, most: usize) -> Result<Self> {
        let programs = Evaluation::new();
        programs.all().into_iter().try_for_each(|program| device.admits(program))?;
        Ok(Self { device, most, programs, decoded: false, room: 0 })
    }

    /// Groups with a lane for each of `count`.
    fn groups(count: usize) -> usize {
        count.div_ceil(GROUP)
    }

    /// Points or rays that are evaluated at once: whole groups.
    fn together(&self) -> usize {
        let fit = self.device.most_bytes() as usize / size_of::<LineRay>() / GROUP * GROUP;
        fit.clamp(GROUP, TOGETHER)
    }

    /// Makes the buffers of the slots.
    fn reserve(&mut self) -> Result<()> {
        for (name, numbers) in [("shapes", 16), ("boxes", 4)] {
            self.device.reserve(name, 4 * (numbers * self.most) as u64)?;
        }
        self.grow(4 * self.most as u32)
    }

    /// Makes room for `entries` in the lists.
    fn grow(&mut self, entries: u32) -> Result<()> {
        if entries > self.room {
            self.device.reserve("entries", 4 * u64::from(entries))?;
            self.room = entries;
        }
        Ok(())
    }

    /// Bins of `tile` points for `shape` points.
    fn bin(&mut self, shape: [usize; 3], tile: [usize; 3]) -> Result<Bins> {
        let bins: [u32; 3] = std::array::from_fn(|k| shape[k].div_ceil(tile[k]) as u32);
        let count = bins.iter().product();
        for name in ["counts", "starts", "next"] {
            self.device.reserve(name, 4 * (u64::from(count) + 1))?;
        }
        let bins = Bins { shape: bins, count, tile: tile.map(|n| n as u32), room: self.room };
        self.device.write("bins", bytes_of(&bins))?;
        Ok(bins)
    }

    /// The shapes of the parameters, if they are not there yet.
    fn decode(&mut self) -> Result<()> {
        if !self.decoded {
            self.device.run(&[(&self.programs.decode, Self::groups(self.most))])?;
            self.decoded = true;
        }
        Ok(())
    }

    /// Lists of the Gaussians that reach the bins of `grid`; `None` if they are larger than a buffer.
    fn listed(&mut self, grid: Grid, tile: usize) -> Result<Option<Bins>> {
        self.decode()?;
        self.device.write("grid", bytes_of(&grid))?;
        let shape = grid.shape.map(|n| n as usize);
        let fits = |numbers: u64, most: u64| 4 * numbers <= most;
        if !fits(shape.iter().map(|n| n.div_ceil(tile) as u64).product::<u64>() + 1, self.device.most_bytes()) {
            return Ok(None);
        }
        loop {
            let bins = self.bin(shape, [tile; 3])?;
            let mut launches = vec![(&self.programs.reach, Self::groups(self.most))];
            launches.extend(self.programs.lists(Self::groups(self.most)));
            self.device.run(&launches)?;
            let mut entries = [0u32];
            self.device.read("starts", 4 * u64::from(bins.count), cast_slice_mut(&mut entries))?;
            if entries[0] <= self.room {
                return Ok(Some(bins));
            }
            if !fits(entries[0].into(), self.device.most_bytes()) {
                return Ok(None);
            }
            self.grow(entries[0])?;
        }
    }
}

impl OnDevice for DeviceMixture {
    fn load(&mut self, params: &[f32]) -> Result<()> {
        self.reserve()?;
        self.decoded = false;
        self.device.write("params", cast_slice(params))
    }

    fn evaluate(&mut self, points: &[[f32; 3]], out: &mut [f32]) -> Result<()> {
        let together = self.together();
        for (points, out) in points.chunks(together).zip(out.chunks_mut(together)) {
            for side in SIDES {
                if self.listed(Grid::scattered(points.len(), side), 1)?.is_some() {
                    break;
                }
            }
            self.device.write("points", cast_slice(points))?;
            self.device.reserve("values", size_of_val(out) as u64)?;
            self.device.run(&[(&self.programs.at_points, Self::groups(points.len()))])?;
            self.device.read("values", 0, cast_slice_mut(out))?;
        }
        Ok(())
    }

    fn values(&mut self, grid: &UnitGrid, out: &mut [f32]) -> Result<()> {
        let Some(bins) = self.listed(Grid::of(grid, 0.0), TILE)? else {
            let [planes, rows, columns] = grid.shape;
            if planes == 1 {
                return self.grow(u32::MAX);
            }
            // Half of the planes at a time.
            let (near, far) = out.split_at_mut(planes / 2 * rows * columns);
            let mut rest = UnitGrid { shape: [planes - planes / 2, rows, columns], ..*grid };
            rest.first[0] += (planes / 2) as f64 * grid.spacing[0];
            self.values(&UnitGrid { shape: [planes / 2, rows, columns], ..*grid }, near)?;
            return self.values(&rest, far);
        };
        self.device.reserve("values", size_of_val(out) as u64)?;
        self.device.run(&[(&self.programs.paint, bins.count as usize)])?;
        self.device.read("values", 0, cast_slice_mut(out))
    }

    fn project(&mut self, rays: &[UnitRay], out: &mut [f32]) -> Result<()> {
        self.decode()?;
        let together = self.together();
        for (rays, out) in rays.chunks(together).zip(out.chunks_mut(together)) {
            let mut all = vec![];
            for rays in rays.chunks(GROUP) {
                let spread = Bundle::of(rays).map_or(0.0, |bundle| bundle.spread);
                all.extend(rays.iter().map(|ray| LineRay {
                    origin: ray.origin,
                    meets: if ray.inside[1] > ray.inside[0] { 1.0 } else { 0.0 },
                    direction: ray.direction,
                    spread: spread as f32,
                }));
            }
            self.device.write("grid", bytes_of(&Grid::scattered(rays.len(), 1)))?;
            self.device.write("rays", cast_slice(&all))?;
            self.device.reserve("values", size_of_val(out) as u64)?;
            self.device.run(&[(&self.programs.lines, Self::groups(rays.len()))])?;
            self.device.read("values", 0, cast_slice_mut(out))?;
        }
        Ok(())
    }
}
