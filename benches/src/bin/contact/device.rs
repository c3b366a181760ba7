//! What a device is, and what it can do at most.

use crate::{Asked, Result, say};
use conefield_backend_wgpu::{Wgpu, adapters};
use serde_json::json;

/// Every adapter with its limits and features, and which one is used.
pub fn adapter(asked: &Asked) -> Result<()> {
    for adapter in adapters() {
        let used = adapter.index == asked.adapter;
        say(&json!({ "adapter": adapter, "used": used }));
    }
    Ok(())
}

/// Rates of the device, by micro-benchmarks.
pub fn limits(asked: &Asked) -> Result<()> {
    say(&json!({ "limits": Wgpu::open(Some(asked.adapter))?.ceiling()? }));
    Ok(())
}
