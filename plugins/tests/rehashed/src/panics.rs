//! An encoder that panics on request. No panic may crash the host.

use conefield_plugin::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

stage_type!(EncoderSpec, "panics", Panics, "panics on request");

/// When to panic.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
enum When {
    Create,
    Forward,
    Backward,
    /// In forward, after more rows than a trial has.
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
        Ok(Box::new(ByRow::new(Copying { when: self.when, calls: AtomicU32::new(0) })))
    }
}

struct Copying {
    when: When,
    calls: AtomicU32,
}

impl RowMap for Copying {
    fn widths(&self) -> [usize; 2] {
        [3, 3]
    }

    fn forward<R: Real>(&self, _: &[R], x: &[R], y: &mut [R]) {
        assert!(self.when != When::Forward, "as ordered, in forward");
        let calls = self.calls.fetch_add(1, Ordering::Relaxed);
        assert!(self.when != When::Later || calls < 2000, "as ordered, in call {calls}");
        y.copy_from_slice(x);
    }

    fn backward<R: Real>(&self, _: &[R], _: &[R], dy: &[R], _: &mut Sums<'_, R>, dx: &mut [R]) {
        assert!(self.when != When::Backward, "as ordered, in backward");
        dx.copy_from_slice(dy);
    }

    fn describe(&self) -> String {
        "panics".into()
    }
}
