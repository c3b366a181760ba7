//! Encoders with several levels of features: what they share.
//!
//! A [`Level`] says where a point lies on it, and which features enter there with which weights. [`Levels`] is the
//! encoder of such levels: it checks the settings, passes blocks of rows to one level after another, selects the
//! requested part of the gradients, names the parameters, removes channels, and calls the functions of levels in WGSL, with
//! the levels' settings as constants.

use conefield_core::prelude::*;
use conefield_core::simd::{Op, Simd, SimdBase, SimdFloat, V, load, run, store};
use conefield_core::trilinear::slabs;
use conefield_core::wgsl;
use std::fmt::Write;
use std::ops::{Range, RangeInclusive};

/// Features are initialized uniformly in ± this (Müller et al. 2022, section 4).
const START: f32 = 1e-4;

/// Rows processed together: their entries and weights stay in the L1 cache.
pub const BLOCK: usize = conefield_core::trilinear::BLOCK;

/// Minimum length of a parameter range that one worker sums.
const SLAB: usize = 1 << 19;

/// More parameters are refused: with gradients and moments they would take 32 GiB.
const MOST: u64 = 1 << 31;

/// For [`Level::WGSL`], of a level whose features are weighted sums of entries.
pub const SUMS: &str = include_str!("sums.wgsl");

/// The settings that all these encoders have.
pub struct Pyramid {
    /// Number of levels, coarse to fine.
    pub levels: usize,
    /// Features per level: 1, 2, 4 or 8.
    pub features: usize,
    /// Cells along the cube's side on the coarsest level.
    pub base_resolution: u32,
    /// Ratio of consecutive levels' resolutions.
    pub growth: f64,
}

/// The settings of an encoder of levels.
pub trait Grid: Clone + Send + Sync + 'static {
    /// The encoder's name.
    const NAME: &'static str;

    /// The settings that all these encoders have.
    fn pyramid(&self) -> Pyramid;
}

/// Registers the settings of an encoder of levels, by its name, and what such a level is. They have all settings of
/// [`Pyramid`].
macro_rules! grid {
    ($name:literal, $settings:ident of $level:ident, $about:literal, example = $example:literal) => {
        conefield_core::stage_type!(EncoderSpec, $name, $settings, $about, example = $example);

        impl EncoderSpec for $settings {
            fn build(&self) -> Result<Box<dyn Encoder>> {
                Ok(Box::new(Levels::<$level>::new(self)?))
            }
        }

        impl levels::Grid for $settings {
            const NAME: &'static str = $name;

            fn pyramid(&self) -> levels::Pyramid {
                let Self { levels, features, base_resolution, growth, .. } = *self;
                levels::Pyramid { levels, features, base_resolution, growth }
            }
        }
    };
}
pub(crate) use grid;

/// The first rows of a block on a level.
pub struct Rows<'a, L: Level, R: Real, const F: usize> {
    /// Where they lie.
    pub located: &'a L::Located<R>,
    /// The features of the level.
    pub table: &'a [[R; F]],
    /// Number of rows.
    pub n: usize,
}

/// A level, or a part of one: some levels have several tables, one per part. A function that takes an `S: Simd` must
/// be `#[inline(always)]`: only then is it compiled with the instructions of `s`.
pub trait Level: Clone + Send + Sync + 'static {
    /// The encoder's settings.
    type Settings: Grid;
    /// Where the rows of a block lie on a level.
    type Located<R: Real>: Default;

    /// Base resolutions that are allowed, and the same in words.
    const BASE: (RangeInclusive<u32>, &'static str);
    /// What `levels.wgsl` expects of a level.
    const WGSL: &'static [&'static str];

    /// The parts of level `number`, with `resolution` cells along the cube's side. The levels before it have `before`
    /// parameters.
    fn parts(settings: &Self::Settings, number: usize, resolution: f64, before: usize) -> Result<Vec<Self>>;

    /// Whether its features are added to those of the part before it, in the same channels.
    fn adds(&self) -> bool {
        false
    }

    /// Cells along the cube's side.
    fn resolution(&self) -> f64;

    /// `[a, b]` of the position `a·x + b` in cells.
    fn scale(&self) -> [f64; 2] {
        [self.resolution(), 0.0]
    }

    /// Name and shape of each block of parameters, in order.
    fn blocks(&self, features: usize) -> Vec<(String, Vec<usize>)>;

    /// Number of slices of the table, all of one length, among which it may be cut for several workers. Each worker
    /// visits every row. With a single slice, [`Level::scatter`] always gets the whole table.
    fn slices(&self) -> usize {
        1
    }

    /// Initializes what does not start like features. `params` are those of the level.
    fn init(&self, _features: usize, _params: &mut [f32]) {}

    /// Multiply-adds per row.
    fn macs(features: usize) -> usize;

    /// Locates rows `at..at + n` of `x`, `n` at most [`BLOCK`], on this level and thus on all its parts.
    fn locate<S: Simd, R: Real>(&self, s: S, to: &mut Self::Located<R>, x: Tile<'_, R>, at: usize, n: usize);

    /// The features of these rows. If it adds, `out` holds those of the part before it.
    fn gather<S: Simd, R: Real, const F: usize>(&self, s: S, rows: &Rows<'_, Self, R, F>, out: &mut [[R; F]; BLOCK]);

    /// Given the derivatives `dy` by the features of these rows, adds those by the numbers `own` of the table to
    /// `grads`.
    fn scatter<S: Simd, R: Real, const F: usize>(
        &self,
        s: S,
        rows: &Rows<'_, Self, R, F>,
        dy: &[[R; F]; BLOCK],
        grads: &mut [R],
        own: &Range<usize>,
    );

    /// Moves located rows to `end` 0 or 1 of their cells along axis `d`. Their features at end 1, less those at end 0, are
    /// the derivatives by the position in cells: a level whose features are not linear in between moves weights instead.
    fn move_to<R: Real>(&self, to: &mut Self::Located<R>, d: usize, end: R);

    /// The fields of its `stage_Level` in WGSL but the last one, the first parameter.
    fn code(&self) -> String;

    /// Constants in WGSL besides `stage_FEATURES`.
    fn constants(_settings: &Self::Settings) -> String {
        String::new()
    }

    /// For [`Stage::describe`]: what has the features of a level, unless it is the level itself.
    fn of(_settings: &Self::Settings) -> &'static str {
        ""
    }

    /// For [`Stage::describe`]: the size of the tables.
    fn size(stage: &Levels<Self>) -> String {
        format!("{} parameters", stage.params)
    }
}

/// A part, its parameters, and the channels of its features.
#[derive(Debug, Clone)]
struct Part<L> {
    level: L,
    /// Index of the level in the settings, which names its parameters.
    number: usize,
    /// Index of the first parameter.
    start: usize,
    /// Number of parameters.
    len: usize,
    /// Output channel of each feature; `None` if unused.
    outputs: Vec<Option<usize>>,
}

impl<L: Level> Part<L> {
    /// The range of its parameters.
    fn range(&self) -> Range<usize> {
        self.start..self.start + self.len
    }

    /// The same part with only the channels `keep` in use and its parameters at `start`; `None` if no channel is in
    /// use.
    fn kept(&self, keep: &[usize], start: usize) -> Option<Self> {
        let place = |c: &Option<usize>| c.and_then(|c| keep.iter().position(|&k| k == c));
        let outputs: Vec<_> = self.outputs.iter().map(place).collect();
        outputs.iter().any(Option::is_some).then(|| Self { start, outputs, ..self.clone() })
    }

    /// Writes the features of rows `at..at + n` to their channels.
    #[inline(always)]
    fn put<R: Real, const F: usize>(&self, out: &[[R; F]; BLOCK], y: &mut TileMut<'_, R>, at: usize, n: usize) {
        for (f, channel) in self.outputs.iter().enumerate() {
            if let Some(c) = *channel {
                for (y, out) in y.channel(c)[at..at + n].iter_mut().zip(out) {
                    *y = out[f];
                }
            }
        }
    }

    /// Reads the gradients of the features of rows `at..at + n`.
    #[inline(always)]
    fn take<R: Real, const F: usize>(&self, dy: Tile<'_, R>, into: &mut [[R; F]; BLOCK], at: usize, n: usize) {
        let zeros = [R::ZERO; BLOCK];
        let mut channels = [&zeros[..n]; F];
        for (from, channel) in channels.iter_mut().zip(&self.outputs) {
            if let Some(c) = *channel {
                *from = &dy.channel(c)[at..at + n];
            }
        }
        for i in 0..n {
            for f in 0..F {
                into[i][f] = channels[f][i];
            }
        }
    }
}

/// The encoder of several levels.
#[derive(Debug, Clone)]
pub struct Levels<L: Level> {
    /// The settings that it was built from.
    pub settings: L::Settings,
    features: usize,
    /// Parts of one level are next to each other.
    parts: Vec<Part<L>>,
    params: usize,
    outputs: usize,
}

impl<L: Level> Levels<L> {
    /// Builds the stage, or names the setting that is out of range.
    pub fn new(settings: &L::Settings) -> Result<Self> {
        let Pyramid { levels, features, base_resolution: base, growth } = settings.pyramid();
        ensure((1..=32).contains(&levels), "spec", "levels", levels, "1 to 32")?;
        ensure([1, 2, 4, 8].contains(&features), "spec", "features", features, "1, 2, 4 or 8")?;
        let (bases, words) = L::BASE;
        ensure(bases.contains(&base), "spec", "base_resolution", base, words)?;
        ensure((1.0..=16.0).contains(&growth), "spec", "growth", growth, "1 to 16")?;
        let mut stage = Self { settings: settings.clone(), features, parts: vec![], params: 0, outputs: 0 };
        for number in 0..levels {
            let resolution = f64::from(base) * growth.powi(number as i32);
            for level in L::parts(settings, number, resolution, stage.params)? {
                let (start, blocks) = (stage.params, level.blocks(features));
                let len = blocks.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
                stage.params += len;
                stage.outputs += if level.adds() { 0 } else { features };
                let outputs = (stage.outputs - features..stage.outputs).map(Some).collect();
                stage.parts.push(Part { level, number, start, len, outputs });
            }
        }
        Ok(stage)
    }

    /// Its levels, part by part.
    pub fn levels(&self) -> impl Iterator<Item = &L> {
        self.parts.iter().map(|p| &p.level)
    }
}

/// The parts of each level.
fn by_level<L>(parts: &[Part<L>]) -> impl Iterator<Item = &[Part<L>]> {
    parts.chunk_by(|a, b| a.number == b.number)
}

/// [`Level::locate`], compiled once for all numbers of features.
#[inline(never)]
fn locate<S: Simd, L: Level, R: Real>(s: S, level: &L, to: &mut L::Located<R>, x: Tile<'_, R>, at: usize, n: usize) {
    s.vectorize(
        #[inline(always)]
        || level.locate(s, to, x, at, n),
    );
}

/// [`Level::move_to`], outside the loops of training.
#[inline(never)]
fn move_to<L: Level, R: Real>(level: &L, to: &mut L::Located<R>, (d, end): (usize, R)) {
    level.move_to(to, d, end);
}

/// Where a point lies on a level.
#[cfg(test)]
pub fn located<L: Level, R: Real>(level: &L, x: [R; 3]) -> L::Located<R> {
    struct At<'a, L, R>(&'a L, [R; 3]);
    impl<L: Level, R: Real> Op for At<'_, L, R> {
        type Number = R;
        type Out = L::Located<R>;
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Self::Out {
            let mut to = L::Located::default();
            locate(s, self.0, &mut to, Tile::new(&self.1, 1), 0, 1);
            to
        }
    }
    run(At(level, x))
}

struct LevelsForward<'a, L: Level, R> {
    stage: &'a Levels<L>,
    parts: &'a [Part<L>],
    params: &'a [R],
    x: Tile<'a, R>,
    y: TileMut<'a, R>,
    /// An axis and an end of the cells along it, to which rows are moved: see [`Level::move_to`].
    end: Option<(usize, R)>,
}

impl<L: Level, R: Real> LevelsForward<'_, L, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = L::Located::default();
        let mut out = [[R::ZERO; F]; BLOCK];
        for parts in by_level(self.parts) {
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                locate(s, &parts[0].level, &mut located, self.x, at, n);
                if let Some(end) = self.end {
                    move_to(&parts[0].level, &mut located, end);
                }
                for part in parts {
                    let (table, _) = self.params[part.range()].as_chunks::<F>();
                    part.level.gather(s, &Rows { located: &located, table, n }, &mut out);
                    // Of parts that are added, the last one writes the result.
                    part.put(&out, &mut self.y, at, n);
                }
            }
        }
    }
}

struct LevelsBackward<'a, L: Level, R> {
    stage: &'a Levels<L>,
    params: &'a [R],
    x: Tile<'a, R>,
    dy: Tile<'a, R>,
    grads: Grads<'a, R>,
}

impl<L: Level, R: Real> LevelsBackward<'_, L, R> {
    #[inline(always)]
    fn features<S: Simd, const F: usize>(mut self, s: S) {
        let mut located = L::Located::default();
        let mut dy = [[R::ZERO; F]; BLOCK];
        for part in &self.stage.parts {
            let level = &part.level;
            let mut asked = Asked::of(&self.grads, &part.range(), level.slices() == 1);
            if asked.is_empty() {
                continue;
            }
            let (table, _) = self.params[part.range()].as_chunks::<F>();
            let (grads, own) = asked.values(&mut self.grads);
            for at in (0..self.x.rows).step_by(BLOCK) {
                let n = BLOCK.min(self.x.rows - at);
                part.take(self.dy, &mut dy, at, n);
                locate(s, level, &mut located, self.x, at, n);
                level.scatter(s, &Rows { located: &located, table, n }, &dy, grads, &own);
            }
            asked.finish(&mut self.grads);
        }
    }
}

/// Runs `features` of an operation with the number of features as a constant.
macro_rules! by_features {
    ($op:ident) => {
        impl<L: Level, R: Real> Op for $op<'_, L, R> {
            type Number = R;
            type Out = ();
            const WIDE: bool = false;
            #[inline(always)]
            fn call<S: Simd>(self, s: S) {
                match self.stage.features {
                    1 => self.features::<S, 1>(s),
                    2 => self.features::<S, 2>(s),
                    4 => self.features::<S, 4>(s),
                    _ => self.features::<S, 8>(s),
                }
            }
        }
    };
}
by_features!(LevelsForward);
by_features!(LevelsBackward);

impl<L: Level> Levels<L> {
    /// The features of `parts`; see [`LevelsForward`].
    #[inline(never)]
    fn encode<R: Real>(
        &self,
        parts: &[Part<L>],
        params: &[R],
        x: Tile<'_, R>,
        y: TileMut<'_, R>,
        end: Option<(usize, R)>,
    ) {
        run(LevelsForward { stage: self, parts, params, x, y, end });
    }

    /// Overwrites `dx` with the derivatives by the input, which no training asks for.
    fn slopes<R: Real>(&self, params: &[R], x: Tile<'_, R>, dy: Tile<'_, R>, mut dx: TileMut<'_, R>) {
        let n = x.rows;
        dx.data.fill(R::ZERO);
        for d in 0..3 {
            let [near, far] = [R::ZERO, R::ONE].map(|end| {
                let mut y = vec![R::ZERO; self.outputs * n];
                self.encode(&self.parts, params, x, TileMut::new(&mut y, n), Some((d, end)));
                y
            });
            let (x, dx) = (x.channel(d), dx.channel(d));
            for part in self.parts.iter().filter(|p| !p.level.adds()) {
                let [scale, shift] = part.level.scale().map(R::of);
                for &c in part.outputs.iter().flatten() {
                    for i in 0..n {
                        // Beyond the rim a position is clamped, whatever its value.
                        if x[i] <= R::ONE && x[i] * scale + shift >= R::ZERO {
                            dx[i] += scale * dy.channel(c)[i] * (far[c * n + i] - near[c * n + i]);
                        }
                    }
                }
            }
        }
    }
}

impl<L: Level, R: Real> Kernel<R> for Levels<L> {
    fn forward(&self, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        self.encode(&self.parts, params, x, y, None);
    }

    fn passes(&self) -> usize {
        by_level(&self.parts).count()
    }

    fn forward_pass(&self, pass: usize, params: &[R], x: Tile<'_, R>, y: TileMut<'_, R>, _: TileMut<'_, R>) {
        let parts = by_level(&self.parts).nth(pass).unwrap_or_default();
        self.encode(parts, params, x, y, None);
    }

    fn backward(&self, Backward { params, x, dy, grads, dx, .. }: Backward<'_, R>) {
        if let Some(dx) = dx {
            self.slopes(params, x, dy, dx);
        }
        run(LevelsBackward { stage: self, params, x, dy, grads });
    }
}

impl<L: Level> Stage for Levels<L> {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: self.outputs,
            params: self.params,
            grads: GradKind::Scatter,
            macs: self.parts.len() * L::macs(self.features),
            ..Info::default()
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        let mut all: Vec<Parameter> = vec![];
        for part in &self.parts {
            for (name, shape) in part.level.blocks(self.features) {
                let start = all.last().map_or(0, |p| p.range().end);
                all.push(Parameter { name: format!("{}.{name}", part.number), shape, start });
            }
        }
        all
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        for (i, p) in params.iter_mut().enumerate() {
            *p = (2.0 * unit(mix(seed, i as u64)) - 1.0) * START;
        }
        for part in &self.parts {
            part.level.init(self.features, &mut params[part.range()]);
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        Some(self)
    }

    /// A worker owns a part, or some slices of a large one: at most 16 pieces, because each visits every row again.
    fn partition(&self) -> Vec<Range<usize>> {
        let pieces = |p: &Part<L>| {
            let (start, slices) = (p.start, p.level.slices());
            slabs(slices, p.len / slices, SLAB).map(move |r| start + r.start..start + r.end)
        };
        self.parts.iter().flat_map(pieces).collect()
    }

    fn wgsl(&self) -> Option<Fragment> {
        let mut levels = vec![];
        // A part that adds belongs to the level in front of it there.
        for part in self.parts.iter().filter(|p| !p.level.adds()) {
            let first = u32::try_from(part.start).ok()?;
            let value = format!("stage_Level({}, {first}u)", part.level.code());
            levels.push((value, part.level.scale(), &part.outputs[..]));
        }
        let constants = format!("const stage_FEATURES = {}u;\n{}", self.features, L::constants(&self.settings));
        let functions = functions(self.features, &levels, self.outputs);
        let shared = [include_str!("levels.wgsl"), &functions];
        Some(Fragment::new(&[&[constants.as_str()], L::WGSL, &shared].concat()))
    }

    fn describe(&self) -> String {
        let cells = |part: Option<&Part<L>>| part.map_or(0.0, |p| p.level.resolution());
        format!(
            "{}: {} levels x {}{}, {:.0} to {:.0} cells per side, {}",
            L::Settings::NAME,
            by_level(&self.parts).count(),
            self.features,
            L::of(&self.settings),
            cells(self.parts.first()),
            cells(self.parts.last()),
            L::size(self)
        )
    }
}

impl<L: Level> Encoder for Levels<L> {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        ensure(!keep.is_empty(), L::Settings::NAME, "channels", "none kept", "at least one")?;
        let settings = self.settings.clone();
        let mut stage = Self { settings, features: self.features, parts: vec![], params: 0, outputs: keep.len() };
        let mut params = vec![];
        for part in &self.parts {
            if let Some(kept) = part.kept(keep, stage.params) {
                params.push(part.range());
                stage.params += kept.len;
                stage.parts.push(kept);
            }
        }
        Ok(Reduced { stage: Box::new(stage), params, channels: vec![0, 1, 2] })
    }

    fn coarse_to_fine(&self) -> bool {
        true
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        let mut cells = vec![0.0; self.outputs];
        for part in &self.parts {
            part.outputs.iter().flatten().for_each(|&c| cells[c] = part.level.resolution());
        }
        Some(cells)
    }
}

/// The requested part of a level's gradients in a call of `backward`: all, none, or a part. If it must be all but only
/// a part is requested, the rest is summed too, into a separate buffer: the order of summation stays the same.
struct Asked<R> {
    /// The requested range among the values of the call.
    from: Range<usize>,
    /// The same range among those of the level.
    own: Range<usize>,
    beside: Vec<R>,
}

impl<R: Real> Asked<R> {
    /// The part of `level` that `grads` requests; `whole` if gradients can be summed of the whole level only.
    fn of(grads: &Grads<'_, R>, level: &Range<usize>, whole: bool) -> Self {
        let range = &grads.range;
        let (from, to) = (level.start.max(range.start), level.end.min(range.end));
        if from >= to {
            return Self { from: 0..0, own: 0..0, beside: vec![] };
        }
        let own = from - level.start..to - level.start;
        let from = from - range.start..to - range.start;
        let mut beside = vec![];
        if whole && own.len() < level.len() {
            beside.resize(level.len(), R::ZERO);
            beside[own.clone()].copy_from_slice(&grads.values[from.clone()]);
        }
        Self { from, own, beside }
    }

    /// Whether nothing is requested.
    fn is_empty(&self) -> bool {
        self.own.is_empty()
    }

    /// Where to add gradients, and the range of the level that they are of.
    fn values<'a>(&'a mut self, grads: &'a mut Grads<'_, R>) -> (&'a mut [R], Range<usize>) {
        if self.beside.is_empty() {
            (&mut grads.values[self.from.clone()], self.own.clone())
        } else {
            let whole = 0..self.beside.len();
            (&mut self.beside, whole)
        }
    }

    /// Copies the requested part to its place.
    fn finish(self, grads: &mut Grads<'_, R>) {
        if !self.beside.is_empty() {
            grads.values[self.from].copy_from_slice(&self.beside[self.own]);
        }
    }
}

/// A level in WGSL: a value of type `stage_Level`, its [`Level::scale`], and the output channels of its features.
type LevelCode<'a> = (String, [f64; 2], &'a [Option<usize>]);

/// `stage_forward` and `stage_backward` of an encoder with `width` output channels, and `stage_features_grad` for its
/// levels, which adds `w` times `dy` to the gradients of the entry that begins at parameter `entry`.
fn functions(features: usize, levels: &[LevelCode<'_>], width: usize) -> String {
    let mut grad =
        String::from("fn stage_features_grad(entry: u32, w: f32, dy: ptr<function, array<f32, stage_FEATURES>>) {\n");
    if features.is_multiple_of(2) {
        for f in (0..features).step_by(2) {
            let _ = writeln!(grad, "    stage_grad_pair(entry + {f}u, w * vec2<f32>((*dy)[{f}], (*dy)[{}]));", f + 1);
        }
    } else {
        for f in 0..features {
            let _ = writeln!(grad, "    stage_grad(entry + {f}u, w * (*dy)[{f}]);");
        }
    }
    grad += "}\n";
    let (mut forward, mut backward) = (String::new(), String::new());
    for (l, (value, scale, outputs)) in levels.iter().enumerate() {
        let level = format!("    let level{l} = {value};\n");
        let _ = writeln!(forward, "{level}    let v{l} = stage_level_value(stage_locate(p, level{l}), level{l});");
        let _ = writeln!(backward, "{level}    var d{l}: array<f32, stage_FEATURES>;");
        for (f, c) in outputs.iter().enumerate().filter_map(|(f, c)| Some((f, (*c)?))) {
            let _ = writeln!(forward, "    (*y)[{c}] = v{l}[{f}];");
            let _ = writeln!(backward, "    d{l}[{f}] = (*dy)[{c}];");
        }
        let [scale, shift] = scale.map(|x| x as f32);
        let _ = write!(
            backward,
            "    stage_level_backward(stage_locate(p, level{l}), level{l}, &d{l});
    if stage_wants_dx {{ slope += stage_level_slope(p, level{l}, &d{l}, {scale:?}, {shift:?}); }}
"
        );
    }
    let p = "    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);\n";
    let slope = "    (*dx)[0] = slope.x;\n    (*dx)[1] = slope.y;\n    (*dx)[2] = slope.z;\n";
    let backward = format!("{p}    var slope = vec3<f32>(0.0);\n{backward}{slope}");
    grad + &wgsl::functions(3, width, &format!("{p}{forward}"), &backward)
}

/// Refuses level `number` if it has more than `most` cells per side.
pub fn finest(number: usize, resolution: f64, most: f64, expected: &str) -> Result<()> {
    let found = format!("level {number} with {resolution:.0} cells per side");
    ensure(resolution <= most, "spec", "levels", found, expected)
}

/// Refuses level `number` if its `resolution + more` entries per side, which are `what`, bring the parameters above
/// [`MOST`].
pub fn cube(number: usize, resolution: f64, more: u64, what: &str, features: usize, before: usize) -> Result<()> {
    // The cast saturates, and what exceeds 64 bits is refused like everything above the limit.
    let all = (resolution as u64)
        .checked_add(more)
        .and_then(|side| side.checked_pow(3))
        .and_then(|entries| entries.checked_mul(features as u64))
        .and_then(|params| params.checked_add(before as u64));
    let found = format!(
        "more than 2^31 parameters with level {number}: ({resolution:.0} + {more})^3 {what} of {features} features"
    );
    let expected = "at most 2^31 parameters: fewer levels, less growth, or a hash-grid, which bounds its tables";
    ensure(all.is_some_and(|all| all <= MOST), "spec", "levels", found, expected)
}

/// Most entries of a table with this setting.
pub fn table_size(log2: u32) -> Result<u32> {
    ensure((4..=28).contains(&log2), "spec", "log2_table_size", log2, "4 to 28")?;
    Ok(1 << log2)
}

/// For [`Level::size`], of tables with a largest size.
pub fn sizes(log2: u32, direct: usize) -> String {
    format!("tables up to 2^{log2}, {direct} of them direct")
}

/// For [`Level::constants`]: the primes of a hash.
pub fn primes([x, y, z]: [u32; 3]) -> String {
    format!("const stage_PRIMES = vec3<u32>({x}u, {y}u, {z}u);\n")
}

/// Cells of a block's rows along each axis of the cube, which is divided into equal cells.
pub struct Cells<R> {
    /// The cell.
    pub cell: [[u32; BLOCK]; 3],
    /// Fraction within the cell, 0 to 1.
    pub fraction: [[R; BLOCK]; 3],
}

impl<R: Real> Default for Cells<R> {
    fn default() -> Self {
        Self { cell: [[0; BLOCK]; 3], fraction: [[R::ZERO; BLOCK]; 3] }
    }
}

impl<R: Real> Cells<R> {
    /// Locates rows `at..at + n` of `x` among `cells` cells. Points outside the cube are clamped to its rim, a NaN
    /// coordinate to 0.
    #[inline(always)]
    pub fn locate<S: Simd>(&mut self, s: S, cells: u32, x: Tile<'_, R>, at: usize, n: usize) {
        let number = |v: f64| V::<S, R>::splat(s, R::of(v));
        let (zero, scale, last) = (number(0.0), number(f64::from(cells)), number(f64::from(cells - 1)));
        for d in 0..3 {
            let x = &x.channel(d)[at..at + n];
            let mut i = 0;
            while i < n {
                // The precise maximum returns the number if the other operand is NaN.
                let p = (load(s, x, i) * scale).max_precise(zero).min(scale);
                let c = p.floor().min(last);
                store::<S, R>(p - c, &mut self.fraction[d], i);
                R::cells(s, c, &mut self.cell[d][i..]);
                i += V::<S, R>::LEN;
            }
        }
    }
}

/// For each of the first `n` rows, whether it is the last one before a row elsewhere, which `differ` tells for a row and
/// the next; and the number of such rows.
#[inline(always)]
pub fn leaving(n: usize, differ: impl Fn(usize) -> bool) -> ([bool; BLOCK], usize) {
    let mut leaves = [true; BLOCK];
    for i in 0..BLOCK - 1 {
        leaves[i] = differ(i);
    }
    leaves[n - 1] = true;
    let count = leaves[..n].iter().map(|&l| usize::from(l)).sum();
    (leaves, count)
}

/// The features of four entries, one after the other, in registers of four, of which `F` are used.
#[inline(always)]
pub fn fours<S: Simd, R: Real, const F: usize>(s: S, entries: &[[R; F]; 4]) -> [R::Four<S>; 8] {
    let mut lanes = [[R::ZERO; 4]; 8];
    for c in 0..4 {
        for f in 0..F {
            lanes[(c * F + f) / 4][(c * F + f) % 4] = entries[c][f];
        }
    }
    let mut all = [R::Four::<S>::splat(s, R::ZERO); 8];
    for q in 0..F {
        all[q] = R::Four::<S>::from_slice(s, &lanes[q]);
    }
    all
}

/// The sum of registers in the layout of [`fours`] over the entries. Register `q` has been added to `sum[q % 2]` if `F`
/// is 8, else to `sum[0]`.
#[inline(always)]
pub fn fold<S: Simd, R: Real, const F: usize>(mut sum: [R::Four<S>; 2]) -> [R; F] {
    if F < 4 {
        sum[0] += sum[0].rotate_elements_left::<2>();
    }
    if F < 2 {
        sum[0] += sum[0].rotate_elements_left::<1>();
    }
    std::array::from_fn(|f| sum[f / 4].as_slice()[f % 4])
}

/// Entry `i` of a level's table. A bounds check per entry doubles the time of the backward pass.
///
/// # Safety
/// `i` is below the length of `table`.
#[inline(always)]
#[allow(unsafe_code)]
pub unsafe fn entry<T>(table: &[T], i: u32) -> &T {
    debug_assert!((i as usize) < table.len());
    // SAFETY: the caller's promise.
    unsafe { table.get_unchecked(i as usize) }
}

/// Mutable version of [`entry`].
///
/// # Safety
/// `i` is below the length of `table`.
#[inline(always)]
#[allow(unsafe_code)]
pub unsafe fn entry_mut<T>(table: &mut [T], i: u32) -> &mut T {
    debug_assert!((i as usize) < table.len());
    // SAFETY: the caller's promise.
    unsafe { table.get_unchecked_mut(i as usize) }
}

/// A table of at least this many bytes does not stay in the L2 cache.
const LARGE: usize = 1 << 20;

/// Prefetches the cache lines of the first `n` entries of each of `indices`, so that misses overlap instead of stalling
/// one row after another. They go to the L2 cache: L1 has no room for them besides the block's other data.
#[inline(always)]
#[allow(unsafe_code)]
pub fn prefetch<'a, T>(table: &[T], indices: impl Iterator<Item = &'a [u32; BLOCK]>, n: usize) {
    #[cfg(target_arch = "x86_64")]
    if size_of_val(table) >= LARGE {
        for index in indices {
            for &i in &index[..n] {
                // SAFETY: a prefetch reads nothing and faults on no address.
                unsafe {
                    use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
                    _mm_prefetch::<_MM_HINT_T1>(table.as_ptr().wrapping_add(i as usize).cast());
                }
            }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (table, indices, n);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::b_spline_grid::BSplineGrid;
    use crate::dense_grid::DenseGrid;
    use crate::hash_grid::HashGrid;
    use crate::permutohedral::Permutohedral;
    use crate::planes::Planes;

    #[test]
    fn levels_too_fine_or_too_large_are_refused_with_words() {
        let (large, growth) = (1 << 20, 16.0);
        let all: [(&dyn EncoderSpec, &[&str]); 7] = [
            (&DenseGrid { levels: 8, ..Default::default() }, &["2^31", "hash-grid"]),
            (&DenseGrid { levels: 32, growth, base_resolution: large, ..Default::default() }, &["2^31"]),
            (&BSplineGrid { levels: 8, ..Default::default() }, &["2^31", "hash-grid"]),
            (&BSplineGrid { levels: 32, growth, base_resolution: large, ..Default::default() }, &["2^31"]),
            (&HashGrid { levels: 32, ..Default::default() }, &["2^23"]),
            (&Permutohedral { levels: 32, ..Default::default() }, &["2^22"]),
            (&Planes { levels: 12, ..Default::default() }, &["8192"]),
        ];
        for (settings, words) in all {
            let e = settings.build().err().unwrap().to_string();
            assert!(e.contains("levels") && words.iter().all(|word| e.contains(word)), "{e}");
        }
    }
}
