//! The device on which tests run kernels: a software one does.

use conefield_backend_wgpu::{Shared, Wgpu};
use std::sync::{Arc, OnceLock};

/// The device, opened once a program; `None`, said on stderr with what is not tried, where there is no adapter.
pub fn shared(what: &str) -> Option<Arc<Shared>> {
    static DEVICE: OnceLock<Option<Arc<Shared>>> = OnceLock::new();
    let device = DEVICE.get_or_init(|| Wgpu::open(None).ok().map(|w| w.shared().clone()));
    if device.is_none() {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    device.clone()
}
