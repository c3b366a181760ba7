//! A mixture of Gaussians as a field: values at any points and line integrals of any rays, one Gaussian at a time.
//!
//! Training uses whole views and whole grids, which is faster ([`view`], [`grid`]); this module implements the same
//! formula for everything else.

use super::device::DeviceMixture;
use super::grid::{self, Grid};
use super::shape::{DENSITY, FREE, NUMBERS, ROTATION, SCALE, Shape, apply};
use super::view;
use conefield_core::device::Device;
use conefield_core::error::Result;
use conefield_core::geometry::{Vec3, cross, dot, norm, sub};
use conefield_core::parallel;
use conefield_core::simd::Real;
use conefield_core::stage::{
    Backward, Field, GradKind, Info, Kernel, Lines, OnDevice, OnGrid, Parameter, Scope, Stage, Tile, TileMut, UnitGrid,
    UnitRay,
};
use std::f64::consts::TAU;
use std::ops::Range;

/// Gaussians per worker when gradients are summed.
const CHUNK: usize = 1024;

/// A mixture of up to `most` Gaussians. The parameters of one are contiguous ([`NUMBERS`]); an unused slot has a
/// density of 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mixture {
    /// Number of slots.
    pub most: usize,
}

/// The shapes of the parameters, slot by slot.
pub fn shapes<R: Real>(params: &[R]) -> Vec<Shape> {
    let mut all = vec![];
    reshape(params, &mut all);
    all
}

/// Like [`shapes`], into a vector that keeps its memory.
pub fn reshape<R: Real>(params: &[R], all: &mut Vec<Shape>) {
    all.resize(params.len().div_ceil(NUMBERS), Shape::default());
    parallel::over(all.chunks_mut(CHUNK).zip(params.chunks(CHUNK * NUMBERS)), |_, (all, params)| {
        all.iter_mut().zip(params.chunks(NUMBERS)).for_each(|(shape, params)| *shape = Shape::of(params));
    });
}

/// The parameters of each slot in use.
fn present<R: Real>(params: &[R]) -> impl Iterator<Item = &[R]> {
    params.chunks_exact(NUMBERS).filter(|p| p[DENSITY].f64() > f64::from(FREE))
}

/// A bound on the reach of a Gaussian, cheaper than its shape.
fn far<R: Real>(p: &[R], extent: f64) -> f64 {
    extent * p[SCALE].f64().max(p[SCALE + 1].f64()).max(p[SCALE + 2].f64()).exp()
}

fn place<R: Real>(p: &[R]) -> Vec3 {
    [p[0].f64(), p[1].f64(), p[2].f64()]
}

/// The points of a tile, and their bounding box.
struct Points {
    all: Vec<Vec3>,
    bounds: [Vec3; 2],
}

impl Points {
    fn of<R: Real>(x: Tile<'_, R>) -> Self {
        let all: Vec<Vec3> = (0..x.rows).map(|i| std::array::from_fn(|k| x.channel(k)[i].f64())).collect();
        let fold = |start: f64, f: fn(f64, f64) -> f64| -> Vec3 {
            std::array::from_fn(|k| all.iter().map(|p| p[k]).fold(start, f))
        };
        let bounds = [fold(f64::INFINITY, f64::min), fold(f64::NEG_INFINITY, f64::max)];
        Self { all, bounds }
    }

    /// Whether a Gaussian may reach one of the points.
    fn near<R: Real>(&self, p: &[R]) -> bool {
        let (c, far) = (place(p), far(p, grid::EXTENT));
        (0..3).all(|k| c[k] + far >= self.bounds[0][k] && c[k] - far <= self.bounds[1][k])
    }
}

impl<R: Real> Kernel<R> for Mixture {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let points = Points::of(x);
        let mut sums = vec![0.0; x.rows];
        for p in present(params).filter(|p| points.near(p)) {
            let shape = Shape::of(p);
            for (sum, x) in sums.iter_mut().zip(&points.all) {
                *sum += shape.value(*x, grid::EXTENT);
            }
        }
        y.data.iter_mut().zip(sums).for_each(|(y, sum)| *y = R::of(sum));
    }

    /// Never called: the method differentiates whole views and grids, and backends refuse its steps.
    fn backward(&self, _: Backward<'_, R>) {
        unreachable!("a mixture of Gaussians is trained by its method")
    }
}

/// Rays in similar directions: a Gaussian further from the first ray than `spread` plus its own reach meets none of
/// them.
pub(super) struct Bundle {
    origin: Vec3,
    direction: Vec3,
    pub(super) spread: f64,
}

impl Bundle {
    pub(super) fn of(rays: &[UnitRay]) -> Option<Self> {
        let of = |r: &UnitRay| (r.origin.map(f64::from), r.direction.map(f64::from));
        let (origin, direction) = of(rays.first()?);
        // No Gaussian has its centre beyond the cube's far side.
        let far = rays.iter().map(|r| f64::from(r.inside[1])).fold(0.0, f64::max) + 2.0;
        let at = |(o, d): (Vec3, Vec3), t: f64| -> Vec3 { std::array::from_fn(|k| o[k] + t * d[k]) };
        let apart = |r: &UnitRay, t: f64| norm(sub(at(of(r), t), at((origin, direction), t)));
        let spread = rays.iter().map(|r| apart(r, 0.0).max(apart(r, far))).fold(0.0, f64::max);
        Some(Self { origin, direction, spread })
    }

    fn near<R: Real>(&self, p: &[R]) -> bool {
        let off = cross(sub(place(p), self.origin), self.direction);
        dot(off, off) <= (self.spread + far(p, view::EXTENT)).powi(2)
    }
}

/// The line integral of a shape of density 1 along a ray; `None` if the ray misses the shape.
fn along(shape: &Shape, ray: &UnitRay) -> Option<f64> {
    if ray.inside[1] <= ray.inside[0] {
        return None;
    }
    let d = ray.direction.map(f64::from);
    let length = norm(d);
    let d = d.map(|x| x / length);
    let y = sub(shape.centre, ray.origin.map(f64::from));
    let (z, w) = (apply(&shape.inverse, y), apply(&shape.inverse, d));
    let (a, off) = (dot(w, w), cross(z, w));
    let e = dot(off, off) / a;
    (e <= view::EXTENT * view::EXTENT).then(|| (TAU / a).sqrt() * (-0.5 * e).exp())
}

impl Mixture {
    /// The line integrals of `rays`, in cube sides.
    pub(super) fn line_integrals<R: Real>(&self, params: &[R], rays: &[UnitRay], out: &mut [R]) {
        let mut sums = vec![0.0; rays.len()];
        if let Some(bundle) = Bundle::of(rays) {
            for p in present(params).filter(|p| bundle.near(p)) {
                let shape = Shape::of(p);
                for (sum, ray) in sums.iter_mut().zip(rays) {
                    *sum += along(&shape, ray).map_or(0.0, |line| shape.density * line);
                }
            }
        }
        out.iter_mut().zip(sums).for_each(|(out, sum)| *out = R::of(sum));
    }
}

impl Lines for Mixture {
    fn project(&self, params: &[f32], rays: &[UnitRay], out: &mut [f32]) {
        self.line_integrals(params, rays, out);
    }

    fn on_device(&self, device: Box<dyn Device>) -> Result<Box<dyn OnDevice>> {
        Ok(Box::new(DeviceMixture::new(device, self.most)?))
    }
}

impl OnGrid for Mixture {
    fn values(&self, params: &[f32], points: &UnitGrid, out: &mut [f32]) {
        let shapes = shapes(params);
        let mut grid = Grid::default();
        grid.look(points, &shapes);
        grid.values(points, &shapes, out);
    }
}

impl Stage for Mixture {
    fn info(&self) -> Info {
        let (scope, grads) = (Scope::Row, GradKind::Scatter);
        let params = NUMBERS * self.most;
        Info { input: 3, output: 1, params, tape: 0, scope, grads, macs: 0, identity: false }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![Parameter { name: "gaussians".into(), shape: vec![self.most, NUMBERS], start: 0 }]
    }

    /// All slots are free.
    fn init(&self, _: u64, params: &mut [f32]) {
        for p in params.chunks_mut(NUMBERS) {
            p.fill(0.0);
            (p[ROTATION], p[DENSITY]) = (1.0, FREE);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        let all = NUMBERS * self.most;
        (0..all).step_by(CHUNK * NUMBERS).map(|at| at..(at + CHUNK * NUMBERS).min(all)).collect()
    }

    fn describe(&self) -> String {
        format!("gaussians: {} slots", self.most)
    }
}

impl Field for Mixture {
    fn lines(&self) -> Option<&dyn Lines> {
        Some(self)
    }

    fn on_grid(&self) -> Option<&dyn OnGrid> {
        Some(self)
    }
}
