//! Features as products of a plane and a line (vector-matrix factors; Chen et al., "TensoRF", 2022), on several levels:
//! for each of the three orientations `F` channels `y = P(a, b)·L(c)`, where P is a grid, interpolated bilinearly at
//! two coordinates, and L a line, interpolated linearly at the third. `R²·F + R·F` numbers per orientation instead of
//! `R³·F`.

use conefield_plugin::prelude::*;
use std::ops::Range;

stage_type!(EncoderSpec, "triplane", Triplane, "products of planes and lines");

/// Settings of `triplane`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Triplane {
    /// Levels, each with half the nodes of the next.
    pub levels: usize,
    /// Nodes per side of a plane, and of a line, on the finest level.
    pub resolution: usize,
    /// Channels of each orientation of a level.
    pub features: usize,
}

impl Default for Triplane {
    fn default() -> Self {
        Self { levels: 3, resolution: 64, features: 4 }
    }
}

impl EncoderSpec for Triplane {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        let Self { levels, resolution, features } = *self;
        ensure((1..=12).contains(&levels), "spec", "levels", levels, "1 to 12")?;
        let least = 2 << (levels - 1);
        let expected = format!("{least} to 4096: the coarsest level has at least 2");
        ensure((least..=4096).contains(&resolution), "spec", "resolution", resolution, expected)?;
        ensure((1..=64).contains(&features), "spec", "features", features, "1 to 64")?;
        let mut factors = vec![];
        for (level, orientation) in (0..levels).flat_map(|l| (0..3).map(move |o| (l, o))) {
            let first = factors.len() * features;
            factors.push(Factor {
                name: format!("{level}.{orientation}"),
                axes: AXES[orientation],
                nodes: resolution >> (levels - 1 - level),
                features,
                outputs: (first..first + features).map(Some).collect(),
            });
        }
        Ok(Box::new(TriplaneStage::new(self.clone(), factors)))
    }
}

/// The two axes of each plane, and the axis of its line.
const AXES: [[usize; 3]; 3] = [[0, 1, 2], [0, 2, 1], [1, 2, 0]];

/// A plane and a line: one orientation of one level.
#[derive(Debug, Clone)]
struct Factor {
    name: String,
    axes: [usize; 3],
    /// Nodes per side of the plane, and of the line.
    nodes: usize,
    features: usize,
    /// Output channel of each feature; `None` if unused.
    outputs: Vec<Option<usize>>,
}

/// A position between two nodes of a line.
#[derive(Clone, Copy)]
struct Between<R> {
    node: usize,
    /// Weights of the node and of the next one.
    weights: [R; 2],
    /// Their derivatives with respect to the coordinate.
    slopes: [R; 2],
}

impl Factor {
    fn plane_len(&self) -> usize {
        self.nodes * self.nodes * self.features
    }

    fn len(&self) -> usize {
        self.plane_len() + self.nodes * self.features
    }

    /// The features in use, with their output channels.
    fn read(&self) -> impl Iterator<Item = (usize, usize)> {
        self.outputs.iter().enumerate().filter_map(|(k, c)| Some((k, (*c)?)))
    }

    /// Coordinates outside the cube are clamped to its faces.
    fn between<R: Real>(&self, x: R) -> Between<R> {
        let cells = R::of((self.nodes - 1) as f64);
        let inside = x > R::ZERO && x < R::ONE;
        let clamped = if x < R::ZERO {
            R::ZERO
        } else if x > R::ONE {
            R::ONE
        } else {
            x
        };
        let at = clamped * cells;
        let node = (at.floor().int().max(0) as usize).min(self.nodes - 2);
        let right = at - R::of(node as f64);
        let slope = if inside { cells } else { R::ZERO };
        Between { node, weights: [R::ONE - right, right], slopes: [R::ZERO - slope, slope] }
    }

    /// Positions of row `i` on the two axes of the plane and on the line.
    fn row<R: Real>(&self, x: &Tile<'_, R>, i: usize) -> [Between<R>; 3] {
        self.axes.map(|axis| self.between(x.channel(axis)[i]))
    }

    /// The four nodes of the plane around a position: index of the first feature, and the product of the weights along
    /// both axes.
    fn corners<R: Real>(&self, [a, b]: [usize; 2], wa: [R; 2], wb: [R; 2]) -> [(usize, R); 4] {
        let at = |i: usize, j: usize| ((a + i) * self.nodes + b + j) * self.features;
        [(at(0, 0), wa[0] * wb[0]), (at(0, 1), wa[0] * wb[1]), (at(1, 0), wa[1] * wb[0]), (at(1, 1), wa[1] * wb[1])]
    }

    fn forward<R: Real>(&self, params: &[R], x: Tile<'_, R>, y: &mut TileMut<'_, R>) {
        let (plane, line) = params.split_at(self.plane_len());
        for i in 0..x.rows {
            let [a, b, c] = self.row(&x, i);
            let corners = self.corners([a.node, b.node], a.weights, b.weights);
            for (k, channel) in self.read() {
                y.channel(channel)[i] = of_plane(plane, &corners, k) * self.of_line(line, c.node, c.weights, k);
            }
        }
    }

    fn of_line<R: Real>(&self, line: &[R], node: usize, w: [R; 2], k: usize) -> R {
        let at = node * self.features + k;
        w[0] * line[at] + w[1] * line[at + self.features]
    }

    /// `start` is the first parameter.
    fn backward<R: Real>(
        &self,
        (start, params): (usize, &[R]),
        x: &Tile<'_, R>,
        dy: &Tile<'_, R>,
        grads: &mut Grads<'_, R>,
        dx: &mut Option<TileMut<'_, R>>,
    ) {
        let (plane, line) = params.split_at(self.plane_len());
        let mut add = |at: usize, value: R| {
            if grads.range.contains(&at) {
                grads.values[at - grads.range.start] += value;
            }
        };
        for i in 0..x.rows {
            let [a, b, c] = self.row(x, i);
            let nodes = [a.node, b.node];
            let corners = self.corners(nodes, a.weights, b.weights);
            let along = [self.corners(nodes, a.slopes, b.weights), self.corners(nodes, a.weights, b.slopes)];
            let mut slopes = [R::ZERO; 3];
            for (k, channel) in self.read() {
                let d = dy.channel(channel)[i];
                let (p, l) = (of_plane(plane, &corners, k), self.of_line(line, c.node, c.weights, k));
                for (at, w) in corners {
                    add(start + at + k, d * l * w);
                }
                for (node, w) in [c.node, c.node + 1].into_iter().zip(c.weights) {
                    add(start + plane.len() + node * self.features + k, d * p * w);
                }
                slopes[0] += d * l * of_plane(plane, &along[0], k);
                slopes[1] += d * l * of_plane(plane, &along[1], k);
                slopes[2] += d * p * self.of_line(line, c.node, c.slopes, k);
            }
            if let Some(dx) = dx {
                for (axis, slope) in self.axes.into_iter().zip(slopes) {
                    dx.channel(axis)[i] += slope;
                }
            }
        }
    }
}

fn of_plane<R: Real>(plane: &[R], corners: &[(usize, R); 4], k: usize) -> R {
    corners.iter().map(|&(at, w)| w * plane[at + k]).sum()
}

/// The stage that [`Triplane`] builds.
pub struct TriplaneStage {
    settings: Triplane,
    factors: Vec<Factor>,
    /// The parameters of each factor.
    ranges: Vec<Range<usize>>,
    outputs: usize,
}

impl TriplaneStage {
    fn new(settings: Triplane, factors: Vec<Factor>) -> Self {
        let mut end = 0;
        let next = |f: &Factor| {
            let start = end;
            end += f.len();
            start..end
        };
        let ranges = factors.iter().map(next).collect();
        let outputs = factors.iter().map(|f| f.read().count()).sum();
        Self { settings, factors, ranges, outputs }
    }

    fn params(&self) -> usize {
        self.ranges.last().map_or(0, |r| r.end)
    }
}

// One source for single precision and for double precision (checks).
impl<R: Real> Kernel<R> for TriplaneStage {
    fn forward(&self, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        for (factor, range) in self.factors.iter().zip(&self.ranges) {
            factor.forward(&params[range.clone()], x, &mut y);
        }
    }

    fn passes(&self) -> usize {
        self.factors.len()
    }

    fn forward_pass(&self, pass: usize, params: &[R], x: Tile<'_, R>, mut y: TileMut<'_, R>, _: TileMut<'_, R>) {
        self.factors[pass].forward(&params[self.ranges[pass].clone()], x, &mut y);
    }

    fn backward(&self, Backward { params, x, dy, mut grads, mut dx, .. }: Backward<'_, R>) {
        if let Some(dx) = &mut dx {
            dx.data.fill(R::ZERO);
        }
        for (factor, range) in self.factors.iter().zip(&self.ranges) {
            let asked = grads.range.start < range.end && range.start < grads.range.end;
            if asked || dx.is_some() {
                factor.backward((range.start, &params[range.clone()]), &x, &dy, &mut grads, &mut dx);
            }
        }
    }
}

impl Stage for TriplaneStage {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: self.outputs,
            params: self.params(),
            grads: GradKind::Scatter,
            macs: 7 * self.outputs,
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let of = |(f, range): (&Factor, &Range<usize>)| {
            let (n, k) = (f.nodes, f.features);
            [
                Parameter { name: format!("{}.plane", f.name), shape: vec![n, n, k], start: range.start },
                Parameter { name: format!("{}.line", f.name), shape: vec![n, k], start: range.start + f.plane_len() },
            ]
        };
        self.factors.iter().zip(&self.ranges).flat_map(of).collect()
    }

    /// Planes start around 0 and lines around 1, so that products start small but learn.
    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            *p = 0.1 * (2.0 * unit(mix(seed, i as u64)) - 1.0);
        }
        for (factor, range) in self.factors.iter().zip(&self.ranges) {
            params[range.start + factor.plane_len()..range.end].iter_mut().for_each(|p| *p += 1.0);
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
        self.ranges.clone()
    }

    fn describe(&self) -> String {
        let Triplane { levels, resolution, features } = self.settings;
        let kept = format!("{} of {} channels", self.outputs, 3 * levels * features);
        format!("triplane: {levels} levels of planes and lines, {resolution} nodes a side on the finest, {kept}")
    }
}

impl Encoder for TriplaneStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let (mut factors, mut params) = (vec![], vec![]);
        for (factor, range) in self.factors.iter().zip(&self.ranges) {
            let place = |c: &Option<usize>| c.and_then(|c| keep.iter().position(|&k| k == c));
            let outputs: Vec<_> = factor.outputs.iter().map(place).collect();
            if outputs.iter().any(Option::is_some) {
                factors.push(Factor { outputs, ..factor.clone() });
                params.push(range.clone());
            }
        }
        let stage = Self::new(self.settings.clone(), factors);
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let cells = |f: &Factor| f.read().map(|_| (f.nodes - 1) as f64).collect::<Vec<_>>();
        Some(self.factors.iter().flat_map(cells).collect())
    }
}
