//! Stopping criteria of iterative methods.

use conefield_core::error::{Result, ensure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Stopping criteria; the first one reached ends the run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Stop {
    /// Stop after this many passes over the views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub passes: Option<u64>,
    /// Stop after this many seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Stop when the change in a pass is less than this share of the volume, both as root mean squares.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// Stop when the error of the held-out views has not fallen for this many passes; keep the best volume.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patience: Option<u64>,
}

impl Stop {
    /// Stops after `n` passes.
    pub fn after(n: u64) -> Self {
        Self { passes: Some(n), ..Self::default() }
    }

    /// Refuses a run without an end; the error names the key `stop`.
    pub fn validate(&self) -> Result<()> {
        let ends = self.passes.is_some() || self.seconds.is_some() || self.change.is_some();
        ensure(ends, "spec", "stop", "no end", "one of passes, seconds or change")?;
        for (name, limit) in [("change", self.change), ("seconds", self.seconds)] {
            if let Some(x) = limit {
                let field = format!("stop.{name}");
                ensure(x.is_finite() && x > 0.0, "spec", &field, x, "a positive finite number")?;
            }
        }
        ensure(self.passes != Some(0), "spec", "stop.passes", 0, "at least 1")?;
        ensure(self.patience != Some(0), "spec", "stop.patience", 0, "at least 1")
    }
}
