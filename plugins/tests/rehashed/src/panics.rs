//! An encoder that panics on request. No panic may crash the host.

use conefield_plugin::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

stage_type!(EncoderSpec, "panics", Panics, "panics on request");

/// When to panic.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
enum When {
    Create,
    Describe,
    Forward,
    Backward,
    /// In forward, after more calls than a trial needs.
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

    #[inline(always)]
    fn forward<N: Lanes>(&self, _: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        assert!(self.when != When::Forward, "as ordered, in forward");
        let calls = self.calls.fetch_add(1, Ordering::Relaxed);
        assert!(self.when != When::Later || calls < 200, "as ordered, in call {calls}");
        (0..3).for_each(|c| y.set(c, x.at(c)));
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, _: &[N::Real], _: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        assert!(self.when != When::Backward, "as ordered, in backward");
        (0..3).for_each(|c| grads.input(c, dy.at(c)));
    }

    fn describe(&self) -> String {
        assert!(self.when != When::Describe, "as ordered, in describe");
        "panics".into()
    }
}
