//! Features as products of a plane and a line (vector-matrix factors; Chen et al., "TensoRF", 2022): of each of the three
//! orientations `F` channels `y = P(a, b)·L(c)`, where P is a grid read bilinearly at two coordinates and L one read
//! linearly at the third. `R²·F + R·F` numbers an orientation instead of `R³·F`.

use conefield_plugin::error::{Result, ensure};
use conefield_plugin::random::{mix, unit};
use conefield_plugin::simd::Real;
use conefield_plugin::spec::EncoderSpec;
use conefield_plugin::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Scope, Stage, Tile, TileMut};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;

conefield_plugin::stage_type!(Encoder, "triplane", Triplane, "products of planes and lines");

/// Settings of `triplane`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Triplane {
    /// Nodes along a side of a plane, and of a line.
    pub resolution: usize,
    /// Channels of each orientation.
    pub features: usize,
}

impl Default for Triplane {
    fn default() -> Self {
        Self { resolution: 64, features: 8 }
    }
}

#[typetag::serde(name = "triplane")]
impl EncoderSpec for Triplane {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        ensure((2..=4096).contains(&self.resolution), "spec", "encoder.resolution", self.resolution, "2 to 4096")?;
        ensure((1..=64).contains(&self.features), "spec", "encoder.features", self.features, "1 to 64")?;
        Ok(Box::new(TriplaneStage(self.clone())))
    }
}

/// The stage that [`Triplane`] builds.
pub struct TriplaneStage(Triplane);

/// The two axes of each plane, and that of its line.
const AXES: [[usize; 3]; 3] = [[0, 1, 2], [0, 2, 1], [1, 2, 0]];

/// A place between two nodes of a line of nodes.
#[derive(Clone, Copy)]
struct Between<R> {
    node: usize,
    /// Weights of the node and of the next.
    weights: [R; 2],
    /// Their derivatives by the coordinate.
    slopes: [R; 2],
}

impl TriplaneStage {
    fn plane_len(&self) -> usize {
        self.0.resolution * self.0.resolution * self.0.features
    }

    fn orientation_len(&self) -> usize {
        self.plane_len() + self.0.resolution * self.0.features
    }

    /// Coordinates outside the cube are taken for those of its face.
    fn between<R: Real>(&self, x: R) -> Between<R> {
        let cells = R::of((self.0.resolution - 1) as f64);
        let inside = x > R::ZERO && x < R::ONE;
        let clamped = if x < R::ZERO {
            R::ZERO
        } else if x > R::ONE {
            R::ONE
        } else {
            x
        };
        let at = clamped * cells;
        let node = (at.floor().int().max(0) as usize).min(self.0.resolution - 2);
        let right = at - R::of(node as f64);
        let slope = if inside { cells } else { R::ZERO };
        Between { node, weights: [R::ONE - right, right], slopes: [R::ZERO - slope, slope] }
    }

    /// Places of one row on the two axes of a plane and on its line.
    fn row<R: Real>(&self, x: &Tile<'_, R>, orientation: usize, i: usize) -> [Between<R>; 3] {
        AXES[orientation].map(|axis| self.between(x.channel(axis)[i]))
    }

    /// The four nodes of a plane around a place: index of the first feature, and a weight made of those of both axes.
    fn corners<R: Real>(&self, a: [usize; 2], wa: [R; 2], wb: [R; 2]) -> [(usize, R); 4] {
        let at = |i: usize, j: usize| ((a[0] + i) * self.0.resolution + a[1] + j) * self.0.features;
        [(at(0, 0), wa[0] * wb[0]), (at(0, 1), wa[0] * wb[1]), (at(1, 0), wa[1] * wb[0]), (at(1, 1), wa[1] * wb[1])]
    }
}

impl<R: Real> Kernel<R> for TriplaneStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let f = self.0.features;
        for o in 0..3 {
            let (plane, line) =
                params[o * self.orientation_len()..][..self.orientation_len()].split_at(self.plane_len());
            for i in 0..x.rows {
                let [a, b, c] = self.row(&x, o, i);
                let corners = self.corners([a.node, b.node], a.weights, b.weights);
                for k in 0..f {
                    let p: R = corners.iter().map(|&(at, w)| w * plane[at + k]).sum();
                    let l = c.weights[0] * line[c.node * f + k] + c.weights[1] * line[(c.node + 1) * f + k];
                    y.channel(o * f + k)[i] = p * l;
                }
            }
        }
    }

    fn backward(
        &self,
        params: &[R],
        x: Tile<'_, R>,
        _: TileMut<'_, R>,
        dy: Tile<'_, R>,
        grads: Grads<'_, R>,
        mut dx: Option<TileMut<'_, R>>,
    ) {
        let f = self.0.features;
        if let Some(dx) = &mut dx {
            dx.data.fill(R::ZERO);
        }
        for o in 0..3 {
            let start = o * self.orientation_len();
            let own = start..start + self.orientation_len();
            let asked = grads.range.start < own.end && own.start < grads.range.end;
            if !asked && dx.is_none() {
                continue;
            }
            let (plane, line) = params[own].split_at(self.plane_len());
            let mut add = |at: usize, value: R| {
                if grads.range.contains(&at) {
                    grads.values[at - grads.range.start] += value;
                }
            };
            for i in 0..x.rows {
                let [a, b, c] = self.row(&x, o, i);
                let nodes = [a.node, b.node];
                let corners = self.corners(nodes, a.weights, b.weights);
                let along = [self.corners(nodes, a.slopes, b.weights), self.corners(nodes, a.weights, b.slopes)];
                let mut slopes = [R::ZERO; 3];
                for k in 0..f {
                    let d = dy.channel(o * f + k)[i];
                    let ends = [c.node * f + k, (c.node + 1) * f + k];
                    let of_plane =
                        |corners: &[(usize, R); 4]| -> R { corners.iter().map(|&(at, w)| w * plane[at + k]).sum() };
                    let of_line = |w: [R; 2]| w[0] * line[ends[0]] + w[1] * line[ends[1]];
                    let (p, l) = (of_plane(&corners), of_line(c.weights));
                    for (at, w) in corners {
                        add(start + at + k, d * l * w);
                    }
                    for (at, w) in ends.into_iter().zip(c.weights) {
                        add(start + self.plane_len() + at, d * p * w);
                    }
                    slopes[0] += d * l * of_plane(&along[0]);
                    slopes[1] += d * l * of_plane(&along[1]);
                    slopes[2] += d * p * of_line(c.slopes);
                }
                if let Some(dx) = &mut dx {
                    for (axis, slope) in AXES[o].into_iter().zip(slopes) {
                        dx.channel(axis)[i] += slope;
                    }
                }
            }
        }
    }
}

impl Stage for TriplaneStage {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: 3 * self.0.features,
            params: 3 * self.orientation_len(),
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::Scatter,
            macs: 3 * 7 * self.0.features,
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let Triplane { resolution: r, features: f } = self.0;
        let of = |o: usize| {
            let start = o * self.orientation_len();
            [
                Parameter { name: format!("{o}.plane"), shape: vec![r, r, f], start },
                Parameter { name: format!("{o}.line"), shape: vec![r, f], start: start + self.plane_len() },
            ]
        };
        (0..3).flat_map(of).collect()
    }

    /// Planes around 0, lines around 1, so that products begin small but learn.
    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            let around = if i % self.orientation_len() < self.plane_len() { 0.0 } else { 1.0 };
            *p = around + 0.1 * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// An orientation a worker.
    fn partition(&self) -> Vec<Range<usize>> {
        (0..3).map(|o| o * self.orientation_len()..(o + 1) * self.orientation_len()).collect()
    }

    fn describe(&self) -> String {
        let Triplane { resolution: r, features: f } = self.0;
        format!("triplane: 3 planes of {r} x {r} and 3 lines of {r}, {f} channels each")
    }
}

impl Encoder for TriplaneStage {}
