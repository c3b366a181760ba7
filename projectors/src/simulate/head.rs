//! The head phantom, painted from the skin inwards. The unit is about 128 mm; the face is towards -y.

use super::paint::{Paint, ball, block, both, cone, ellipsoid, path, tube};
use conefield_core::geometry::Vec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const AIR: f64 = 0.0;
const FAT: f64 = 0.28;
const FLUID: f64 = 0.33;
const WHITE: f64 = 0.375;
const MUSCLE: f64 = 0.365;
const GRAY: f64 = 0.41;
const BLOOD: f64 = 0.50;
const SPONGY: f64 = 0.58;
const CORTICAL: f64 = 0.85;
const ENAMEL: f64 = 1.0;

/// The base of the skull rises from the back to the front: `BASE · p` is the height above the slope.
const BASE: Vec3 = [0.0, 0.41, 1.0];

/// All parts of a head, in painting order.
pub(super) fn head() -> Vec<Paint> {
    let mut random = ChaCha8Rng::seed_from_u64(0x6865_6164);
    [
        skin_and_neck(),
        spine(),
        skull(),
        skull_base(&mut random),
        brain(),
        ventricles_and_nuclei(),
        face(&mut random),
        jaws_and_teeth(),
        vessels(&mut random),
        inserts(),
    ]
    .concat()
}

fn skin_and_neck() -> Vec<Paint> {
    let mut out = Vec::new();
    // Skin, the fat below it, then muscle.
    for (less, value) in [(0.0, MUSCLE), (0.014, FAT), (0.034, MUSCLE)] {
        out.extend([
            cone([0.0, 0.14, -1.6], [0.0, 0.16, -0.3], [0.46 - less, 0.42 - less], value).wavy(0.01, 3.0, 1),
            ellipsoid([0.0, 0.04, 0.27], [0.605 - less, 0.745 - less, 0.665 - less], value).wavy(0.008, 4.0, 2),
            ellipsoid([0.0, -0.29, -0.36], [0.45 - less, 0.45 - less, 0.53 - less], value).wavy(0.015, 4.0, 3),
            // Cheekbones and temples, the region of the ears, chin and lips, nose.
            ellipsoid([0.0, -0.28, -0.05], [0.52 - less, 0.41 - less, 0.34 - less], value).wavy(0.008, 5.0, 4),
            ellipsoid([0.0, 0.08, -0.12], [0.57 - less, 0.57 - less, 0.36 - less], value),
            ellipsoid([0.0, -0.40, -0.66], [0.35 - less, 0.40 - less, 0.26 - less], value),
            cone([0.0, -0.66, 0.0], [0.0, -0.76, -0.22], [0.05 - less, 0.085 - less], value),
        ]);
    }
    out.extend(both(|s| {
        vec![
            ellipsoid([s * 0.585, 0.12, -0.14], [0.035, 0.10, 0.16], MUSCLE).turned([0.0, 0.0, -s * 25.0]),
            ellipsoid([s * 0.605, 0.10, -0.13], [0.020, 0.06, 0.09], AIR).turned([0.0, 0.0, -s * 25.0]),
            // Cheek fat, parotid, chewing muscles, neck muscles with fat between them.
            ellipsoid([s * 0.30, -0.42, -0.36], [0.09, 0.16, 0.17], FAT).wavy(0.02, 7.0, 4),
            ellipsoid([s * 0.41, 0.00, -0.40], [0.05, 0.12, 0.18], 0.34).textured(0.02, 18.0, 5),
            ellipsoid([s * 0.39, -0.22, -0.48], [0.05, 0.14, 0.22], 0.375).textured(0.012, 25.0, 6),
            ellipsoid([s * 0.27, -0.12, -0.42], [0.06, 0.10, 0.18], FAT),
            ellipsoid([s * 0.24, -0.14, -0.42], [0.045, 0.09, 0.16], 0.375),
            tube([s * 0.22, 0.30, -1.2], [s * 0.20, 0.36, -0.35], 0.13, FAT),
            tube([s * 0.15, 0.38, -1.2], [s * 0.15, 0.42, -0.35], 0.09, 0.375).textured(0.012, 22.0, 7),
            tube([s * 0.29, 0.28, -1.2], [s * 0.29, 0.32, -0.35], 0.07, 0.375).textured(0.012, 22.0, 8),
            cone([s * 0.20, -0.06, -1.2], [s * 0.42, 0.20, -0.36], [0.07, 0.05], 0.375),
        ]
    }));
    out
}

fn spine() -> Vec<Paint> {
    let mut out = Vec::new();
    for i in 0..4 {
        let z = -0.46 - 0.17 * f64::from(i);
        out.extend(both(|s| {
            path(
                &[[s * 0.10, 0.19, z], [s * 0.17, 0.22, z], [s * 0.13, 0.34, z - 0.02], [0.0, 0.41, z - 0.04]],
                0.034,
                CORTICAL,
            )
        }));
        out.push(tube([0.0, 0.40, z - 0.03], [0.0, 0.52, z - 0.07], 0.026, CORTICAL));
        out.extend(both(|s| vec![ball([s * 0.17, 0.22, z], 0.022, SPONGY)]));
        out.push(ellipsoid([0.0, 0.13, z], [0.13, 0.095, 0.068], CORTICAL));
        out.push(ellipsoid([0.0, 0.13, z], [0.115, 0.08, 0.055], SPONGY).textured(0.05, 30.0, 9));
    }
    // The pivot of the second vertebra.
    out.push(tube([0.0, 0.10, -0.62], [0.0, 0.09, -0.40], 0.04, CORTICAL));
    out.push(tube([0.0, 0.10, -0.60], [0.0, 0.09, -0.42], 0.025, SPONGY));
    out
}

fn skull() -> Vec<Paint> {
    let center = [0.0, 0.04, 0.27];
    let shell = |less: f64, value: f64| {
        ellipsoid(center, [0.56 - less, 0.70 - less, 0.62 - less], value)
            .above(BASE, -0.165 + 0.6 * less)
            .wavy(0.010, 3.5, 11)
    };
    vec![
        shell(0.0, CORTICAL),
        shell(0.016, SPONGY).textured(0.07, 26.0, 12),
        shell(0.046, CORTICAL),
        // The space around the brain; the shell is thicker at the back.
        ellipsoid([0.0, 0.03, 0.27], [0.502, 0.632, 0.56], FLUID).above(BASE, -0.125),
    ]
}

fn skull_base(random: &mut ChaCha8Rng) -> Vec<Paint> {
    let mut out = vec![
        // Sphenoid bone with its sinus, clivus, and the rear hollow with its opening.
        ellipsoid([0.0, -0.18, -0.07], [0.18, 0.15, 0.11], CORTICAL),
        cone([0.0, -0.06, -0.12], [0.0, 0.10, -0.34], [0.07, 0.045], SPONGY),
        ellipsoid([0.0, 0.34, -0.15], [0.42, 0.32, 0.27], CORTICAL),
        ellipsoid([0.0, 0.34, -0.13], [0.385, 0.285, 0.25], FLUID),
    ];
    out.extend(both(|s| {
        vec![
            cone([s * 0.12, -0.02, -0.14], [s * 0.44, 0.16, -0.17], [0.05, 0.095], CORTICAL),
            ellipsoid([s * 0.43, 0.20, -0.28], [0.08, 0.12, 0.16], SPONGY),
            ellipsoid([s * 0.07, -0.20, -0.06], [0.058, 0.09, 0.065], AIR),
            tube([s * 0.70, 0.10, -0.15], [s * 0.42, 0.10, -0.15], 0.024, AIR),
            ellipsoid([s * 0.385, 0.10, -0.145], [0.028, 0.03, 0.035], AIR),
            // Cochlea and semicircular canal.
            ball([s * 0.29, 0.06, -0.15], 0.016, FLUID),
            tube([s * 0.33, 0.10, -0.13], [s * 0.33, 0.14, -0.12], 0.010, FLUID),
            tube([s * 0.15, 0.14, -0.14], [s * 0.27, 0.08, -0.15], 0.014, FLUID),
        ]
    }));
    // Air cells of the mastoid.
    for _ in 0..90 {
        let s = if random.random::<bool>() { 1.0 } else { -1.0 };
        let mut within = |low: f64, high: f64| random.random_range(low..high);
        let at = [s * (0.43 + 0.055 * within(-1.0, 1.0)), 0.20 + 0.09 * within(-1.0, 1.0), within(-0.39, -0.16)];
        out.push(ball(at, within(0.010, 0.021), AIR));
    }
    out.push(cone([0.0, 0.26, -0.28], [0.0, 0.26, -0.48], [0.13, 0.10], FLUID));
    out.push(tube([0.0, 0.26, -0.45], [0.0, 0.27, -1.2], 0.088, FLUID));
    out
}

/// A slab of the cranial cavity around the plane between the hemispheres.
fn midline(half: f64, value: f64) -> Paint {
    ellipsoid([0.0, 0.03, 0.27], [0.502, 0.632, 0.56], value)
        .above([1.0, 0.0, 0.0], -half)
        .above([-1.0, 0.0, 0.0], -half)
}

fn brain() -> Vec<Paint> {
    let mut out = vec![
        ellipsoid([0.0, 0.03, 0.28], [0.488, 0.615, 0.54], GRAY)
            .above(BASE, -0.10)
            .wavy(0.008, 9.0, 21)
            .cleft(FLUID, 8.0, 0.20, 0.15),
    ];
    out.extend(both(|s| {
        vec![
            ellipsoid([s * 0.225, 0.03, 0.31], [0.165, 0.47, 0.37], WHITE)
                .above(BASE, 0.02)
                .wavy(0.06, 9.0, 22)
                .textured(0.008, 14.0, 23),
            // Stem of the temporal lobe, and the fissure above it.
            ellipsoid([s * 0.33, 0.02, 0.07], [0.07, 0.26, 0.06], WHITE).above(BASE, -0.04).wavy(0.02, 12.0, 24),
            ellipsoid([s * 0.40, -0.08, 0.17], [0.11, 0.20, 0.014], FLUID).turned([18.0, -s * 12.0, 0.0]),
            ellipsoid([s * 0.30, -0.06, 0.20], [0.012, 0.15, 0.09], FLUID),
        ]
    }));
    out.extend([
        // Corpus callosum, then the fissure between the hemispheres and the membrane in it.
        ellipsoid([0.0, 0.02, 0.38], [0.10, 0.30, 0.045], WHITE),
        midline(0.011, FLUID).above([0.0, 0.0, 1.0], 0.43),
        midline(0.011, FLUID).above([0.0, -1.0, 0.0], 0.28).above([0.0, 0.0, 1.0], 0.13),
        midline(0.011, FLUID).above([0.0, 1.0, 0.0], 0.36).above([0.0, 0.0, 1.0], 0.11),
        midline(0.005, 0.45).above([0.0, 0.0, 1.0], 0.46),
        midline(0.005, 0.45).above([0.0, -1.0, 0.0], 0.36).above([0.0, 0.0, 1.0], 0.13),
        midline(0.005, 0.45).above([0.0, 1.0, 0.0], 0.41).above([0.0, 0.0, 1.0], 0.13),
        // Cerebellum with its leaves, stem and cord.
        ellipsoid([0.0, 0.38, -0.13], [0.36, 0.23, 0.19], GRAY).wavy(0.01, 9.0, 25).cleft(FLUID, 15.0, 0.16, 0.07),
    ]);
    out.extend(both(|s| vec![ellipsoid([s * 0.15, 0.38, -0.13], [0.13, 0.12, 0.07], WHITE).wavy(0.02, 18.0, 26)]));
    out.extend([
        cone([0.0, 0.06, 0.16], [0.0, 0.13, -0.06], [0.10, 0.11], WHITE).textured(0.008, 20.0, 27),
        ellipsoid([0.0, 0.10, -0.06], [0.12, 0.09, 0.10], WHITE),
        cone([0.0, 0.15, -0.10], [0.0, 0.26, -0.45], [0.08, 0.055], WHITE),
        tube([0.0, 0.26, -0.45], [0.0, 0.27, -1.2], 0.05, WHITE),
        ellipsoid([0.0, 0.26, -0.07], [0.05, 0.035, 0.07], FLUID),
        // Cisterns around the stem.
        ellipsoid([0.0, -0.03, 0.04], [0.09, 0.04, 0.07], FLUID),
        ellipsoid([0.0, 0.21, 0.14], [0.10, 0.035, 0.05], FLUID),
        ball([0.0, -0.13, 0.025], 0.032, GRAY),
    ]);
    out
}

fn ventricles_and_nuclei() -> Vec<Paint> {
    let mut out = both(|s| {
        vec![
            ellipsoid([s * 0.20, -0.06, 0.25], [0.05, 0.14, 0.10], 0.415).turned([0.0, 0.0, -s * 14.0]),
            ellipsoid([s * 0.085, 0.06, 0.27], [0.065, 0.11, 0.09], 0.415).turned([0.0, 0.0, -s * 20.0]),
            ellipsoid([s * 0.13, -0.20, 0.30], [0.045, 0.09, 0.09], 0.415),
            ellipsoid([s * 0.075, -0.19, 0.32], [0.032, 0.15, 0.065], FLUID).turned([0.0, 0.0, s * 16.0]),
            ellipsoid([s * 0.075, 0.05, 0.355], [0.045, 0.20, 0.038], FLUID).turned([0.0, 0.0, -s * 8.0]),
            ellipsoid([s * 0.15, 0.24, 0.30], [0.05, 0.10, 0.065], FLUID).turned([0.0, 0.0, -s * 20.0]),
            cone([s * 0.17, 0.28, 0.28], [s * 0.13, 0.46, 0.27], [0.036, 0.010], FLUID),
            cone([s * 0.19, 0.24, 0.25], [s * 0.27, -0.02, 0.10], [0.028, 0.014], FLUID),
            ball([s * 0.15, 0.25, 0.29], 0.016, 0.70),
        ]
    });
    out.extend([
        ellipsoid([0.0, -0.01, 0.24], [0.014, 0.12, 0.08], FLUID),
        block([0.0, -0.19, 0.33], [0.005, 0.09, 0.05], WHITE),
        ball([0.0, 0.16, 0.25], 0.018, 0.75),
    ]);
    out
}

fn face(random: &mut ChaCha8Rng) -> Vec<Paint> {
    let mut out = vec![
        // Brow with the frontal sinus, and the bone between the eyes.
        ellipsoid([0.0, -0.60, 0.13], [0.24, 0.07, 0.09], CORTICAL),
        ellipsoid([0.0, -0.44, 0.01], [0.095, 0.21, 0.095], SPONGY),
        cone([0.0, -0.60, 0.09], [0.0, -0.68, -0.06], [0.045, 0.03], CORTICAL),
    ];
    out.extend(both(|s| {
        let mut eye = vec![
            ellipsoid([s * 0.07, -0.625, 0.14], [0.055, 0.025, 0.055], AIR).wavy(0.01, 20.0, 31),
            ellipsoid([s * 0.20, -0.45, -0.20], [0.135, 0.145, 0.145], CORTICAL),
            ellipsoid([s * 0.20, -0.45, -0.20], [0.118, 0.128, 0.128], 0.35),
            ellipsoid([s * 0.20, -0.45, -0.20], [0.110, 0.120, 0.120], AIR).wavy(0.012, 10.0, 32),
            // Orbit: bone, fat, optic nerve and muscles, then the eye with its lens.
            ellipsoid([s * 0.225, -0.42, 0.02], [0.155, 0.215, 0.145], CORTICAL)
                .turned([0.0, 0.0, s * 18.0])
                .above([0.0, 1.0, 0.0], -0.55),
            ellipsoid([s * 0.230, -0.45, 0.02], [0.135, 0.225, 0.124], FAT)
                .turned([0.0, 0.0, s * 18.0])
                .above([0.0, 1.0, 0.0], -0.57),
            tube([s * 0.23, -0.46, 0.02], [s * 0.15, -0.23, 0.02], 0.020, MUSCLE),
        ];
        for (dx, dz) in [(0.105, 0.0), (-0.105, 0.0), (0.0, 0.10), (0.0, -0.10)] {
            eye.push(tube(
                [s * (0.23 + dx), -0.50, 0.02 + dz],
                [s * (0.16 + 0.2 * dx), -0.25, 0.02 + 0.2 * dz],
                0.016,
                0.38,
            ));
        }
        eye.extend([
            ball([s * 0.235, -0.525, 0.02], 0.098, 0.42),
            ball([s * 0.235, -0.525, 0.02], 0.088, 0.345),
            ellipsoid([s * 0.235, -0.592, 0.02], [0.042, 0.018, 0.042], 0.47),
        ]);
        eye.extend(path(
            &[[s * 0.29, -0.51, -0.13], [s * 0.39, -0.42, -0.13], [s * 0.45, -0.24, -0.15], [s * 0.46, -0.02, -0.14]],
            0.034,
            CORTICAL,
        ));
        eye.extend(path(&[[s * 0.30, -0.50, -0.13], [s * 0.39, -0.42, -0.13]], 0.018, SPONGY));
        eye.push(tube([s * 0.385, -0.43, -0.10], [s * 0.39, -0.38, 0.10], 0.028, CORTICAL));
        eye
    }));
    // Ethmoid cells.
    for i in 0..5 {
        for s in [-1.0, 1.0] {
            for z in [-0.02, 0.045] {
                let mut within = |low: f64, high: f64| random.random_range(low..high);
                let at = [s * 0.045, -0.585 + 0.062 * f64::from(i), z + within(-0.01, 0.01)];
                let radii = [within(0.026, 0.036), within(0.022, 0.029), within(0.022, 0.030)];
                out.push(ellipsoid(at, radii, AIR));
            }
        }
    }
    // Nasal cavity, septum and conchae, throat.
    out.push(ellipsoid([0.0, -0.50, -0.20], [0.095, 0.25, 0.145], AIR).wavy(0.012, 9.0, 33));
    out.extend(both(|s| vec![tube([s * 0.035, -0.66, -0.25], [s * 0.04, -0.75, -0.31], 0.026, AIR)]));
    out.push(
        ellipsoid([0.0, -0.50, -0.20], [0.10, 0.26, 0.15], 0.45)
            .above([1.0, 0.02, 0.0], -0.014)
            .above([-1.0, -0.02, 0.0], -0.002),
    );
    out.extend(both(|s| {
        vec![
            ellipsoid([s * 0.058, -0.48, -0.25], [0.026, 0.17, 0.040], 0.36).turned([0.0, s * 15.0, 0.0]),
            ellipsoid([s * 0.050, -0.46, -0.16], [0.020, 0.15, 0.032], 0.36).turned([0.0, s * 15.0, 0.0]),
            ellipsoid([s * 0.055, -0.48, -0.25], [0.006, 0.15, 0.020], 0.60),
        ]
    }));
    out.extend(path(&[[0.0, -0.27, -0.20], [0.0, -0.16, -0.38], [0.0, -0.13, -0.62], [0.0, -0.16, -1.2]], 0.05, AIR));
    out
}

fn jaws_and_teeth() -> Vec<Paint> {
    // Points of an arch: `t` from -1 (right) over 0 (front) to 1 (left).
    let arch = |t: f64, wide: f64, deep: f64, z: f64| -> Vec3 {
        let a = 1.35 * t;
        [wide * a.sin(), -0.36 - deep * a.cos(), z]
    };
    let along = |wide: f64, deep: f64, z: f64| -> Vec<Vec3> {
        (-8..=8).map(|i| arch(f64::from(i) / 8.0, wide, deep, z)).collect()
    };
    let mut out = vec![
        block([0.0, -0.45, -0.395], [0.15, 0.19, 0.014], CORTICAL),
        ellipsoid([0.0, -0.42, -0.56], [0.165, 0.25, 0.13], 0.37).textured(0.012, 16.0, 41),
        ellipsoid([0.0, -0.45, -0.425], [0.13, 0.19, 0.012], AIR),
    ];
    out.extend(path(&along(0.195, 0.29, -0.37), 0.045, CORTICAL));
    out.extend(path(&along(0.195, 0.29, -0.36), 0.033, SPONGY));
    out.extend(path(&along(0.20, 0.31, -0.43), 0.042, CORTICAL));
    out.extend(path(&along(0.20, 0.31, -0.43), 0.028, SPONGY));
    // Lower jaw: body, rising branch and joint.
    let body = along(0.24, 0.33, -0.75);
    out.extend(path(&body, 0.062, CORTICAL));
    out.extend(path(&along(0.215, 0.31, -0.69), 0.042, CORTICAL));
    out.extend(path(&body, 0.038, SPONGY));
    out.extend(both(|s| {
        let end = arch(s, 0.24, 0.33, -0.75);
        let angle = [s * 0.33, -0.12, -0.66];
        let mut branch = path(&[end, angle, [s * 0.40, -0.03, -0.36], [s * 0.41, 0.01, -0.24]], 0.042, CORTICAL);
        branch.extend(path(&[end, angle, [s * 0.40, -0.03, -0.36]], 0.022, SPONGY));
        branch.push(tube(angle, [s * 0.39, -0.20, -0.32], 0.030, CORTICAL));
        branch.push(ellipsoid([s * 0.41, 0.01, -0.235], [0.055, 0.03, 0.03], CORTICAL));
        branch
    }));
    for i in 0..14 {
        let t = (f64::from(i) - 6.5) / 7.0;
        // Molars are thicker and have larger pulps; one has a filling.
        let r = 0.021 + 0.013 * t.abs();
        for (root, neck, crown) in [(-0.42, -0.49, -0.555), (-0.70, -0.64, -0.575)] {
            let (wide, deep) = if root > -0.6 { (0.20, 0.315) } else { (0.205, 0.310) };
            let at = |z: f64| arch(t, wide, deep, z);
            out.push(cone(at(root), at(neck), [0.5 * r, r], 0.88));
            out.push(tube(at(neck), at(crown), r, ENAMEL));
            out.push(tube(at(neck), at(crown - (crown - neck) * 0.3), 0.7 * r, 0.88));
            out.push(tube(at(root), at(neck), 0.22 * r, 0.4));
        }
    }
    out
}

fn vessels(random: &mut ChaCha8Rng) -> Vec<Paint> {
    let mut out = both(|s| {
        let mut arteries = path(
            &[
                [s * 0.21, -0.02, -1.2],
                [s * 0.22, -0.02, -0.55],
                [s * 0.20, 0.03, -0.22],
                [s * 0.10, -0.08, -0.10],
                [s * 0.10, -0.16, 0.02],
                [s * 0.09, -0.11, 0.06],
            ],
            0.026,
            BLOOD,
        );
        arteries.extend(path(&[[s * 0.27, 0.06, -1.2], [s * 0.28, 0.06, -0.5], [s * 0.24, 0.12, -0.26]], 0.035, 0.45));
        arteries.extend(path(&[[s * 0.13, 0.17, -1.2], [s * 0.15, 0.18, -0.5], [0.0, 0.05, -0.16]], 0.016, BLOOD));
        // Transverse sinus.
        arteries.extend(path(&[[0.0, 0.63, 0.10], [s * 0.30, 0.52, 0.02], [s * 0.42, 0.28, -0.10]], 0.024, 0.45));
        arteries
    });
    out.push(tube([0.0, 0.05, -0.16], [0.0, -0.02, 0.08], 0.016, BLOOD));
    // Superior sagittal sinus along the vault.
    let vault: Vec<Vec3> = (0..=14)
        .map(|i| {
            let a = (10.0 + 160.0 * f64::from(i) / 14.0).to_radians();
            [0.0, 0.03 + 0.61 * a.cos(), 0.27 + 0.54 * a.sin()]
        })
        .collect();
    out.extend(path(&vault, 0.018, 0.45));
    // Arteries of the brain: three trunks per side, which branch outwards.
    for s in [-1.0, 1.0] {
        for (start, towards) in [
            ([s * 0.10, -0.11, 0.07], [s * 1.0, 0.1, 0.25]),
            ([s * 0.04, -0.16, 0.09], [s * 0.1, -0.8, 0.9]),
            ([s * 0.05, 0.02, 0.08], [s * 0.5, 1.0, 0.35]),
        ] {
            let mut ends = vec![(start, towards, 0.017)];
            while let Some((from, direction, radius)) = ends.pop() {
                if radius < 0.0055 {
                    continue;
                }
                let bend: Vec3 = std::array::from_fn(|k| direction[k] + random.random_range(-0.55..0.55));
                let length = 0.11 / bend.iter().map(|x| x * x).sum::<f64>().sqrt().max(0.1);
                let to: Vec3 = std::array::from_fn(|k| from[k] + length * bend[k]);
                // No vessel leaves the brain.
                if (to[0] / 0.48).powi(2) + ((to[1] - 0.03) / 0.61).powi(2) + ((to[2] - 0.28) / 0.53).powi(2) > 1.0 {
                    continue;
                }
                out.push(cone(from, to, [radius, 0.87 * radius], BLOOD));
                ends.push((to, bend, 0.87 * radius));
                if random.random_range(0.0..1.0) < 0.35 {
                    let side: Vec3 = std::array::from_fn(|k| bend[k] + random.random_range(-1.2..1.2));
                    ends.push((to, side, 0.72 * radius));
                }
            }
        }
    }
    out
}

/// Details of known size: low-contrast lesions, rows of ever smaller balls, a fan of bars.
fn inserts() -> Vec<Paint> {
    let mut out = vec![
        ellipsoid([0.27, 0.27, 0.42], [0.07, 0.06, 0.06], 0.43).wavy(0.012, 12.0, 51),
        ellipsoid([0.27, 0.27, 0.42], [0.035, 0.03, 0.03], 0.36),
        ellipsoid([-0.30, -0.20, 0.42], [0.05, 0.06, 0.05], 0.355),
    ];
    for i in 0..6 {
        let radius = 0.024 * 0.75f64.powi(i);
        let x = -0.36 + 0.07 * f64::from(i);
        out.push(ball([x, 0.33, 0.48], radius, 0.55));
        out.push(ball([x, 0.39, 0.48], radius, 0.30));
    }
    for i in 0..5 {
        let width = 0.005 + 0.0025 * f64::from(i);
        for bar in 0..3 {
            let x = 0.12 + 0.055 * f64::from(i) + 2.0 * width * f64::from(bar);
            out.push(block([x, -0.30, 0.55], [width / 2.0, 0.035, 0.035], 0.60));
        }
    }
    out
}
