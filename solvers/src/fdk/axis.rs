//! Finds the axis of the source circle, wherever it lies.

use conefield_core::geometry::{Geometry, Vec3, View, cross, dot, norm, sub};
use std::borrow::Cow;

/// An axis this close to z, in radians and as a share of the circle's radius, counts as z: the deviations of calibrated
/// scans do not move the axis.
const NEAR: f64 = 0.01;
/// Largest distance of sources on a circle from the circle and from its plane, as a share of the radius: a turn of a
/// helix with a small pitch is nearly flat.
const OFF: f64 = 0.05;
const OFF_PLANE: f64 = 0.01;
/// A shorter arc of sources, in radians, does not determine the centre.
const LEAST_ARC: f64 = 1.5;

/// The axis of the source circle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    center: Vec3,
    /// Two directions orthogonal to the axis, and the axis itself, right-handed.
    axes: [Vec3; 3],
}

impl Axis {
    /// The axis of the circle on which the sources of `geometry` lie. `None` if it is z, or if no circle can be
    /// determined.
    pub fn of(geometry: &Geometry) -> Option<Self> {
        let sources: Vec<Vec3> = geometry.views.iter().map(|v| v.source).collect();
        let n = sources.len() as f64;
        let mean: Vec3 = std::array::from_fn(|k| sources.iter().map(|s| s[k]).sum::<f64>() / n);
        let from_mean: Vec<Vec3> = sources.iter().map(|s| sub(*s, mean)).collect();
        let normal = normal(&from_mean)?;
        // A direction orthogonal to the normal, close to a world axis where possible.
        let along = if normal[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let first = unit(std::array::from_fn(|k| along[k] - dot(along, normal) * normal[k]))?;
        let axes = [first, cross(normal, first), normal];
        let flat: Vec<[f64; 2]> = from_mean.iter().map(|s| [dot(*s, axes[0]), dot(*s, axes[1])]).collect();
        let middle = middle(&flat)?;
        let center = std::array::from_fn(|k| mean[k] + middle[0] * axes[0][k] + middle[1] * axes[1][k]);
        let axis = Self { center, axes };
        axis.is_of(&sources).then_some(axis)
    }

    /// Whether the sources lie on the circle and cover enough of it, and its axis is not z.
    fn is_of(&self, sources: &[Vec3]) -> bool {
        let local: Vec<Vec3> = sources.iter().map(|s| self.point(*s)).collect();
        let radii: Vec<f64> = local.iter().map(|p| p[0].hypot(p[1])).collect();
        let radius = radii.iter().sum::<f64>() / radii.len() as f64;
        let fits = |(p, r): (&Vec3, &f64)| (r - radius).abs() <= OFF * radius && p[2].abs() <= OFF_PLANE * radius;
        let on = local.iter().zip(&radii).all(fits);
        let mut angles: Vec<f64> = local.iter().map(|p| p[1].atan2(p[0])).collect();
        angles.sort_unstable_by(f64::total_cmp);
        let gaps = angles.windows(2).map(|w| w[1] - w[0]);
        let around = std::f64::consts::TAU - angles[angles.len() - 1] + angles[0];
        let arc = std::f64::consts::TAU - gaps.fold(around, f64::max);
        let aside = self.center[0].hypot(self.center[1]) > NEAR * radius;
        on && arc > LEAST_ARC && (aside || self.tilt() > NEAR)
    }

    /// The angle between the axis and z, rad.
    fn tilt(&self) -> f64 {
        self.axes[2][0].hypot(self.axes[2][1]).atan2(self.axes[2][2].abs())
    }

    fn direction(&self, a: Vec3) -> Vec3 {
        self.axes.map(|axis| dot(a, axis))
    }

    /// A point in the circle's own axes.
    pub fn point(&self, a: Vec3) -> Vec3 {
        self.direction(sub(a, self.center))
    }

    /// Description for the log.
    pub fn describe(&self) -> String {
        let [x, y, z] = self.center;
        format!(
            "circle around ({x:.1}, {y:.1}, {z:.1}) mm, its axis tilted by {:.1} degrees against z",
            self.tilt().to_degrees()
        )
    }
}

/// `geometry` rotated so that the circle's axis is z. Only for weights: the volume does not move.
pub(super) fn upright<'a>(geometry: &'a Geometry, axis: Option<&Axis>) -> Cow<'a, Geometry> {
    let Some(axis) = axis else { return Cow::Borrowed(geometry) };
    let turned = |w: &View| View {
        source: axis.point(w.source),
        detector: axis.point(w.detector),
        u: axis.direction(w.u),
        v: axis.direction(w.v),
    };
    let views = geometry.views.iter().map(turned).collect();
    Cow::Owned(Geometry { detector: geometry.detector, views, volume: geometry.volume })
}

fn unit(a: Vec3) -> Option<Vec3> {
    let length = norm(a);
    (length > 0.0 && length.is_finite()).then(|| a.map(|x| x / length))
}

/// The direction in which the centred `points` spread least, towards +z: the largest column of the adjugate of their
/// scatter matrix, which tends to λ₁λ₂·n·nᵀ for coplanar points.
fn normal(points: &[Vec3]) -> Option<Vec3> {
    let scatter = |i: usize, j: usize| points.iter().map(|p| p[i] * p[j]).sum::<f64>();
    let rows: [Vec3; 3] = std::array::from_fn(|i| std::array::from_fn(|j| scatter(i, j)));
    let columns = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])];
    let largest = columns.into_iter().max_by(|a, b| norm(*a).total_cmp(&norm(*b)))?;
    let normal = unit(largest)?;
    Some(if normal[2] < 0.0 { normal.map(|x| -x) } else { normal })
}

/// The centre of the circle through the centred `points`, by least squares of x² + y² = 2ax + 2by + c (Kåsa, IEEE
/// Trans. Instrum. Meas. 25(1), 1976).
fn middle(points: &[[f64; 2]]) -> Option<[f64; 2]> {
    let sum = |f: &dyn Fn(&[f64; 2]) -> f64| points.iter().map(f).sum::<f64>();
    let (xx, xy, yy) = (sum(&|p| p[0] * p[0]), sum(&|p| p[0] * p[1]), sum(&|p| p[1] * p[1]));
    let square = |p: &[f64; 2]| p[0] * p[0] + p[1] * p[1];
    let (x, y) = (0.5 * sum(&|p| p[0] * square(p)), 0.5 * sum(&|p| p[1] * square(p)));
    let determinant = xx * yy - xy * xy;
    (determinant > 1e-9 * xx * yy.max(f64::MIN_POSITIVE))
        .then(|| [(x * yy - y * xy) / determinant, (y * xx - x * xy) / determinant])
}
