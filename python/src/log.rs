//! Forwards the log to Python's logging, under the name `conefield`.

use crate::errors::in_python;
use pyo3::prelude::*;
use std::fmt::{Debug, Write};
use std::sync::Once;
use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};

/// Forwards messages from the first call on. A program that already has a logger keeps it.
pub fn start() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let log = tracing_subscriber::registry().with(ToPython.with_filter(LevelFilter::INFO));
        let _ = tracing::subscriber::set_global_default(log);
    });
}

struct ToPython;

impl<S: Subscriber> Layer<S> for ToPython {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        // Messages of other libraries are not meant for users.
        if !event.metadata().target().starts_with("conefield") {
            return;
        }
        let mut text = Message(String::new());
        event.record(&mut text);
        let level = match *event.metadata().level() {
            Level::ERROR => "error",
            Level::WARN => "warning",
            _ => "info",
        };
        // A failing logger does not stop the work.
        let _ = Python::attach(|py| -> PyResult<()> {
            let logger = py.import("logging")?.call_method1("getLogger", ("conefield",))?;
            logger.call_method1(level, ("%s", in_python(py, &text.0)?))?;
            Ok(())
        });
    }
}

struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}");
        }
    }
}
