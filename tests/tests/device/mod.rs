//! The device on which tests run kernels: a software one does.

use conefield_backend_wgpu::{Limits, Shared, Wgpu};
use std::sync::{Arc, OnceLock};

/// The device, opened once a program; `None`, said on stderr with what is not tried, where there is no adapter.
#[allow(dead_code)]
pub fn shared(what: &str) -> Option<Arc<Shared>> {
    static DEVICE: OnceLock<Option<Arc<Shared>>> = OnceLock::new();
    let device = DEVICE.get_or_init(|| Wgpu::open(None).ok().map(|w| w.shared().clone()));
    if device.is_none() {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    device.clone()
}

/// Backends on the device: as it is, told that it can do less (no atomic sums; buffers so small that everything is cut into
/// pieces), and with subgroup operations where it has them.
#[allow(dead_code)]
pub fn backends(what: &str) -> Vec<(&'static str, Wgpu)> {
    let small = Limits { binding_bytes: Some(2048), uniform_bytes: Some(0), ..Limits::default() };
    let exchange = Limits { compare_exchange: true, ..Limits::default() };
    let subgroups = Limits { subgroups: true, ..Limits::default() };
    let plain = Limits::default();
    let all =
        [("as it is", plain), ("compare and exchange", exchange), ("small buffers", small), ("subgroups", subgroups)];
    let opened = all.into_iter().filter_map(|(name, limits)| Some((name, Wgpu::with_limits(None, limits).ok()?)));
    let opened: Vec<_> = opened.collect();
    if opened.is_empty() {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    opened
}
