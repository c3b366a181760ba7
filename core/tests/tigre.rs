//! The tilt of a detector beside TIGRE's `rotDetector`, whose rotation is written out here as in its
//! `Siddon_projection.cu` (`rollPitchYaw`, then the move to its place).

use conefield_core::geometry::{Millimetres as Mm, Radians, Vec3, View};

/// A point near the origin, rotated as TIGRE rotates the detector by `rotDetector` before it moves it away.
fn roll_pitch_yaw([yaw, pitch, roll]: [f64; 3], [x, y, z]: Vec3) -> Vec3 {
    let ((sy, cy), (sp, cp), (sr, cr)) = (yaw.sin_cos(), pitch.sin_cos(), roll.sin_cos());
    [
        cr * cp * x + (cr * sp * sy - sr * cy) * y + (cr * sp * cy + sr * sy) * z,
        sr * cp * x + (sr * sp * sy + cr * cy) * y + (sr * sp * cy - cr * sy) * z,
        -sp * x + cp * sy * y + cp * cy * z,
    ]
}

/// Largest distance between a pixel of TIGRE's detector and the same one here, with the tilt of the documentation.
fn apart(turns: [f64; 3]) -> f64 {
    let shape = [4, 6];
    let view = View::circular(Radians(0.0), Mm(500.0), Mm(800.0), [Mm(2.0), Mm(1.5)], [Mm(7.0), Mm(-3.0)]);
    let view = view.tilted([Radians(turns[1]), Radians(-turns[2]), Radians(-turns[0])]);
    let mut most = 0.0f64;
    for row in 0..shape[0] {
        for column in 0..shape[1] {
            let (along_u, up) = (1.5 * (column as f64 - 2.5), 2.0 * (1.5 - row as f64));
            let [x, y, z] = roll_pitch_yaw(turns, [0.0, along_u, up]);
            // TIGRE's offDetector is towards +z and along u.
            let theirs = [x - 300.0, y - 3.0, z - 7.0];
            let ours = view.pixel(shape, row as f64, column as f64);
            most = (0..3).map(|k| (theirs[k] - ours[k]).abs()).fold(most, f64::max);
        }
    }
    most
}

#[test]
fn tilts_are_those_of_tigre_unless_it_turns_about_both_y_and_z() {
    for turns in [[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3], [0.1, -0.2, 0.0], [-0.1, 0.0, 0.3]] {
        assert!(apart(turns) < 1e-12, "{turns:?}: {}", apart(turns));
    }
    // Turns about y and z are made in the other order: their product is what differs.
    assert!(apart([0.0, 0.2, 0.3]) > 0.1);
    assert!(apart([0.001, 0.002, 0.003]) < 1e-4);
}
