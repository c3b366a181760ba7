//! Circular orbits of source and detector, described by a few numbers.

use crate::geometry::{Millimetres, Radians, View, dot, norm, sub};

/// Views on one circle about z, all with the same distances and detector.
#[derive(Debug, Clone, PartialEq)]
pub struct CircularOrbit {
    /// Source to rotation axis, in mm.
    pub dso: f64,
    /// Source to detector plane, in mm.
    pub dsd: f64,
    /// Pixel size along v (rows) and u (columns), in mm.
    pub pixel: [f64; 2],
    /// Shift of the detector along v and u, in mm.
    pub offset: [f64; 2],
    /// Angle of each view in radians.
    pub angles: Vec<f64>,
}

/// Tolerance of a view's deviation from the circle, relative to the source-detector distance.
const TOLERANCE: f64 = 1e-9;

impl CircularOrbit {
    /// The view at `angle` (radians).
    pub fn view(&self, angle: f64) -> View {
        let mm = |x: [f64; 2]| x.map(Millimetres);
        let (dso, dsd) = (Millimetres(self.dso), Millimetres(self.dsd));
        View::circular(Radians(angle), dso, dsd, mm(self.pixel), mm(self.offset))
    }

    /// All views.
    pub fn views(&self) -> Vec<View> {
        self.angles.iter().map(|&a| self.view(a)).collect()
    }

    /// The orbit of `views`, or `None` if they do not lie on one circle to a relative 1e-9.
    ///
    /// Angles increase or decrease monotonically, without jumps of more than half a turn.
    pub fn fit(views: &[View]) -> Option<Self> {
        let first = views.first()?;
        let mut angles = Vec::with_capacity(views.len());
        let mut last = 0.0f64;
        for v in views {
            let mut a = v.source[1].atan2(v.source[0]);
            a += ((last - a) / std::f64::consts::TAU).round() * std::f64::consts::TAU;
            angles.push(a);
            last = a;
        }
        let dso = first.source[0].hypot(first.source[1]);
        let (s, c) = angles[0].sin_cos();
        // Along the circle's own axes the first view gives all lengths.
        let reach = sub(first.detector, first.source);
        // Rounding errors do not count as a shift.
        let shift = |x: f64| if x.abs() < 1e-12 * norm(reach) { 0.0 } else { x };
        let orbit = Self {
            dso,
            dsd: -dot(reach, [c, s, 0.0]),
            pixel: [norm(first.v), norm(first.u)],
            offset: [shift(-first.detector[2]), shift(dot(first.detector, [-s, c, 0.0]))],
            angles,
        };
        let scale = dso.abs().max(orbit.dsd.abs());
        let pixel = orbit.pixel[0].max(orbit.pixel[1]);
        let near = |a: [f64; 3], b: [f64; 3], scale: f64| norm(sub(a, b)) <= TOLERANCE * scale;
        let fits = dso > 0.0
            && orbit.dsd > 0.0
            && views.iter().zip(&orbit.angles).all(|(v, &a)| {
                let w = orbit.view(a);
                near(v.source, w.source, scale)
                    && near(v.detector, w.detector, scale)
                    && near(v.u, w.u, pixel)
                    && near(v.v, w.v, pixel)
            });
        fits.then_some(orbit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A circle with an offset detector.
    fn circle() -> Vec<View> {
        let mm = Millimetres;
        let view = |i: i32| {
            let angle = Radians(0.3 + f64::from(i) * std::f64::consts::TAU / 7.0);
            View::circular(angle, mm(500.0), mm(800.0), [mm(2.0), mm(1.5)], [mm(-1.0), mm(30.0)])
        };
        (0..7).map(view).collect()
    }

    #[test]
    fn an_orbit_is_found_again() {
        let views = circle();
        let o = CircularOrbit::fit(&views).unwrap();
        assert!((o.dso - 500.0).abs() < 1e-9 && (o.dsd - 800.0).abs() < 1e-9, "{o:?}");
        assert!((o.offset[0] + 1.0).abs() < 1e-9 && (o.offset[1] - 30.0).abs() < 1e-9, "{o:?}");
        for (i, a) in o.angles.iter().enumerate() {
            assert!((a - 0.3 - i as f64 * std::f64::consts::TAU / 7.0).abs() < 1e-12, "{o:?}");
        }
    }

    #[test]
    fn a_view_off_the_circle_is_no_orbit() {
        for change in [0usize, 1, 2, 3] {
            let mut views = circle();
            let v = &mut views[4];
            [&mut v.source, &mut v.detector, &mut v.u, &mut v.v][change][2] += 1e-4;
            assert_eq!(CircularOrbit::fit(&views), None);
        }
        // Columns in the opposite direction do not give such an orbit either.
        let mut views = circle();
        views.iter_mut().for_each(|v| v.u = v.u.map(|x| -x));
        assert_eq!(CircularOrbit::fit(&views), None);
        assert_eq!(CircularOrbit::fit(&[]), None);
    }
}
