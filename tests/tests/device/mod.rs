//! The device on which tests run kernels: a software one does. `CONEFIELD_ADAPTER=N` asks for adapter N of `conefield backends`;
//! tests then fail where it cannot be opened. Without it they take the best adapter, and skip where there is none.

mod translations;

use conefield_backend_wgpu::{Limits, Wgpu, source};
use std::sync::OnceLock;

/// The adapter that was asked for.
fn asked() -> Option<usize> {
    let index = std::env::var("CONEFIELD_ADAPTER").ok()?;
    Some(index.parse().unwrap_or_else(|_| panic!("CONEFIELD_ADAPTER: found {index:?}, expected an adapter's number")))
}

fn open(limits: Limits) -> Option<Wgpu> {
    let index = asked();
    let _ = source::EXTRA_CHECK.set(translations::check);
    match Wgpu::with_limits(index, limits) {
        Ok(opened) => Some(opened),
        Err(e) if index.is_some() => panic!("CONEFIELD_ADAPTER: {e}"),
        Err(_) => None,
    }
}

/// The device, opened once a program; `None`, said on stderr with what is not tried, where there is no adapter.
#[allow(dead_code)]
pub fn shared(what: &str) -> Option<&'static Wgpu> {
    static DEVICE: OnceLock<Option<Wgpu>> = OnceLock::new();
    let device = DEVICE.get_or_init(|| open(Limits::default()));
    if device.is_none() {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    device.as_ref()
}

/// Backends on the device: with its own limits, and with lower ones: no atomic sums; buffers so small that everything is
/// cut into pieces; no subgroup operations. Opened once a program, so that a kernel is compiled once for each.
#[allow(dead_code)]
pub fn backends(what: &str) -> Vec<(&'static str, &'static Wgpu)> {
    static OPENED: OnceLock<Vec<(&'static str, Wgpu)>> = OnceLock::new();
    OPENED.get_or_init(|| alone(what)).iter().map(|(name, backend)| (*name, backend)).collect()
}

/// The same, for one test alone: what they move and launch is its own.
#[allow(dead_code)]
pub fn alone(what: &str) -> Vec<(&'static str, Wgpu)> {
    let small = Limits { binding_bytes: Some(2048), uniform_bytes: Some(0), ..Limits::default() };
    let exchange = Limits { compare_exchange: true, ..Limits::default() };
    let apart = Limits { no_subgroups: true, ..Limits::default() };
    let plain = Limits::default();
    let all =
        [("own limits", plain), ("compare and exchange", exchange), ("small buffers", small), ("no subgroups", apart)];
    let opened: Vec<_> = all.into_iter().filter_map(|(name, limits)| Some((name, open(limits)?))).collect();
    if opened.is_empty() {
        eprintln!("SKIPPED: no adapter for {what}");
    }
    opened
}

/// A backend on a device with room for this many bytes of arrays.
#[allow(dead_code)]
pub fn little(bytes: u64) -> Option<Wgpu> {
    open(Limits { memory_bytes: Some(bytes), ..Limits::default() })
}
