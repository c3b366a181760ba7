//! Multi-resolution dense grid: points `[n, 3]` in the unit cube to `[n, levels·features]`; on each level the features
//! of the 8 corners of the point's cell, trilinearly interpolated, as in a hash grid (Müller et al. 2022, section 3)
//! whose tables hold every vertex.
//!
//! A level with `r` cells per side has `(r + 1)³` vertices at the corners of its cells, which fill the cube exactly:
//! `p = clamp(x, 0, 1)·r`.

use crate::levels::{self, BLOCK, Levels, Rows, SUMS, cube, grid};
use conefield_core::prelude::*;
use conefield_core::simd::Simd;
use conefield_core::trilinear::{Grid, Located};
use conefield_core::wgsl::TRILINEAR;
use std::ops::{Range, RangeInclusive};

/// Settings of `dense-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DenseGrid {
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions, at least 1. Resolutions are rounded to whole cells.
    pub growth: f64,
}

impl Default for DenseGrid {
    fn default() -> Self {
        Self { levels: 4, features: 2, base_resolution: 16, growth: 2.0 }
    }
}

grid! {
    "dense-grid", DenseGrid of DenseLevel,
    "multi-resolution grid without hashing",
    example = r#"{"levels": 3, "base_resolution": 4}"#
}

#[derive(Debug, Clone)]
struct DenseLevel {
    grid: Grid,
    /// From the first corner of a cell to the others.
    offsets: [usize; 8],
}

impl levels::Level for DenseLevel {
    type Settings = DenseGrid;
    type Located<R: Real> = Located<R>;

    const BASE: (RangeInclusive<u32>, &'static str) = (1..=1 << 20, "1 to 2^20 cells per side");
    const WGSL: &'static [&'static str] = &[TRILINEAR, SUMS, include_str!("dense_grid.wgsl")];

    fn parts(s: &DenseGrid, number: usize, resolution: f64, before: usize) -> Result<Vec<Self>> {
        let resolution = resolution.round();
        cube(number, resolution, 1, "vertices", s.features, before)?;
        let grid = Grid::corners([resolution as usize; 3]);
        Ok(vec![Self { offsets: grid.offsets(), grid }])
    }

    fn resolution(&self) -> f64 {
        (self.grid.side()[0] - 1) as f64
    }

    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)> {
        vec![("table".into(), self.grid.side().into_iter().chain([features]).collect())]
    }

    /// Planes of equal x.
    fn slices(&self) -> usize {
        self.grid.side()[0]
    }

    fn macs(features: usize) -> usize {
        8 * features + 16
    }

    #[inline(always)]
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Located<R>, x: Tile<'_, R>, at: usize, n: usize) {
        to.locate(s, &self.grid, x, at, n);
    }

    #[inline(always)]
    fn gather<S: Simd, R: Real, const F: usize>(&self, _: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]) {
        let &Rows { located, table, n } = rows;
        let offsets = self.offsets;
        for i in 0..n {
            out[i] = located.gather(i, &offsets, table);
        }
    }

    #[inline(always)]
    fn scatter<S: Simd, R: Real, const F: usize>(
        &self,
        _: S,
        rows: &Rows<'_, Self, R, F>,
        dy: &[[R; F]; BLOCK],
        grads: &mut [R],
        own: &Range<usize>,
    ) {
        let &Rows { located, n, .. } = rows;
        let offsets = self.offsets;
        for i in 0..n {
            // A copy is in registers: the compiler cannot tell whether writing to `grads` changes the original.
            let dy = dy[i];
            located.scatter(i, &offsets, &dy, grads, own);
        }
    }

    fn move_to<R: Real>(&self, to: &mut Located<R>, d: usize, end: R) {
        to.move_to(d, end);
    }

    fn code(&self) -> String {
        let ([x, y, z], [sx, sy, sz]) = (self.grid.side(), self.grid.strides());
        let cells = (x - 1) as f32;
        format!("vec3<u32>({x}u, {y}u, {z}u), vec3<u32>({sx}u, {sy}u, {sz}u), {cells:?}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type DenseGridStage = Levels<DenseLevel>;

    #[test]
    fn vertices_have_the_stated_shape_and_place() {
        let stage =
            DenseGridStage::new(&DenseGrid { levels: 2, features: 1, base_resolution: 2, growth: 1.5 }).unwrap();
        let names: Vec<_> = stage.parameters().into_iter().map(|p| (p.name, p.shape)).collect();
        assert_eq!(names, [("0.table".into(), vec![3, 3, 3, 1]), ("1.table".into(), vec![4, 4, 4, 1])]);
        // Each vertex of level 0 holds 100·i + 10·j + k, which is linear, so that interpolation is exact.
        let mut params = vec![0.0f64; stage.info().params];
        for v in 0..27 {
            params[v] = (100 * (v / 9) + 10 * (v / 3 % 3) + v % 3) as f64;
        }
        let mut y = vec![0.0; 2];
        let x = [0.75, 0.5, 0.125];
        stage.forward(&params, Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
        assert!((y[0] - (150.0 + 10.0 + 0.25)).abs() < 1e-12 && y[1] == 0.0, "{y:?}");
    }
}
