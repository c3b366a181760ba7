//! Forward and backward of a group of rows, tile by tile.

use conefield_core::pipeline::Pipeline;
use conefield_core::simd::Real;
use conefield_core::stage::{Backward, GradKind, Grads, Info, Kernel, Scope, Stage, TILE_ROWS, Tile, TileMut};
use std::ops::Range;

/// A stage ready to run: its kernel, widths and place in the arena.
pub struct Step<'a, R: Real> {
    /// The arithmetic.
    pub kernel: &'a dyn Kernel<R>,
    /// Widths and counts.
    pub info: Info,
    /// Its parameter range in the arena.
    pub params: Range<usize>,
    /// Parameter ranges (within the stage) that workers may own, for scattered stages.
    pub partition: Vec<Range<usize>>,
    /// Whether an earlier stage learns, so that it must compute an input gradient.
    pub hands_on: bool,
    /// Tile channels of its input and output; its tape follows its output. The encoder's features come first.
    input: Range<usize>,
    output: Range<usize>,
}

impl<R: Real> Step<'_, R> {
    /// Whether it looks along rays, but the rows are on none.
    fn off_rays(&self, belong: Belong) -> bool {
        belong == Belong::Nowhere && self.info.scope == Scope::Ray
    }

    /// The kernel for whole tiles; `None` if it needs rows one at a time.
    fn whole(&self, belong: Belong) -> Option<&(dyn Kernel<R> + '_)> {
        if self.off_rays(belong) { self.kernel.points() } else { Some(self.kernel) }
    }
}

/// All stages except identities, in order.
pub struct Kernels<'a, R: Real> {
    /// Encoder first, field last.
    pub steps: Vec<Step<'a, R>>,
    scope: Scope,
}

impl<'a, R: Real> Kernels<'a, R> {
    /// The kernels of `pipeline` that `pick` chooses.
    pub fn new(pipeline: &'a Pipeline, pick: impl Fn(&'a dyn Stage) -> &'a dyn Kernel<R>) -> Self {
        let mut steps = vec![];
        let mut learns = false;
        let (mut input, mut end) = (0..0, 0);
        for ((_, stage), range) in pipeline.stages().into_iter().zip(pipeline.ranges()) {
            let info = stage.info();
            let hands_on = learns;
            learns |= info.params > 0;
            if info.identity && !steps.is_empty() {
                continue;
            }
            let partition = if info.grads == GradKind::Scatter { stage.partition() } else { vec![] };
            let output = end..end + info.output;
            end = if steps.is_empty() { output.end } else { output.end + info.tape };
            let read = std::mem::replace(&mut input, output.clone());
            let (kernel, params) = (pick(stage), range.clone());
            steps.push(Step { kernel, info, params, partition, hands_on, input: read, output });
        }
        Self { steps, scope: pipeline.scope() }
    }

    /// Number of passes of the encoder.
    pub fn encoder_passes(&self) -> usize {
        self.steps[0].kernel.passes()
    }

    /// Number of channels that the encoder computes.
    pub fn encoder_width(&self) -> usize {
        self.steps[0].info.output
    }

    /// Tile sizes for one ray of `n` samples.
    pub fn ray_tiles(&self, n: usize) -> Vec<usize> {
        if self.scope == Scope::Ray { vec![n] } else { even_tiles(n) }
    }

    /// Whether rows of several rays may share a tile.
    pub fn mixes_rays(&self) -> bool {
        self.scope == Scope::Row
    }

    /// Numbers per row of a tile: the encoder's features, then output and tape of every other stage.
    fn row_numbers(&self) -> usize {
        self.encoder_width() + self.steps[1..].iter().map(|s| s.info.output + s.info.tape).sum::<usize>()
    }

    /// Numbers per row of [`Encoded`].
    pub fn encoded_numbers(&self) -> usize {
        3 + self.steps[0].info.output + self.steps[0].info.tape
    }

    /// Numbers per row of all [`Log`]s except the encoder's.
    pub fn logged_numbers(&self) -> usize {
        let scattered = self.steps[1..].iter().filter(|s| s.info.grads == GradKind::Scatter);
        scattered.map(|s| s.info.input + s.info.output).sum()
    }

    /// Numbers per row of [`Scratch`].
    pub fn scratch_numbers(&self) -> usize {
        self.row_numbers() + 1
    }

    fn widest(&self) -> usize {
        self.steps.iter().map(|s| s.info.output).max().unwrap_or(1).max(3)
    }
}

/// Splits `n` rows into as few tiles of nearly equal size as [`TILE_ROWS`] allows, of whole vectors except the last.
pub fn even_tiles(n: usize) -> Vec<usize> {
    let tiles = n.div_ceil(TILE_ROWS).max(1);
    let each = n.div_ceil(tiles).next_multiple_of(32).min(TILE_ROWS);
    (0..n).step_by(each).map(|at| each.min(n - at)).collect()
}

/// Inputs of a scattered stage's second pass.
#[derive(Debug, Default, Clone)]
pub struct Log<R> {
    /// Tile by tile: input channels, then output-gradient channels.
    pub data: Vec<R>,
    /// Rows of each tile.
    pub rows: Vec<usize>,
}

impl<R> Log<R> {
    /// Appends a tile, or one tile per row if `apart`.
    fn push(&mut self, x: Tile<'_, R>, dy: Tile<'_, R>, apart: bool)
    where
        R: Copy,
    {
        if !apart {
            self.data.extend_from_slice(x.data);
            self.data.extend_from_slice(dy.data);
            self.rows.push(x.rows);
            return;
        }
        for i in 0..x.rows {
            self.data.extend(row(x, i));
            self.data.extend(row(dy, i));
            self.rows.push(1);
        }
    }

    /// Removes everything.
    pub fn clear(&mut self) {
        self.data.clear();
        self.rows.clear();
    }
}

/// Row `i` of a tile.
fn row<R: Copy>(tile: Tile<'_, R>, i: usize) -> impl Iterator<Item = R> {
    tile.data.iter().skip(i).step_by(tile.rows).copied()
}

/// Writes row `i` of a tile.
fn set_row<R: Copy>(tile: &mut TileMut<'_, R>, i: usize, from: &[R]) {
    let rows = tile.rows;
    for (to, &v) in tile.data.iter_mut().skip(i).step_by(rows).zip(from) {
        *to = v;
    }
}

/// Passes the rows of a tile to a stage one at a time.
#[derive(Debug, Default)]
struct Single<R> {
    x: Vec<R>,
    y: Vec<R>,
    tape: Vec<R>,
    dx: Vec<R>,
}

impl<R: Real> Single<R> {
    fn forward(
        &mut self,
        kernel: &dyn Kernel<R>,
        params: &[R],
        x: Tile<'_, R>,
        mut y: TileMut<'_, R>,
        mut tape: TileMut<'_, R>,
    ) {
        self.y.resize(y.width(), R::ZERO);
        self.tape.resize(tape.width(), R::ZERO);
        for i in 0..x.rows {
            self.x.clear();
            self.x.extend(row(x, i));
            kernel.forward(
                params,
                Tile::new(&self.x, 1),
                TileMut::new(&mut self.y, 1),
                TileMut::new(&mut self.tape, 1),
            );
            set_row(&mut y, i, &self.y);
            set_row(&mut tape, i, &self.tape);
        }
    }

    fn backward(&mut self, kernel: &dyn Kernel<R>, pass: Backward<'_, R>) {
        let Backward { params, x, tape, dy, grads, mut dx } = pass;
        let left = Tile::new(&*tape.data, tape.rows);
        self.dx.resize(x.width(), R::ZERO);
        for i in 0..x.rows {
            for (to, from) in [(&mut self.x, x), (&mut self.y, dy), (&mut self.tape, left)] {
                to.clear();
                to.extend(row(from, i));
            }
            kernel.backward(Backward {
                params,
                x: Tile::new(&self.x, 1),
                tape: TileMut::new(&mut self.tape, 1),
                dy: Tile::new(&self.y, 1),
                grads: Grads { values: &mut *grads.values, range: grads.range.clone() },
                dx: dx.is_some().then(|| TileMut::new(&mut self.dx, 1)),
            });
            if let Some(dx) = &mut dx {
                set_row(dx, i, &self.dx);
            }
        }
    }
}

/// The encoder's part of the work: it processes the rows of many tiles at once, so that the table of a level stays in
/// the cache.
#[derive(Debug, Default)]
pub struct Encoded<R> {
    /// One tile of all rows: the points, then the features, which their gradients later replace.
    log: Log<R>,
    tape: Vec<R>,
}

impl<R: Real> Encoded<R> {
    /// Encodes `points`.
    pub fn forward(&mut self, kernels: &Kernels<'_, R>, params: &[R], points: &[[f32; 3]]) {
        self.begin(kernels, points);
        for pass in 0..kernels.encoder_passes() {
            self.pass(kernels, params, pass);
        }
    }

    /// Sets `points`, which [`Encoded::pass`] then encodes.
    pub fn begin(&mut self, kernels: &Kernels<'_, R>, points: &[[f32; 3]]) {
        let (s, n) = (&kernels.steps[0], points.len());
        self.log.rows.clear();
        self.log.rows.extend((n > 0).then_some(n));
        self.log.data.resize((3 + s.info.output) * n, R::ZERO);
        self.tape.resize(s.info.tape * n, R::ZERO);
        for (k, x) in self.log.data[..3 * n].chunks_exact_mut(n.max(1)).enumerate() {
            for (x, p) in x.iter_mut().zip(points) {
                *x = R::of(f64::from(p[k]));
            }
        }
    }

    /// Pass `pass` of the encoder's [`Kernels::encoder_passes`].
    pub fn pass(&mut self, kernels: &Kernels<'_, R>, params: &[R], pass: usize) {
        let (s, n) = (&kernels.steps[0], self.rows());
        let (x, y) = self.log.data.split_at_mut(3 * n);
        if n > 0 {
            s.kernel.forward_pass(
                pass,
                &params[s.params.clone()],
                Tile::new(x, n),
                TileMut::new(y, n),
                TileMut::new(&mut self.tape, n),
            );
        }
    }

    /// Runs the encoder's backward pass, unless its gradients are scattered.
    pub fn backward(&mut self, kernels: &Kernels<'_, R>, params: &[R], dense: &mut DenseGrads<R>) {
        let s = &kernels.steps[0];
        let n = self.rows();
        if s.info.grads == GradKind::Dense && s.info.params > 0 && n > 0 {
            let (x, dy) = self.log.data.split_at(3 * n);
            s.kernel.backward(Backward {
                params: &params[s.params.clone()],
                x: Tile::new(x, n),
                tape: TileMut::new(&mut self.tape, n),
                dy: Tile::new(dy, n),
                grads: Grads::all(dense.of(0)),
                dx: None,
            });
        }
    }

    /// Inputs of the encoder's second pass, if its gradients are scattered.
    pub fn log(&self) -> &Log<R> {
        &self.log
    }

    /// Removes all rows. Their numbers stay, as the next ones overwrite them.
    pub fn clear(&mut self) {
        self.log.rows.clear();
    }

    /// Features, channel-major.
    pub fn features(&self) -> &[R] {
        &self.log.data[3 * self.rows()..]
    }

    fn rows(&self) -> usize {
        self.log.rows.first().copied().unwrap_or(0)
    }

    /// Copies the features of a tile's rows to `tile`.
    fn load(&self, rows: Range<usize>, tile: &mut [R]) {
        for (y, tile) in self.features().chunks_exact(self.rows()).zip(tile.chunks_exact_mut(rows.len())) {
            tile.copy_from_slice(&y[rows.clone()]);
        }
    }

    /// Replaces the features of a tile's rows with their gradients.
    fn store(&mut self, rows: Range<usize>, tile: &[R]) {
        let n = self.rows();
        for (y, tile) in self.log.data[3 * n..].chunks_exact_mut(n).zip(tile.chunks_exact(rows.len())) {
            y[rows.clone()].copy_from_slice(tile);
        }
    }
}

/// Relation between the rows of a tile.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Belong {
    /// Samples of one ray, or of several if no stage looks along rays.
    #[default]
    ToRays,
    /// Points off any ray: to a stage that looks along rays, each is a ray of one sample.
    Nowhere,
}

/// Working memory of a worker for all stages after the encoder; it grows to the largest group and is reused.
#[derive(Debug, Default)]
pub struct Scratch<R> {
    /// Tile by tile: features, then output and tape of each stage.
    data: Vec<R>,
    /// Rows of each tile, as a range of the encoded rows.
    tiles: Vec<Range<usize>>,
    outputs: Vec<R>,
    /// Gradients in the backward pass: of a stage's output and of its input.
    back: [Vec<R>; 2],
    belong: Belong,
    /// Working memory for stages that get one row at a time.
    single: Single<R>,
}

impl<R: Real> Scratch<R> {
    /// The field's value at every row of the last [`Scratch::forward`].
    pub fn outputs(&self) -> &[R] {
        &self.outputs
    }

    /// Runs every stage after the encoder over tiles of `tiles` rows; the first one starts at row `first` of `encoded`.
    pub fn forward(
        &mut self,
        kernels: &Kernels<'_, R>,
        params: &[R],
        encoded: &Encoded<R>,
        first: usize,
        tiles: &[usize],
        belong: Belong,
    ) {
        self.belong = belong;
        let rows: usize = tiles.iter().sum();
        let numbers = kernels.row_numbers();
        if self.data.len() < rows * numbers {
            self.data.resize(rows * numbers, R::ZERO);
        }
        self.tiles.clear();
        self.outputs.clear();
        let mut tile = &mut self.data[..];
        let mut at = first;
        for &n in tiles {
            let (own, rest) = std::mem::take(&mut tile).split_at_mut(n * numbers);
            tile = rest;
            encoded.load(at..at + n, &mut own[..kernels.encoder_width() * n]);
            self.tiles.push(at..at + n);
            at += n;
            for s in &kernels.steps[1..] {
                let (before, after) = own.split_at_mut(s.output.start * n);
                let (y, tape) = after[..(s.info.output + s.info.tape) * n].split_at_mut(s.info.output * n);
                let params = &params[s.params.clone()];
                let x = Tile::new(&before[s.input.start * n..s.input.end * n], n);
                let (y, tape) = (TileMut::new(y, n), TileMut::new(tape, n));
                match s.whole(belong) {
                    Some(kernel) => kernel.forward(params, x, y, tape),
                    None => self.single.forward(s.kernel, params, x, y, tape),
                }
            }
            let y = &kernels.steps[kernels.steps.len() - 1].output;
            self.outputs.extend_from_slice(&own[y.start * n..y.end * n]);
        }
    }

    /// Given the gradient of every row's output, adds the gradients of dense stages to `dense`, appends the inputs of
    /// scattered stages to `logs` (one per stage; the encoder's stays empty), and stores the gradients of the features
    /// in `encoded`.
    pub fn backward(
        &mut self,
        kernels: &Kernels<'_, R>,
        params: &[R],
        dmu: &[R],
        dense: &mut DenseGrads<R>,
        logs: &mut [Log<R>],
        encoded: &mut Encoded<R>,
    ) {
        let widest = kernels.widest();
        let mut tile = &mut self.data[..];
        let mut dmu = dmu;
        'tiles: for rows in &self.tiles {
            let n = rows.len();
            let (own, rest) = std::mem::take(&mut tile).split_at_mut(n * kernels.row_numbers());
            tile = rest;
            let [dy, dx] = &mut self.back;
            dy.resize((widest * n).max(dy.len()), R::ZERO);
            dx.resize((widest * n).max(dx.len()), R::ZERO);
            dy[..n].copy_from_slice(&dmu[..n]);
            dmu = &dmu[n..];
            for (k, s) in kernels.steps.iter().enumerate().skip(1).rev() {
                if s.info.params == 0 && !s.hands_on {
                    continue 'tiles;
                }
                let (before, after) = own.split_at_mut(s.output.start * n);
                let x = &before[s.input.start * n..s.input.end * n];
                let g = &dy[..s.info.output * n];
                let scattered = s.info.grads == GradKind::Scatter;
                if scattered {
                    logs[k].push(Tile::new(x, n), Tile::new(g, n), s.off_rays(self.belong));
                }
                if scattered && !s.hands_on {
                    continue 'tiles;
                }
                let grads = if scattered || s.info.params == 0 {
                    Grads { values: &mut [], range: 0..0 }
                } else {
                    Grads::all(dense.of(k))
                };
                let pass = Backward {
                    params: &params[s.params.clone()],
                    x: Tile::new(x, n),
                    tape: TileMut::new(&mut after[s.info.output * n..(s.info.output + s.info.tape) * n], n),
                    dy: Tile::new(g, n),
                    grads,
                    dx: s.hands_on.then(|| TileMut::new(&mut dx[..s.info.input * n], n)),
                };
                match s.whole(self.belong) {
                    Some(kernel) => kernel.backward(pass),
                    None => self.single.backward(s.kernel, pass),
                }
                if !s.hands_on {
                    continue 'tiles;
                }
                std::mem::swap(dy, dx);
            }
            encoded.store(rows.clone(), &dy[..kernels.encoder_width() * n]);
        }
    }
}

/// Gradients of all dense stages in one buffer.
#[derive(Debug, Default, Clone)]
pub struct DenseGrads<R> {
    values: Vec<R>,
    /// Range of each step in `values`, empty for those that are not dense.
    places: Vec<Range<usize>>,
}

impl<R: Real> DenseGrads<R> {
    /// Zeros for every dense step of `kernels`.
    pub fn new(kernels: &Kernels<'_, R>) -> Self {
        let mut places = vec![];
        let mut end = 0;
        for s in &kernels.steps {
            let n = Self::of_step(s);
            places.push(end..end + n);
            end += n;
        }
        Self { values: vec![R::ZERO; end], places }
    }

    /// Number of dense gradients of `kernels`.
    pub fn numbers(kernels: &Kernels<'_, R>) -> usize {
        kernels.steps.iter().map(Self::of_step).sum()
    }

    fn of_step(s: &Step<'_, R>) -> usize {
        if s.info.grads == GradKind::Dense { s.info.params } else { 0 }
    }

    /// The gradients of step `k`.
    pub fn of(&mut self, k: usize) -> &mut [R] {
        &mut self.values[self.places[k].clone()]
    }

    /// Resets to zero.
    pub fn clear(&mut self) {
        self.values.fill(R::ZERO);
    }

    /// Adds everything to the arena's gradients.
    pub fn merge(&self, kernels: &Kernels<'_, R>, grads: &mut [R]) {
        for (s, place) in kernels.steps.iter().zip(&self.places) {
            for (g, &v) in grads[s.params.clone()].iter_mut().zip(&self.values[place.clone()]) {
                *g += v;
            }
        }
    }
}
