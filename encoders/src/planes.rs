//! Features on planes, at several levels: points `[n, 3]` in the unit cube to features, from tables of `R²` numbers
//! instead of `R³`. Each of the three orientations has a plane `P(a, b)`, interpolated bilinearly at two coordinates.
//!
//! - `form = "vector-matrix"` (Chen et al. 2022, TensoRF, section 4.1, VM decomposition): for each orientation
//!   `y = P(a, b)·L(c)`, where `L` is a line, interpolated linearly at the third coordinate. `3·features` channels per
//!   level.
//! - `form = "tri-plane"` (Chan et al. 2022, EG3D, section 4.1): `y = P(x, y) + P(x, z) + P(y, z)`. `features` channels
//!   per level.
//!
//! A level with `r` cells per side has `r + 1` nodes along each axis, at the corners of its cells, which fill the cube
//! exactly.

use crate::levels::{self, BLOCK, Cells, Levels, Rows, finest, grid};
use conefield_core::prelude::*;
use conefield_core::simd::Simd;
use std::ops::{Range, RangeInclusive};

/// How the planes of a level are combined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// Each is multiplied with a line along the third axis (TensoRF).
    VectorMatrix,
    /// They are added (EG3D).
    TriPlane,
}

/// Settings of `planes`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Planes {
    /// How the planes of a level are combined.
    pub form: Form,
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per plane: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions, at least 1. Resolutions are rounded to whole cells.
    pub growth: f64,
}

impl Default for Planes {
    fn default() -> Self {
        Self { form: Form::VectorMatrix, levels: 4, features: 4, base_resolution: 32, growth: 2.0 }
    }
}

grid! {
    "planes", Planes of Factor,
    "planes and lines, or three planes, of features on several levels",
    example = r#"{"levels": 2, "base_resolution": 4}"#
}

/// Resolution limit of the finest level.
const FINEST: f64 = 8192.0;

/// The two axes of each plane, and the axis of its line.
const AXES: [[usize; 3]; 3] = [[0, 1, 2], [0, 2, 1], [1, 2, 0]];

/// A plane, and its line if it has one: one orientation of one level.
#[derive(Debug, Clone)]
struct Factor {
    cells: u32,
    orientation: usize,
    form: Form,
}

impl Factor {
    /// Nodes along an axis.
    fn nodes(&self) -> usize {
        self.cells as usize + 1
    }

    /// Numbers in the plane.
    fn plane(&self, features: usize) -> usize {
        self.nodes() * self.nodes() * features
    }

    fn has_line(&self) -> bool {
        self.form == Form::VectorMatrix
    }
}

/// A position on a plane and its line: entries and weights of the plane's four surrounding corners, entry of the line's
/// first node and the weights of both nodes.
struct Place<R> {
    corners: [usize; 4],
    weights: [R; 4],
    node: usize,
    line: [R; 2],
}

impl<R: Real> Place<R> {
    /// The position of row `i`, on a plane of this orientation with `nodes` nodes per side.
    #[inline(always)]
    fn of(at: &Cells<R>, orientation: usize, nodes: usize, i: usize) -> Self {
        let [a, b, c] = AXES[orientation];
        let (f, g, h) = (at.fraction[a][i], at.fraction[b][i], at.fraction[c][i]);
        let first = at.cell[a][i] as usize * nodes + at.cell[b][i] as usize;
        let (a, b) = ([R::ONE - f, f], [R::ONE - g, g]);
        Self {
            corners: [first, first + 1, first + nodes, first + nodes + 1],
            weights: [a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]],
            node: at.cell[c][i] as usize,
            line: [R::ONE - h, h],
        }
    }
}

/// The plane's value.
#[inline(always)]
fn on_plane<R: Real, const F: usize>(plane: &[[R; F]], at: &Place<R>) -> [R; F] {
    let mut sum = [R::ZERO; F];
    for c in 0..4 {
        let entry = &plane[at.corners[c]];
        for f in 0..F {
            sum[f] += at.weights[c] * entry[f];
        }
    }
    sum
}

/// The line's value.
#[inline(always)]
fn on_line<R: Real, const F: usize>(line: &[[R; F]], at: &Place<R>) -> [R; F] {
    let mut sum = [R::ZERO; F];
    let [near, far] = [&line[at.node], &line[at.node + 1]];
    for f in 0..F {
        sum[f] = at.line[0] * near[f] + at.line[1] * far[f];
    }
    sum
}

impl levels::Level for Factor {
    type Settings = Planes;
    type Located<R: Real> = Cells<R>;

    const BASE: (RangeInclusive<u32>, &'static str) = (1..=8192, "1 to 8192 cells per side");
    const WGSL: &'static [&'static str] = &[include_str!("planes.wgsl")];

    fn parts(s: &Planes, number: usize, resolution: f64, _: usize) -> Result<Vec<Self>> {
        let cells = resolution.round();
        finest(number, cells, FINEST, "at most 8192 cells per side: fewer levels, less growth")?;
        Ok((0..3).map(|orientation| Self { cells: cells as u32, orientation, form: s.form }).collect())
    }

    fn adds(&self) -> bool {
        self.form == Form::TriPlane && self.orientation > 0
    }

    fn resolution(&self) -> f64 {
        f64::from(self.cells)
    }

    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)> {
        let (n, name) = (self.nodes(), self.orientation);
        let mut all = vec![(format!("{name}.plane"), vec![n, n, features])];
        if self.has_line() {
            all.push((format!("{name}.line"), vec![n, features]));
        }
        all
    }

    /// Planes are initialized near 0, like the features of other grids; lines start at 1, so that planes learn.
    fn init(&self, features: usize, params: &mut [f32]) {
        params[self.plane(features)..].fill(1.0);
    }

    fn macs(features: usize) -> usize {
        7 * features + 8
    }

    #[inline(always)]
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Cells<R>, x: Tile<'_, R>, at: usize, n: usize) {
        to.locate(s, self.cells, x, at, n);
    }

    #[inline(always)]
    fn gather<S: Simd, R: Real, const F: usize>(&self, _: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]) {
        let &Rows { located, table, n } = rows;
        let (plane, line) = table.split_at(self.plane(1));
        for i in 0..n {
            let place = Place::of(located, self.orientation, self.nodes(), i);
            let mut value = on_plane(plane, &place);
            if self.has_line() {
                let along = on_line(line, &place);
                for f in 0..F {
                    value[f] *= along[f];
                }
            } else if self.adds() {
                for f in 0..F {
                    value[f] += out[i][f];
                }
            }
            out[i] = value;
        }
    }

    #[inline(always)]
    fn scatter<S: Simd, R: Real, const F: usize>(
        &self,
        _: S,
        rows: &Rows<'_, Self, R, F>,
        dy: &[[R; F]; BLOCK],
        grads: &mut [R],
        _: &Range<usize>,
    ) {
        let &Rows { located, table, n } = rows;
        let (plane, line) = table.split_at(self.plane(1));
        let (plane_grads, line_grads) = grads.as_chunks_mut::<F>().0.split_at_mut(self.plane(1));
        for i in 0..n {
            let place = Place::of(located, self.orientation, self.nodes(), i);
            // The gradient with respect to the plane's value.
            let mut worth = dy[i];
            if self.has_line() {
                let along = on_line(line, &place);
                for f in 0..F {
                    worth[f] *= along[f];
                }
            }
            for c in 0..4 {
                let to = &mut plane_grads[place.corners[c]];
                for f in 0..F {
                    to[f] += place.weights[c] * worth[f];
                }
            }
            if self.has_line() {
                let value = on_plane(plane, &place);
                for k in 0..2 {
                    let to = &mut line_grads[place.node + k];
                    for f in 0..F {
                        to[f] += place.line[k] * (dy[i][f] * value[f]);
                    }
                }
            }
        }
    }

    fn move_to<R: Real>(&self, to: &mut Cells<R>, d: usize, end: R) {
        to.fraction[d] = [end; BLOCK];
    }

    fn code(&self) -> String {
        format!("{}u, {}u", self.cells, self.orientation)
    }

    fn constants(s: &Planes) -> String {
        format!("const stage_LINES = {};\n", s.form == Form::VectorMatrix)
    }

    fn of(s: &Planes) -> &'static str {
        if s.form == Form::VectorMatrix { " of planes and lines" } else { " of three planes" }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type PlanesStage = Levels<Factor>;

    /// Nodes are at the positions that the shape implies, and planes use the axes in the formula.
    #[test]
    fn planes_and_lines_follow_the_formula() {
        let x = [0.75, 0.5, 0.125f64];
        for form in [Form::VectorMatrix, Form::TriPlane] {
            let settings = Planes { form, levels: 2, features: 1, base_resolution: 2, growth: 1.5 };
            let stage = PlanesStage::new(&settings).unwrap();
            let mut params = vec![0.0f64; stage.info().params];
            for p in stage.parameters() {
                let level: f64 = p.name[..1].parse().unwrap();
                let side = p.shape[0];
                for (n, value) in params[p.range()].iter_mut().enumerate() {
                    let plane = p.name.ends_with("plane");
                    // Linear in both coordinates, so that interpolation is exact.
                    let at = [n / side, n % side].map(|k| k as f64 / (side - 1) as f64);
                    *value =
                        1.0 + level + if plane { 10.0 * at[0] + at[1] } else { 2.0 * n as f64 / (side - 1) as f64 };
                }
            }
            let mut y = vec![0.0; stage.info().output];
            stage.forward(&params, Tile::new(&x, 1), TileMut::new(&mut y, 1), TileMut::new(&mut [], 1));
            let mut want = vec![];
            for level in [1.0, 2.0] {
                let planes = AXES.map(|[a, b, _]| level + 10.0 * x[a] + x[b]);
                match form {
                    Form::VectorMatrix => want.extend((0..3).map(|o| planes[o] * (level + 2.0 * x[AXES[o][2]]))),
                    Form::TriPlane => want.push(planes.iter().sum()),
                }
            }
            assert!(y.iter().zip(&want).all(|(y, w)| (y - w).abs() < 1e-12), "{form:?}: {y:?} {want:?}");
        }
    }
}
