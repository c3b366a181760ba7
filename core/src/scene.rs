//! The scene: the mapping between the world in millimetres and the unit cube of the stages.

use crate::error::{Result, ensure};
use crate::geometry::{Geometry, Ray, Vec3, View, VoxelGrid, dot, norm, sub};
use crate::scan::{Scan, high, highest};
use crate::stage::UnitRay;
use crate::support::Support;
use std::sync::Arc;

mod settings;

pub use settings::{
    AttenuationScale, BoundsSettings, CoarseSurround, CuboidSettings, CylinderSettings, LevelRule, RegionSettings,
    SceneSettings, SupportRule, SurroundRule, VoxelScene,
};

/// Maps lengths to cube sides and attenuation to order one, based on the scan only.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// World position of the cube's lowest corner, mm.
    pub origin: Vec3,
    /// Side of the cube, mm.
    pub side: f64,
    /// The box to reconstruct, mm.
    pub bounds: [Vec3; 2],
    /// Where the object can be inside the box, if known.
    pub support: Option<Arc<Support>>,
    /// The voxels to export.
    pub grid: VoxelGrid,
    /// The attenuation that counts as 1 for the stages, in 1/mm.
    pub attenuation: f64,
    /// Half the diagonal of the volume in the orbit plane plus a small tolerance: the published sampling range extends
    /// this far before and behind the axis.
    published_reach: f64,
}

impl Scene {
    /// The scene of `scan` for the spec's settings.
    pub fn new(scan: &Scan, settings: &SceneSettings) -> Result<Self> {
        let grid = scan.geometry.volume;
        let longest = grid.size().into_iter().fold(0.0, f64::max);
        let attenuation = settings.attenuation.of(scan.unit.mm, longest, &|| {
            let top = top_projection(scan);
            let expected = "line integrals of an object, positive where it absorbs";
            ensure(top > 0.0, "scan", "projections", "no positive line integral", expected)?;
            Ok(top)
        })?;
        Self::with_attenuation(grid, settings, attenuation)
    }

    /// The scene around `grid` in which `attenuation` (1/mm) counts as 1.
    pub fn with_attenuation(grid: VoxelGrid, settings: &SceneSettings, attenuation: f64) -> Result<Self> {
        settings.validate()?;
        let fill = settings.fill;
        let size = grid.size();
        let longest = size.into_iter().fold(0.0, f64::max);
        let side = longest / fill;
        let bounds = grid.bounds();
        Ok(Self {
            origin: std::array::from_fn(|k| grid.center[k] - side / 2.0),
            side,
            bounds,
            support: None,
            grid,
            attenuation,
            published_reach: size[0].hypot(size[1]) / 2.0 + 0.0125 * longest,
        })
    }

    /// The scene with the unit cube around `support` instead of the whole volume.
    pub fn within(mut self, support: Support, settings: &SceneSettings) -> Self {
        let (box_, all) = (support.bounds(), self.grid.bounds());
        self.bounds =
            [std::array::from_fn(|k| box_[0][k].max(all[0][k])), std::array::from_fn(|k| box_[1][k].min(all[1][k]))];
        let [low, high] = self.bounds;
        let longest = (0..3).map(|k| high[k] - low[k]).fold(0.0, f64::max);
        self.side = longest / settings.fill;
        self.origin = std::array::from_fn(|k| (low[k] + high[k] - self.side) / 2.0);
        self.support = Some(Arc::new(support));
        self
    }

    /// Whether the object can be at `p` (mm).
    pub fn holds(&self, p: Vec3) -> bool {
        self.support.as_ref().is_none_or(|s| s.holds(p))
    }

    /// A world position in the unit cube.
    pub fn to_unit(&self, p: Vec3) -> [f32; 3] {
        std::array::from_fn(|k| ((p[k] - self.origin[k]) / self.side) as f32)
    }

    /// A ray in the unit cube, with zero length inside if it misses the reconstruction box. `axis` is the unit vector
    /// from source to detector along which the published codes measure depth.
    pub fn ray(&self, ray: &Ray, axis: Vec3) -> UnitRay {
        let inside = match &self.support {
            Some(support) => support.clip(ray),
            None => ray.clip(self.bounds),
        }
        .unwrap_or([0.0; 2]);
        let depth = dot(ray.direction, axis);
        let to_axis = dot(sub(self.grid.center, ray.origin), axis);
        let s = self.side;
        let near = ((to_axis - self.published_reach) / depth).max(0.0);
        let far = (to_axis + self.published_reach) / depth;
        UnitRay {
            origin: self.to_unit(ray.origin),
            direction: ray.direction.map(|x| x as f32),
            inside: inside.map(|t| (t / s) as f32),
            published: [(near / s) as f32, (far / s) as f32],
            per_mm: (1.0 / s) as f32,
        }
    }

    /// The ray of a pixel of `geometry`.
    pub fn pixel_ray(&self, geometry: &Geometry, view: usize, row: usize, column: usize) -> UnitRay {
        self.ray(&geometry.ray(view, row, column), geometry.views[view].normal().0)
    }

    /// A line integral in the scale of the stages: attenuation of order one times cube sides.
    pub fn line_to_unit(&self, a: f32) -> f32 {
        (f64::from(a) / (self.attenuation * self.side)) as f32
    }

    /// The line integral that counts as 1 for the stages.
    pub fn line_scale(&self) -> f64 {
        self.attenuation * self.side
    }

    /// The shortest side of an exported voxel, mm.
    pub fn voxel_mm(&self) -> f64 {
        self.grid.spacing.into_iter().fold(f64::INFINITY, f64::min)
    }

    /// Number of cells along the cube's side that the data resolve: exported voxels, or pixels projected to the
    /// volume's centre if these are larger.
    pub fn cells(&self, geometry: &Geometry) -> f64 {
        let pixel = |w: &View| {
            let [rows, columns] = geometry.detector;
            let middle = w.pixel(geometry.detector, (rows as f64 - 1.0) / 2.0, (columns as f64 - 1.0) / 2.0);
            let magnification = norm(sub(middle, w.source)) / self.distance(w.source).max(f64::MIN_POSITIVE);
            norm(w.u).min(norm(w.v)) / magnification
        };
        let finest = geometry.views.iter().map(pixel).fold(f64::INFINITY, f64::min);
        self.side / finest.max(self.voxel_mm())
    }

    /// Spacing of the exported voxels, in cube sides.
    pub fn unit_spacing(&self) -> [f32; 3] {
        std::array::from_fn(|k| (self.grid.spacing[k] / self.side) as f32)
    }

    /// Unit-cube position of a voxel's centre.
    pub fn voxel(&self, index: [usize; 3]) -> [f32; 3] {
        self.to_unit(self.grid.voxel(index))
    }

    /// Distance of the cube's centre from a view's source, mm.
    pub fn distance(&self, source: Vec3) -> f64 {
        norm(sub(self.grid.center, source))
    }
}

/// The 99.5th percentile of the projections: the scan's own scale, hardly moved by single hot pixels.
fn top_projection(scan: &Scan) -> f64 {
    let top = high(scan.projections.view());
    if top > 0.0 {
        return f64::from(top);
    }
    // An object on fewer pixels.
    let mut all: Vec<f32> = scan.projections.iter().copied().filter(|p| *p > 0.0).collect();
    f64::from(highest(&mut all))
}
