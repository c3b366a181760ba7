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

use crate::levels::{
    Asked, BLOCK, Cells, LevelCode, Table, by_channel, by_features, functions, kernel_of_levels, start, stretch,
};
use conefield_core::error::{Result, ensure};
use conefield_core::settings::EncoderSpec;
use conefield_core::simd::{Op, Real, Simd, run};
use conefield_core::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Reduced, Scope, Stage, Tile, TileMut};
use conefield_core::wgsl::Fragment;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

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

conefield_core::stage_type!(
    Encoder,
    "planes",
    Planes,
    "planes and lines, or three planes, of features on several levels",
    example = r#"{"levels": 2, "base_resolution": 4}"#
);

#[typetag::serde(name = "planes")]
impl EncoderSpec for Planes {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(PlanesStage::new(self)?))
    }
}

/// Resolution limit of the finest level.
const FINEST: f64 = 8192.0;

/// The two axes of each plane, and the axis of its line.
const AXES: [[usize; 3]; 3] = [[0, 1, 2], [0, 2, 1], [1, 2, 0]];

/// A plane, and its line if it has one: one orientation of one level.
#[derive(Debug, Clone, PartialEq)]
struct Factor {
    table: Table,
    orientation: usize,
}

#[derive(Debug, Clone, PartialEq)]
struct Level {
    cells: u32,
    factors: Vec<Factor>,
}

impl Level {
    /// Nodes along an axis.
    fn nodes(&self) -> usize {
        self.cells as usize + 1
    }
}

/// The stage that [`Planes`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanesStage {
    form: Form,
    features: usize,
    levels: Vec<Level>,
    params: usize,
    outputs: usize,
}

impl PlanesStage {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &Planes) -> Result<Self> {
        let s = settings;
        ensure((1..=32).contains(&s.levels), "spec", "levels", s.levels, "1 to 32")?;
        ensure([1, 2, 4, 8].contains(&s.features), "spec", "features", s.features, "1, 2, 4 or 8")?;
        let base = s.base_resolution;
        ensure((1..=8192).contains(&base), "spec", "base_resolution", base, "1 to 8192 cells per side")?;
        ensure((1.0..=16.0).contains(&s.growth), "spec", "growth", s.growth, "1 to 16")?;
        let mut stage = Self { form: s.form, features: s.features, levels: vec![], params: 0, outputs: 0 };
        for number in 0..s.levels {
            let cells = (f64::from(base) * s.growth.powi(number as i32)).round();
            let found = format!("level {number} with {cells:.0} cells per side");
            ensure(cells <= FINEST, "spec", "levels", found, "at most 8192 cells per side: fewer levels, less growth")?;
            let mut level = Level { cells: cells as u32, factors: vec![] };
            for orientation in 0..3 {
                let first = stage.outputs + if s.form == Form::VectorMatrix { orientation * s.features } else { 0 };
                let outputs = (first..first + s.features).map(Some).collect();
                let len = stage.factor(level.nodes());
                level.factors.push(Factor { table: Table { start: stage.params, len, number, outputs }, orientation });
                stage.params += len;
            }
            stage.outputs += s.features * if s.form == Form::VectorMatrix { 3 } else { 1 };
            stage.levels.push(level);
        }
        Ok(stage)
    }

    /// Numbers in a plane with `nodes` nodes per axis.
    fn plane(&self, nodes: usize) -> usize {
        nodes * nodes * self.features
    }

    /// Numbers in a plane and its line, if it has one.
    fn factor(&self, nodes: usize) -> usize {
        let line = if self.form == Form::VectorMatrix { nodes * self.features } else { 0 };
        self.plane(nodes) + line
    }

    fn factors(&self) -> impl Iterator<Item = (&Level, &Factor)> {
        self.levels.iter().flat_map(|l| l.factors.iter().map(move |f| (l, f)))
    }
}

/// A position on a plane and its line: entries and weights of the plane's four surrounding corners, entry of the line's
/// first node and the weights of both nodes.
struct Place<R> {
    corners: [usize; 4],
    weights: [R; 4],
    node: usize,
    line: [R; 2],
    /// For both coordinates on the plane: the weights of the node and of the next one.
    plane: [[R; 2]; 2],
}

impl<R: Real> Place<R> {
    /// The position of row `i`, on a plane of this orientation with `nodes` nodes per side.
    #[inline(always)]
    fn of(at: &Cells<R>, orientation: usize, nodes: usize, i: usize) -> Self {
        let [a, b, c] = AXES[orientation];
        let (f, g, h) = (at.fraction[a][i], at.fraction[b][i], at.fraction[c][i]);
        let first = at.cell[a][i] as usize * nodes + at.cell[b][i] as usize;
        let plane = [[R::ONE - f, f], [R::ONE - g, g]];
        Self {
            corners: [first, first + 1, first + nodes, first + nodes + 1],
            weights: products(plane[0], plane[1]),
            node: at.cell[c][i] as usize,
            line: [R::ONE - h, h],
            plane,
        }
    }
}

/// The weights of the corners of a plane's cell.
#[inline(always)]
fn products<R: Real>(a: [R; 2], b: [R; 2]) -> [R; 4] {
    [a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]]
}

/// `Σ weights·plane` at the corners.
#[inline(always)]
fn on_plane<R: Real, const F: usize>(plane: &[[R; F]], at: &Place<R>, weights: [R; 4]) -> [R; F] {
    let mut sum = [R::ZERO; F];
    for c in 0..4 {
        let entry = &plane[at.corners[c]];
        for f in 0..F {
            sum[f] += weights[c] * entry[f];
        }
    }
    sum
}

/// `Σ weights·line` at both nodes.
#[inline(always)]
fn on_line<R: Real, const F: usize>(line: &[[R; F]], at: &Place<R>, weights: [R; 2]) -> [R; F] {
    let mut sum = [R::ZERO; F];
    let [near, far] = [&line[at.node], &line[at.node + 1]];
    for f in 0..F {
        sum[f] = weights[0] * near[f] + weights[1] * far[f];
    }
    sum
}

struct Forward<'a, R> {
    stage: &'a PlanesStage,
    levels: Range<usize>,
    params: &'a [R],
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
}

impl<R: Real> Forward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut cells = Cells::new();
        for level in &self.stage.levels[self.levels.clone()] {
            let nodes = level.nodes();
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                cells.locate(s, level.cells, self.x, at, n);
                let mut out = [[R::ZERO; F]; BLOCK];
                for factor in &level.factors {
                    let (table, _) = self.params[factor.table.range()].as_chunks::<F>();
                    let (plane, line) = table.split_at(nodes * nodes);
                    for i in 0..n {
                        let place = Place::of(&cells, factor.orientation, nodes, i);
                        let mut value = on_plane(plane, &place, place.weights);
                        if self.stage.form == Form::VectorMatrix {
                            let along = on_line(line, &place, place.line);
                            for f in 0..F {
                                out[i][f] = value[f] * along[f];
                            }
                        } else {
                            for f in 0..F {
                                value[f] += out[i][f];
                            }
                            out[i] = value;
                        }
                    }
                    // The last plane of a sum writes the result.
                    factor.table.put(&out, &mut self.y, at, n);
                }
            }
        }
    }
}

struct Backward<'a, R> {
    stage: &'a PlanesStage,
    params: &'a [R],
    x: Tile<'a, R>,
    dy: Tile<'a, R>,
    grads: Grads<'a, R>,
    dx: Option<TileMut<'a, R>>,
}

impl<R: Real> Backward<'_, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut cells = Cells::new();
        let mut dy = [[R::ZERO; F]; BLOCK];
        if let Some(dx) = &mut self.dx {
            dx.data.fill(R::ZERO);
        }
        let lines = self.stage.form == Form::VectorMatrix;
        for (level, factor) in self.stage.factors() {
            let mut asked = Asked::of(&self.grads, &factor.table.range());
            if asked.is_empty() && self.dx.is_none() {
                continue;
            }
            let nodes = level.nodes();
            let [a, b, c] = AXES[factor.orientation];
            let (table, _) = self.params[factor.table.range()].as_chunks::<F>();
            let (plane, line) = table.split_at(nodes * nodes);
            let (grads, _) = asked.values(&mut self.grads).as_chunks_mut::<F>();
            let (plane_grads, line_grads) = grads.split_at_mut(grads.len().min(nodes * nodes));
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                factor.table.take(self.dy, &mut dy, at, n);
                cells.locate(s, level.cells, self.x, at, n);
                for i in 0..n {
                    let place = Place::of(&cells, factor.orientation, nodes, i);
                    // The gradient with respect to the plane's value.
                    let mut worth = dy[i];
                    if lines {
                        let along = on_line(line, &place, place.line);
                        for f in 0..F {
                            worth[f] *= along[f];
                        }
                    }
                    if !plane_grads.is_empty() {
                        for c in 0..4 {
                            let to = &mut plane_grads[place.corners[c]];
                            for f in 0..F {
                                to[f] += place.weights[c] * worth[f];
                            }
                        }
                    }
                    if !line_grads.is_empty() {
                        let value = on_plane(plane, &place, place.weights);
                        for k in 0..2 {
                            let to = &mut line_grads[place.node + k];
                            for f in 0..F {
                                to[f] += place.line[k] * (dy[i][f] * value[f]);
                            }
                        }
                    }
                    let Some(dx) = &mut self.dx else { continue };
                    let ends = [R::ZERO - R::ONE, R::ONE];
                    let along_a = on_plane(plane, &place, products(ends, place.plane[1]));
                    let along_b = on_plane(plane, &place, products(place.plane[0], ends));
                    let dot = |v: [R; F], w: [R; F]| (0..F).map(|f| v[f] * w[f]).sum::<R>();
                    let mut slopes = vec![(a, dot(along_a, worth)), (b, dot(along_b, worth))];
                    if lines {
                        let value = on_plane(plane, &place, place.weights);
                        let along = on_line(line, &place, ends);
                        slopes.push((c, (0..F).map(|f| dy[i][f] * value[f] * along[f]).sum()));
                    }
                    for (d, slope) in slopes {
                        dx.channel(d)[at + i] += slope * stretch(self.x.channel(d)[at + i], level.cells);
                    }
                }
            }
            asked.finish(&mut self.grads);
        }
    }
}

by_features!(Forward);
by_features!(Backward);

kernel_of_levels!(PlanesStage);

impl Stage for PlanesStage {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: self.outputs,
            params: self.params,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Scatter,
            macs: self.factors().count() * (7 * self.features + 8),
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let mut all = vec![];
        for (level, factor) in self.factors() {
            let (n, f, table) = (level.nodes(), self.features, &factor.table);
            let name = format!("{}.{}", table.number, factor.orientation);
            all.push(Parameter { name: format!("{name}.plane"), shape: vec![n, n, f], start: table.start });
            if self.form == Form::VectorMatrix {
                let start = table.start + self.plane(n);
                all.push(Parameter { name: format!("{name}.line"), shape: vec![n, f], start });
            }
        }
        all
    }

    /// Planes are initialized near 0, like the features of other grids; lines start at 1, so that planes learn.
    fn init(&self, seed: u64, params: &mut [f32]) {
        start(seed, params);
        for (level, factor) in self.factors() {
            params[factor.table.start + self.plane(level.nodes())..factor.table.range().end].fill(1.0);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// A plane and its line per worker.
    fn partition(&self) -> Vec<Range<usize>> {
        self.factors().map(|(_, f)| f.table.range()).collect()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let mut levels = vec![];
        for level in &self.levels {
            // Planes that are summed count as one level there.
            let each = if self.form == Form::VectorMatrix { 1 } else { 3 };
            for factor in level.factors.iter().step_by(each) {
                let first = u32::try_from(factor.table.start).ok()?;
                let value = format!("stage_Level({}u, {}u, {first}u)", level.cells, factor.orientation);
                levels.push(LevelCode { value, outputs: factor.table.outputs.clone() });
            }
        }
        let (f, lines) = (self.features, self.form == Form::VectorMatrix);
        let constants = format!("const stage_FEATURES = {f}u;\nconst stage_LINES = {lines};\n");
        Some(Fragment::new(&[&constants, include_str!("planes.wgsl"), &functions(&levels, self.outputs)]))
    }

    fn describe(&self) -> String {
        let cells = |l: Option<&Level>| l.map_or(0, |l| l.cells);
        format!(
            "planes: {} levels x {} of {}, {} to {} cells per side, {} parameters",
            self.levels.len(),
            self.features,
            if self.form == Form::VectorMatrix { "planes and lines" } else { "three planes" },
            cells(self.levels.first()),
            cells(self.levels.last()),
            self.params
        )
    }
}

impl Encoder for PlanesStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), "planes", "channels", "none kept", "at least one")?;
        let mut stage = Self { levels: vec![], params: 0, outputs: keep.len(), ..self.clone() };
        let mut params = vec![];
        for level in &self.levels {
            let mut factors = vec![];
            for factor in &level.factors {
                if let Some(table) = factor.table.kept(keep, stage.params) {
                    stage.params += table.len;
                    params.push(factor.table.range());
                    factors.push(Factor { table, ..factor.clone() });
                }
            }
            if !factors.is_empty() {
                stage.levels.push(Level { factors, ..level.clone() });
            }
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let factors = self.factors().map(|(l, f)| (f64::from(l.cells), &f.table.outputs[..]));
        Some(by_channel(factors, self.outputs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn a_level_too_fine_is_refused() {
        let e = PlanesStage::new(&Planes { levels: 12, ..Planes::default() }).unwrap_err().to_string();
        assert!(e.contains("levels") && e.contains("8192"), "{e}");
    }
}
