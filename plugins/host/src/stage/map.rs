//! Encoders, normalizers and fields.

use super::*;
use conefield_core::allowance;
use conefield_core::registry::Kind;
use conefield_core::stage::TILE_ROWS;
use std::ops::Range;

/// Upper bound of the numbers of parameters, channels, … of a stage: more would overflow computations of hosts.
const MOST: usize = 1 << 40;

/// Most channels, of input, output and tape.
const WIDEST: usize = 1 << 20;

/// Maximum number of forward passes: a host does some work for each.
const MOST_PASSES: usize = 1 << 16;

settings! {
    encoder EncoderSpec(self) -> dyn Encoder { self.build(3, |handle| MapStage::tried(handle, 3)) }
    normalizer NormalizerSpec(self, width: usize) -> dyn Normalizer {
        self.build(width, move |handle| MapStage::tried(handle, width))
    }
    field FieldSpec(self, width: usize) -> dyn Field { self.build(width, move |handle| MapStage::tried(handle, width)) }
}

/// An encoder, normalizer or field from a library.
pub struct MapStage {
    own: Foreign<ConefieldMap>,
    info: Info,
    /// Further properties reported by the library.
    said: ConefieldInfo,
    passes: usize,
    resolutions: Option<Vec<f64>>,
    parameters: Vec<Parameter>,
    partition: Vec<Range<usize>>,
}

impl MapStage {
    /// The stage of `handle` for `width` channels, after a trial.
    pub(crate) fn tried(handle: Handle, width: usize) -> Result<Self> {
        let stage = Self::of(Foreign::new(handle)?)?;
        let found = format!("{width} channels for a stage that takes {}", stage.info.input);
        ensure(stage.info.input == width, "spec", "", found, "as many as it was made for")?;
        try_map(stage.own.ty(), &stage)?;
        Ok(stage)
    }

    fn of(own: Foreign<ConefieldMap>) -> Result<Self> {
        let mut said = ConefieldInfo::default();
        ask!(own, info(&mut said))?;
        let info = sound(&said).map_err(|what| own.wrong("info", &what))?;
        // The functions that these properties need.
        let f = &own.functions;
        let init = said.params == 0 || f.init.is_some();
        own.require(init, "info", || "there are parameters and no function init".into())?;
        let double = said.double_precision == 0 || (f.forward_f64.is_some() && f.backward_f64.is_some());
        own.require(double, "info", || "it declares double-precision kernels but has none".into())?;
        let parameters = parameters(&own, &said)?;
        let partition = partition(&own, &said)?;
        let passes = passes(&own)?;
        let resolutions = resolutions(&own, info.output)?;
        Ok(Self { own, info, said, passes, resolutions, parameters, partition })
    }

    /// The stage without channels on one side; `boxed` makes it one of its kind.
    fn reduce<S: ?Sized>(&self, side: u32, keep: &[usize], boxed: fn(Self) -> Box<S>) -> Result<Reduced<S>> {
        let info = &self.info;
        let Some(reduce) = self.own.functions.reduce else {
            return Err(Error::unsupported(self.own.ty().words(), "it cannot leave out channels"));
        };
        let (params, channels) = (ptr::null(), ptr::null());
        let mut r = ConefieldReduced { stage: ptr::null_mut(), params, params_count: 0, channels, channels_count: 0 };
        let made = self.own.make("reduce", |stage, out, error| {
            // SAFETY: the stage is alive; all arguments live during the call.
            let status = unsafe { reduce(stage, side, keep.as_ptr(), keep.len(), &mut r, error) };
            // SAFETY: `out` is writable.
            unsafe { *out = r.stage };
            status
        })?;
        let derived = self.own.derived("reduce", made)?;
        let smaller = timed(self.own.ty(), move || {
            let smaller = Self::of(derived)?;
            try_map(smaller.own.ty(), &smaller)?;
            Ok(smaller)
        })?;
        let fewer = r.params_count <= info.params && r.channels_count <= info.input.max(info.output);
        self.own.require(fewer, "reduce", || "it keeps more than there is".into())?;
        // SAFETY: the plugin guarantees that this many items are valid while the reduced stage lives.
        let (ranges, channels) = unsafe { (many(r.params, r.params_count), many(r.channels, r.channels_count)) };
        let params: Vec<Range<usize>> = ranges.iter().map(|r| r.start..r.end).collect();
        let sound = params.iter().all(|r| r.start <= r.end && r.end <= info.params);
        let kept: usize = if sound { params.iter().map(Range::len).sum() } else { usize::MAX };
        let (others, widths) = match side {
            CONEFIELD_OUTPUTS => (info.input, [smaller.info.output, smaller.info.input]),
            _ => (info.output, [smaller.info.input, smaller.info.output]),
        };
        let rising = channels.is_sorted_by(|a, b| a < b) && channels.iter().all(|&c| c < others);
        if kept != smaller.info.params || !rising || widths != [keep.len(), channels.len()] {
            let [own, other] = widths;
            let found = format!("a stage with {own} and {other} channels, of which {kept} parameters were kept");
            let expected = format!("what is kept to fit it, {} and {} channels", keep.len(), channels.len());
            return Err(Error::invalid(self.own.ty().words(), "reduce", found, expected));
        }
        let channels = channels.to_vec();
        Ok(Reduced { stage: boxed(smaller), params, channels })
    }
}

/// `n` items at `data`.
unsafe fn many<'a, T>(data: *const T, n: usize) -> &'a [T] {
    // SAFETY: the caller guarantees that this many items are valid.
    if n == 0 || data.is_null() { &[] } else { unsafe { slice::from_raw_parts(data, n) } }
}

/// The reported properties, if they make sense.
fn sound(i: &ConefieldInfo) -> Result<Info, String> {
    let &ConefieldInfo { input, output, params, tape, macs, .. } = i;
    let wide = [input, output, tape].iter().any(|&n| n > WIDEST);
    if [input, output].contains(&0) || wide || [params, macs].iter().any(|&n| n > MOST) {
        return Err(format!("{input} channels in, {output} out, {tape} on tape, {params} parameters"));
    }
    if i.blocks > params || i.partitions > params.max(1) {
        return Err(format!("{} blocks and {} partitions of {params} parameters", i.blocks, i.partitions));
    }
    let scope = match i.scope {
        CONEFIELD_SCOPE_ROW => Scope::Row,
        CONEFIELD_SCOPE_RAY => Scope::Ray,
        other => return Err(format!("its scope {other} is unknown")),
    };
    let grads = match i.grads {
        CONEFIELD_GRADS_NONE => GradKind::None,
        CONEFIELD_GRADS_DENSE => GradKind::Dense,
        CONEFIELD_GRADS_SCATTER => GradKind::Scatter,
        other => return Err(format!("its kind of gradients {other} is unknown")),
    };
    if (params == 0) != (grads == GradKind::None) {
        let grads = format!("CONEFIELD_GRADS_{}", format!("{grads:?}").to_uppercase());
        let expected =
            if params == 0 { "CONEFIELD_GRADS_NONE" } else { "CONEFIELD_GRADS_DENSE or CONEFIELD_GRADS_SCATTER" };
        return Err(format!("{params} parameters with {grads}, expected {expected}"));
    }
    Ok(Info { input, output, params, tape, scope, grads, macs, identity: i.identity != 0 })
}

/// Number of forward passes.
fn passes(own: &Foreign<ConefieldMap>) -> Result<usize> {
    let f = &own.functions;
    // SAFETY: the stage is alive.
    let passes = f.passes.map_or(1, |f| unsafe { f(own.handle.stage) });
    let able = passes == 1 || (2..=MOST_PASSES).contains(&passes) && f.forward_pass.is_some();
    let there = if f.forward_pass.is_some() { "a" } else { "no" };
    own.require(able, "info", || format!("it goes forward in {passes} passes with {there} function forward_pass"))?;
    Ok(passes)
}

fn parameters(own: &Foreign<ConefieldMap>, i: &ConefieldInfo) -> Result<Vec<Parameter>> {
    let require = |holds: bool, what: &dyn Fn() -> String| own.require(holds, "parameter", what);
    let mut all: Vec<Parameter> = vec![];
    let mut names = BTreeSet::new();
    let mut start = 0usize;
    for index in 0..i.blocks {
        let mut p = ConefieldParameter { name: ConefieldStr::of(""), shape: ptr::null(), dimensions: 0 };
        // SAFETY: the stage is alive, `p` is writable.
        let status =
            own.functions.parameter.map_or(CONEFIELD_FAILED, |f| unsafe { f(own.handle.stage, index, &mut p) });
        require(status == CONEFIELD_OK, &|| format!("block {index} of {} is missing", i.blocks))?;
        let (bytes, dimensions) = (p.name.length, p.dimensions);
        let sane = (1..=256).contains(&bytes) && dimensions <= 8 && !p.name.data.is_null();
        require(sane, &|| format!("block {index} has a name of {bytes} bytes, {dimensions} dimensions"))?;
        // SAFETY: the plugin guarantees that this many items are valid while the stage lives.
        let (name, shape) = unsafe { (many(p.name.data, p.name.length), many(p.shape, p.dimensions)) };
        let name = String::from_utf8_lossy(name).into_owned();
        let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).filter(|&n| n <= i.params);
        require(count.is_some(), &|| format!("block {name:?} has shape {shape:?}"))?;
        require(names.insert(name.clone()), &|| format!("two blocks are called {name:?}"))?;
        all.push(Parameter { name, shape: shape.to_vec(), start });
        start += count.unwrap_or_default();
        if start > i.params {
            break;
        }
    }
    require(start == i.params, &|| format!("blocks of {start} parameters in all, where there are {}", i.params))?;
    Ok(all)
}

fn partition(own: &Foreign<ConefieldMap>, i: &ConefieldInfo) -> Result<Vec<Range<usize>>> {
    let parts = i.grads == CONEFIELD_GRADS_SCATTER && i.partitions > 1;
    let whole = 0..i.params;
    let Some(f) = own.functions.partition.filter(|_| parts) else { return Ok(vec![whole]) };
    let mut all = vec![];
    let mut end = 0;
    for index in 0..i.partitions {
        let mut r = ConefieldRange::default();
        // SAFETY: the stage is alive, `r` is writable.
        let status = unsafe { f(own.handle.stage, index, &mut r) };
        let next = status == CONEFIELD_OK && r.start == end && r.end > r.start && r.end <= i.params;
        let what = || format!("range {index} is {}..{} after {end} of {}", r.start, r.end, i.params);
        own.require(next, "partition", what)?;
        all.push(r.start..r.end);
        end = r.end;
    }
    own.require(end == i.params, "partition", || format!("ranges end at {end} of {}", i.params))?;
    Ok(all)
}

/// Resolution of each of `count` channels in cells, if the encoder reports it.
fn resolutions(own: &Foreign<ConefieldMap>, count: usize) -> Result<Option<Vec<f64>>> {
    let Some(f) = own.functions.resolutions.filter(|_| own.ty().kind == Kind::Encoder) else { return Ok(None) };
    let mut cells = vec![f64::MARK; count + GUARD];
    // SAFETY: the stage is alive, `cells` has room for more than `count`.
    if !own.asked("resolutions", |stage, error| unsafe { f(stage, cells.as_mut_ptr(), count, error) })? {
        return Ok(None);
    }
    let within = cells[count..].iter().all(|v| v.is_mark());
    own.require(within, "resolutions", || format!("it writes past the {count} channels that there are"))?;
    cells.truncate(count);
    for (c, cells) in cells.iter().enumerate() {
        own.require(!cells.is_mark(), "resolutions", || format!("channel {c} of {count} is left unwritten"))?;
        let sound = cells.is_finite() && *cells > 0.0;
        own.require(sound, "resolutions", || format!("channel {c} of {count} resolves {cells} cells"))?;
    }
    Ok(Some(cells))
}

/// Channel-major rows in the format of the ABI.
trait Across<T> {
    fn across(self, rows: usize) -> T;
}

macro_rules! across {
    ($($real:ty, $tile:ident $tile_mut:ident;)*) => {$(
        impl Across<$tile> for &[$real] {
            fn across(self, rows: usize) -> $tile {
                $tile { data: self.as_ptr(), channels: self.len() / rows, rows, stride: rows }
            }
        }

        impl Across<$tile_mut> for &mut [$real] {
            fn across(self, rows: usize) -> $tile_mut {
                $tile_mut { data: self.as_mut_ptr(), channels: self.len() / rows, rows, stride: rows }
            }
        }
    )*};
}

across! {
    f32, ConefieldTile ConefieldTileMut;
    f64, ConefieldTile64 ConefieldTileMut64;
}

macro_rules! kernel {
    ($real:ty, $tile_mut:ident $grads:ident, $forward:ident $backward:ident $($forward_pass:ident)?) => {
        impl Kernel<$real> for MapStage {
            fn forward(&self, params: &[$real], x: Tile<'_, $real>, y: TileMut<'_, $real>, tape: TileMut<'_, $real>) {
                let (rows, params) = (x.rows, params.as_ptr());
                let (x, out, tape) = (x.data.across(rows), y.data.across(rows), tape.data.across(rows));
                self.own.filled(call!(self.own, $forward(params, x, out, tape)), y.data);
            }

            fn backward(&self, Backward { params, x, tape, dy, grads, dx }: Backward<'_, $real>) {
                let (rows, params) = (x.rows, params.as_ptr());
                let (x, tape, dy) = (x.data.across(rows), tape.data.across(rows), dy.data.across(rows));
                let dx = dx.map(|dx| dx.data).unwrap_or_default();
                let mut to: $tile_mut = dx.across(rows);
                if dx.is_empty() {
                    to.data = ptr::null_mut();
                }
                let (start, length) = (grads.range.start, grads.values.len());
                let grads = $grads { data: grads.values.as_mut_ptr(), start, length };
                self.own.filled(call!(self.own, $backward(params, x, tape, dy, grads, to)), dx);
            }

            $(
                fn passes(&self) -> usize {
                    self.passes
                }

                fn forward_pass(
                    &self,
                    pass: usize,
                    params: &[$real],
                    x: Tile<'_, $real>,
                    y: TileMut<'_, $real>,
                    tape: TileMut<'_, $real>,
                ) {
                    if self.passes <= 1 || self.own.functions.$forward_pass.is_none() {
                        return self.forward(params, x, y, tape);
                    }
                    let (rows, params) = (x.rows, params.as_ptr());
                    let (x, out, tape) = (x.data.across(rows), y.data.across(rows), tape.data.across(rows));
                    self.own.filled(call!(self.own, $forward_pass(pass, params, x, out, tape)), y.data);
                }
            )?
        }
    };
}

kernel! { f32, ConefieldTileMut ConefieldGrads, forward backward forward_pass }
kernel! { f64, ConefieldTileMut64 ConefieldGrads64, forward_f64 backward_f64 }

impl Stage for MapStage {
    fn info(&self) -> Info {
        self.info.clone()
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.parameters.clone()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        if !params.is_empty() {
            self.own.noted(call!(self.own, init(seed, params.as_mut_ptr(), params.len())), ());
        }
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        (self.said.double_precision != 0).then_some(self as _)
    }

    fn partition(&self) -> Vec<Range<usize>> {
        self.partition.clone()
    }

    said! { own: describe fault wgsl }
}

impl Encoder for MapStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        self.reduce(CONEFIELD_OUTPUTS, keep, |stage| Box::new(stage))
    }

    fn coarse_to_fine(&self) -> bool {
        self.said.coarse_to_fine != 0
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        self.resolutions.clone()
    }
}

impl Field for MapStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        self.reduce(CONEFIELD_INPUTS, keep, |stage| Box::new(stage))
    }
}

impl Normalizer for MapStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        self.reduce(CONEFIELD_INPUTS, keep, |stage| Box::new(stage))
    }
}

/// Stages with more parameters are not initialized for their trial: it takes long, and the run does it anyway.
const MANY: usize = 1 << 20;

/// Tries an encoder, normalizer or field of type `ty`.
fn try_map(ty: &Type, stage: &dyn Stage) -> Result<()> {
    let info = stage.info();
    // The trial's parameters and their gradients; a run needs more.
    allowance::numbers(&ty.words(), "parameters", info.params.saturating_mul(2))?;
    let mut params = Guarded::zeroed(info.params);
    if info.params <= MANY {
        stage.init(1, params.inner());
        stage.fault()?;
        settled(ty, params.broken("parameters").or_else(|| params.unsound("initial parameters")))?;
    }
    for rows in [1, 3, TILE_ROWS] {
        try_tile(ty, stage, &mut params, rows)?;
    }
    Ok(())
}

/// Tries the kernel of a stage on a tile.
fn try_tile(ty: &Type, stage: &dyn Stage, params: &mut Guarded<f32>, rows: usize) -> Result<()> {
    let (info, kernel) = (stage.info(), stage.kernel());
    let range: Range<usize> = match info.grads {
        GradKind::Scatter => stage.partition().into_iter().min_by_key(Range::len).unwrap_or(0..info.params),
        _ => 0..info.params,
    };
    let mut x = Guarded::new(info.input * rows);
    for (i, x) in x.inner().iter_mut().enumerate() {
        *x = unit(mix(7, i as u64));
    }
    let [mut y, mut tape, mut dx] = [info.output, info.tape, info.input].map(|c| Guarded::new(c * rows));
    let (to, left) = (TileMut::new(y.inner(), rows), TileMut::new(tape.inner(), rows));
    kernel.forward(params.inner(), Tile::new(x.inner(), rows), to, left);
    stage.fault()?;
    settled(ty, y.broken("output").or_else(|| tape.broken("tape")).or_else(|| y.unsound("output")))?;
    let changed = info.identity && y.inner() != x.inner();
    settled(ty, changed.then(|| "an identity must return its input unchanged".into()))?;
    if kernel.passes() > 1 {
        let [mut again, mut left] = [info.output, info.tape].map(|c| Guarded::new(c * rows));
        for pass in 0..kernel.passes() {
            let (y, tape) = (TileMut::new(again.inner(), rows), TileMut::new(left.inner(), rows));
            kernel.forward_pass(pass, params.inner(), Tile::new(x.inner(), rows), y, tape);
        }
        stage.fault()?;
        settled(ty, again.broken("output in passes").or_else(|| left.broken("tape in passes")))?;
        let same = again.inner() == y.inner() && left.inner() == tape.inner();
        settled(ty, (!same).then(|| "its passes together are not its forward".into()))?;
    }
    let dy = vec![1.0; info.output * rows];
    let mut grads = Guarded::zeroed(range.len());
    kernel.backward(Backward {
        params: params.inner(),
        x: Tile::new(x.inner(), rows),
        tape: TileMut::new(tape.inner(), rows),
        dy: Tile::new(&dy, rows),
        grads: Grads { values: grads.inner(), range },
        dx: Some(TileMut::new(dx.inner(), rows)),
    });
    stage.fault()?;
    settled(ty, grads.broken("gradients").or_else(|| dx.broken("input gradient")))?;
    settled(ty, tape.broken("tape").or_else(|| x.broken("input")).or_else(|| params.broken("parameters")))?;
    settled(ty, grads.unsound("gradients").or_else(|| dx.unsound("input gradient")))
}
