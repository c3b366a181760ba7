//! Encoders, normalizers and fields.

use super::*;
use crate::built::{Map, Rows};
use std::borrow::Cow;

table! {
    ConefieldMap: info parameter init forward backward forward_f64 backward_f64 partition reduce wgsl passes forward_pass resolutions;
    encoder(keys, _) { of(Rows::Encoder(settings::<dyn EncoderSpec>(keys)?.build()?)) }
    normalizer(keys, width) { of(Rows::Normalizer(settings::<dyn NormalizerSpec>(keys)?.build(width)?)) }
    field(keys, width) { of(Rows::Field(settings::<dyn FieldSpec>(keys)?.build(width)?)) };
    Map: "encoder, normalizer or field"
}

shims! {
    fn info(map: Map, out: *mut ConefieldInfo) {
        *out = map.info;
    }

    fn parameter(map: Map, index: usize, out: *mut ConefieldParameter) {
        let p = map.blocks.get(index).ok_or_else(|| Error::unsupported("parameters", "the index is too large"))?;
        let name = ConefieldStr::of(&p.name);
        *out = ConefieldParameter { name, shape: p.shape.as_ptr(), dimensions: p.shape.len() };
    }

    fn partition(map: Map, index: usize, out: *mut ConefieldRange) {
        let r = map.partition.get(index).ok_or_else(|| Error::unsupported("ranges", "the index is too large"))?;
        *out = ConefieldRange { start: r.start, end: r.end };
    }

    fn init(map: Map, seed: u64, params: *mut f32, length: usize; error) {
        map.stage().init(seed, many_mut(params, length));
    }

    fn passes(map: Map) -> usize, or 0, { map.stage().kernel().passes() }

    fn resolutions(map: Map, cells: *mut f64, count: usize; error) {
        let found = map.encoder()?.resolutions().ok_or_else(|| Error::unsupported("resolutions", "they are not known"))?;
        let expected = format!("one for each of {count} channels");
        ensure(found.len() == count, "encoder", "resolutions", found.len(), expected)?;
        many_mut(cells, count).copy_from_slice(&found);
    }

    fn reduce(map: Map, side: u32, keep: *const usize, keep_count: usize, out: *mut ConefieldReduced; error) {
        let smaller = Box::new(map.reduced(side, many(keep, keep_count))?);
        // Both lists stay where they are when the stage moves.
        let (params, channels) = &smaller.kept;
        *out = ConefieldReduced {
            params: params.as_ptr(),
            params_count: params.len(),
            channels: channels.as_ptr(),
            channels_count: channels.len(),
            stage: hand_over(smaller),
        };
    }

    fn wgsl(map: Map; source) {
        write_wgsl(source, map.stage().wgsl())?;
    }
}

fn of(rows: Rows) -> super::Held {
    Box::new(Box::new(Map::of(rows)))
}

/// Channels in the host's memory, with a stride.
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

    /// The channels, contiguous.
    unsafe fn read<'a>(&self) -> Cow<'a, [R]> {
        // SAFETY: see `shims/mod.rs`.
        unsafe {
            if self.close() {
                return Cow::Borrowed(many(self.data, self.channels * self.rows));
            }
            let channel = |c| many(self.data.add(c * self.stride), self.rows);
            Cow::Owned((0..self.channels).flat_map(|c| channel(c).iter().copied()).collect())
        }
    }

    /// Runs `f` on the channels, made contiguous.
    unsafe fn write<T>(&self, f: impl FnOnce(&mut [R]) -> T) -> T {
        // SAFETY: see `shims/mod.rs`.
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

/// `forward` of a kernel, or one of its passes.
unsafe fn run_forward<R: Real>(
    map: &Map,
    kernel: &dyn Kernel<R>,
    pass: Option<usize>,
    params: *const R,
    [x, y, tape]: [Strided<R>; 3],
) -> Result<()> {
    let rows = x.rows;
    // SAFETY: see `shims/mod.rs`.
    unsafe {
        let (params, x) = (many(params, map.info.params), x.read());
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
    map.stage().fault()
}

unsafe fn run_backward<R: Real>(
    map: &Map,
    kernel: &dyn Kernel<R>,
    params: *const R,
    [x, tape, dy, dx]: [Strided<R>; 4],
    grads: Grads<'_, R>,
) -> Result<()> {
    let rows = x.rows;
    let wanted = !dx.data.is_null();
    // SAFETY: see `shims/mod.rs`.
    unsafe {
        let (params, x, dy) = (many(params, map.info.params), x.read(), dy.read());
        tape.write(|tape| {
            let (x, tape, dy) = (Tile::new(&x, rows), TileMut::new(tape, rows), Tile::new(&dy, rows));
            if wanted {
                dx.write(|dx| {
                    let dx = Some(TileMut::new(dx, rows));
                    kernel.backward(Backward { params, x, tape, dy, grads, dx });
                });
            } else {
                kernel.backward(Backward { params, x, tape, dy, grads, dx: None });
            }
        });
    }
    map.stage().fault()
}

/// The kernel of a stage.
fn single(stage: &dyn Stage) -> Result<&dyn Kernel<f32>> {
    Ok(stage.kernel())
}

/// The same in double precision.
fn double(stage: &dyn Stage) -> Result<&dyn Kernel<f64>> {
    stage.reference().ok_or_else(|| Error::unsupported("this stage", "it has no kernel in double precision"))
}

/// `forward` and `backward` in one precision.
macro_rules! kernel {
    ($real:ty, $tile:ident $tile_mut:ident $grads:ident, $forward:ident $backward:ident, $kernel:expr) => {
        shims! {
            fn $forward(map: Map, params: *const $real, x: $tile, y: $tile_mut, tape: $tile_mut; error) {
                run_forward(map, $kernel(map.stage())?, None, params, [x.into(), y.into(), tape.into()])?;
            }

            fn $backward(
                map: Map, params: *const $real, x: $tile, tape: $tile_mut, dy: $tile, to: $grads, dx: $tile_mut; error
            ) {
                let grads = Grads { values: many_mut(to.data, to.length), range: to.start..to.start + to.length };
                run_backward(map, $kernel(map.stage())?, params, [x.into(), tape.into(), dy.into(), dx.into()], grads)?;
            }
        }
    };
}

kernel! { f32, ConefieldTile ConefieldTileMut ConefieldGrads, forward backward, single }
kernel! { f64, ConefieldTile64 ConefieldTileMut64 ConefieldGrads64, forward_f64 backward_f64, double }

shims! {
    fn forward_pass(
        map: Map, pass: usize, params: *const f32, x: ConefieldTile, y: ConefieldTileMut, tape: ConefieldTileMut; error
    ) {
        run_forward(map, map.stage().kernel(), Some(pass), params, [x.into(), y.into(), tape.into()])?;
    }
}
