//! Encoders, normalizers and fields.

#![allow(unsafe_code)]

use super::{Fault, fragment};
use crate::library::{Functions, Handle, Text, Type};
use crate::trial::{self, GUARD, UNTOUCHED};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::half::{Bf16, F16};
use conefield_core::registry::Kind;
use conefield_core::stage::{
    Encoder, Field, GradKind, Grads, Halves, Info, Kernel, Normalizer, Parameter, Reduced, Scope, Stage, Tile, TileMut,
};
use conefield_core::wgsl::Fragment;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use std::{ptr, slice};

/// Most parameters, channels, … that a stage may say it has: more would overflow what hosts compute from them.
const MOST: usize = 1 << 40;

/// Most passes that a stage may go forward in: a host does something for each.
const MOST_PASSES: usize = 1 << 16;

/// An encoder, a normalizer or a field of a library.
pub struct MapStage {
    handle: Handle,
    map: ConefieldMap,
    info: Info,
    coarse_to_fine: bool,
    double: bool,
    halves: bool,
    passes: usize,
    resolutions: Option<Vec<f64>>,
    parameters: Vec<Parameter>,
    partition: Vec<Range<usize>>,
    describe: String,
    fault: Fault,
}

/// Makes a stage and tries it out.
pub(crate) fn build(ty: &Arc<Type>, settings: &Value, width: usize) -> Result<MapStage> {
    let (own, settings) = (ty.clone(), settings.clone());
    trial::timed(ty, move || {
        let stage = MapStage::new(own.create(&settings, width)?)?;
        let found = format!("{width} channels for a stage that takes {}", stage.info.input);
        ensure(stage.info.input == width, "spec", "", found, "as many as it was made for")?;
        trial::map(&own, &stage)?;
        Ok(stage)
    })
}

impl MapStage {
    fn new(handle: Handle) -> Result<Self> {
        let Functions::Map(map) = handle.ty.functions else {
            return Err(handle.ty.failed("create", CONEFIELD_FAILED, "it is no map of rows"));
        };
        let wrong = |what: &str| handle.ty.failed("info", CONEFIELD_FAILED, what);
        let mut i = ConefieldInfo {
            input: 0,
            output: 0,
            params: 0,
            blocks: 0,
            partitions: 0,
            tape: 0,
            macs: 0,
            scope: 0,
            grads: 0,
            identity: 0,
            coarse_to_fine: 0,
            double_precision: 0,
            halves: 0,
        };
        // SAFETY: the stage is alive, `i` is to be written.
        let status = map.info.map_or(CONEFIELD_FAILED, |info| unsafe { info(handle.stage, &mut i) });
        if status != CONEFIELD_OK {
            return Err(handle.ty.failed("info", status, ""));
        }
        if [i.input, i.output].contains(&0) || [i.input, i.output, i.params, i.tape, i.macs].iter().any(|&n| n > MOST) {
            return Err(wrong(&format!("{} channels in, {} out, {} parameters", i.input, i.output, i.params)));
        }
        let scope = match i.scope {
            CONEFIELD_SCOPE_ROW => Scope::Row,
            CONEFIELD_SCOPE_RAY => Scope::Ray,
            other => return Err(wrong(&format!("it looks as far as {other}, which is none of the known scopes"))),
        };
        let grads = match i.grads {
            CONEFIELD_GRADS_NONE => GradKind::None,
            CONEFIELD_GRADS_DENSE => GradKind::Dense,
            CONEFIELD_GRADS_SCATTER => GradKind::Scatter,
            other => return Err(wrong(&format!("its gradients are {other}, which is none of the known kinds"))),
        };
        if (i.params == 0) != (grads == GradKind::None) {
            return Err(wrong(&format!("{} parameters with gradients {grads:?}", i.params)));
        }
        if i.params > 0 && map.init.is_none() {
            return Err(wrong("there are parameters and no function init"));
        }
        let parameters = parameters(&handle, &map, &i)?;
        let partition = partition(&handle, &map, &i, grads)?;
        let info = Info {
            input: i.input,
            output: i.output,
            params: i.params,
            tape: i.tape,
            scope,
            grads,
            macs: i.macs,
            identity: i.identity != 0,
        };
        let describe = handle.describe();
        let coarse_to_fine = i.coarse_to_fine != 0;
        let double = i.double_precision != 0;
        if double && (map.forward_f64.is_none() || map.backward_f64.is_none()) {
            return Err(wrong("it has no kernels in double precision, and says that it has"));
        }
        let halves = i.halves != 0;
        if halves && (map.forward_halves.is_none() || map.backward_halves.is_none()) {
            return Err(wrong("it has no kernels that read halves, and says that it has"));
        }
        // SAFETY: the stage is alive.
        let passes = map.passes.map_or(1, |f| unsafe { f(handle.stage) });
        if passes == 0 || passes > MOST_PASSES || (passes > 1 && map.forward_pass.is_none()) {
            let there = if map.forward_pass.is_some() { "a" } else { "no" };
            return Err(wrong(&format!("it goes forward in {passes} passes with {there} function forward_pass")));
        }
        if halves && passes > 1 && map.forward_pass_halves.is_none() {
            return Err(wrong(&format!("it goes forward in {passes} passes with no function forward_pass_halves")));
        }
        let resolutions = resolutions(&handle, &map, info.output)?;
        let fault = Fault::default();
        Ok(Self {
            handle,
            map,
            info,
            coarse_to_fine,
            double,
            halves,
            passes,
            resolutions,
            parameters,
            partition,
            describe,
            fault,
        })
    }

    /// The type that it is of.
    fn ty(&self) -> &Type {
        &self.handle.ty
    }

    /// Notes what a call that may fail said.
    fn settle(&self, call: &str, status: ConefieldStatus, error: &Text) -> bool {
        let fine = status == CONEFIELD_OK;
        if !fine {
            self.fault.set(self.ty().failed(call, status, &error.text()));
        }
        fine
    }

    fn reduce(&self, side: u32, keep: &[usize]) -> Result<(Self, Vec<Range<usize>>, Vec<usize>)> {
        let (ty, info) = (self.ty(), &self.info);
        let Some(reduce) = self.map.reduce else {
            return Err(Error::unsupported(ty.words(), "it cannot leave out channels"));
        };
        let mut r = ConefieldReduced {
            stage: ptr::null_mut(),
            params: ptr::null(),
            params_count: 0,
            channels: ptr::null(),
            channels_count: 0,
        };
        let mut error = Text::new();
        // SAFETY: the stage is alive; everything handed over lives for the time of the call.
        let status = unsafe { reduce(self.handle.stage, side, keep.as_ptr(), keep.len(), &mut r, error.room()) };
        if status != CONEFIELD_OK {
            return Err(ty.failed("reduce", status, &error.text()));
        }
        let wrong = |what: &str| ty.failed("reduce", CONEFIELD_FAILED, what);
        let nothing = || Error::invalid(ty.words(), "reduce", "nothing", "a new stage");
        let handle = self.handle.made(r.stage, "reduce")?.ok_or_else(nothing)?;
        let smaller = Self::new(handle)?;
        if r.params_count > info.params || r.channels_count > info.input.max(info.output) {
            return Err(wrong("it keeps more than there is"));
        }
        // SAFETY: the plugin says that so many stand there as long as the smaller stage lives.
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
            return Err(Error::invalid(ty.words(), "reduce", found, expected));
        }
        Ok((smaller, params, channels.to_vec()))
    }
}

/// `n` things at `data`.
unsafe fn many<'a, T>(data: *const T, n: usize) -> &'a [T] {
    // SAFETY: the caller knows that so many stand there.
    if n == 0 || data.is_null() { &[] } else { unsafe { slice::from_raw_parts(data, n) } }
}

fn parameters(handle: &Handle, map: &ConefieldMap, i: &ConefieldInfo) -> Result<Vec<Parameter>> {
    let wrong = |what: String| handle.ty.failed("parameter", CONEFIELD_FAILED, &what);
    let mut all: Vec<Parameter> = vec![];
    let mut names = BTreeSet::new();
    let mut start = 0usize;
    for index in 0..i.blocks {
        let mut p = ConefieldParameter {
            name: ConefieldStr { data: ptr::null(), length: 0 },
            shape: ptr::null(),
            dimensions: 0,
        };
        // SAFETY: the stage is alive, `p` is to be written.
        let status = map.parameter.map_or(CONEFIELD_FAILED, |f| unsafe { f(handle.stage, index, &mut p) });
        if status != CONEFIELD_OK {
            return Err(wrong(format!("block {index} of {} cannot be had", i.blocks)));
        }
        if p.name.length == 0 || p.name.length > 256 || p.dimensions > 8 || p.name.data.is_null() {
            return Err(wrong(format!(
                "block {index} has a name of {} bytes, {} dimensions",
                p.name.length, p.dimensions
            )));
        }
        // SAFETY: the plugin says that so many stand there as long as the stage lives.
        let (name, shape) = unsafe { (many(p.name.data, p.name.length), many(p.shape, p.dimensions)) };
        let name = String::from_utf8_lossy(name).into_owned();
        let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).filter(|&n| n <= i.params);
        let Some(count) = count else { return Err(wrong(format!("block {name:?} has shape {shape:?}"))) };
        if !names.insert(name.clone()) {
            return Err(wrong(format!("two blocks are called {name:?}")));
        }
        all.push(Parameter { name, shape: shape.to_vec(), start });
        start += count;
        if start > i.params {
            break;
        }
    }
    if start != i.params {
        return Err(wrong(format!("blocks of {start} parameters in all, where there are {}", i.params)));
    }
    Ok(all)
}

fn partition(handle: &Handle, map: &ConefieldMap, i: &ConefieldInfo, grads: GradKind) -> Result<Vec<Range<usize>>> {
    let whole = || vec![0..i.params];
    let Some(f) = map.partition.filter(|_| grads == GradKind::Scatter && i.partitions > 1) else { return Ok(whole()) };
    let wrong = |what: String| handle.ty.failed("partition", CONEFIELD_FAILED, &what);
    let mut all = vec![];
    let mut end = 0;
    for index in 0..i.partitions {
        let mut r = ConefieldRange { start: 0, end: 0 };
        // SAFETY: the stage is alive, `r` is to be written.
        let status = unsafe { f(handle.stage, index, &mut r) };
        if status != CONEFIELD_OK || r.start != end || r.end < r.start || r.end > i.params {
            return Err(wrong(format!("range {index} is {}..{} after {end} of {}", r.start, r.end, i.params)));
        }
        all.push(r.start..r.end);
        end = r.end;
    }
    if end == i.params { Ok(all) } else { Err(wrong(format!("ranges end at {end} of {}", i.params))) }
}

/// How many cells each of `count` channels tells apart, where the encoder says so.
fn resolutions(handle: &Handle, map: &ConefieldMap, count: usize) -> Result<Option<Vec<f64>>> {
    let Some(f) = map.resolutions.filter(|_| handle.ty.kind == Kind::Encoder) else { return Ok(None) };
    let mark = f64::from_bits(UNTOUCHED.into());
    let mut cells = vec![mark; count + GUARD];
    let mut error = Text::new();
    // SAFETY: the stage is alive, `cells` has room for more than `count`.
    let status = unsafe { f(handle.stage, cells.as_mut_ptr(), count, error.room()) };
    if status == CONEFIELD_UNSUPPORTED {
        return Ok(None);
    }
    if status != CONEFIELD_OK {
        return Err(handle.ty.failed("resolutions", status, &error.text()));
    }
    let wrong = |what: String| Err(handle.ty.failed("resolutions", CONEFIELD_FAILED, &what));
    let untouched = |v: &f64| v.to_bits() == mark.to_bits();
    if !cells[count..].iter().all(untouched) {
        return wrong(format!("it writes past the {count} channels that there are"));
    }
    cells.truncate(count);
    match cells.iter().position(|v| !(v.is_finite() && *v > 0.0) || untouched(v)) {
        Some(c) if untouched(&cells[c]) => wrong(format!("channel {c} of {count} is left unwritten")),
        Some(c) => wrong(format!("channel {c} of {count} tells {} cells apart", cells[c])),
        None => Ok(Some(cells)),
    }
}

/// Channel-major rows, as a library sees them.
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

/// Calls a function of the library, which is told the format of halves where there is one.
macro_rules! call {
    ($f:ident, $stage:expr, ($($format:expr)?), $($rest:expr),*) => {
        $f($stage, $($format,)? $($rest),*)
    };
}

/// A kernel in `$real` on parameters that stand as `$param`, which the library's functions are told by `$format`.
macro_rules! kernel {
    (
        $real:ty, $param:ty, $tile_mut:ident $grads:ident,
        $forward:ident $backward:ident $format:tt $(passes: $forward_pass:ident)?
    ) => {
        impl Kernel<$real, $param> for MapStage {
            fn forward(&self, params: &[$param], x: Tile<'_, $real>, y: TileMut<'_, $real>, tape: TileMut<'_, $real>) {
                let rows = x.rows;
                let mut error = Text::new();
                // SAFETY: the stage is alive, and every pointer goes with the length of what it leads to.
                let status = self.map.$forward.map_or(CONEFIELD_UNSUPPORTED, |f| unsafe {
                    let (x, out, tape) = (x.data.across(rows), y.data.across(rows), tape.data.across(rows));
                    call!(f, self.handle.stage, $format, params.as_ptr().cast(), x, out, tape, error.room())
                });
                if !self.settle(stringify!($forward), status, &error) {
                    y.data.fill(<$real>::NAN);
                }
            }

            fn backward(
                &self,
                params: &[$param],
                x: Tile<'_, $real>,
                tape: TileMut<'_, $real>,
                dy: Tile<'_, $real>,
                grads: Grads<'_, $real>,
                mut dx: Option<TileMut<'_, $real>>,
            ) {
                let rows = x.rows;
                let mut error = Text::new();
                // SAFETY: as for `forward`.
                let status = self.map.$backward.map_or(CONEFIELD_UNSUPPORTED, |f| unsafe {
                    let nowhere = $tile_mut { data: ptr::null_mut(), channels: 0, rows, stride: rows };
                    let (x, tape, dy) = (x.data.across(rows), tape.data.across(rows), dy.data.across(rows));
                    let dx = dx.as_mut().map_or(nowhere, |dx| dx.data.across(rows));
                    let (start, length) = (grads.range.start, grads.values.len());
                    let grads = $grads { data: grads.values.as_mut_ptr(), start, length };
                    call!(f, self.handle.stage, $format, params.as_ptr().cast(), x, tape, dy, grads, dx, error.room())
                });
                if !self.settle(stringify!($backward), status, &error)
                    && let Some(dx) = dx
                {
                    dx.data.fill(<$real>::NAN);
                }
            }

            $(
                fn passes(&self) -> usize {
                    self.passes
                }

                fn forward_pass(
                    &self,
                    pass: usize,
                    params: &[$param],
                    x: Tile<'_, $real>,
                    y: TileMut<'_, $real>,
                    tape: TileMut<'_, $real>,
                ) {
                    let Some(f) = self.map.$forward_pass.filter(|_| self.passes > 1) else {
                        return self.forward(params, x, y, tape);
                    };
                    let rows = x.rows;
                    let mut error = Text::new();
                    // SAFETY: as for `forward`.
                    let status = unsafe {
                        let (x, out, tape) = (x.data.across(rows), y.data.across(rows), tape.data.across(rows));
                        call!(f, self.handle.stage, $format, pass, params.as_ptr().cast(), x, out, tape, error.room())
                    };
                    if !self.settle(stringify!($forward_pass), status, &error) {
                        y.data.fill(<$real>::NAN);
                    }
                }
            )?
        }
    };
}

kernel! { f32, f32, ConefieldTileMut ConefieldGrads, forward backward () passes: forward_pass }
kernel! { f64, f64, ConefieldTileMut64 ConefieldGrads64, forward_f64 backward_f64 () }
kernel! {
    f32, F16, ConefieldTileMut ConefieldGrads,
    forward_halves backward_halves (CONEFIELD_F16) passes: forward_pass_halves
}
kernel! {
    f32, Bf16, ConefieldTileMut ConefieldGrads,
    forward_halves backward_halves (CONEFIELD_BF16) passes: forward_pass_halves
}

impl Stage for MapStage {
    fn info(&self) -> Info {
        self.info.clone()
    }

    fn parameters(&self) -> Vec<Parameter> {
        self.parameters.clone()
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        let Some(init) = self.map.init.filter(|_| !params.is_empty()) else { return };
        let mut error = Text::new();
        // SAFETY: the stage is alive, `params` has that length.
        let status = unsafe { init(self.handle.stage, seed, params.as_mut_ptr(), params.len(), error.room()) };
        self.settle("init", status, &error);
    }

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn reference(&self) -> Option<&dyn Kernel<f64>> {
        self.double.then_some(self as _)
    }

    fn halves(&self) -> Option<Halves<'_>> {
        self.halves.then(|| Halves::of(self))
    }

    fn partition(&self) -> Vec<Range<usize>> {
        self.partition.clone()
    }

    fn fault(&self) -> Result<()> {
        self.fault.take()
    }

    fn wgsl(&self) -> Option<Fragment> {
        fragment(&self.handle, self.map.wgsl)
    }

    fn describe(&self) -> String {
        self.describe.clone()
    }
}

impl Encoder for MapStage {
    fn keep_outputs(&self, keep: &[usize]) -> Result<Reduced<dyn Encoder>> {
        let (stage, params, channels) = self.reduce(CONEFIELD_OUTPUTS, keep)?;
        Ok(Reduced { stage: Box::new(stage), params, channels })
    }

    fn coarse_to_fine(&self) -> bool {
        self.coarse_to_fine
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        self.resolutions.clone()
    }
}

impl Field for MapStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Field>> {
        let (stage, params, channels) = self.reduce(CONEFIELD_INPUTS, keep)?;
        Ok(Reduced { stage: Box::new(stage), params, channels })
    }
}

impl Normalizer for MapStage {
    fn keep_inputs(&self, keep: &[usize]) -> Result<Reduced<dyn Normalizer>> {
        let (stage, params, channels) = self.reduce(CONEFIELD_INPUTS, keep)?;
        Ok(Reduced { stage: Box::new(stage), params, channels })
    }
}
