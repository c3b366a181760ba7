//! What a view of Gaussians costs: line integrals on 512² pixels and their adjoint, against the number of Gaussians and
//! against the machine's multiply-adds in the same run.
//!
//! `cargo bench -p conefield-benches --bench gaussians`

use conefield_benches::{multiply_adds, times};
use conefield_core::random::{mix, unit};
use conefield_solvers::gaussians::shape::{Shape, Slope};
use conefield_solvers::gaussians::view::{Beam, EXTENT, Sight};
use std::f64::consts::PI;

const RUNS: usize = 7;
/// Radius of the ball that the Gaussians fill, in sides of the unit cube.
const BALL: f64 = 0.4;
/// Multiply-adds that a pixel of a footprint takes at least: two polynomials, a reciprocal root, a power and the sum;
/// backward six moments in place of the sum.
const FORWARD: f64 = 4.0 + 3.0 + 5.0 + 2.0;
const BACKWARD: f64 = 4.0 + 3.0 + 5.0 + 3.0 + 8.0;

/// The published scanner: the cube is seen from 2.5 sides before its centre by a detector 3.5 sides away.
const DISTANCES: [f64; 2] = [2.5, 3.5];
const DETECTOR: [usize; 2] = [512; 2];

fn main() {
    let pixel = 2.0 / DETECTOR[1] as f64;
    let [near, far] = DISTANCES;
    let corner = [-0.5, -0.5].map(|share| share * (DETECTOR[0] - 1) as f64 * pixel);
    let beam = Beam {
        source: [0.5 - near, 0.5, 0.5],
        first: [far, corner[0], corner[1]],
        u: [0.0, pixel, 0.0],
        v: [0.0, 0.0, pixel],
        detector: DETECTOR,
    };
    let limit = multiply_adds();
    println!("limit of this machine, measured now: {:.0} G multiply-adds/s", limit / 1e9);
    for count in [7_500, 15_000, 30_000, 60_000, 120_000] {
        let shapes = ball(count);
        let width = shapes[0].deviations[0];
        // Pixels within the ellipse of each Gaussian, at the magnification of the centre.
        let pixels = count as f64 * PI * (EXTENT * width * far / near / pixel).powi(2);
        let (mut sight, mut image) = (Sight::<f32>::default(), vec![0.0f32; beam.padded()]);
        let mut slopes = vec![Slope::default(); count];
        let forward = times(RUNS, || sight.project(&beam, &shapes, &mut image));
        assert!(image.iter().any(|x| *x > 0.0));
        let backward = times(RUNS, || {
            image.fill(1e-3);
            sight.backproject(&beam, &shapes, &mut image, &mut slopes);
        });
        for (name, [low, median, high], work) in [("project", forward, FORWARD), ("adjoint", backward, BACKWARD)] {
            println!(
                "{count:>7} Gaussians of {:.1} pixels, {name}: {:.1} ms ({:.1} to {:.1}), {:.2} G pixels/s, {:.0} % of the \
                 multiply-adds",
                width * far / near / pixel,
                1e3 * median,
                1e3 * low,
                1e3 * high,
                pixels / median / 1e9,
                100.0 * pixels * work / median / limit
            );
        }
    }
}

/// Round Gaussians at random places of a ball, as wide as half their mean distance.
fn ball(count: usize) -> Vec<Shape> {
    let width = 0.5 * BALL * (4.0 / 3.0 * PI / count as f64).cbrt();
    let mut all = vec![];
    let mut number = 0u64;
    while all.len() < count {
        let centre: [f64; 3] = std::array::from_fn(|_| {
            number += 1;
            2.0 * BALL * (f64::from(unit(mix(number, 7))) - 0.5)
        });
        if centre.iter().map(|x| x * x).sum::<f64>() < BALL * BALL {
            let inverse = std::array::from_fn(|i| std::array::from_fn(|k| if i == k { 1.0 / width } else { 0.0 }));
            all.push(Shape { centre: centre.map(|x| x + 0.5), inverse, deviations: [width; 3], density: 1.0 });
        }
    }
    all
}
