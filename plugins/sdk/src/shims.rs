//! The functions that the host calls: each turns pointers into slices, runs the stage, and turns what goes wrong, panics
//! included, into a status and a text.

// Pointers come from the host, by the rules of the contract (`conefield_plugin_abi`): they are valid for the lengths beside
// them for the time of the call, do not overlap where one of them is written to, and `stage` is what `create`, `reduce`,
// `fitted` or `with_weights` made. Every block below that is unsafe relies on that alone.
#![allow(unsafe_code)]

use crate::built::{AnyStage, Built, MapInfo};
use conefield_core::arena::{Arena, Block, Layout, Weights};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::loss::{Loss, NoiseModel};
use conefield_core::prior::{Blocks, Prior};
use conefield_core::registry::StageType;
use conefield_core::settings::Initializer;
use conefield_core::simd::Real;
use conefield_core::stage::{Grads, Halves, Kernel, Lengths, Projector, Samples, Stage, Tile, TileMut, UnitRay};
use conefield_plugin_abi::*;
use std::borrow::Cow;
use std::cell::RefCell;
use std::ffi::c_void;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::{mem, ptr, slice};

/// Functions of every encoder, normalizer and field.
pub static MAP: ConefieldMap = ConefieldMap {
    size: size_of::<ConefieldMap>(),
    info: Some(info),
    parameter: Some(parameter),
    init: Some(init),
    forward: Some(forward),
    backward: Some(backward),
    forward_f64: Some(forward_f64),
    backward_f64: Some(backward_f64),
    partition: Some(partition),
    reduce: Some(reduce),
    wgsl: Some(wgsl),
    passes: Some(passes),
    forward_pass: Some(forward_pass),
    forward_halves: Some(forward_halves),
    forward_pass_halves: Some(forward_pass_halves),
    backward_halves: Some(backward_halves),
    resolutions: Some(resolutions),
};

/// Functions of every projector.
pub static PROJECTOR: ConefieldProjector = ConefieldProjector {
    size: size_of::<ConefieldProjector>(),
    max_samples: Some(max_samples),
    sample: Some(sample),
    integrate: Some(integrate),
    adjoint: Some(adjoint),
    fitted: Some(fitted),
    wgsl: Some(wgsl),
};

/// Functions of every loss.
pub static LOSS: ConefieldLoss = ConefieldLoss {
    size: size_of::<ConefieldLoss>(),
    at: Some(at),
    needs_scan: Some(needs_scan),
    fitted: Some(fitted_loss),
    wgsl: Some(wgsl),
};

/// Functions of every prior.
pub static PRIOR: ConefieldPrior =
    ConefieldPrior { size: size_of::<ConefieldPrior>(), blocks: Some(blocks), block: Some(block), wgsl: Some(wgsl) };

/// Functions of every initializer.
pub static INITIALIZER: ConefieldInitializer = ConefieldInitializer {
    size: size_of::<ConefieldInitializer>(),
    apply: Some(apply),
    check: Some(check),
    weights: Some(weights),
    with_weights: Some(with_weights),
    volume: Some(volume),
};

/// Runs `f`; what goes wrong becomes a status, its text goes to `error`.
fn guard(error: *mut ConefieldText, f: impl FnOnce() -> Result<()>) -> ConefieldStatus {
    match catch_unwind(AssertUnwindSafe(f)) {
        Ok(Ok(())) => CONEFIELD_OK,
        Ok(Err(e)) => {
            let (status, text) = match &e {
                // The host knows the place.
                Error::Invalid { field, found, expected, .. } => {
                    (CONEFIELD_INVALID, format!("{field}: found {found}, expected {expected}"))
                }
                Error::Unsupported { .. } => (CONEFIELD_UNSUPPORTED, e.to_string()),
                _ => (CONEFIELD_FAILED, e.to_string()),
            };
            write(error, &text);
            status
        }
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a word");
            write(error, &format!("panicked: {text}"));
            // To drop what was thrown could panic again.
            mem::forget(panic);
            CONEFIELD_PANICKED
        }
    }
}

/// Writes as much of `text` as there is room for.
fn write(out: *mut ConefieldText, text: &str) {
    // SAFETY: see the top of this file.
    let Some(out) = (unsafe { out.as_mut() }) else { return };
    out.length = text.len();
    let n = text.len().min(out.capacity);
    if n > 0 {
        // SAFETY: see the top of this file.
        unsafe { ptr::copy_nonoverlapping(text.as_ptr(), out.data, n) };
    }
}

/// `n` things at `data`, which may be NULL for none.
unsafe fn many<'a, T>(data: *const T, n: usize) -> &'a [T] {
    // SAFETY: see the top of this file.
    if n == 0 { &[] } else { unsafe { slice::from_raw_parts(data, n) } }
}

/// As [`many`], to be written.
unsafe fn many_mut<'a, T>(data: *mut T, n: usize) -> &'a mut [T] {
    // SAFETY: see the top of this file.
    if n == 0 { &mut [] } else { unsafe { slice::from_raw_parts_mut(data, n) } }
}

unsafe fn text<'a>(s: ConefieldStr) -> Result<&'a str> {
    // SAFETY: see the top of this file.
    let bytes = unsafe { many(s.data, s.length) };
    std::str::from_utf8(bytes).map_err(|e| Error::unsupported("a text from the host", e.to_string()))
}

unsafe fn built<'a>(stage: *const c_void) -> &'a Built {
    // SAFETY: see the top of this file.
    unsafe { &*stage.cast::<Built>() }
}

unsafe fn map<'a>(stage: *const c_void) -> Result<(&'a dyn Stage, &'a MapInfo)> {
    // SAFETY: see the top of this file.
    let built = unsafe { built(stage) };
    let both = built.stage.map().zip(built.map.as_ref());
    both.ok_or_else(|| Error::unsupported("this stage", "it is no encoder, normalizer or field"))
}

unsafe fn projector<'a>(stage: *const c_void) -> Result<&'a dyn Projector> {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).stage } {
        AnyStage::Projector(p) => Ok(p.as_ref()),
        _ => Err(Error::unsupported("this stage", "it is no projector")),
    }
}

pub unsafe extern "C" fn create(
    context: *const c_void,
    settings: ConefieldStr,
    width: usize,
    stage: *mut *mut c_void,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file; `context` is what the table says, a static.
        let (t, settings) = unsafe { (&*context.cast::<StageType>(), text(settings)?) };
        let settings = serde_json::from_str(settings).map_err(|e| Error::invalid("spec", "", e, "JSON"))?;
        let built = Box::new(Built::new(t, settings, width)?);
        // SAFETY: see the top of this file.
        unsafe { *stage = Box::into_raw(built).cast() };
        Ok(())
    })
}

pub unsafe extern "C" fn destroy(stage: *mut c_void) {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file; the host lets go of it here.
        drop(unsafe { Box::from_raw(stage.cast::<Built>()) });
        Ok(())
    });
}

pub unsafe extern "C" fn describe(stage: *const c_void, out: *mut ConefieldText) -> ConefieldStatus {
    guard(out, || {
        // SAFETY: see the top of this file.
        write(out, &unsafe { built(stage) }.stage.describe());
        Ok(())
    })
}

unsafe extern "C" fn info(stage: *const c_void, out: *mut ConefieldInfo) -> ConefieldStatus {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        unsafe { *out = map(stage)?.1.info };
        Ok(())
    })
}

unsafe extern "C" fn parameter(stage: *const c_void, index: usize, out: *mut ConefieldParameter) -> ConefieldStatus {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        let blocks = unsafe { &map(stage)?.1.blocks };
        let p = blocks.get(index).ok_or_else(|| Error::unsupported("parameters", "there are not so many"))?;
        let name = ConefieldStr { data: p.name.as_ptr(), length: p.name.len() };
        let parameter = ConefieldParameter { name, shape: p.shape.as_ptr(), dimensions: p.shape.len() };
        // SAFETY: see the top of this file.
        unsafe { *out = parameter };
        Ok(())
    })
}

unsafe extern "C" fn partition(stage: *const c_void, index: usize, out: *mut ConefieldRange) -> ConefieldStatus {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        let ranges = unsafe { &map(stage)?.1.partition };
        let r = ranges.get(index).ok_or_else(|| Error::unsupported("ranges", "there are not so many"))?;
        // SAFETY: see the top of this file.
        unsafe { *out = ConefieldRange { start: r.start, end: r.end } };
        Ok(())
    })
}

unsafe extern "C" fn init(
    stage: *const c_void,
    seed: u64,
    params: *mut f32,
    length: usize,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        unsafe { map(stage)?.0.init(seed, many_mut(params, length)) };
        Ok(())
    })
}

/// Channels that the host has laid out with a stride.
struct Strided<R> {
    data: *mut R,
    channels: usize,
    rows: usize,
    stride: usize,
}

impl<R: Real> Strided<R> {
    fn close(&self) -> bool {
        self.stride == self.rows || self.channels <= 1
    }

    /// The channels, one right after the other.
    unsafe fn read<'a>(&self) -> Cow<'a, [R]> {
        // SAFETY: see the top of this file.
        unsafe {
            if self.close() {
                return Cow::Borrowed(many(self.data, self.channels * self.rows));
            }
            let channel = |c| many(self.data.add(c * self.stride), self.rows);
            Cow::Owned((0..self.channels).flat_map(|c| channel(c).iter().copied()).collect())
        }
    }

    /// Runs `f` on the channels, one right after the other.
    unsafe fn write<T>(&self, f: impl FnOnce(&mut [R]) -> T) -> T {
        // SAFETY: see the top of this file.
        unsafe {
            if self.close() {
                return f(many_mut(self.data, self.channels * self.rows));
            }
            let mut dense = self.read().into_owned();
            let out = f(&mut dense);
            for (c, from) in dense.chunks_exact(self.rows).enumerate() {
                many_mut(self.data.add(c * self.stride), self.rows).copy_from_slice(from);
            }
            out
        }
    }
}

macro_rules! strided {
    ($($tile:ident $real:ty)*) => {$(
        impl From<$tile> for Strided<$real> {
            fn from(t: $tile) -> Self {
                Self { data: t.data as *mut $real, channels: t.channels, rows: t.rows, stride: t.stride }
            }
        }
    )*};
}

strided! { ConefieldTile f32 ConefieldTileMut f32 ConefieldTile64 f64 ConefieldTileMut64 f64 }

/// `forward` of a kernel, or one pass of it.
unsafe fn run_forward<R: Real, P>(
    kernel: &dyn Kernel<R, P>,
    pass: Option<usize>,
    info: &ConefieldInfo,
    params: *const P,
    [x, y, tape]: [Strided<R>; 3],
) {
    let rows = x.rows;
    // SAFETY: see the top of this file.
    unsafe {
        let (params, x) = (many(params, info.params), x.read());
        y.write(|y| {
            tape.write(|tape| {
                let (x, y, tape) = (Tile::new(&x, rows), TileMut::new(y, rows), TileMut::new(tape, rows));
                match pass {
                    Some(pass) => kernel.forward_pass(pass, params, x, y, tape),
                    None => kernel.forward(params, x, y, tape),
                }
            });
        });
    }
}

unsafe fn run_backward<R: Real, P>(
    kernel: &dyn Kernel<R, P>,
    info: &ConefieldInfo,
    params: *const P,
    [x, tape, dy, dx]: [Strided<R>; 4],
    (grads, start, length): (*mut R, usize, usize),
) {
    let rows = x.rows;
    let wanted = !dx.data.is_null();
    // SAFETY: see the top of this file.
    unsafe {
        let (params, x, dy) = (many(params, info.params), x.read(), dy.read());
        let grads = Grads { values: many_mut(grads, length), range: start..start + length };
        tape.write(|tape| {
            let (x, tape, dy) = (Tile::new(&x, rows), TileMut::new(tape, rows), Tile::new(&dy, rows));
            if wanted {
                dx.write(|dx| kernel.backward(params, x, tape, dy, grads, Some(TileMut::new(dx, rows))));
            } else {
                kernel.backward(params, x, tape, dy, grads, None);
            }
        });
    }
}

const NO_DOUBLE: &str = "it has no kernel in double precision";

macro_rules! kernels {
    ($forward:ident $backward:ident $real:ty, $tile:ident $tile_mut:ident $grads:ident, $pick:expr) => {
        unsafe extern "C" fn $forward(
            stage: *const c_void,
            params: *const $real,
            x: $tile,
            y: $tile_mut,
            tape: $tile_mut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus {
            guard(error, || {
                // SAFETY: see the top of this file.
                unsafe {
                    let (stage, known) = map(stage)?;
                    let kernel: Option<&dyn Kernel<$real>> = $pick(stage);
                    let kernel = kernel.ok_or_else(|| Error::unsupported(stage.describe(), NO_DOUBLE))?;
                    let tiles = [x.into(), y.into(), tape.into()];
                    run_forward(kernel, None, &known.info, params, tiles);
                    stage.fault()
                }
            })
        }

        unsafe extern "C" fn $backward(
            stage: *const c_void,
            params: *const $real,
            x: $tile,
            tape: $tile_mut,
            dy: $tile,
            grads: $grads,
            dx: $tile_mut,
            error: *mut ConefieldText,
        ) -> ConefieldStatus {
            guard(error, || {
                // SAFETY: see the top of this file.
                unsafe {
                    let (stage, known) = map(stage)?;
                    let kernel: Option<&dyn Kernel<$real>> = $pick(stage);
                    let kernel = kernel.ok_or_else(|| Error::unsupported(stage.describe(), NO_DOUBLE))?;
                    let tiles = [x.into(), tape.into(), dy.into(), dx.into()];
                    run_backward(kernel, &known.info, params, tiles, (grads.data, grads.start, grads.length));
                    stage.fault()
                }
            })
        }
    };
}

kernels! { forward backward f32, ConefieldTile ConefieldTileMut ConefieldGrads, |s: &'static dyn Stage| Some(s.kernel()) }
kernels! { forward_f64 backward_f64 f64, ConefieldTile64 ConefieldTileMut64 ConefieldGrads64, |s: &'static dyn Stage| s.reference() }

unsafe extern "C" fn passes(stage: *const c_void) -> usize {
    let mut passes = 0;
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        passes = unsafe { map(stage)? }.0.kernel().passes();
        Ok(())
    });
    passes
}

unsafe extern "C" fn forward_pass(
    stage: *const c_void,
    pass: usize,
    params: *const f32,
    x: ConefieldTile,
    y: ConefieldTileMut,
    tape: ConefieldTileMut,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        unsafe {
            let (stage, known) = map(stage)?;
            let tiles = [x.into(), y.into(), tape.into()];
            run_forward(stage.kernel(), Some(pass), &known.info, params, tiles);
            stage.fault()
        }
    })
}

fn halves(stage: &dyn Stage) -> Result<Halves<'_>> {
    stage.halves().ok_or_else(|| Error::unsupported(stage.describe(), "it has no kernel that reads halves"))
}

/// Runs `$run` with the kernel that reads the parameters as they stand.
macro_rules! in_halves {
    ($stage:expr, $format:expr, |$kernel:ident| $run:expr) => {{
        let halves = halves($stage)?;
        match $format {
            CONEFIELD_F16 => {
                let $kernel = halves.f16;
                $run
            }
            CONEFIELD_BF16 => {
                let $kernel = halves.bf16;
                $run
            }
            other => return Err(Error::unsupported("halves", format!("{other} is none of the known formats"))),
        }
    }};
}

/// `forward_halves`, or one pass of it.
unsafe fn forward_of_halves(
    stage: *const c_void,
    format: u32,
    pass: Option<usize>,
    params: *const u16,
    tiles: [Strided<f32>; 3],
) -> Result<()> {
    // SAFETY: see the top of this file.
    unsafe {
        let (stage, known) = map(stage)?;
        in_halves!(stage, format, |kernel| run_forward(kernel, pass, &known.info, params.cast(), tiles));
        stage.fault()
    }
}

unsafe extern "C" fn forward_halves(
    stage: *const c_void,
    format: u32,
    params: *const u16,
    x: ConefieldTile,
    y: ConefieldTileMut,
    tape: ConefieldTileMut,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    // SAFETY: see the top of this file.
    guard(error, || unsafe { forward_of_halves(stage, format, None, params, [x.into(), y.into(), tape.into()]) })
}

unsafe extern "C" fn forward_pass_halves(
    stage: *const c_void,
    format: u32,
    pass: usize,
    params: *const u16,
    x: ConefieldTile,
    y: ConefieldTileMut,
    tape: ConefieldTileMut,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    // SAFETY: see the top of this file.
    guard(error, || unsafe { forward_of_halves(stage, format, Some(pass), params, [x.into(), y.into(), tape.into()]) })
}

unsafe extern "C" fn backward_halves(
    stage: *const c_void,
    format: u32,
    params: *const u16,
    x: ConefieldTile,
    tape: ConefieldTileMut,
    dy: ConefieldTile,
    grads: ConefieldGrads,
    dx: ConefieldTileMut,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        unsafe {
            let (stage, known) = map(stage)?;
            let tiles = [x.into(), tape.into(), dy.into(), dx.into()];
            let to = (grads.data, grads.start, grads.length);
            in_halves!(stage, format, |kernel| run_backward(kernel, &known.info, params.cast(), tiles, to));
            stage.fault()
        }
    })
}

unsafe extern "C" fn resolutions(
    stage: *const c_void,
    cells: *mut f64,
    count: usize,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let found = match unsafe { &built(stage).stage } {
            AnyStage::Encoder(e) => e.resolutions(),
            _ => None,
        };
        let found = found.ok_or_else(|| Error::unsupported("resolutions", "they are not known"))?;
        ensure(
            found.len() == count,
            "encoder",
            "resolutions",
            found.len(),
            format!("one for each of {count} channels"),
        )?;
        // SAFETY: see the top of this file; there is room for `count`.
        unsafe { many_mut(cells, count).copy_from_slice(&found) };
        Ok(())
    })
}

unsafe extern "C" fn reduce(
    stage: *const c_void,
    side: u32,
    keep: *const usize,
    keep_count: usize,
    out: *mut ConefieldReduced,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let smaller = unsafe { Box::new(built(stage).reduced(side, many(keep, keep_count))?) };
        let (params, channels) = &smaller.kept;
        let mut reduced = ConefieldReduced {
            stage: ptr::null_mut(),
            params: params.as_ptr(),
            params_count: params.len(),
            channels: channels.as_ptr(),
            channels_count: channels.len(),
        };
        reduced.stage = Box::into_raw(smaller).cast();
        // SAFETY: see the top of this file.
        unsafe { *out = reduced };
        Ok(())
    })
}

unsafe extern "C" fn wgsl(stage: *const c_void, source: *mut ConefieldText) -> ConefieldStatus {
    guard(source, || {
        // SAFETY: see the top of this file.
        let fragment = match unsafe { &built(stage).stage } {
            AnyStage::Projector(p) => p.wgsl(),
            AnyStage::Loss(l) => l.wgsl(),
            AnyStage::Prior(p) => p.wgsl(),
            other => other.map().and_then(|s| s.wgsl()),
        };
        let fragment = fragment.ok_or_else(|| Error::unsupported("this stage", "it has no WGSL"))?;
        write(source, &fragment.source);
        Ok(())
    })
}

unsafe fn ray(ray: *const ConefieldRay) -> UnitRay {
    // SAFETY: see the top of this file.
    let ConefieldRay { origin, direction, inside, published, per_mm } = unsafe { *ray };
    UnitRay { origin, direction, inside, published, per_mm }
}

unsafe extern "C" fn max_samples(stage: *const c_void, at: *const ConefieldRay) -> usize {
    let mut most = 0;
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        most = unsafe { projector(stage)?.max_samples(&ray(at)) };
        Ok(())
    });
    most
}

thread_local! {
    /// Samples of a ray, before they are handed over.
    static SAMPLES: RefCell<Samples> = RefCell::default();
}

unsafe extern "C" fn sample(
    stage: *const c_void,
    at: *const ConefieldRay,
    seed: *const u64,
    points: *mut f32,
    weights: *mut f32,
    capacity: usize,
    count: *mut usize,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let (stage, ray, seed) = unsafe { (projector(stage)?, ray(at), seed.as_ref().copied()) };
        SAMPLES.with_borrow_mut(|samples| {
            samples.points.clear();
            samples.weights.clear();
            stage.sample(&ray, seed, samples);
            stage.fault()?;
            let n = samples.points.len();
            if n > capacity || samples.weights.len() != n {
                let why = format!("{n} points and {} weights, room for {capacity}", samples.weights.len());
                return Err(Error::unsupported("the samples of a ray", why));
            }
            // SAFETY: see the top of this file; both have room for `capacity`.
            unsafe {
                many_mut(points.cast::<[f32; 3]>(), n).copy_from_slice(&samples.points);
                many_mut(weights, n).copy_from_slice(&samples.weights);
                *count = n;
            }
            Ok(())
        })
    })
}

unsafe extern "C" fn integrate(stage: *const c_void, weights: *const f32, mu: *const f64, count: usize) -> f64 {
    let mut line = f64::NAN;
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        line = unsafe { projector(stage)?.integrate(many(weights, count), many(mu, count)) };
        Ok(())
    });
    line
}

unsafe extern "C" fn adjoint(stage: *const c_void, weights: *const f32, dline: f64, dmu: *mut f64, count: usize) {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        unsafe { projector(stage)?.adjoint(many(weights, count), dline, many_mut(dmu, count)) };
        Ok(())
    });
}

unsafe extern "C" fn fitted(
    stage: *const c_void,
    lengths: *const ConefieldLengths,
    out: *mut *mut c_void,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let (stage, ConefieldLengths { voxel_mm, cell_mm }) = unsafe { (projector(stage)?, *lengths) };
        let lengths = Lengths { voxel_mm, cell_mm: (cell_mm > 0.0).then_some(cell_mm) };
        if let Some(fitted) = stage.fitted(lengths)? {
            let built = Box::new(Built::of(AnyStage::Projector(fitted)));
            // SAFETY: see the top of this file.
            unsafe { *out = Box::into_raw(built).cast() };
        }
        Ok(())
    })
}

unsafe fn loss<'a>(stage: *const c_void) -> Result<&'a dyn Loss> {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).stage } {
        AnyStage::Loss(l) => Ok(l.as_ref()),
        _ => Err(Error::unsupported("this stage", "it is no loss")),
    }
}

unsafe extern "C" fn at(
    stage: *const c_void,
    predicted: *const f64,
    measured: *const f64,
    count: usize,
    out: *mut f64,
    slope: *mut f64,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let stage = unsafe { loss(stage)? };
        // SAFETY: see the top of this file; every pointer has `count` numbers or room for them.
        let (from, to) = unsafe {
            let (predicted, measured) = (many(predicted, count), many(measured, count));
            (predicted.iter().zip(measured), many_mut(out, count).iter_mut().zip(many_mut(slope, count)))
        };
        for ((&predicted, &measured), (loss, slope)) in from.zip(to) {
            (*loss, *slope) = stage.at(predicted, measured);
        }
        stage.fault()
    })
}

unsafe extern "C" fn needs_scan(stage: *const c_void) -> u32 {
    let mut needs = false;
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        needs = unsafe { loss(stage)? }.needs_scan();
        Ok(())
    });
    needs.into()
}

unsafe extern "C" fn fitted_loss(
    stage: *const c_void,
    noise: *const ConefieldNoise,
    out: *mut *mut c_void,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let (stage, measured, sigma, growth) = unsafe {
            let ConefieldNoise { sigma, growth, measured, count } = *noise;
            (loss(stage)?, many(measured, count), sigma, growth)
        };
        if let Some(fitted) = stage.fitted(&NoiseModel { sigma, growth, measured }) {
            let built = Box::new(Built::of(AnyStage::Loss(fitted)));
            // SAFETY: see the top of this file.
            unsafe { *out = Box::into_raw(built).cast() };
        }
        stage.fault()
    })
}

unsafe fn prior<'a>(stage: *const c_void) -> Result<&'a dyn Prior> {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).stage } {
        AnyStage::Prior(p) => Ok(p.as_ref()),
        _ => Err(Error::unsupported("this stage", "it is no prior")),
    }
}

unsafe extern "C" fn blocks(stage: *const c_void, out: *mut ConefieldBlocks) -> ConefieldStatus {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file.
        let Blocks { edge, count, spacing, weight } = unsafe { prior(stage)? }.blocks();
        // SAFETY: see the top of this file.
        unsafe { *out = ConefieldBlocks { edge, count, spacing, weight } };
        Ok(())
    })
}

unsafe extern "C" fn block(
    stage: *const c_void,
    values: *const f64,
    count: usize,
    scale: f64,
    gradient: *mut f64,
    penalty: *mut f64,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        unsafe {
            let stage = prior(stage)?;
            *penalty = stage.block(many(values, count), scale, many_mut(gradient, count));
            stage.fault()
        }
    })
}

unsafe fn initializer<'a>(stage: *const c_void) -> Result<&'a dyn Initializer> {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).stage } {
        AnyStage::Initializer(i) => Ok(i.as_ref()),
        AnyStage::Waiting(w) => Err(Error::unsupported(&w.path, "the weights were not handed over")),
        _ => Err(Error::unsupported("this stage", "it is no initializer")),
    }
}

unsafe fn layout(blocks: *const ConefieldBlock, count: usize) -> Result<Layout> {
    let block = |b: &ConefieldBlock| -> Result<Block> {
        // SAFETY: see the top of this file.
        let (name, shape) = unsafe { (text(b.name)?, many(b.shape, b.dimensions)) };
        Ok(Block { name: name.into(), shape: shape.to_vec(), range: b.start..b.start + b.length })
    };
    // SAFETY: see the top of this file.
    Ok(Layout { blocks: unsafe { many(blocks, count) }.iter().map(block).collect::<Result<_>>()? })
}

unsafe extern "C" fn apply(
    stage: *const c_void,
    blocks: *const ConefieldBlock,
    block_count: usize,
    params: *mut f32,
    length: usize,
    filled: *mut u8,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let (initializer, layout) = unsafe { (initializer(stage)?, layout(blocks, block_count)?) };
        // SAFETY: see the top of this file.
        let (params, filled) = unsafe { (many_mut(params, length), many_mut(filled, block_count)) };
        let mut arena = Arena::new(length);
        arena.params.copy_from_slice(params);
        let report = initializer.apply(&layout, &mut arena)?;
        params.copy_from_slice(&arena.params);
        for (filled, b) in filled.iter_mut().zip(&layout.blocks) {
            *filled = report.loaded.contains(&b.name).into();
        }
        Ok(())
    })
}

unsafe extern "C" fn check(
    stage: *const c_void,
    blocks: *const ConefieldBlock,
    block_count: usize,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    // SAFETY: see the top of this file.
    guard(error, || unsafe { initializer(stage)?.check(&layout(blocks, block_count)?) })
}

unsafe extern "C" fn weights(stage: *const c_void, path: *mut ConefieldStr) -> ConefieldStatus {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).stage } {
        AnyStage::Waiting(w) => {
            // SAFETY: see the top of this file; the stage keeps the text.
            unsafe { *path = ConefieldStr::of(&w.path) };
            CONEFIELD_OK
        }
        _ => CONEFIELD_UNSUPPORTED,
    }
}

unsafe extern "C" fn with_weights(
    stage: *const c_void,
    tensors: *const ConefieldTensor,
    count: usize,
    out: *mut *mut c_void,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file.
        let (stage, tensors) = unsafe { (&built(stage).stage, many(tensors, count)) };
        let AnyStage::Waiting(waiting) = stage else {
            return Err(Error::unsupported("this stage", "it names no weights file"));
        };
        let mut weights = Weights::default();
        for t in tensors {
            // SAFETY: see the top of this file.
            let (name, shape, values) =
                unsafe { (text(t.name)?, many(t.shape, t.dimensions), many(t.values, t.length)) };
            weights.tensors.insert(name.into(), (shape.to_vec(), values.to_vec()));
        }
        let built = Box::new(Built::of(waiting.with(&weights)?));
        // SAFETY: see the top of this file.
        unsafe { *out = Box::into_raw(built).cast() };
        Ok(())
    })
}

unsafe extern "C" fn volume(stage: *const c_void, path: *mut ConefieldStr, steps: *mut u64) -> ConefieldStatus {
    // SAFETY: see the top of this file.
    match unsafe { &built(stage).volume } {
        Some(known) => {
            // SAFETY: see the top of this file; the stage keeps the text.
            unsafe { (*path, *steps) = (ConefieldStr::of(&known.path), known.steps) };
            CONEFIELD_OK
        }
        None => CONEFIELD_UNSUPPORTED,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::registry::{Kind, find};
    use conefield_core::settings::EncoderSpec;
    use conefield_core::stage::{Encoder, GradKind, Info, Parameter, Scope};
    use schemars::JsonSchema;
    use serde::{Deserialize, Serialize};

    /// `y = w·x`, or a panic.
    #[derive(Clone, Serialize, Deserialize, JsonSchema)]
    struct Scaled {
        panics: bool,
    }

    conefield_core::stage_type!(Encoder, "scaled", Scaled, "for tests");
    #[typetag::serde(name = "scaled")]
    impl EncoderSpec for Scaled {
        fn build(&self) -> Result<Box<dyn Encoder>> {
            Ok(Box::new(self.clone()))
        }
    }

    impl Kernel<f32> for Scaled {
        fn forward(&self, params: &[f32], x: Tile<'_, f32>, y: TileMut<'_, f32>, tape: TileMut<'_, f32>) {
            assert!(!self.panics, "told to, {}", "é".repeat(600));
            for (y, x) in y.data.iter_mut().zip(x.data) {
                *y = params[0] * x;
            }
            tape.data.copy_from_slice(&x.data[..x.rows]);
        }

        fn backward(
            &self,
            params: &[f32],
            x: Tile<'_, f32>,
            tape: TileMut<'_, f32>,
            dy: Tile<'_, f32>,
            grads: Grads<'_, f32>,
            dx: Option<TileMut<'_, f32>>,
        ) {
            assert_eq!(*tape.data, x.data[..x.rows]);
            grads.values[0] += dy.data.iter().zip(x.data).map(|(d, x)| d * x).sum::<f32>();
            if let Some(dx) = dx {
                dx.data.iter_mut().zip(dy.data).for_each(|(dx, d)| *dx = params[0] * d);
            }
        }
    }

    impl Stage for Scaled {
        fn info(&self) -> Info {
            let (scope, grads) = (Scope::Row, GradKind::Dense);
            Info { input: 3, output: 3, params: 1, tape: 1, scope, grads, macs: 3, identity: false }
        }
        fn parameters(&self) -> Vec<Parameter> {
            vec![Parameter { name: "w".into(), shape: vec![1], start: 0 }]
        }
        fn init(&self, _: u64, params: &mut [f32]) {
            params.fill(2.0);
        }
        fn kernel(&self) -> &dyn Kernel<f32> {
            self
        }
        fn describe(&self) -> String {
            "scaled".into()
        }
    }

    impl Encoder for Scaled {}

    fn made(settings: &str, error: *mut ConefieldText) -> (ConefieldStatus, *mut c_void) {
        let t = find(Kind::Encoder, "scaled").unwrap();
        let mut stage = ptr::null_mut();
        let settings = ConefieldStr::of(settings);
        let status = unsafe { create(ptr::from_ref(t).cast(), settings, 3, &mut stage, error) };
        (status, stage)
    }

    fn room(bytes: &mut [u8]) -> ConefieldText {
        ConefieldText { data: bytes.as_mut_ptr(), capacity: bytes.len(), length: 0 }
    }

    /// Rows `0..3` of 3 channels that lie 5 apart; what lies between is -1 and stays so.
    #[test]
    fn strided_tiles_are_read_and_written_in_place() {
        let (status, stage) = made(r#"{"panics": false}"#, ptr::null_mut());
        assert_eq!(status, CONEFIELD_OK);
        let spread = |v: [f32; 9]| -> Vec<f32> { v.chunks(3).flat_map(|c| [c[0], c[1], c[2], -1.0, -1.0]).collect() };
        let x = spread([1., 2., 3., 4., 5., 6., 7., 8., 9.]);
        let (mut y, mut tape, mut dx) = (vec![-1.0f32; 15], vec![-1.0f32; 5], vec![-1.0f32; 15]);
        let tile = |v: &[f32], channels| ConefieldTile { data: v.as_ptr(), channels, rows: 3, stride: 5 };
        let tile_mut =
            |v: &mut [f32], channels| ConefieldTileMut { data: v.as_mut_ptr(), channels, rows: 3, stride: 5 };
        let (params, mut grads) = ([2.0f32], [10.0f32]);
        let none = ptr::null_mut();
        unsafe {
            let (out, left) = (tile_mut(&mut y, 3), tile_mut(&mut tape, 1));
            assert_eq!(forward(stage, params.as_ptr(), tile(&x, 3), out, left, none), CONEFIELD_OK);
            assert_eq!(y, spread([2., 4., 6., 8., 10., 12., 14., 16., 18.]));
            assert_eq!(tape, [1., 2., 3., -1., -1.]);
            let dy = spread([1., 0., 0., 0., 1., 0., 0., 0., 1.]);
            let to = ConefieldGrads { data: grads.as_mut_ptr(), start: 0, length: 1 };
            let (left, out) = (tile_mut(&mut tape, 1), tile_mut(&mut dx, 3));
            let status = backward(stage, params.as_ptr(), tile(&x, 3), left, tile(&dy, 3), to, out, none);
            assert_eq!(status, CONEFIELD_OK);
            assert_eq!(grads, [10. + 1. + 5. + 9.]);
            assert_eq!(dx, spread([2., 0., 0., 0., 2., 0., 0., 0., 2.]));
            destroy(stage);
        }
    }

    #[test]
    fn a_panic_is_a_status_and_a_text_that_fits_its_room() {
        let (_, stage) = made(r#"{"panics": true}"#, ptr::null_mut());
        let mut bytes = [0u8; 16];
        let mut error = room(&mut bytes);
        let (x, mut y, mut tape) = ([0.5f32; 3], [0.0f32; 3], [0.0f32; 1]);
        let status = unsafe {
            forward(
                stage,
                [1.0f32].as_ptr(),
                ConefieldTile { data: x.as_ptr(), channels: 3, rows: 1, stride: 1 },
                ConefieldTileMut { data: y.as_mut_ptr(), channels: 3, rows: 1, stride: 1 },
                ConefieldTileMut { data: tape.as_mut_ptr(), channels: 1, rows: 1, stride: 1 },
                &mut error,
            )
        };
        assert_eq!((status, error.length), (CONEFIELD_PANICKED, "panicked: told to, ".len() + 1200));
        assert_eq!(&bytes, b"panicked: told t");
        unsafe { destroy(stage) };
    }

    #[test]
    fn settings_that_do_not_fit_are_refused_in_words() {
        let mut bytes = [0u8; 200];
        let mut error = room(&mut bytes);
        let (status, stage) = made(r#"{"panics": 3}"#, &mut error);
        assert_eq!(status, CONEFIELD_INVALID);
        assert!(stage.is_null());
        let n = error.length;
        let said = String::from_utf8_lossy(&bytes[..n]);
        assert!(said.contains("boolean"), "{said}");
    }
}
