//! Scan geometry: positions of source, detector and volume, in millimetres.
//!
//! World: right-handed, rotation axis z. On a circular orbit the source at angle `a` is at `DSO·(cos a, sin a, 0)`,
//! detector columns (u) run along `(-sin a, cos a, 0)` and detector rows (v) run towards −z. A view is stored as
//! vectors, so that irregular orbits need no special case.

use crate::error::{Result, ensure};
use serde::{Deserialize, Serialize};
use std::fmt::Debug;
use std::ops::{Range, RangeInclusive};

/// A point or vector in the world, in millimetres.
pub type Vec3 = [f64; 3];

/// A length in millimetres.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Millimetres(pub f64);

/// An angle in radians.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Radians(pub f64);

/// One position of source and detector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// The X-ray source.
    pub source: Vec3,
    /// The centre of the detector (between the middle pixels if their number is even).
    pub detector: Vec3,
    /// Vector between the centres of neighbouring columns.
    pub u: Vec3,
    /// Vector between the centres of neighbouring rows.
    pub v: Vec3,
}

impl View {
    /// A view of a circular orbit: source at `dso·(cos a, sin a, 0)`, detector plane at distance `dsd` from the
    /// source, pixels of `pixel = [rows, columns]`, detector shifted by `offset = [along v, along u]`.
    pub fn circular(
        angle: Radians,
        dso: Millimetres,
        dsd: Millimetres,
        pixel: [Millimetres; 2],
        offset: [Millimetres; 2],
    ) -> Self {
        let (s, c) = angle.0.sin_cos();
        let u_dir = [-s, c, 0.0];
        let v_dir = [0.0, 0.0, -1.0];
        let back = dso.0 - dsd.0;
        Self {
            source: [dso.0 * c, dso.0 * s, 0.0],
            detector: std::array::from_fn(|k| back * [c, s, 0.0][k] + offset[0].0 * v_dir[k] + offset[1].0 * u_dir[k]),
            u: u_dir.map(|x| x * pixel[1].0),
            v: v_dir.map(|x| x * pixel[0].0),
        }
    }

    /// The same detector in a parallel beam with rays along the unit vector `direction`. Its source is [`FAR`] diagonals of
    /// the volume away; pixels have the same size where the rays pass the middle of the volume.
    pub fn parallel(&self, direction: Vec3, volume: &VoxelGrid) -> Self {
        let behind = dot(sub(self.detector, volume.center), direction);
        let away = FAR * (norm(volume.size()) + behind.abs());
        let wide = (away + behind) / away;
        Self {
            source: std::array::from_fn(|k| self.detector[k] - (away + behind) * direction[k]),
            u: self.u.map(|x| x * wide),
            v: self.v.map(|x| x * wide),
            ..*self
        }
    }

    /// The same view with its detector rotated about its centre: right-handed about `u`, `v` and `u × v` (pointing away
    /// from the source). The rotation about `u × v` comes first; each uses the axis before any rotation.
    pub fn tilted(&self, [about_u, about_v, about_normal]: [Radians; 3]) -> Self {
        let unit = |a: Vec3| a.map(|x| x / norm(a));
        let axes = [(cross(self.u, self.v), about_normal), (self.v, about_v), (self.u, about_u)];
        let turned = |a: Vec3| axes.into_iter().fold(a, |a, (axis, angle)| turned(a, unit(axis), angle));
        if [about_u, about_v, about_normal] == [Radians(0.0); 3] {
            return *self;
        }
        Self { u: turned(self.u), v: turned(self.v), ..*self }
    }

    /// The world position of the (possibly fractional) pixel `row`, `column` of a detector of `shape` rows × columns;
    /// whole numbers are pixel centres.
    pub fn pixel(&self, shape: [usize; 2], row: f64, column: f64) -> Vec3 {
        let dv = row - (shape[0] as f64 - 1.0) / 2.0;
        let du = column - (shape[1] as f64 - 1.0) / 2.0;
        std::array::from_fn(|k| self.detector[k] + dv * self.v[k] + du * self.u[k])
    }

    /// The detector's unit normal, pointing away from the source, and the distance from the source to the detector
    /// plane.
    pub fn normal(&self) -> (Vec3, f64) {
        let n = cross(self.u, self.v);
        let len = norm(n);
        let n = n.map(|x| x / len);
        let d = dot(n, sub(self.detector, self.source));
        if d < 0.0 { (n.map(|x| -x), -d) } else { (n, d) }
    }
}

/// The voxel grid to reconstruct.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VoxelGrid {
    /// Voxels along x, y, z.
    pub shape: [usize; 3],
    /// Voxel size in mm along x, y, z.
    pub spacing: Vec3,
    /// Centre of the grid in mm.
    #[serde(default)]
    pub center: Vec3,
}

impl VoxelGrid {
    /// Side lengths in mm.
    pub fn size(&self) -> Vec3 {
        std::array::from_fn(|k| self.shape[k] as f64 * self.spacing[k])
    }

    /// Distance from its centre to `source`, in diagonals of the box.
    pub fn diagonals_to(&self, source: Vec3) -> f64 {
        norm(sub(source, self.center)) / norm(self.size())
    }

    /// Whether positions that count from `source` would round in single precision. A parallel beam is far also for volumes
    /// much larger than its own.
    pub fn is_far(&self, source: Vec3) -> bool {
        self.diagonals_to(source) > 1e3
    }

    /// A grid of the same box with `n` voxels along its longest side and nearly cubic voxels.
    pub fn with_longest(&self, n: usize) -> Self {
        let size = self.size();
        let voxel = size.into_iter().fold(0.0, f64::max) / n as f64;
        let shape = size.map(|s| ((s / voxel).round() as usize).max(1));
        Self { shape, spacing: std::array::from_fn(|k| size[k] / shape[k] as f64), center: self.center }
    }

    /// Lower and upper corner of the box.
    pub fn bounds(&self) -> [Vec3; 2] {
        let size = self.size();
        [
            std::array::from_fn(|k| self.center[k] - size[k] / 2.0),
            std::array::from_fn(|k| self.center[k] + size[k] / 2.0),
        ]
    }

    /// Centre of voxel `index`.
    pub fn voxel(&self, index: [usize; 3]) -> Vec3 {
        let lo = self.bounds()[0];
        std::array::from_fn(|k| lo[k] + (index[k] as f64 + 0.5) * self.spacing[k])
    }

    /// The grid of some planes along x.
    pub fn slab(&self, planes: Range<usize>) -> Self {
        let mut slab = Self { shape: [planes.len(), self.shape[1], self.shape[2]], ..*self };
        slab.center[0] += self.spacing[0] * 0.5 * ((planes.start + planes.end) as f64 - self.shape[0] as f64);
        slab
    }

    /// Number of voxels, or `None` if it overflows `usize`.
    pub fn len(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s))
    }

    /// Whether there are no voxels.
    pub fn is_empty(&self) -> bool {
        self.shape.contains(&0)
    }

    /// Refuses empty grids, sizes beyond memory, and voxels whose sides single precision cannot hold.
    pub fn validate(&self, place: &str) -> Result<()> {
        let check = |ok: bool, key: &str, found: &dyn Debug, expected: &str| {
            ensure(ok, place, &format!("volume.{key}"), format!("{found:?}"), expected)
        };
        check(!self.is_empty(), "shape", &self.shape, "at least one voxel per axis")?;
        check(addressable(self.len()), "shape", &self.shape, "a number of voxels that can be addressed")?;
        let spaced = self.spacing.iter().all(|s| SIDES.contains(s));
        check(spaced, "spacing", &self.spacing, "voxels with sides from 1e-12 to 1e12 mm")?;
        check(self.center.iter().all(|s| s.is_finite()), "center", &self.center, "finite millimetres")
    }
}

/// Sides of voxels in mm. The square of a length on them, for all rays of a scan, is a number in single precision.
const SIDES: RangeInclusive<f64> = 1e-12..=1e12;

/// Whether memory can hold as many numbers in double precision.
fn addressable(count: Option<usize>) -> bool {
    count.and_then(|n| n.checked_mul(8)).is_some_and(|bytes| bytes <= isize::MAX as usize)
}

/// Views, detector and volume: maps every detector pixel to a ray through the volume.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Geometry {
    /// Detector rows (v) × columns (u).
    pub detector: [usize; 2],
    /// One entry per view, in the order of the projections.
    pub views: Vec<View>,
    /// The voxels to reconstruct.
    pub volume: VoxelGrid,
}

/// Diagonals of a volume between it and the source of a parallel beam ([`crate::orbit::CircularOrbit::parallel`]): across
/// the volume, rays come together by 1/100 000.
pub const FAR: f64 = 1e5;
/// Diagonals beyond which a beam counts as parallel: less than [`FAR`], so that a volume of several times the size does not
/// change that.
pub(crate) const PARALLEL: f64 = 0.1 * FAR;

/// A straight line from the source: `origin + t·direction`, `t` in mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The source; for a parallel beam, a point of the ray before the volume.
    pub origin: Vec3,
    /// Unit vector towards the pixel.
    pub direction: Vec3,
}

impl Ray {
    /// Entry into and exit from the box `[lower, upper]`, as `t` in mm, or `None` if the ray misses it.
    pub fn clip(&self, bounds: [Vec3; 2]) -> Option<[f64; 2]> {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for k in 0..3 {
            let (o, d) = (self.origin[k], self.direction[k]);
            if d == 0.0 {
                if o < bounds[0][k] || o > bounds[1][k] {
                    return None;
                }
                continue;
            }
            let (a, b) = ((bounds[0][k] - o) / d, (bounds[1][k] - o) / d);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (far > near).then_some([near, far])
    }

    /// The point at `t` mm from the origin.
    pub fn at(&self, t: f64) -> Vec3 {
        std::array::from_fn(|k| self.origin[k] + t * self.direction[k])
    }
}

impl Geometry {
    /// The ray from the source of `view` to the centre of pixel `row`, `column`.
    pub fn ray(&self, view: usize, row: usize, column: usize) -> Ray {
        let v = &self.views[view];
        let d = sub(v.pixel(self.detector, row as f64, column as f64), v.source);
        let len = norm(d);
        let direction = d.map(|x| x / len);
        if !self.volume.is_far(v.source) {
            return Ray { origin: v.source, direction };
        }
        // Positions along the ray count from a near point: from the source they would round to the size of a voxel.
        let pixel = v.pixel(self.detector, row as f64, column as f64);
        let back = dot(sub(pixel, self.volume.center), direction) + 2.0 * norm(self.volume.size());
        Ray { origin: std::array::from_fn(|k| pixel[k] - back * direction[k]), direction }
    }

    /// Whether the beam of `view` is parallel.
    pub fn is_parallel(&self, view: usize) -> bool {
        self.volume.diagonals_to(self.views[view].source) > PARALLEL
    }

    /// Number of measured values, or `None` if it overflows `usize`.
    pub fn measurements(&self) -> Option<usize> {
        self.views.len().checked_mul(self.detector[0])?.checked_mul(self.detector[1])
    }

    /// All lengths multiplied by `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        let s = |v: Vec3| v.map(|x| x * factor);
        let view = |w: &View| View { source: s(w.source), detector: s(w.detector), u: s(w.u), v: s(w.v) };
        let volume = &self.volume;
        Self {
            detector: self.detector,
            views: self.views.iter().map(view).collect(),
            volume: VoxelGrid { spacing: s(volume.spacing), center: s(volume.center), ..*volume },
        }
    }

    /// Refuses unusable geometry: no views, no pixels, non-finite numbers, a degenerate detector, a source inside the
    /// volume.
    pub fn validate(&self, place: &str) -> Result<()> {
        self.volume.validate(place)?;
        ensure(!self.views.is_empty(), place, "views", 0, "at least one view")?;
        let detector = format!("{:?}", self.detector);
        ensure(!self.detector.contains(&0), place, "detector", &detector, "at least one row and one column")?;
        let found = format!("{} views of {detector}", self.views.len());
        let measured = addressable(self.measurements());
        ensure(measured, place, "detector", found, "a number of pixels that can be addressed")?;
        let [lo, hi] = self.volume.bounds();
        for (i, v) in self.views.iter().enumerate() {
            let field = format!("views[{i}]");
            let finite = [v.source, v.detector, v.u, v.v].iter().flatten().all(|x| x.is_finite());
            ensure(finite, place, &field, "a number that is not finite", "finite millimetres")?;
            let independent = norm(cross(v.u, v.v)) > 0.0;
            ensure(independent, place, &field, "parallel or zero pixel axes", "two independent detector axes")?;
            let before = v.normal().1 > 0.0;
            ensure(before, place, &field, "a source in the plane of the detector", "a source before the detector")?;
            let outside = (0..3).any(|k| v.source[k] <= lo[k] || v.source[k] >= hi[k]);
            let found = format!("a source at {:?} mm inside the volume", v.source);
            ensure(outside, place, &field, found, "a source outside the volume (check units and distances)")?;
        }
        Ok(())
    }
}

/// Scalar product.
#[inline]
pub fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Vector product.
#[inline]
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a` rotated right-handed about the unit vector `axis` (Rodrigues).
fn turned(a: Vec3, axis: Vec3, Radians(angle): Radians) -> Vec3 {
    let (s, c) = angle.sin_cos();
    let (across, along) = (cross(axis, a), dot(axis, a) * (1.0 - c));
    std::array::from_fn(|k| a[k] * c + across[k] * s + axis[k] * along)
}

/// Difference `a − b`.
#[inline]
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Euclidean length.
#[inline]
pub fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::orbit::{Beam, CircularOrbit};

    fn mm(x: f64) -> Millimetres {
        Millimetres(x)
    }

    fn geometry() -> Geometry {
        Geometry {
            detector: [4, 6],
            views: vec![View::circular(Radians(0.0), mm(100.0), mm(150.0), [mm(2.0), mm(1.0)], [mm(0.0); 2])],
            volume: VoxelGrid { shape: [8, 8, 8], spacing: [1.0; 3], center: [0.0; 3] },
        }
    }

    #[test]
    fn circular_view_follows_the_world_convention() {
        let v = &geometry().views[0];
        assert_eq!(v.source, [100.0, 0.0, 0.0]);
        assert_eq!(v.detector, [-50.0, 0.0, 0.0]);
        assert_eq!(v.u, [0.0, 1.0, 0.0]);
        assert_eq!(v.v, [0.0, 0.0, -2.0]);
        let (n, d) = v.normal();
        assert_eq!((n, d), ([-1.0, 0.0, 0.0], 150.0));
        // First pixel: half of 6 columns to the left, half of 4 rows up.
        assert_eq!(v.pixel([4, 6], 0.0, 0.0), [-50.0, -2.5, 3.0]);
    }

    #[test]
    fn a_detector_turns_about_its_own_axes() {
        let view = geometry().views[0];
        let near = |a: Vec3, b: Vec3| assert!(norm(sub(a, b)) < 1e-12, "{a:?} {b:?}");
        assert_eq!(view.tilted([Radians(0.0); 3]), view);
        let quarter = Radians(std::f64::consts::FRAC_PI_2);
        // u is y, v is -z: a quarter turn about the normal u × v (-x) takes u to v and v to -u.
        let skewed = view.tilted([Radians(0.0), Radians(0.0), quarter]);
        near(skewed.u, [0.0, 0.0, -1.0]);
        near(skewed.v, [0.0, -2.0, 0.0]);
        assert_eq!((skewed.source, skewed.detector), (view.source, view.detector));
        // About u only v rotates, and its length is preserved.
        let pitched = view.tilted([quarter, Radians(0.0), Radians(0.0)]);
        near(pitched.u, view.u);
        near(pitched.v, [-2.0, 0.0, 0.0]);
    }

    #[test]
    fn a_clipped_ray_starts_and_ends_on_the_box() {
        let g = geometry();
        let r = Ray { origin: [100.0, 0.0, 0.0], direction: [-1.0, 0.0, 0.0] };
        assert_eq!(r.clip(g.volume.bounds()), Some([96.0, 104.0]));
        let miss = Ray { origin: [100.0, 10.0, 0.0], direction: [-1.0, 0.0, 0.0] };
        assert_eq!(miss.clip(g.volume.bounds()), None);
    }

    /// The rays of a parallel beam, against lines of one direction through the pixels.
    #[test]
    fn a_parallel_beam_has_parallel_rays_of_its_pixels_pitch() {
        let volume = VoxelGrid { shape: [40, 30, 20], spacing: [1.0; 3], center: [3.0, -2.0, 1.0] };
        let orbit = CircularOrbit::parallel(&volume, [0.7, 1.3], [2.0, -4.0], vec![0.3, 2.0]);
        let g = Geometry { detector: [16, 24], views: orbit.views(), volume };
        g.validate("test").unwrap();
        for (view, a) in [0.3f64, 2.0].into_iter().enumerate() {
            assert!(g.is_parallel(view));
            let (s, c) = a.sin_cos();
            for (row, column) in [(0, 0), (15, 23), (3, 11)] {
                let ray = g.ray(view, row, column);
                let off = (ray.direction[0] + c).hypot(ray.direction[1] + s).hypot(ray.direction[2]);
                assert!(off < 1e-5 && norm(ray.origin) < 200.0, "{off} {ray:?}");
                // At the axis.
                let t = -(ray.origin[0] * c + ray.origin[1] * s) / (ray.direction[0] * c + ray.direction[1] * s);
                let p = ray.at(t);
                let want = [1.3 * (column as f64 - 11.5) - 4.0, -0.7 * (row as f64 - 7.5) - 2.0];
                let found = [c * p[1] - s * p[0], p[2]];
                assert!(norm([found[0] - want[0], found[1] - want[1], 0.0]) < 1e-6, "{found:?} {want:?}");
            }
        }
        // Another volume for the same views, as the space around the object.
        let larger = Geometry { volume: VoxelGrid { spacing: [4.0; 3], ..volume }, ..g.clone() };
        let [a, b] = [&g, &larger].map(|g| g.ray(0, 3, 11));
        let along = dot(sub(b.origin, a.origin), a.direction);
        let apart = norm(sub(b.origin, a.at(along)));
        assert!(larger.is_parallel(0) && norm(b.origin) < 1000.0 && apart < 1e-6, "{b:?} {apart}");
        let fitted = CircularOrbit::fit(&g.views).unwrap();
        assert_eq!(fitted.beam(&volume), Beam::Parallel);
        let at_axis = fitted.at_axis();
        let apart = (0..2).map(|k| (at_axis.0[k] - [0.7, 1.3][k]).abs() + (at_axis.1[k] - [2.0, -4.0][k]).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-6, "{at_axis:?}");
    }

    #[test]
    fn voxels_of_no_size_in_single_precision_are_refused() {
        let of = |side: f64| VoxelGrid { spacing: [1.0, side, 1.0], ..geometry().volume }.validate("scan.toml");
        assert!([1e-12, 1e12].into_iter().all(|side| of(side).is_ok()));
        for side in [0.0, -1.0, 1e-22, 1e16, f64::NAN, f64::INFINITY] {
            let e = of(side).unwrap_err().to_string();
            assert!(e.contains(&format!("volume.spacing: found [1.0, {side:?}, 1.0], expected")), "{e}");
        }
    }

    #[test]
    fn a_source_inside_the_volume_is_refused() {
        let mut g = geometry();
        assert!(g.validate("test").is_ok());
        g.views[0].source = [1.0, 0.0, 0.0];
        let e = g.validate("scan.toml").unwrap_err().to_string();
        assert!(e.contains("scan.toml") && e.contains("views[0]") && e.contains("inside the volume"), "{e}");
    }
}
