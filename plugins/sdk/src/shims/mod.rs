//! The functions that the host calls. Each turns pointers into slices, runs the stage, and turns errors and panics into
//! a status and a text.

// Pointers come from the host, by the rules of the contract (`conefield_plugin_abi`): they are valid for the given
// lengths during the call, writable ones do not overlap others, and `stage` was returned by `create` or another of
// these functions. Every unsafe block in this folder relies on that alone.
#![allow(unsafe_code)]

pub mod basis;
pub mod data_term;
pub mod initializer;
pub mod loss;
pub mod map;
pub mod prior;
pub mod projector;
pub mod regularizer;

// The modules of the kinds take these imports by `use super::*`.
use crate::built::{Named, OnGrid, Part, settings};
use conefield_core::prelude::*;
use conefield_core::registry::{Kind, StageType};
use conefield_core::scan::ScanHeader;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::ffi::c_void;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::{mem, ptr, slice};

/// Defines the table of a kind, with these functions; a constructor for each of its kinds, with the kind's name; and the
/// parts that the functions take, each with its name in errors.
macro_rules! table {
    (
        $table:ident: $($function:ident)*;
        $($kind:ident($keys:pat, $width:pat) { $build:expr })*;
        $($part:ty: $name:literal),*
    ) => {
        pub static TABLE: $table = $table { size: size_of::<$table>(), $($function: Some($function),)* };

        $(pub fn $kind($keys: serde_json::Value, $width: usize) -> Result<crate::shims::Held> {
            Ok($build)
        })*

        $(
            impl crate::built::Named for $part {
                const NAME: &str = $name;
            }

            impl crate::built::Part for Box<$part> {
                fn describe(&self) -> String {
                    (**self).describe()
                }
            }
        )*
    };
}
use table;

/// Defines functions of tables. Each one gets the stage behind its first pointer, as the type named after it, and runs
/// inside [`guard`]. A `mut` stage is not used by other calls meanwhile. A function with an error text as last argument
/// reports a reason; one with a result of its own defines its value on failure.
macro_rules! shims {
    () => {};
    (fn $name:ident($stage:ident: $kind:ty $(, $arg:ident: $ty:ty)* $(; $error:ident)?) $body:block $($rest:tt)*) => {
        unsafe extern "C" fn $name(
            stage: *const c_void
            $(, $arg: $ty)*
            $(, $error: *mut ConefieldText)?
        ) -> ConefieldStatus {
            let error = [$($error,)? std::ptr::null_mut()][0];
            // SAFETY: see `shims/mod.rs`.
            guard(error, || unsafe {
                let $stage = crate::shims::held(stage).get::<$kind>()?;
                $body;
                Ok(())
            })
        }
        shims! { $($rest)* }
    };
    (fn $name:ident(mut $stage:ident: $kind:ty $(, $arg:ident: $ty:ty)* $(; $error:ident)?) $body:block $($rest:tt)*) => {
        unsafe extern "C" fn $name(
            stage: *mut c_void
            $(, $arg: $ty)*
            $(, $error: *mut ConefieldText)?
        ) -> ConefieldStatus {
            let error = [$($error,)? std::ptr::null_mut()][0];
            // SAFETY: see `shims/mod.rs`; nothing else uses the stage meanwhile.
            guard(error, || unsafe {
                let $stage = (*stage.cast::<crate::shims::Held>()).get_mut::<$kind>()?;
                $body;
                Ok(())
            })
        }
        shims! { $($rest)* }
    };
    (fn $name:ident($stage:ident: $kind:ty $(, $arg:ident: $ty:ty)*) -> $out:ty, or $failed:expr, $body:block $($rest:tt)*) => {
        unsafe extern "C" fn $name(stage: *const c_void $(, $arg: $ty)*) -> $out {
            let mut out = $failed;
            // SAFETY: see `shims/mod.rs`.
            guard(std::ptr::null_mut(), || unsafe {
                let $stage = crate::shims::held(stage).get::<$kind>()?;
                out = $body;
                Ok(())
            });
            out
        }
        shims! { $($rest)* }
    };
}
use shims;

/// Runs `f`; an error becomes a status, and its text goes to `error`.
fn guard(error: *mut ConefieldText, f: impl FnOnce() -> Result<()>) -> ConefieldStatus {
    match catch_unwind(AssertUnwindSafe(f)) {
        Ok(Ok(())) => CONEFIELD_OK,
        Ok(Err(e)) => {
            let (status, text) = match &e {
                // The host adds the place.
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
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
            write(error, &format!("panicked: {text}"));
            // Dropping the payload could panic again.
            mem::forget(panic);
            CONEFIELD_PANICKED
        }
    }
}

/// Writes as much of `text` as fits.
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

/// `n` items at `data`, which may be NULL if there are none.
unsafe fn many<'a, T>(data: *const T, n: usize) -> &'a [T] {
    // SAFETY: see the top of this file.
    if n == 0 { &[] } else { unsafe { slice::from_raw_parts(data, n) } }
}

/// As [`many`], mutable.
unsafe fn many_mut<'a, T>(data: *mut T, n: usize) -> &'a mut [T] {
    // SAFETY: see the top of this file.
    if n == 0 { &mut [] } else { unsafe { slice::from_raw_parts_mut(data, n) } }
}

unsafe fn text<'a>(s: ConefieldStr) -> Result<&'a str> {
    // SAFETY: see the top of this file.
    let bytes = unsafe { many(s.data, s.length) };
    std::str::from_utf8(bytes).map_err(|e| Error::unsupported("a text from the host", e.to_string()))
}

unsafe fn grid(grid: *const ConefieldGrid) -> VoxelGrid {
    // SAFETY: see `shims/mod.rs`.
    let ConefieldGrid { shape, spacing, center } = unsafe { *grid };
    VoxelGrid { shape, spacing, center }
}

/// The size of a scan of which only the volume or only the views are known.
fn header(volume: [usize; 3], [views, rows, columns]: [usize; 3]) -> ScanHeader {
    ScanHeader { views, detector: [rows, columns], volume }
}

/// `shape` numbers at `data`.
unsafe fn array<'a, R: Real>(shape: [usize; 3], data: *const R) -> Result<ArrayView3<'a, R>> {
    // SAFETY: see `shims/mod.rs`.
    let data = unsafe { many(data, shape.iter().product()) };
    ArrayView3::from_shape(shape, data).map_err(|e| Error::unsupported("an array from the host", e.to_string()))
}

unsafe fn array_mut<'a, R: Real>(shape: [usize; 3], data: *mut R) -> Result<ArrayViewMut3<'a, R>> {
    // SAFETY: see `shims/mod.rs`.
    let data = unsafe { many_mut(data, shape.iter().product()) };
    ArrayViewMut3::from_shape(shape, data).map_err(|e| Error::unsupported("an array from the host", e.to_string()))
}

/// A part as it is held behind a pointer.
type Held = Box<dyn Part>;

unsafe fn held<'a>(stage: *const c_void) -> &'a Held {
    // SAFETY: see the top of this file.
    unsafe { &*stage.cast::<Held>() }
}

/// Passes ownership of a part to the host.
fn hand_over<T: Named + ?Sized>(part: Box<T>) -> *mut c_void
where
    Box<T>: Part,
{
    Box::into_raw(Box::<Held>::new(Box::new(part))).cast()
}

/// Writes the WGSL of a stage, if there is some.
fn write_wgsl(out: *mut ConefieldText, fragment: Option<Fragment>) -> Result<()> {
    let fragment = fragment.ok_or_else(|| Error::unsupported("this stage", "it has no WGSL"))?;
    write(out, &fragment.source);
    Ok(())
}

/// The stage of type `t` with `keys`, its settings without their type; some need the number of input channels.
fn build(t: &StageType, mut keys: Value, width: usize) -> Result<Held> {
    let Some(table) = keys.as_object_mut() else {
        return Err(Error::invalid("spec", "", &keys, "a table of settings"));
    };
    table.insert("type".into(), t.name.into());
    macro_rules! built {
        ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {
            match t.kind {
                $($(Kind::$kind => $field::$name(keys, width),)+)*
                other => Err(Error::unsupported(t.name, format!("a {other} cannot come from a plugin"))),
            }
        };
    }
    conefield_plugin_abi::kinds! { built }
}

pub unsafe extern "C" fn create(
    context: *const c_void,
    settings: ConefieldStr,
    width: usize,
    stage: *mut *mut c_void,
    error: *mut ConefieldText,
) -> ConefieldStatus {
    guard(error, || {
        // SAFETY: see the top of this file; `context` is set by the table and points to a static.
        let (t, settings) = unsafe { (&*context.cast::<StageType>(), text(settings)?) };
        let settings = serde_json::from_str(settings).map_err(|e| Error::invalid("spec", "", e, "JSON"))?;
        let part = build(t, settings, width)?;
        // SAFETY: see the top of this file.
        unsafe { *stage = Box::into_raw(Box::new(part)).cast() };
        Ok(())
    })
}

pub unsafe extern "C" fn destroy(stage: *mut c_void) {
    guard(ptr::null_mut(), || {
        // SAFETY: see the top of this file; the host gives up ownership here.
        drop(unsafe { Box::from_raw(stage.cast::<Held>()) });
        Ok(())
    });
}

pub unsafe extern "C" fn describe(stage: *const c_void, out: *mut ConefieldText) -> ConefieldStatus {
    guard(out, || {
        // SAFETY: see the top of this file.
        write(out, &unsafe { held(stage) }.describe());
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::registry::find;

    /// `y = w·x`.
    #[derive(Clone, Serialize, Deserialize, JsonSchema)]
    struct Scaled {
        initial: f32,
    }

    conefield_core::stage_type!(EncoderSpec, "scaled", Scaled, "for tests");
    impl EncoderSpec for Scaled {
        fn build(&self) -> Result<Box<dyn Encoder>> {
            Ok(Box::new(self.clone()))
        }
    }

    impl Kernel<f32> for Scaled {
        fn forward(&self, params: &[f32], x: Tile<'_, f32>, y: TileMut<'_, f32>, tape: TileMut<'_, f32>) {
            for (y, x) in y.data.iter_mut().zip(x.data) {
                *y = params[0] * x;
            }
            tape.data.copy_from_slice(&x.data[..x.rows]);
        }

        fn backward(&self, Backward { params, x, tape, dy, grads, dx }: Backward<'_, f32>) {
            assert_eq!(*tape.data, x.data[..x.rows]);
            grads.values[0] += dy.data.iter().zip(x.data).map(|(d, x)| d * x).sum::<f32>();
            if let Some(dx) = dx {
                dx.data.iter_mut().zip(dy.data).for_each(|(dx, d)| *dx = params[0] * d);
            }
        }
    }

    impl Stage for Scaled {
        fn info(&self) -> Info {
            Info { input: 3, output: 3, params: 1, tape: 1, grads: GradKind::Dense, ..Info::default() }
        }
        fn parameters(&self) -> Vec<Parameter> {
            vec![Parameter { name: "w".into(), shape: vec![1], start: 0 }]
        }
        fn init(&self, _: u64, params: &mut [f32]) {
            params.fill(self.initial);
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

    /// Rows `0..3` of 3 channels with stride 5; the gaps are -1 and must stay so.
    #[test]
    fn strided_tiles_are_read_and_written_in_place() {
        let (status, stage) = made(r#"{"initial": 2.0}"#, ptr::null_mut());
        assert_eq!(status, CONEFIELD_OK);
        let spread = |v: [f32; 9]| -> Vec<f32> { v.chunks(3).flat_map(|c| [c[0], c[1], c[2], -1.0, -1.0]).collect() };
        let x = spread([1., 2., 3., 4., 5., 6., 7., 8., 9.]);
        let (mut y, mut tape, mut dx) = (vec![-1.0f32; 15], vec![-1.0f32; 5], vec![-1.0f32; 15]);
        let tile = |v: &[f32], channels| ConefieldTile { data: v.as_ptr(), channels, rows: 3, stride: 5 };
        let tile_mut =
            |v: &mut [f32], channels| ConefieldTileMut { data: v.as_mut_ptr(), channels, rows: 3, stride: 5 };
        let (params, mut grads) = ([2.0f32], [10.0f32]);
        let none = ptr::null_mut();
        let (forward, backward) = (map::TABLE.forward.unwrap(), map::TABLE.backward.unwrap());
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
        let mut bytes = [0u8; 16];
        let mut error = room(&mut bytes);
        let status = guard(&mut error, || panic!("on request, {}", "é".repeat(600)));
        assert_eq!((status, error.length), (CONEFIELD_PANICKED, "panicked: on request, ".len() + 1200));
        assert_eq!(&bytes, b"panicked: on req");
    }

    #[test]
    fn what_does_not_fit_is_refused_in_words() {
        let mut bytes = [0u8; 200];
        let mut error = room(&mut bytes);
        let (status, stage) = made(r#"{"initial": true}"#, &mut error);
        assert_eq!(status, CONEFIELD_INVALID);
        assert!(stage.is_null());
        let n = error.length;
        let said = String::from_utf8_lossy(&bytes[..n]);
        assert!(said.contains("boolean"), "{said}");
        // A stage whose table has no such function.
        let (_, stage) = made(r#"{"initial": 2.0}"#, ptr::null_mut());
        let other = unsafe { held(stage) }.get::<dyn Loss>().map(drop).unwrap_err();
        assert_eq!(other.to_string(), "this stage: it is no loss");
        unsafe { destroy(stage) };
    }
}
