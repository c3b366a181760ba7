//! The device as a place: arrays in its memory, and kernels that combine them; see [`conefield_core::place`].
//!
//! - `launch`: launches of kernels. Up to two batches are on the device, so that it computes while the next views come.
//! - `elements`: elementwise maps, masks, reductions.
//! - `rays`: projection and its adjoint. `pixels`: data terms. `filtered`: FDK.
//! - `stencils`: total variation.
//!
//! An array larger than a buffer is split along its first axis. The adjoint adds to voxels atomically, so its sums have
//! no fixed order.

mod elements;
mod filtered;
mod launch;
mod pixels;
mod rays;
mod stencils;

use crate::Shared;
use conefield_core::error::Result;
use conefield_core::parallel;
use conefield_core::place::{
    Array, FilteredViews, Map, Mask, MeasuredViews, Place, ProximalStep, Reduction, SPARE, Streamed, VariationSlope,
    ViewRays, Weighing, prox_on_host, zeros_with_spare,
};
use conefield_core::regularizer::{Kernels, Penalty};
use conefield_core::voxel::VoxelProjector;
use launch::{ARRAY, Room};
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, s};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes of a buffer with which free memory is sought.
const PIECE: u64 = 1 << 30;

/// Numbers that are read at once, about: as many as the buffer holds through which they come.
const READ: usize = 1 << 24;

/// A part of an array: planes along its first axis, in a buffer.
pub(crate) struct Chunk {
    planes: Range<usize>,
    buffer: wgpu::Buffer,
}

/// An array on the device. Arrays of one shape have the same parts.
pub(crate) struct Chunks(Vec<Chunk>);

/// The arrays of a device.
pub struct DevicePlace {
    shared: Arc<Shared>,
    room: Mutex<Room>,
}

/// The parts of an array of this place.
fn parts<T>(x: &conefield_core::place::Held<T>) -> &[Chunk] {
    // An array in the shape of a slab.
    let x = x.planes().map_or(x, |(_, planes)| planes);
    x.get::<Chunks>().map_or_else(|| unreachable!("an array of another place"), |parts| &parts.0)
}

impl DevicePlace {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { room: Mutex::new(Room::new(shared.clone())), shared }
    }

    fn room(&self) -> MutexGuard<'_, Room> {
        self.room.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Planes along the first axis of each part of an array.
    fn split(&self, shape: [usize; 3]) -> Result<Vec<Range<usize>>> {
        let plane = 4 * (shape[1] * shape[2]) as u64;
        let bytes = self.shared.gpu.adapter.bound_bytes();
        let most = bytes.checked_div(plane).unwrap_or(bytes) as usize;
        if most == 0 {
            let what = format!("a plane or view of {plane} bytes is larger than a buffer of {bytes} bytes");
            return Err(self.shared.gpu.error(what));
        }
        // Parts of nearly the same size.
        let parts = shape[0].div_ceil(most).max(1);
        let each = shape[0].div_ceil(parts).max(1);
        Ok((0..shape[0]).step_by(each).map(|at| at..(at + each).min(shape[0])).collect())
    }
}

/// Whether element i of a mask is set, in WGSL.
fn flag(mask: &str, i: &str) -> String {
    format!("((({mask}[{i} / 32u] >> ({i} % 32u)) & 1u) == 1u)")
}

/// Numbers per plane.
fn plane(shape: [usize; 3]) -> usize {
    shape[1] * shape[2]
}

impl Place for DevicePlace {
    fn device(&self) -> Option<String> {
        Some(self.shared.gpu.adapter.to_string())
    }

    fn admits(&self, projector: &dyn VoxelProjector) -> Result<()> {
        rays::admits(&self.shared, projector)
    }

    fn holds(&self, bytes: u64) -> bool {
        let (most, bytes) = (self.shared.gpu.adapter.buffer_bytes.min(PIECE), bytes.saturating_add(bytes.min(SPARE)));
        let pieces = (0..bytes).step_by(most as usize).map(|at| most.min(bytes - at));
        // All of them at once.
        pieces.map(|bytes| self.shared.gpu.buffer("arrays", bytes, ARRAY)).collect::<Result<Vec<_>>>().is_ok()
    }

    fn streamed(&self) -> Option<Arc<dyn Place>> {
        Some(Arc::new(Streamed::new(Arc::new(Self::new(self.shared.clone())))))
    }

    fn zeros(&self, shape: [usize; 3]) -> Result<Array> {
        let parts = self.split(shape)?.into_iter().map(|planes| {
            let bytes = 4 * (planes.len() * plane(shape)) as u64;
            Ok(Chunk { planes, buffer: self.shared.gpu.buffer("an array", bytes, ARRAY)? })
        });
        Ok(Array::there(shape, Chunks(parts.collect::<Result<_>>()?)))
    }

    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()> {
        let (n, plane) = (from.len_of(Axis(0)), plane(to.shape()));
        for part in parts(to) {
            let planes = part.planes.start.max(first)..part.planes.end.min(first + n);
            if planes.is_empty() {
                continue;
            }
            let data = from.slice(s![planes.start - first..planes.end - first, .., ..]);
            let data = data.as_standard_layout();
            let at = 4 * ((planes.start - part.planes.start) * plane) as u64;
            self.shared.gpu.upload(&part.buffer, at, bytemuck::cast_slice(data.as_slice().unwrap_or_default()))?;
        }
        Ok(())
    }

    fn store(&self, from: &Array, first: usize, mut to: ArrayViewMut3<'_, f32>) -> Result<()> {
        let (n, plane) = (to.len_of(Axis(0)), plane(from.shape()));
        let mut room = self.room();
        for part in parts(from) {
            let (start, end) = (part.planes.start.max(first), part.planes.end.min(first + n));
            for start in (start..end).step_by((READ / plane.max(1)).max(1)) {
                let end = end.min(start + (READ / plane.max(1)).max(1));
                let mut to = to.slice_mut(s![start - first..end - first, .., ..]);
                let at = (start - part.planes.start) * plane;
                let shape = to.raw_dim();
                room.read(&part.buffer, at, (end - start) * plane, |found| {
                    let found = ArrayView3::from_shape(shape, found);
                    let found = found.unwrap_or_else(|e| unreachable!("as many numbers as asked for: {e}"));
                    parallel::over(to.outer_iter_mut().zip(found.outer_iter()), |_, (mut to, found)| to.assign(&found));
                })?;
            }
        }
        Ok(())
    }

    fn mask(&self, flags: Array3<bool>) -> Result<Mask> {
        let shape: [usize; 3] = flags.dim().into();
        let parts = self.split(shape)?.into_iter().map(|planes| {
            let flags = flags.slice(s![planes.clone(), .., ..]);
            let words = elements::words(&flags);
            let buffer = self.shared.gpu.buffer("a mask", 4 * words.len() as u64, ARRAY)?;
            self.shared.gpu.upload(&buffer, 0, bytemuck::cast_slice(&words))?;
            Ok(Chunk { planes, buffer })
        });
        Ok(Mask::there(shape, Chunks(parts.collect::<Result<_>>()?)))
    }

    fn views<'a>(&self, measured: &'a Array3<f32>) -> Result<MeasuredViews<'a>> {
        // Views that do not fit beside what a pass takes for a moment are loaded in every pass.
        let here = match zeros_with_spare(self, measured.dim().into()) {
            Ok(mut here) => {
                self.load(measured.view(), &mut here, 0)?;
                Some(here)
            }
            Err(e) => {
                tracing::info!(
                    "the views do not fit on the device beside the arrays and are loaded in every pass: {e}"
                );
                None
            }
        };
        Ok(MeasuredViews { measured, here })
    }

    fn fill(&self, x: &mut Array, value: f32) -> Result<()> {
        elements::fill(&mut self.room(), x, value)
    }

    fn scatter(&self, from: &Array, first: usize, out: &mut Array, at: &[usize]) -> Result<()> {
        elements::scatter(&self.shared, (from, first), out, at);
        Ok(())
    }

    fn keep(&self, x: &mut Array, inside: &Mask, value: f32) -> Result<()> {
        elements::keep(&mut self.room(), x, inside, value)
    }

    fn map(&self, map: &Map, factors: [f64; 2], out: &mut Array, inputs: &[&Array]) -> Result<()> {
        elements::map(&mut self.room(), map, factors, out, inputs)
    }

    fn reduce(&self, kind: Reduction, x: &Array, y: &Array) -> Result<f64> {
        elements::reduce(&mut self.room(), kind, x, y)
    }

    fn forward(&self, rays: ViewRays<'_>, volume: &Array, images: &mut Array) -> Result<()> {
        rays::project(&mut self.room(), true, rays, volume, images)
    }

    fn adjoint(&self, rays: ViewRays<'_>, images: &Array, volume: &mut Array) -> Result<()> {
        rays::project(&mut self.room(), false, rays, volume, images)
    }

    fn compare(&self, by: &Weighing<'_>, views: &[usize], images: &mut Array) -> Result<[f64; 2]> {
        match by.term.map(|term| term.wgsl()) {
            Some(None) => {
                // The data term runs on the host, on residuals.
                let residual = Weighing { term: None, weights: None, ..*by };
                let [residual, _] = pixels::compare(self, &residual, None, views, images)?;
                let weights = by.weights.map(|w| self.read(w)).transpose()?;
                let mut misfit = 0.0;
                self.change(images, &mut |images| {
                    misfit = by.derivative(views, images, weights.as_ref()).unwrap_or_default();
                })?;
                by.fault()?;
                Ok([residual, misfit])
            }
            term => pixels::compare(self, by, term.flatten().as_ref(), views, images),
        }
    }

    fn weigh(&self, by: &Weighing<'_>, spread: bool, views: &[usize], images: &mut Array) -> Result<()> {
        match by.term.and_then(|term| term.wgsl()) {
            Some(term) => pixels::weigh(self, by, &term, spread, views, images),
            None => by.weigh(self, spread, views, images),
        }
    }

    fn filtered(
        &self,
        work: &dyn FilteredViews,
        views: &[usize],
        images: &mut Array,
        slab: &mut Array,
        first: usize,
    ) -> Result<()> {
        filtered::backproject(&mut self.room(), work, (views, images), (slab, first))
    }

    fn update(&self, step: ProximalStep<'_>, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        match penalty.kernels() {
            Some(kernels) => stencils::update(&mut self.room(), step, tau, kernels),
            None => self.update_around(step, tau, penalty),
        }
    }

    fn prox(&self, v: &mut Array, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        let Some(kernels) = penalty.kernels() else {
            return prox_on_host(self, v, tau, penalty);
        };
        let iterate = self.zeros(v.shape())?;
        stencils::prox(&mut self.room(), (v, &iterate), tau, kernels)
    }

    fn penalty(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<f64> {
        match penalty.kernels() {
            Some(Kernels::Clip(_)) => Ok(0.0),
            Some(Kernels::Dual(dual)) => stencils::value(&mut self.room(), &dual, x),
            None => Ok(penalty.value(self.read(x)?.view())),
        }
    }

    fn adapt(&self, penalty: &mut dyn Penalty, x: &Array) -> Result<Option<f64>> {
        match penalty.kernels() {
            Some(Kernels::Dual(dual)) => stencils::adapt(&mut self.room(), dual, x).map(Some),
            _ => Ok(penalty.adapt(self.read(x)?.view())),
        }
    }

    fn slope(&self, slope: &VariationSlope<'_>, x: &Array, out: &mut Array) -> Result<f64> {
        stencils::slope(&mut self.room(), slope, x, out)
    }
}
