//! Trilinear interpolation on a regular grid over the unit cube, with its gradient and adjoint.
//!
//! Grids of vertices ([`Grid::corners`]) and of voxel centres ([`Grid::centres`]) share the arithmetic. Vertex
//! `(x, y, z)` is entry `(x·n_y + y)·n_z + z`: row-major, shape `[n_x, n_y, n_z]`. Along an axis of `n` vertices the
//! position is `p = clamp(x·scale + shift, 0, n − 1)`, the cell is `⌊p⌋` (the last cell if `p = n − 1`) and the
//! fraction is the remainder.

use crate::simd::{Real, Simd, SimdBase, SimdFloat, V, load, store};
use crate::stage::Tile;
use std::ops::Range;

/// Rows located together: [`Located`] fits into the L1 cache.
pub const BLOCK: usize = 64;

/// The positions of a grid's vertices.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    side: [usize; 3],
    scale: [f64; 3],
    shift: f64,
}

impl Grid {
    /// Vertices at the corners of `cells` cells per axis, which fill the cube: `cells + 1` vertices, `p = x·cells`. A
    /// point outside the cube is clamped to its surface.
    pub fn corners(cells: [usize; 3]) -> Self {
        Self { side: cells.map(|n| n + 1), scale: cells.map(|n| n as f64), shift: 0.0 }
    }

    /// Vertices at the centres of `voxels` voxels per axis, which fill the cube: `p = x·voxels − 1/2`. Values are
    /// constant within half a voxel of the surface.
    pub fn centres(voxels: [usize; 3]) -> Self {
        Self { side: voxels, scale: voxels.map(|n| n as f64), shift: -0.5 }
    }

    /// Number of vertices along x, y, z.
    pub fn side(&self) -> [usize; 3] {
        self.side
    }

    /// Total number of vertices.
    pub fn entries(&self) -> usize {
        self.side.iter().product()
    }

    /// Strides to the next vertex along x, y, z; 0 along an axis with one vertex, which is its own neighbour.
    pub fn strides(&self) -> [usize; 3] {
        let [x, y, z] = self.side;
        let step = |n: usize, s: usize| if n > 1 { s } else { 0 };
        [step(x, y * z), step(y, z), step(z, 1)]
    }

    /// Offsets from a cell's first corner to its corner `c`, which is further along x, y, z if bits 0, 1, 2 are set.
    pub fn offsets(&self) -> [usize; 8] {
        let s = self.strides();
        std::array::from_fn(|c| (0..3).map(|d| (c >> d & 1) * s[d]).sum())
    }

    /// Derivative of the position along axis `d` with respect to the coordinate `x`: 0 where it is clamped.
    pub fn stretch<R: Real>(&self, d: usize, x: R) -> R {
        let scale = R::of(self.scale[d]);
        let p = x * scale + R::of(self.shift);
        let inside = p >= R::ZERO && p <= R::of(self.side[d] as f64 - 1.0);
        if inside { scale } else { R::ZERO }
    }

    /// [`slabs`] of whole planes of equal x.
    pub fn slabs(&self, most: usize) -> Vec<Range<usize>> {
        slabs(self.side[0], self.side[1] * self.side[2], most).collect()
    }
}

/// Disjoint ranges that cover `planes` planes of `plane` entries each: enough to keep each below `most` entries, but at
/// most 16, because each range reads every row again.
pub fn slabs(planes: usize, plane: usize, most: usize) -> impl Iterator<Item = Range<usize>> {
    let pieces = (planes * plane).div_ceil(most.max(1)).clamp(1, 16).min(planes);
    (0..pieces).map(move |i| i * planes / pieces * plane..(i + 1) * planes / pieces * plane)
}

/// Locations of up to [`BLOCK`] rows on a grid.
#[derive(Debug, Clone)]
pub struct Located<R> {
    cell: [[u32; BLOCK]; 3],
    base: [usize; BLOCK],
    fraction: [[R; BLOCK]; 3],
}

impl<R: Real> Default for Located<R> {
    fn default() -> Self {
        Self { cell: [[0; BLOCK]; 3], base: [0; BLOCK], fraction: [[R::ZERO; BLOCK]; 3] }
    }
}

impl<R: Real> Located<R> {
    /// Locates rows `at..at + n` of `x` (`[3][rows]`, unit cube), `n` at most [`BLOCK`]. A NaN coordinate counts as 0,
    /// so that it cannot reach other rows through a gradient.
    #[inline(always)]
    pub fn locate<S: Simd>(&mut self, s: S, grid: &Grid, x: Tile<'_, R>, at: usize, n: usize) {
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let zero = number(0.0);
        for d in 0..3 {
            let x = &x.channel(d)[at..at + n];
            let top = grid.side[d] - 1;
            let (scale, shift, top, last) =
                (number(grid.scale[d]), number(grid.shift), number(top as f64), number(top.saturating_sub(1) as f64));
            let mut i = 0;
            while i < n {
                let p = load(s, x, i).mul_add(scale, shift);
                // The precise forms return the other operand if one is NaN.
                let p = p.max_precise(zero).min_precise(top);
                let c = p.floor().min(last);
                store::<S, R>(p - c, &mut self.fraction[d][..n], i);
                R::cells(s, c, &mut self.cell[d][i..n]);
                i += V::<S, R>::LEN;
            }
        }
        let [sx, sy, sz] = grid.strides();
        for i in 0..n {
            self.base[i] =
                self.cell[0][i] as usize * sx + self.cell[1][i] as usize * sy + self.cell[2][i] as usize * sz;
        }
    }

    /// The first corner of row `i`'s cell.
    #[inline(always)]
    pub fn base(&self, i: usize) -> usize {
        self.base[i]
    }

    /// Weights of the 8 corners of row `i`'s cell, in the order of [`Grid::offsets`]. They add to 1.
    #[inline(always)]
    pub fn weights(&self, i: usize) -> [R; 8] {
        let f = self.fraction.each_ref().map(|f| [R::ONE - f[i], f[i]]);
        std::array::from_fn(|c| f[0][c & 1] * f[1][c >> 1 & 1] * f[2][c >> 2])
    }

    /// Moves all rows to an end of their cells along axis `d`, 0 or 1. An interpolated value is linear in between: at end
    /// 1, less that at end 0, it is the derivative with respect to the position.
    pub fn move_to(&mut self, d: usize, end: R) {
        self.fraction[d] = [end; BLOCK];
    }

    /// The interpolated features of row `i` from `table`, the grid's entries.
    #[inline(always)]
    pub fn gather<const F: usize>(&self, i: usize, offsets: &[usize; 8], table: &[[R; F]]) -> [R; F] {
        let weights = self.weights(i);
        let cell = &table[self.base[i]..];
        let mut sum = [R::ZERO; F];
        for c in 0..8 {
            let entry = &cell[offsets[c]];
            for f in 0..F {
                sum[f] += weights[c] * entry[f];
            }
        }
        sum
    }

    /// Adds row `i`'s `dy` to the corners in `own`, a range of the grid's numbers (entry `e`, feature `f` is number
    /// `e·F + f`). `grads` holds the gradients of that range.
    #[inline(always)]
    pub fn scatter<const F: usize>(
        &self,
        i: usize,
        offsets: &[usize; 8],
        dy: &[R; F],
        grads: &mut [R],
        own: &Range<usize>,
    ) {
        let base = self.base[i];
        let (first, end) = (base * F, (base + offsets[7] + 1) * F);
        if end <= own.start || own.end <= first {
            return;
        }
        let weights = self.weights(i);
        let whole = own.start <= first && end <= own.end;
        for c in 0..8 {
            let entry = (base + offsets[c]) * F;
            if whole || (own.start <= entry && entry + F <= own.end) {
                let g = &mut grads[entry - own.start..][..F];
                for f in 0..F {
                    g[f] += weights[c] * dy[f];
                }
            } else {
                for f in 0..F {
                    if own.contains(&(entry + f)) {
                        grads[entry + f - own.start] += weights[c] * dy[f];
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Op, run};

    struct At<'a>(&'a Grid, &'a [f64]);
    impl Op for At<'_> {
        type Number = f64;
        type Out = Located<f64>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Located<f64> {
            let mut l = Located::default();
            l.locate(s, self.0, Tile::new(self.1, 1), 0, 1);
            l
        }
    }

    fn value(grid: &Grid, f: impl Fn([f64; 3]) -> f64, x: [f64; 3]) -> (f64, [f64; 3]) {
        let [nx, ny, nz] = grid.side();
        let mut table = vec![];
        for i in 0..nx {
            for j in 0..ny {
                for k in 0..nz {
                    table.push([f([i as f64, j as f64, k as f64])]);
                }
            }
        }
        let l = run(At(grid, &x));
        let offsets = grid.offsets();
        let slope = |d: usize| {
            let [near, far] = [0.0, 1.0].map(|end| {
                let mut moved = l.clone();
                moved.move_to(d, end);
                moved.gather(0, &offsets, &table)[0]
            });
            (far - near) * grid.stretch(d, x[d])
        };
        (l.gather(0, &offsets, &table)[0], [0, 1, 2].map(slope))
    }

    #[test]
    fn a_linear_function_is_interpolated_exactly() {
        let f = |p: [f64; 3]| 1.0 + 2.0 * p[0] - 3.0 * p[1] + 0.5 * p[2];
        let corners = Grid::corners([4, 3, 5]);
        for x in [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.3, 0.71, 0.999], [0.5, 1.0 / 3.0, 0.2]] {
            let (v, d) = value(&corners, f, x);
            let want = f([4.0 * x[0], 3.0 * x[1], 5.0 * x[2]]);
            assert!((v - want).abs() < 1e-12, "{x:?}: {v} {want}");
            assert!((d[0] - 8.0).abs() < 1e-12 && (d[1] + 9.0).abs() < 1e-12 && (d[2] - 2.5).abs() < 1e-12, "{d:?}");
        }
        let centres = Grid::centres([4, 2, 1]);
        let (v, d) = value(&centres, f, [0.5, 0.4, 0.9]);
        assert!((v - f([1.5, 0.3, 0.0])).abs() < 1e-12);
        assert!((d[0] - 8.0).abs() < 1e-12 && (d[1] + 6.0).abs() < 1e-12 && d[2] == 0.0, "{d:?}");
    }

    #[test]
    fn points_outside_and_nan_stay_on_the_grid() {
        let f = |p: [f64; 3]| p[0] + 10.0 * p[1] + 100.0 * p[2];
        let grid = Grid::corners([2, 2, 2]);
        let (v, d) = value(&grid, f, [-3.0, f64::INFINITY, f64::NAN]);
        assert_eq!((v, d), (20.0, [0.0; 3]));
        assert_eq!(value(&Grid::centres([2, 2, 2]), f, [0.1, 0.95, 1e300]), (110.0, [0.0; 3]));
    }

    #[test]
    fn slabs_are_disjoint_and_cover() {
        for (grid, most) in
            [(Grid::corners([6, 4, 2]), 20), (Grid::centres([1, 9, 9]), 3), (Grid::centres([40, 2, 2]), 1)]
        {
            let slabs = grid.slabs(most);
            assert!(slabs.len() <= 16);
            let mut end = 0;
            for s in &slabs {
                assert!(s.start == end && s.end > s.start);
                end = s.end;
            }
            assert_eq!(end, grid.entries());
        }
    }
}
