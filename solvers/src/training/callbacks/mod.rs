//! The callbacks: those that a spec may name, and those of every run.

pub mod coarse_to_fine;
pub mod drift;
pub mod fft_mask;
pub mod field_monitor;
pub mod live_slices;
pub mod patience;
pub mod rollback;

pub use drift::Drift;
pub use field_monitor::FieldMonitor;
pub use live_slices::LiveSlices;
pub use rollback::Rollback;

use conefield_core::error::{Result, ensure};
use conefield_core::pipeline::Pipeline;

/// Refuses, for the callback `name`, a field that reads positions: there are no features.
fn needs_features(name: &str, pipeline: &Pipeline) -> Result<()> {
    let found = format!("{name} with a field that has no encoder");
    ensure(pipeline.field.lines().is_none(), "spec", "", found, "a method with an encoder; leave this callback out")
}

#[cfg(test)]
mod tests {
    use crate::gaussians::Gaussians;
    use conefield_backend_cpu::Cpu;
    use conefield_core::method::{Context, Method};
    use serde_json::{from_value, json};

    #[test]
    fn what_looks_at_features_is_refused_without_an_encoder() {
        for callback in [json!("drift"), json!("fft-mask"), json!({"type": "fft-mask", "keep": [0, 1]})] {
            let method: Gaussians = from_value(json!({"callbacks": ["rollback", callback]})).unwrap();
            let e = method.plan(&Context::new(&Cpu::new())).err().unwrap().to_string();
            assert!(e.contains("callbacks.1") && e.contains("no encoder"), "{e}");
        }
    }
}
