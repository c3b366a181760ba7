//! Bounds of attenuation by region.

use crate::fit::object;
use conefield_core::error::Result;
use conefield_core::geometry::{Vec3, VoxelGrid};
use conefield_core::method::Job;
use conefield_core::parallel;
use conefield_core::place::Bounds;
use conefield_core::scene::{BoundsSettings, RegionSettings};
use conefield_core::support::Support;
use ndarray::{Array3, Axis};
use std::sync::Arc;

/// Regions with bounds of their own, in 1/mm.
#[derive(Default)]
pub struct Regions {
    all: Vec<(Support, Bounds)>,
    /// Voxels outside stay 0.
    support: Option<Support>,
}

impl Regions {
    /// The regions of a spec; voxels outside `support` stay 0.
    ///
    /// # Errors
    /// A region outside the volume, or a file that does not suit the scan.
    pub fn of(settings: &BoundsSettings, support: Option<&Support>, job: &Job<'_>) -> Result<Self> {
        let region = |(i, region): (usize, &RegionSettings)| {
            let found = object(job.scan, &region.within, Some(job.volumes));
            let support = found.map_err(|e| RegionSettings::concern(i, e))?.support;
            Ok(support.map(|support| (support, region.in_mm(job.scan.unit.mm))))
        };
        let all = settings.regions.iter().enumerate().filter_map(|region_of| region(region_of).transpose());
        let all: Vec<_> = all.collect::<Result<_>>()?;
        let support = support.filter(|_| !all.is_empty()).cloned();
        Ok(Self { all, support })
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// The bounds that hold everywhere if those outside the regions are `bounds`.
    pub fn widest(&self, bounds: Bounds) -> Bounds {
        let wider = |a: Bounds, (_, b): &(Support, Bounds)| Bounds { low: a.low.min(b.low), high: a.high.max(b.high) };
        self.all.iter().fold(bounds, wider)
    }

    /// The bounds at a point.
    fn at(&self, p: Vec3, bounds: Bounds) -> Bounds {
        let Bounds { low, high } =
            self.all.iter().rev().find(|(region, _)| region.holds(p)).map_or(bounds, |(_, b)| *b);
        let free = self.support.as_ref().is_none_or(|support| support.holds(p));
        if free { Bounds { low, high } } else { Bounds { low: 0.0, high: high.max(0.0) } }
    }

    /// Lower and upper bounds of all voxels of `grid`, in standard order.
    pub fn on(&self, grid: &VoxelGrid, bounds: Bounds) -> Arc<[Vec<f32>; 2]> {
        let [low, high] = [bounds.low, bounds.high].map(|x| Array3::from_elem(grid.shape, x));
        let (mut low, mut high) = (low, high);
        let planes = low.axis_iter_mut(Axis(0)).zip(high.axis_iter_mut(Axis(0)));
        parallel::over(planes, |x, (mut low, mut high)| {
            for ((y, z), low) in low.indexed_iter_mut() {
                let here = self.at(grid.voxel([x, y, z]), bounds);
                (*low, high[[y, z]]) = (here.low, here.high);
            }
        });
        Arc::new([low, high].map(|x| x.into_raw_vec_and_offset().0))
    }

    /// Clips `x`, whose numbers are `factor` times attenuation in 1/mm.
    pub fn clip(&self, x: &mut Array3<f32>, grid: &VoxelGrid, bounds: Bounds, factor: f32) {
        if self.is_empty() {
            let bounds = Bounds { low: bounds.low * factor, high: bounds.high * factor };
            return parallel::change_all(x, |x| bounds.clip(x));
        }
        parallel::over(x.axis_iter_mut(Axis(0)), |i, mut plane| {
            for ((j, k), x) in plane.indexed_iter_mut() {
                let Bounds { low, high } = self.at(grid.voxel([i, j, k]), bounds);
                *x = Bounds { low: low * factor, high: high * factor }.clip(*x);
            }
        });
    }
}
