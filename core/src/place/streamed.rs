//! A device without room for a method's arrays. They live in the host's memory; the device computes line integrals of one
//! slab of the volume after another.

use super::{Array, Host, Penalty, Place, ProximalStep, ViewRays, additive};
use crate::error::{Error, Result};
use crate::geometry::Geometry;
use crate::parallel;
use crate::voxel::VoxelProjector;
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, s};
use std::ops::Range;
use std::sync::Arc;

/// Numbers that come from the device at once, about.
const PIECE: usize = 1 << 22;
/// Images beside a slab take at most this share of its memory.
const IMAGES: usize = 4;
/// Bytes that a device keeps free beside arrays, for transfers and kernels; as many as the arrays take, if those are fewer.
pub const SPARE: u64 = 1 << 28;

/// Arrays in the host's memory, line integrals on a device.
pub struct Streamed {
    device: Arc<dyn Place>,
}

/// Arrays on the device: planes of a volume, and as many images as go with them.
struct Room {
    slab: Array,
    images: Array,
}

impl Streamed {
    /// Uses the memory of `device` for one slab at a time.
    pub fn new(device: Arc<dyn Place>) -> Self {
        Self { device }
    }

    /// Room for as many planes of `volume` as the device can hold. It does not say how much memory it has.
    fn room(&self, volume: [usize; 3], images: [usize; 3]) -> Result<Room> {
        let ([mut planes, ny, nz], [most, rows, columns]) = (volume, images);
        loop {
            let together = (planes * ny * nz / (IMAGES * rows * columns).max(1)).clamp(1, most.max(1));
            let make = || {
                let images = self.device.zeros([together, rows, columns])?;
                zeros_with_spare(self.device.as_ref(), [planes, ny, nz]).map(|slab| Room { slab, images })
            };
            match make() {
                Err(_) if planes > 1 => planes = planes.div_ceil(2),
                room => return room,
            }
        }
    }

    /// Adds the first planes of `from` to `to`.
    fn add(&self, from: &Array, mut to: ArrayViewMut3<'_, f32>) -> Result<()> {
        let [_, rows, columns] = from.shape();
        let together = (PIECE / (rows * columns).max(1)).max(1);
        let mut piece = Array3::zeros([together.min(to.len_of(Axis(0))), rows, columns]);
        for (i, mut to) in to.axis_chunks_iter_mut(Axis(0), together).enumerate() {
            let mut piece = piece.slice_mut(s![..to.len_of(Axis(0)), .., ..]);
            self.device.store(from, i * together, piece.view_mut())?;
            parallel::over(to.outer_iter_mut().zip(piece.outer_iter()), |_, (mut to, piece)| to += &piece);
        }
        Ok(())
    }
}

/// Zeros, if the device then still has [`SPARE`] bytes.
///
/// # Errors
/// Too little memory.
pub fn zeros_with_spare(device: &dyn Place, [planes, rows, columns]: [usize; 3]) -> Result<Array> {
    let array = device.zeros([planes, rows, columns])?;
    let spare = planes.min(SPARE as usize / (size_of::<f32>() * rows * columns).max(1));
    device.zeros([spare, rows, columns]).map(|_| array)
}

/// The parts of `count` with at most `size` in each.
fn parts(count: usize, size: usize) -> impl Iterator<Item = Range<usize>> {
    (0..count).step_by(size).map(move |first| first..(first + size).min(count))
}

/// The slabs of a volume in parts of as many planes, each with its geometry. Planes beyond the volume fill the last one.
fn slabs(geometry: &Geometry, planes: usize) -> impl Iterator<Item = (Range<usize>, Geometry)> {
    let all = geometry.volume.shape[0];
    parts(all, planes).map(move |own| {
        let volume = geometry.volume.slab(own.start..own.start + planes);
        (own, Geometry { volume, ..geometry.clone() })
    })
}

fn elsewhere() -> Error {
    Error::unsupported("array", "it lives in another place")
}

impl Place for Streamed {
    fn zeros(&self, shape: [usize; 3]) -> Result<Array> {
        Host.zeros(shape)
    }

    fn load(&self, from: ArrayView3<'_, f32>, to: &mut Array, first: usize) -> Result<()> {
        Host.load(from, to, first)
    }

    fn store(&self, from: &Array, first: usize, to: ArrayViewMut3<'_, f32>) -> Result<()> {
        Host.store(from, first, to)
    }

    fn room(&self) -> u64 {
        Host.room()
    }

    fn adopt(&self, from: Array3<f32>) -> Result<Array> {
        Host.adopt(from)
    }

    fn update(&self, step: ProximalStep<'_>, tau: f32, penalty: &mut dyn Penalty) -> Result<()> {
        Host.update(step, tau, penalty)
    }

    fn admits(&self, projector: &dyn VoxelProjector) -> Result<()> {
        additive(projector)?;
        self.device.admits(projector)
    }

    fn forward(&self, rays: ViewRays<'_>, volume: &Array, images: &mut Array) -> Result<()> {
        let mut room = self.room(volume.shape(), images.shape())?;
        let (volume, images) = (volume.on_host().ok_or_else(elsewhere)?, images.on_host_mut().ok_or_else(elsewhere)?);
        images.slice_mut(s![..rays.views.len(), .., ..]).fill(0.0);
        for (own, slab) in slabs(rays.geometry, room.slab.shape()[0]) {
            self.device.fill(&mut room.slab, 0.0)?;
            self.device.load(volume.slice(s![own, .., ..]), &mut room.slab, 0)?;
            for some in parts(rays.views.len(), room.images.shape()[0]) {
                let rays = ViewRays { geometry: &slab, views: &rays.views[some.clone()], ..rays };
                self.device.forward(rays, &room.slab, &mut room.images)?;
                self.add(&room.images, images.slice_mut(s![some, .., ..]))?;
            }
        }
        Ok(())
    }

    fn adjoint(&self, rays: ViewRays<'_>, images: &Array, volume: &mut Array) -> Result<()> {
        let mut room = self.room(volume.shape(), images.shape())?;
        let (images, volume) = (images.on_host().ok_or_else(elsewhere)?, volume.on_host_mut().ok_or_else(elsewhere)?);
        for (own, slab) in slabs(rays.geometry, room.slab.shape()[0]) {
            self.device.fill(&mut room.slab, 0.0)?;
            for some in parts(rays.views.len(), room.images.shape()[0]) {
                self.device.load(images.slice(s![some.clone(), .., ..]), &mut room.images, 0)?;
                let rays = ViewRays { geometry: &slab, views: &rays.views[some], ..rays };
                self.device.adjoint(rays, &room.images, &mut room.slab)?;
            }
            self.add(&room.slab, volume.slice_mut(s![own, .., ..]))?;
        }
        Ok(())
    }
}
