//! What a conefield plugin is written against.
//!
//! A plugin's stage is written like a built-in one, against the same traits: settings that implement `EncoderSpec` (or the
//! trait of another kind), a stage that implements [`Stage`](stage::Stage) and [`Kernel`](stage::Kernel). The crate's type
//! is `cdylib`, and [`export!`] at its root offers every type that the crate registers with [`stage_type!`]:
//!
//! ```text
//! conefield_plugin::export!();
//! conefield_plugin::stage_type!(Encoder, "wavelet", Wavelet, "Gaussian-windowed waves");
//!
//! #[typetag::serde(name = "wavelet")]
//! impl EncoderSpec for Wavelet { … }
//! ```
//!
//! `conefield plugins new NAME --kind encoder --lang rust` makes such a crate. A panic in a stage becomes an error of the
//! run; keep `panic = "unwind"`, which is Cargo's default. Methods, callbacks and projectors of voxels cannot be exported.

mod built;
mod export;
mod shims;

pub use conefield_core::{
    Error, Result, arena, basis, by_row, data_term, error, geometry, half, loss, prelude, prior, random, regularizer,
    scan, settings, simd, space, stage, stage_type, wgsl,
};
pub use conefield_plugin_abi as abi;
pub use export::Plugin;

/// Exports every stage type that this crate registers. To be called once, at the root of the crate.
#[macro_export]
macro_rules! export {
    () => {
        /// What the host asks for when it loads this library.
        #[allow(unsafe_code)]
        #[unsafe(no_mangle)]
        pub extern "C" fn conefield_plugin() -> *const $crate::abi::ConefieldPlugin {
            static PLUGIN: $crate::Plugin =
                $crate::Plugin::new(env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"), env!("CARGO_PKG_LICENSE"));
            PLUGIN.table()
        }
    };
}
