//! Compares line integrals with quadrature, derivatives with finite differences, and whole views and grids with single
//! rays and points.

use super::grid::Grid;
use super::shape::{FREE, NUMBERS, Slope, apply};
use super::stage::{Mixture, shapes};
use super::view::{Beam, EXTENT, Sight};
use conefield_core::geometry::{Vec3, cross, dot, sub};
use conefield_core::stage::{Kernel, Tile, TileMut, UnitGrid, UnitRay};

const ROWS: usize = 24;
const COLUMNS: usize = 29;

/// A cone beam on a rotated and shifted detector.
fn beam() -> Beam {
    let (u, v) = ([-0.045, 0.05, 0.004], [0.003, 0.006, -0.07]);
    let first: Vec3 = std::array::from_fn(|k| [-2.1, -1.9, 0.1][k] - 13.0 * u[k] - 11.5 * v[k]);
    Beam { source: [1.9, 1.8, 0.4], first, u, v, detector: [ROWS, COLUMNS] }
}

/// Gaussians of any shape and orientation, and a free slot.
fn parameters() -> Vec<f64> {
    let mut state = 77u64;
    let mut draw = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let mut all = vec![];
    for i in 0..7 {
        all.extend((0..3).map(|_| 0.5 + 0.3 * draw()));
        all.extend((0..3).map(|_| -2.8 + 0.6 * draw()));
        all.extend((0..4).map(|_| draw()));
        all.push(if i == 3 { f64::from(FREE) } else { draw() });
    }
    all
}

/// Arbitrary weights for pixels, and 0 between rows.
fn weights(beam: &Beam) -> Vec<f64> {
    let stride = beam.padded() / ROWS;
    let value = |i: usize| ((i * 7919) % 1009) as f64 / 504.5 - 1.0;
    (0..beam.padded()).map(|i| if i % stride < COLUMNS { value(i) } else { 0.0 }).collect()
}

fn project(params: &[f64]) -> Vec<f64> {
    let (beam, mut image) = (beam(), vec![f64::NAN; beam().padded()]);
    Sight::default().project(&beam, &shapes(params), &mut image);
    let stride = image.len() / ROWS;
    image.iter_mut().enumerate().for_each(|(i, x)| {
        if i % stride >= COLUMNS {
            *x = 0.0
        }
    });
    image
}

fn gradient(params: &[f64], by: &[f64]) -> (Vec<f64>, Vec<Slope>) {
    let (beam, shapes) = (beam(), shapes(params));
    let (mut image, mut sight) = (vec![0.0; beam.padded()], Sight::default());
    sight.project(&beam, &shapes, &mut image);
    let (mut by, mut slopes) = (by.to_vec(), vec![Slope::default(); shapes.len()]);
    sight.backproject(&beam, &shapes, &mut by, &mut slopes);
    let all = slopes.iter().zip(&shapes).zip(params.chunks(NUMBERS));
    (all.flat_map(|((slope, shape), p)| slope.by_parameters(p, shape)).collect(), slopes)
}

/// The largest difference between `gradient` and finite differences of `loss`, relative to its largest entry.
fn off(params: &[f64], gradient: &[f64], loss: impl Fn(&[f64]) -> f64) -> f64 {
    let most = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
    let mut worst = 0.0f64;
    for i in 0..params.len() {
        // Steps so small that no pixel crosses a Gaussian's cutoff, where the value drops to 0.
        let h = 1e-7;
        let at = |h: f64| {
            let mut p = params.to_vec();
            p[i] += h;
            loss(&p)
        };
        worst = worst.max(((at(h) - at(-h)) / (2.0 * h) - gradient[i]).abs() / most);
    }
    worst
}

#[test]
fn line_integrals_are_those_of_quadrature() {
    let (beam, image, all) = (beam(), project(&parameters()), shapes(&parameters()));
    let stride = image.len() / ROWS;
    let (mut worst, mut most) = (0.0f64, 0.0f64);
    for row in 0..ROWS {
        for column in 0..COLUMNS {
            let d: Vec3 = std::array::from_fn(|k| beam.first[k] + column as f64 * beam.u[k] + row as f64 * beam.v[k]);
            let length = dot(d, d).sqrt();
            let mut sum = 0.0;
            for shape in &all {
                let y = sub(shape.centre, beam.source);
                let off = cross(apply(&shape.inverse, y), apply(&shape.inverse, d));
                let e = dot(off, off) / dot(apply(&shape.inverse, d), apply(&shape.inverse, d));
                if e <= EXTENT * EXTENT {
                    let step = 4.5 / 1500.0;
                    for i in 0..1500 {
                        let t = (i as f64 + 0.5) * step / length;
                        let m = apply(&shape.inverse, std::array::from_fn(|k| t * d[k] - y[k]));
                        sum += shape.density * (-0.5 * dot(m, m)).exp() * step;
                    }
                }
            }
            worst = worst.max((image[row * stride + column] - sum).abs());
            most = most.max(sum);
        }
    }
    assert!(most > 0.1 && worst < 1e-6 * most, "{worst:e} of {most}");
}

#[test]
fn derivatives_of_a_view_are_finite_differences() {
    let (p, by) = (parameters(), weights(&beam()));
    let slopes = gradient(&p, &by).0;
    let worst = off(&p, &slopes, |p| dot_all(&project(p), &by));
    // A free slot gets no gradient.
    assert!(slopes[3 * NUMBERS..4 * NUMBERS].iter().all(|g| *g == 0.0));
    assert!(worst < 1e-7, "{worst:e}");
    // A wrong derivative is detected.
    let mut wrong = gradient(&p, &by).0;
    wrong[4] *= 1.01;
    assert!(off(&p, &wrong, |p| dot_all(&project(p), &by)) > 1e-5);
}

fn dot_all(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A view is linear in the densities: `<Aρ, y> = <ρ, Aᵀy>`.
#[test]
fn the_way_back_is_the_adjoint() {
    let (p, by) = (parameters(), weights(&beam()));
    let left = dot_all(&project(&p), &by);
    let right: f64 = gradient(&p, &by).1.iter().zip(&shapes(&p)).map(|(s, shape)| s.density * shape.density).sum();
    let size: f64 = project(&p).iter().zip(&by).map(|(a, b)| (a * b).abs()).sum();
    assert!((left - right).abs() < 1e-12 * size, "{left} {right}");
}

fn single(params: &[f64]) -> Vec<f32> {
    params.iter().map(|p| *p as f32).collect()
}

#[test]
fn a_view_is_its_rays_in_both_precisions() {
    let (p, beam) = (parameters(), beam());
    let image = project(&p);
    let stride = image.len() / ROWS;
    let mut narrow = vec![0.0f32; image.len()];
    Sight::default().project(&beam, &shapes(&single(&p)), &mut narrow);
    let mixture = Mixture { most: p.len() / NUMBERS };
    let most = image.iter().fold(0.0f64, |m, x| m.max(*x));
    // At a Gaussian's cutoff rounding decides whether a pixel gets its last 0.2 %.
    let (mut unlike, mut apart) = (0, 0.0f64);
    for row in 0..ROWS {
        for column in 0..COLUMNS {
            let d: Vec3 = std::array::from_fn(|k| beam.first[k] + column as f64 * beam.u[k] + row as f64 * beam.v[k]);
            let length = dot(d, d).sqrt();
            let ray = UnitRay {
                origin: beam.source.map(|x| x as f32),
                direction: d.map(|x| (x / length) as f32),
                inside: [1.0, 4.0],
                published: [1.0, 4.0],
                per_mm: 1.0,
            };
            let mut line = [f64::NAN];
            mixture.line_integrals(&p, &[ray], &mut line);
            let at = row * stride + column;
            let differences = [line[0] - image[at], f64::from(narrow[at]) - image[at]].map(f64::abs);
            unlike += usize::from(differences.iter().any(|d| *d > 2e-5 * most));
            apart = differences.into_iter().fold(apart, f64::max);
        }
    }
    assert!(unlike <= 4 && apart < 3e-3 * most, "{unlike} pixels, {apart:e}");
}

fn points() -> UnitGrid {
    UnitGrid { first: [0.21, 0.2, 0.13], spacing: [0.06, 0.05, 0.045], shape: [9, 11, 17] }
}

fn painted(params: &[f64]) -> Vec<f64> {
    let (grid, shapes, mut found) = (points(), shapes(params), Grid::default());
    let mut out = vec![f64::NAN; grid.shape.iter().product()];
    found.look(&grid, &shapes);
    found.values(&grid, &shapes, &mut out);
    out
}

#[test]
fn a_grid_is_its_points_and_its_derivatives_are_finite_differences() {
    let (p, grid) = (parameters(), points());
    let n: usize = grid.shape.iter().product();
    let by: Vec<f64> = (0..n).map(|i| ((i * 7919) % 1009) as f64 / 504.5 - 1.0).collect();
    let [_, ny, nz] = grid.shape;
    let at = |i: usize, k: usize| grid.first[k] + grid.spacing[k] * [i / (ny * nz), i / nz % ny, i % nz][k] as f64;
    let x: Vec<f64> = (0..3).flat_map(|k| (0..n).map(move |i| at(i, k))).collect();
    let mixture = Mixture { most: p.len() / NUMBERS };
    let mut y = vec![0.0; n];
    mixture.forward(&p, Tile::new(&x, n), TileMut::new(&mut y, n), TileMut::new(&mut [], n));
    let values = painted(&p);
    let most = y.iter().fold(0.0f64, |m, y| m.max(*y));
    assert!(most > 0.2 && values.iter().zip(&y).all(|(a, b)| (a - b).abs() < 1e-12), "{most}");
    let (all, mut found, mut g) = (shapes(&p), Grid::default(), vec![0.0; p.len()]);
    found.look(&grid, &all);
    for (i, slope) in found.slopes(&grid, &all, &by) {
        let own = i * NUMBERS..(i + 1) * NUMBERS;
        g[own.clone()].copy_from_slice(&slope.by_parameters(&p[own], &all[i]));
    }
    assert!(off(&p, &g, |p| dot_all(&painted(p), &by)) < 1e-7);
}
