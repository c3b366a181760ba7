//! An encoder that panics on request. No panic may crash the host.

use conefield_plugin::error::Result;
use conefield_plugin::settings::EncoderSpec;
use conefield_plugin::stage::{Encoder, GradKind, Grads, Info, Kernel, Parameter, Scope, Stage, Tile, TileMut};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicU32, Ordering};

conefield_plugin::export!();
conefield_plugin::stage_type!(EncoderSpec, "panics", Panics, "panics on request");

/// When to panic.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
enum When {
    Create,
    Forward,
    Backward,
    /// In the hundredth call of forward.
    Later,
}

#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct Panics {
    when: When,
}

impl Default for Panics {
    fn default() -> Self {
        Self { when: When::Forward }
    }
}

impl EncoderSpec for Panics {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        assert!(self.when != When::Create, "as ordered, in create");
        Ok(Box::new(Copying { when: self.when, calls: AtomicU32::new(0) }))
    }
}

struct Copying {
    when: When,
    calls: AtomicU32,
}

impl Kernel<f32> for Copying {
    fn forward(&self, _: &[f32], x: Tile<'_, f32>, y: TileMut<'_, f32>, _: TileMut<'_, f32>) {
        assert!(self.when != When::Forward, "as ordered, in forward");
        let calls = self.calls.fetch_add(1, Ordering::Relaxed);
        assert!(self.when != When::Later || calls < 100, "as ordered, in call {calls}");
        y.data.copy_from_slice(x.data);
    }

    fn backward(
        &self,
        _: &[f32],
        _: Tile<'_, f32>,
        _: TileMut<'_, f32>,
        dy: Tile<'_, f32>,
        _: Grads<'_, f32>,
        dx: Option<TileMut<'_, f32>>,
    ) {
        assert!(self.when != When::Backward, "as ordered, in backward");
        if let Some(dx) = dx {
            dx.data.copy_from_slice(dy.data);
        }
    }
}

impl Stage for Copying {
    fn info(&self) -> Info {
        Info {
            input: 3,
            output: 3,
            params: 0,
            tape: 0,
            scope: Scope::Row,
            grads: GradKind::None,
            macs: 3,
            identity: false,
        }
    }

    fn parameters(&self) -> Vec<Parameter> {
        vec![]
    }

    fn init(&self, _: u64, _: &mut [f32]) {}

    fn kernel(&self) -> &dyn Kernel<f32> {
        self
    }

    fn describe(&self) -> String {
        "panics".into()
    }
}

impl Encoder for Copying {}
