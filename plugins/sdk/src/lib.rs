//! The crate for writing conefield plugins.
//!
//! A plugin's stage is written like a built-in one, with the same traits: settings that implement `EncoderSpec` (or the
//! trait of another kind), and a stage that implements [`Stage`](stage::Stage) and [`Kernel`](stage::Kernel). The
//! crate's type is `cdylib`. [`export!`] at its root exports every type that the crate registers with [`stage_type!`]:
//!
//! ```text
//! conefield_plugin::export!();
//! conefield_plugin::stage_type!(EncoderSpec, "wavelet", Wavelet, "Gaussian-windowed waves");
//!
//! impl EncoderSpec for Wavelet { … }
//! ```
//!
//! `conefield plugins new NAME --kind encoder --lang rust` creates such a crate. A panic in a stage becomes an error of
//! the run; keep `panic = "unwind"`, Cargo's default. Methods, callbacks and voxel projectors cannot be exported.

mod built;
mod export;
mod shims;

pub use conefield_core::{
    Error, Result, arena, basis, by_row, data_term, error, geometry, loss, prelude, prior, random, regularizer, scan,
    settings, simd, space, stage, stage_type, wgsl,
};
pub use conefield_plugin_abi as abi;
#[doc(hidden)]
pub use export::table;

/// Exports every stage type that this crate registers. Call it once, at the root of the crate.
#[macro_export]
macro_rules! export {
    () => {
        /// The function that the host calls when it loads this library.
        #[allow(unsafe_code)]
        #[unsafe(no_mangle)]
        pub extern "C" fn conefield_plugin() -> *const $crate::abi::ConefieldPlugin {
            static TABLE: ::std::sync::OnceLock<usize> = ::std::sync::OnceLock::new();
            $crate::table(&TABLE, [env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"), env!("CARGO_PKG_LICENSE")])
        }
    };
}
