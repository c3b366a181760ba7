//! A fixed source and detector with an object rotating between them: the geometry of CIL and Nikon.

use conefield_core::geometry::{Vec3, View, cross, dot, norm, sub};

/// All in the laboratory frame, in mm; the object rotates.
#[derive(Debug, Clone, Copy)]
pub(super) struct TurningObject {
    pub source: Vec3,
    /// The detector's centre.
    pub detector: Vec3,
    /// The steps to the next column and to the next row.
    pub u: Vec3,
    pub v: Vec3,
    /// A point of the rotation axis, and its direction, of any length above 0.
    pub axis: Vec3,
    pub axis_direction: Vec3,
}

impl TurningObject {
    /// The views in the object's frame, whose origin is the axis' point and whose z is the axis. `turns` are the
    /// angles, in degrees, by which source and detector rotate about it, counterclockwise seen from +z.
    ///
    /// The smallest rotation that brings the axis to z tilts the frame (Rodrigues' formula).
    pub fn views(&self, turns: impl Iterator<Item = f64>) -> Vec<View> {
        let length = norm(self.axis_direction);
        let d = self.axis_direction.map(|x| x / length);
        let upright = |p: Vec3| tip(d, p);
        let [source, detector] = [self.source, self.detector].map(|p| upright(sub(p, self.axis)));
        let [u, v] = [self.u, self.v].map(upright);
        turns
            .map(|degrees| {
                let (s, c) = degrees.to_radians().sin_cos();
                let turn = |p: Vec3| [c * p[0] - s * p[1], s * p[0] + c * p[1], p[2]];
                View { source: turn(source), detector: turn(detector), u: turn(u), v: turn(v) }
            })
            .collect()
    }
}

/// Rotates `p` by the smallest rotation that brings the unit vector `d` to z.
fn tip(d: Vec3, p: Vec3) -> Vec3 {
    let c = d[2];
    if c <= -1.0 + 1e-12 {
        // Half a turn about x.
        return [p[0], -p[1], -p[2]];
    }
    // p + w × p + w × (w × p)/(1 + c) with w = d × z.
    let w = cross(d, [0.0, 0.0, 1.0]);
    let once = cross(w, p);
    let twice = cross(w, once);
    debug_assert!(dot(d, d) < 1.0 + 1e-9);
    std::array::from_fn(|k| p[k] + once[k] + twice[k] / (1.0 + c))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::is_view;
    use conefield_core::geometry::{Millimetres, Radians};

    #[test]
    fn an_upright_axis_gives_a_circle_and_a_tipped_one_keeps_lengths() {
        let rest = TurningObject {
            source: [0.0, -500.0, 0.0],
            detector: [0.0, 300.0, 0.0],
            u: [2.0, 0.0, 0.0],
            v: [0.0, 0.0, -1.5],
            axis: [0.0; 3],
            axis_direction: [0.0, 0.0, 3.0],
        };
        let mm = Millimetres;
        for (turn, view) in [0.0, 30.0, -100.0].into_iter().zip(rest.views([0.0, 30.0, -100.0].into_iter())) {
            // The source starts at -90 degrees.
            let angle = Radians(f64::to_radians(turn - 90.0));
            let want = View::circular(angle, mm(500.0), mm(800.0), [mm(1.5), mm(2.0)], [mm(0.0), mm(0.0)]);
            is_view(&view, [want.source, want.detector, want.u, want.v]);
        }
        for direction in [[0.1, -0.2, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]] {
            let axis = [3.0, 1.0, -2.0];
            let tipped = TurningObject { axis, axis_direction: direction, ..rest };
            let d = direction.map(|x| x / norm(direction));
            assert!(norm(sub(tip(d, d), [0.0, 0.0, 1.0])) < 1e-9);
            let view = tipped.views([40.0].into_iter())[0];
            // Lengths, and the distance from the axis to the central ray, do not change.
            let away = |p: Vec3, q: Vec3| norm(sub(p, q));
            assert!((away(view.source, view.detector) - 800.0).abs() < 1e-9);
            assert!((norm(view.source) - away(rest.source, axis)).abs() < 1e-9);
            assert!((view.source[2] - dot(d, sub(rest.source, axis))).abs() < 1e-9);
            assert!(dot(view.u, view.v).abs() < 1e-9 && (norm(view.u) - 2.0).abs() < 1e-9);
        }
    }
}
