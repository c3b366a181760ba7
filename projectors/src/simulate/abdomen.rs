//! The abdomen phantom, painted from the skin inwards. The unit is 200 mm; the belly faces -y, the liver is at -x.

use super::paint::{Paint, ball, block, both, cone, ellipsoid, path, tube};
use conefield_core::geometry::Vec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const AIR: f64 = 0.0;
const FAT: f64 = 0.27;
const FLUID: f64 = 0.335;
const MUSCLE: f64 = 0.36;
const BLOOD: f64 = 0.43;
const SPONGY: f64 = 0.47;
const CORTICAL: f64 = 0.75;

/// All parts of an abdomen, in painting order.
pub(super) fn abdomen() -> Vec<Paint> {
    let mut random = ChaCha8Rng::seed_from_u64(0x6162_646f);
    [wall(), bowel(&mut random), organs(), spine_and_ribs(), vessels(&mut random)].concat()
}

fn wall() -> Vec<Paint> {
    // Long ellipsoids: nearly a cylinder within the cube.
    let trunk =
        |less: f64, value: f64| ellipsoid([0.0, 0.02, 0.0], [0.86 - less, 0.60 - less, 3.2], value).wavy(0.02, 1.6, 1);
    let mut out = vec![
        trunk(0.0, MUSCLE),
        trunk(0.012, FAT).textured(0.006, 12.0, 2),
        trunk(0.10, MUSCLE).textured(0.01, 18.0, 3),
        trunk(0.15, FAT).textured(0.008, 14.0, 4),
    ];
    out.extend(both(|s| {
        vec![
            // Muscles of the back and beside the spine.
            ellipsoid([s * 0.17, 0.43, 0.0], [0.14, 0.10, 3.0], MUSCLE).textured(0.012, 20.0, 5),
            ellipsoid([s * 0.15, 0.22, -0.45], [0.09, 0.09, 0.75], MUSCLE).textured(0.01, 20.0, 6),
            ellipsoid([s * 0.10, -0.49, 0.0], [0.11, 0.035, 3.0], MUSCLE),
        ]
    }));
    out
}

fn bowel(random: &mut ChaCha8Rng) -> Vec<Paint> {
    let mut out = Vec::new();
    // Small bowel: winding loops with thin walls, contents and some gas.
    for _ in 0..9 {
        let mut at =
            [random.random_range(-0.35..0.35), random.random_range(-0.36..-0.10), random.random_range(-0.95..-0.30)];
        let gas = random.random_range(0.0..1.0) < 0.3;
        let mut points: Vec<Vec3> = vec![at];
        for _ in 0..7 {
            let step: Vec3 = std::array::from_fn(|_| random.random_range(-0.16..0.16));
            let low = [-0.45, -0.38, -1.1];
            let high = [0.45, -0.05, -0.25];
            at = std::array::from_fn(|k| (at[k] + step[k]).clamp(low[k], high[k]));
            points.push(at);
        }
        out.extend(path(&points, 0.065, 0.39));
        out.extend(path(&points, 0.050, if gas { AIR } else { FLUID }));
    }
    // Large bowel: up on the right, across, down on the left; gas in front of its contents.
    let frame: [Vec3; 7] = [
        [-0.56, 0.02, -1.1],
        [-0.57, 0.02, -0.40],
        [-0.45, -0.24, -0.18],
        [0.0, -0.38, -0.22],
        [0.48, -0.22, 0.05],
        [0.60, 0.05, -0.25],
        [0.58, 0.08, -1.1],
    ];
    for (radius, value) in [(0.105, 0.38), (0.088, 0.34)] {
        out.extend(path(&frame, radius, value).into_iter().map(|p| p.wavy(0.02, 9.0, 11).textured(0.02, 16.0, 12)));
    }
    for pair in frame.windows(2) {
        let top = pair[0][1].min(pair[1][1]) - 0.005;
        out.push(tube(pair[0], pair[1], 0.086, AIR).wavy(0.02, 9.0, 11).above([0.0, -1.0, 0.0], -top));
    }
    out
}

fn organs() -> Vec<Paint> {
    let mut out = vec![
        // Lungs reach down behind the dome of the diaphragm.
        ellipsoid([-0.36, 0.06, 1.05], [0.40, 0.42, 0.42], 0.08).textured(0.03, 16.0, 21),
        ellipsoid([0.38, 0.06, 1.05], [0.36, 0.42, 0.46], 0.08).textured(0.03, 16.0, 22),
        ellipsoid([-0.33, -0.02, 0.40], [0.385, 0.43, 0.47], 0.40).wavy(0.02, 2.5, 23).textured(0.012, 9.0, 24),
        ellipsoid([0.10, -0.24, 0.50], [0.34, 0.20, 0.24], 0.40).textured(0.012, 9.0, 25),
        ellipsoid([-0.23, -0.27, 0.06], [0.07, 0.11, 0.13], 0.345),
        ellipsoid([0.56, 0.20, 0.42], [0.13, 0.22, 0.27], 0.405).turned([0.0, 0.0, 20.0]).textured(0.015, 14.0, 26),
        // Stomach: wall, contents, gas above their level.
        ellipsoid([0.30, -0.18, 0.33], [0.24, 0.21, 0.28], 0.385).wavy(0.02, 6.0, 27),
        ellipsoid([0.30, -0.18, 0.33], [0.215, 0.185, 0.255], FLUID).textured(0.015, 18.0, 28),
        ellipsoid([0.30, -0.18, 0.33], [0.215, 0.185, 0.255], AIR).above([0.0, -1.0, 0.0], 0.24),
        // Pancreas.
        cone([-0.14, -0.06, 0.02], [0.42, 0.10, 0.20], [0.065, 0.035], 0.385).wavy(0.018, 16.0, 29),
        // Two touching cysts in the liver, a bright lesion, and a stone in the gall bladder.
        ball([-0.46, 0.08, 0.46], 0.055, 0.34),
        ball([-0.38, 0.10, 0.46], 0.035, 0.34),
        ellipsoid([-0.22, 0.14, 0.52], [0.06, 0.05, 0.06], 0.43).wavy(0.01, 15.0, 30),
        ball([-0.22, -0.22, 0.02], 0.022, 0.62),
    ];
    out.extend(both(|s| {
        let z = if s < 0.0 { -0.06 } else { 0.04 };
        let at = [s * 0.36, 0.24, z];
        let lean = [0.0, s * 10.0, s * 25.0];
        vec![
            ellipsoid(at, [0.17, 0.16, 0.33], FAT),
            ellipsoid(at, [0.11, 0.10, 0.24], 0.45).turned(lean),
            ellipsoid(at, [0.075, 0.065, 0.19], 0.40).turned(lean).wavy(0.02, 14.0, 31),
            ellipsoid([s * 0.31, 0.20, z], [0.045, 0.04, 0.10], 0.33).turned(lean),
            ellipsoid([s * 0.27, 0.18, z + 0.28], [0.04, 0.015, 0.05], 0.38),
        ]
    }));
    out
}

fn spine_and_ribs() -> Vec<Paint> {
    let mut out = vec![tube([0.0, 0.40, -1.2], [0.0, 0.40, 1.2], 0.06, FLUID)];
    for i in 0..8 {
        let z = -1.0 + 0.27 * f64::from(i);
        out.extend([
            ellipsoid([0.0, 0.24, z], [0.135, 0.105, 0.105], CORTICAL),
            ellipsoid([0.0, 0.24, z], [0.122, 0.092, 0.094], SPONGY).textured(0.04, 34.0, 41),
            // The disc between two bodies.
            ellipsoid([0.0, 0.24, z + 0.135], [0.125, 0.095, 0.028], 0.37),
            block([0.0, 0.545, z - 0.02], [0.014, 0.05, 0.05], CORTICAL),
        ]);
        out.extend(both(|s| {
            let mut arch = path(&[[s * 0.08, 0.32, z], [s * 0.10, 0.40, z], [0.0, 0.50, z - 0.02]], 0.024, CORTICAL);
            arch.push(cone([s * 0.10, 0.39, z], [s * 0.24, 0.42, z], [0.026, 0.016], CORTICAL));
            arch
        }));
    }
    out.push(tube([0.0, 0.40, -1.2], [0.0, 0.40, 1.2], 0.035, 0.36));
    // Ribs run down from the back to the front.
    for i in 0..6 {
        let z = 1.15 - 0.24 * f64::from(i);
        out.extend(both(|s| {
            let points: Vec<Vec3> = (0..=12)
                .map(|n| {
                    let a = (68.0 - 11.0 * f64::from(n)).to_radians();
                    [s * 0.735 * a.cos(), 0.02 + 0.485 * a.sin(), z - 0.035 * f64::from(n)]
                })
                .collect();
            // Lower ribs are shorter.
            let points = &points[..(13 - i as usize).min(13)];
            [path(points, 0.030, CORTICAL), path(points, 0.017, SPONGY)].concat()
        }));
    }
    out
}

fn vessels(random: &mut ChaCha8Rng) -> Vec<Paint> {
    let mut out = Vec::new();
    out.extend(path(&[[0.03, 0.10, 1.2], [0.05, 0.08, 0.3], [0.03, 0.07, -0.60]], 0.055, 0.47));
    out.extend(path(&[[-0.11, 0.02, 1.2], [-0.11, 0.08, 0.2], [-0.10, 0.08, -0.65]], 0.062, BLOOD));
    out.extend(both(|s| {
        let mut branches =
            path(&[[s * 0.06 - 0.03, 0.07, -0.60], [s * 0.20, 0.12, -0.85], [s * 0.30, 0.16, -1.2]], 0.034, BLOOD);
        branches.extend(path(&[[s * 0.04, 0.09, 0.0], [s * 0.28, 0.19, 0.0]], 0.018, BLOOD));
        branches
    }));
    out.push(tube([0.05, 0.05, 0.22], [0.03, -0.10, -0.40], 0.018, 0.47));
    // A calcified plaque in the aorta.
    out.push(ball([0.085, 0.08, -0.30], 0.018, 0.70));
    // Portal vein and its branches in the liver.
    let mut ends: Vec<(Vec3, Vec3, f64)> =
        vec![([-0.08, -0.02, 0.12], [-0.6, 0.0, 0.8], 0.036), ([-0.16, 0.02, 0.62], [-1.0, 0.1, -0.3], 0.030)];
    while let Some((from, direction, radius)) = ends.pop() {
        let inside = |p: Vec3| {
            ((p[0] + 0.33) / 0.35).powi(2) + ((p[1] + 0.02) / 0.40).powi(2) + ((p[2] - 0.40) / 0.44).powi(2) < 1.0
        };
        let bend: Vec3 = std::array::from_fn(|k| direction[k] + random.random_range(-0.5..0.5));
        let length = 0.12 / bend.iter().map(|x| x * x).sum::<f64>().sqrt().max(0.1);
        let to: Vec3 = std::array::from_fn(|k| from[k] + length * bend[k]);
        if radius < 0.008 || (radius < 0.029 && !inside(to)) {
            continue;
        }
        out.push(cone(from, to, [radius, 0.85 * radius], BLOOD));
        ends.push((to, bend, 0.85 * radius));
        if random.random_range(0.0..1.0) < 0.7 {
            let side: Vec3 = std::array::from_fn(|k| bend[k] + random.random_range(-1.0..1.0));
            ends.push((to, side, 0.72 * radius));
        }
    }
    out
}
