//! Metrics during a voxel reconstruction: PSNR against a reference, the error of held-out views.

use crate::watched;
use conefield_core::error::Result;
use conefield_core::geometry::Geometry;
use conefield_core::method::Job;
use conefield_core::place::{Array, Place, ViewRays};
use conefield_core::scan::Scan;
use conefield_core::voxel::VoxelProjector;
use ndarray::{Array3, ArrayView3};

/// Evaluates a job's reference and held-out views; never trains on them.
pub struct VolumeMonitor<'a> {
    reference: Option<&'a Array3<f32>>,
    held_out: Option<&'a Scan>,
    peak: f64,
}

impl<'a> VolumeMonitor<'a> {
    /// A monitor of the job's reference and held-out views.
    pub fn new(job: &Job<'a>) -> Self {
        let shape = job.scan.geometry.volume.shape;
        let reference = job.reference.map(|r| &r.data).filter(|r| r.shape() == shape);
        Self { reference, held_out: job.held_out, peak: job.peak }
    }

    /// Whether there is a volume to compare with.
    pub fn has_reference(&self) -> bool {
        self.reference.is_some()
    }

    /// Whether there is anything to evaluate.
    pub fn looks(&self) -> bool {
        self.reference.is_some() || self.held_out.is_some()
    }

    /// PSNR in dB of `scale·volume` over the voxels of `watched`.
    pub fn psnr(&self, volume: ArrayView3<'_, f32>, scale: f32) -> Option<f64> {
        let reference = self.reference?;
        let (mut sum, mut n) = (0.0, 0usize);
        for voxel in watched::voxels(volume.dim().into()) {
            sum += (f64::from(volume[voxel] * scale) - f64::from(reference[voxel])).powi(2);
            n += 1;
        }
        let mse = sum / n as f64;
        Some(10.0 * (self.peak * self.peak / mse.max(1e-300)).log10())
    }

    /// Root mean square error of the held-out views' line integrals, relative to their largest value.
    pub fn held_out(&self, place: &dyn Place, projector: &dyn VoxelProjector, volume: &Array) -> Result<Option<f64>> {
        let Some(scan) = self.held_out else { return Ok(None) };
        let geometry: &Geometry = &scan.geometry;
        let [rows, columns] = geometry.detector;
        let mut found = place.zeros([1, rows, columns])?;
        let (mut square, mut top) = (0.0, 0.0f32);
        for view in 0..geometry.views.len() {
            place.forward(ViewRays { projector, geometry, views: &[view] }, volume, &mut found)?;
            for (a, &b) in place.read(&found)?.iter().zip(scan.view(view)) {
                square += f64::from(a - b).powi(2);
                top = top.max(b);
            }
        }
        Ok(Some((square / scan.projections.len() as f64).sqrt() / f64::from(top).max(1e-300)))
    }
}
