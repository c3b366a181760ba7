//! The built-in voxel projectors.

use super::rays;
use super::{bundles, columns};
use conefield_core::error::{Result, ensure};
use conefield_core::geometry::Geometry;
use conefield_core::parallel;
use conefield_core::scan::ScanHeader;
use conefield_core::simd::Real;
use conefield_core::voxel::{VoxelOperator, VoxelProjector, VoxelProjectorSpec};
use conefield_core::wgsl::Fragment;
use ndarray::{ArrayView3, ArrayViewMut3, Axis};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Settings of `siddon`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Siddon {}

/// Settings of `joseph`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Joseph {}

/// Settings of `trilinear`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Trilinear {
    /// Minimum number of samples along the smallest side of a voxel.
    pub samples_per_voxel: f64,
}

impl Default for Trilinear {
    fn default() -> Self {
        Self { samples_per_voxel: 2.0 }
    }
}

conefield_core::stage_type!(VoxelProjectorSpec, "siddon", Siddon, "exact path lengths through voxels");
conefield_core::stage_type!(
    VoxelProjectorSpec,
    "joseph",
    Joseph,
    "bilinear interpolation from plane to plane of voxels"
);
conefield_core::stage_type!(VoxelProjectorSpec, "trilinear", Trilinear, "trilinear samples of voxels at equal steps");

impl VoxelProjectorSpec for Siddon {
    fn build(&self) -> Result<Box<dyn VoxelProjector>> {
        Ok(Box::new(*self))
    }
}

impl VoxelProjectorSpec for Joseph {
    fn build(&self) -> Result<Box<dyn VoxelProjector>> {
        Ok(Box::new(*self))
    }
}

impl VoxelProjectorSpec for Trilinear {
    fn build(&self) -> Result<Box<dyn VoxelProjector>> {
        let n = self.samples_per_voxel;
        ensure((0.5..=64.0).contains(&n), "spec", "samples_per_voxel", n, "0.5 to 64")?;
        Ok(Box::new(*self))
    }
}

// `inline(never)`: a crate that inlines these methods compiles the operators behind them again.
impl VoxelProjector for Siddon {
    #[inline(never)]
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        self
    }
    #[inline(never)]
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self
    }
    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&[include_str!("walk.wgsl"), include_str!("siddon.wgsl")]))
    }
    fn describe(&self) -> String {
        "siddon: exact lengths inside voxels".into()
    }
}

impl VoxelProjector for Joseph {
    #[inline(never)]
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        self
    }
    #[inline(never)]
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self
    }
    fn wgsl(&self) -> Option<Fragment> {
        Some(Fragment::new(&[include_str!("walk.wgsl"), include_str!("joseph.wgsl")]))
    }
    fn scratch(&self, header: &ScanHeader, views: usize) -> u64 {
        // A header does not say whether a view looks along z. Bundles of such views may take some ten MiB more.
        columns::scratch(header, views)
    }
    fn describe(&self) -> String {
        "joseph: bilinear from plane to plane".into()
    }
}

impl Trilinear {
    /// Axis-aligned rays of a parallel beam cross whole numbers of steps. Their counts must not depend on rounding, which
    /// differs between devices.
    pub(super) fn samples(&self) -> f64 {
        self.samples_per_voxel * (1.0 - 1e-5)
    }
}

impl VoxelProjector for Trilinear {
    #[inline(never)]
    fn operator(&self) -> &dyn VoxelOperator<f32> {
        self
    }
    #[inline(never)]
    fn reference(&self) -> &dyn VoxelOperator<f64> {
        self
    }
    fn wgsl(&self) -> Option<Fragment> {
        let samples = format!("const stage_SAMPLES = {:?};\n", self.samples() as f32);
        Some(Fragment::new(&[&samples, include_str!("walk.wgsl"), include_str!("trilinear.wgsl")]))
    }
    fn describe(&self) -> String {
        format!("trilinear: {} samples per voxel", self.samples_per_voxel)
    }
}

impl<R: Real> VoxelOperator<R> for Siddon {
    fn is_additive(&self) -> bool {
        true
    }

    fn forward(&self, geometry: &Geometry, views: &[usize], volume: ArrayView3<'_, R>, out: ArrayViewMut3<'_, R>) {
        rays::forward(self, geometry, views, volume, out);
    }
    fn adjoint(&self, geometry: &Geometry, views: &[usize], p: ArrayView3<'_, R>, volume: ArrayViewMut3<'_, R>) {
        rays::adjoint(self, geometry, views, p, volume);
    }
}

impl<R: Real> VoxelOperator<R> for Trilinear {
    fn forward(&self, geometry: &Geometry, views: &[usize], volume: ArrayView3<'_, R>, out: ArrayViewMut3<'_, R>) {
        rays::forward(self, geometry, views, volume, out);
    }
    fn adjoint(&self, geometry: &Geometry, views: &[usize], p: ArrayView3<'_, R>, volume: ArrayViewMut3<'_, R>) {
        rays::adjoint(self, geometry, views, p, volume);
    }
}

/// Uses columns for views that allow it, and bundles for the others.
impl<R: Real> VoxelOperator<R> for Joseph {
    fn is_additive(&self) -> bool {
        true
    }

    fn forward(&self, geometry: &Geometry, views: &[usize], volume: ArrayView3<'_, R>, mut out: ArrayViewMut3<'_, R>) {
        let (mut fitting, mut others) = ((vec![], vec![]), (vec![], vec![]));
        let all: Vec<_> = parallel::map(views, |_, &v| columns::of(geometry, v));
        for ((&v, columns), image) in views.iter().zip(all).zip(out.outer_iter_mut()) {
            match columns {
                Some(columns) => {
                    fitting.0.push((v, columns));
                    fitting.1.push(image);
                }
                None => {
                    others.0.push(v);
                    others.1.push(image);
                }
            }
        }
        // Most scans have views of one kind only: nothing is prepared for the other.
        if !fitting.0.is_empty() {
            columns::forward(geometry, &fitting.0, volume, fitting.1);
        }
        if !others.0.is_empty() {
            bundles::forward(geometry, &others.0, volume, others.1);
        }
    }

    fn adjoint(&self, geometry: &Geometry, views: &[usize], p: ArrayView3<'_, R>, mut volume: ArrayViewMut3<'_, R>) {
        let all: Vec<_> = parallel::map(views, |_, &v| (v, columns::of(geometry, v)));
        // Runs of views of the same kind, in order.
        let mut from = 0;
        for run in all.chunk_by(|a, b| a.1.is_some() == b.1.is_some()) {
            let part = from..from + run.len();
            let images = p.slice_axis(Axis(0), part.clone().into());
            let fitting: Vec<_> = run.iter().filter_map(|(v, columns)| Some((*v, columns.as_deref()?))).collect();
            if fitting.is_empty() {
                bundles::adjoint(geometry, &views[part.clone()], images, &mut volume);
            } else {
                columns::adjoint(geometry, &fitting, images, &mut volume);
            }
            from = part.end;
        }
    }
}
