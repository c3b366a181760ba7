//! Work without the GIL: Ctrl-C ends it cleanly, a callback observes progress, and no panic crosses into Python.

use crate::errors::{broken, raised};
use crate::log;
use crate::stages::{Raised, within};
use conefield_core::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::method::{Observer, Record};
use conefield_core::parallel::{Stop, stoppable};
use conefield_core::parts::Part;
use ndarray::Array3;
use numpy::IntoPyArray;
use pyo3::prelude::*;
use pyo3::types::PyList;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tracing::{info, warn};

/// Interval between two checks for signals, which acquire the GIL.
const LOOK: Duration = Duration::from_millis(20);

/// Whether the work must end: Python received a signal, or a Python object that takes part in it has failed.
pub struct Watch {
    looked: Mutex<Instant>,
    stopped: Mutex<Option<PyErr>>,
    raised: Arc<Raised>,
}

impl Watch {
    /// Whether to stop.
    pub fn cancelled(&self) -> bool {
        let stopped = || self.stopped.lock().unwrap_or_else(PoisonError::into_inner);
        if stopped().is_some() || self.raised.any() {
            return true;
        }
        let mut looked = self.looked.lock().unwrap_or_else(PoisonError::into_inner);
        if looked.elapsed() < LOOK {
            return false;
        }
        *looked = Instant::now();
        match Python::attach(|py| py.check_signals()) {
            Ok(()) => false,
            Err(e) => {
                *stopped() = Some(e);
                true
            }
        }
    }

    /// Stops the work with this exception.
    fn stop(&self, error: PyErr) {
        self.stopped.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

/// Runs `work` without the GIL. It ends where it asks the watch, at the end of a loop's items under way, or where a stage is
/// checked. An exception of a callback, a stage or a signal handler takes precedence over the error caused by stopping.
pub fn without_lock<T: Send>(py: Python<'_>, work: impl FnOnce(&Watch) -> Result<T> + Send) -> PyResult<T> {
    log::start();
    let (looked, stopped) = (Mutex::new(Instant::now()), Mutex::new(None));
    let watch = Arc::new(Watch { looked, stopped, raised: Arc::default() });
    let stop = || -> Stop {
        let watch = watch.clone();
        Arc::new(move || watch.cancelled())
    };
    let work = || stoppable(stop(), || work(&watch));
    let done = py.detach(|| within(&watch.raised, || catch_unwind(AssertUnwindSafe(work))));
    let stopped = watch.stopped.lock().unwrap_or_else(PoisonError::into_inner).take();
    if let Some(e) = stopped.or_else(|| watch.raised.take()) {
        return Err(e);
    }
    match done {
        Ok(done) => done.map_err(|e| {
            let error = raised(py, &e);
            if let Some(cause) = watch.raised.cause(py, &e.to_string()) {
                error.set_cause(py, Some(cause));
            }
            error
        }),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            Err(broken(py, text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("a panic without a message")))
        }
    }
}

/// A function called during a run, and its interval.
pub struct Callback {
    /// Called with step, share, seconds left, the new records in JSON, and the middle slices or None.
    pub function: Py<PyAny>,
    /// Interval between calls.
    pub every: Duration,
    /// Whether it wants slices.
    pub slices: bool,
}

/// Calls a callback during a run, and checks for cancellation.
pub struct Progress<'a> {
    watch: &'a Watch,
    callback: Option<Callback>,
    called_at: Option<Instant>,
    slices: Option<[Array3<f32>; 3]>,
    records: Vec<Record>,
    /// Number of records that the callback has received.
    seen: usize,
    /// The last finished step.
    step: u64,
}

impl<'a> Progress<'a> {
    pub fn new(watch: &'a Watch, callback: Option<Callback>) -> Self {
        Self { watch, callback, called_at: None, slices: None, records: vec![], seen: 0, step: 0 }
    }

    /// The records so far.
    pub fn records(&self) -> &[Record] {
        &self.records
    }

    /// At the end of the run, the callback receives the remaining records.
    pub fn finish(&mut self) {
        let step = self.records.last().map_or(self.step, |r| r.step.max(self.step));
        self.tell(step, 1.0, 0.0);
    }

    fn due(&self) -> bool {
        let wait = self.callback.as_ref().map_or(Duration::MAX, |c| c.every);
        self.callback.is_some() && self.called_at.is_none_or(|t| t.elapsed() >= wait)
    }

    fn tell(&mut self, step: u64, share: f64, seconds_left: f64) {
        let Some(callback) = &self.callback else { return };
        self.called_at = Some(Instant::now());
        let new = serde_json::to_string(&self.records[self.seen..]).unwrap_or_else(|_| "[]".into());
        self.seen = self.records.len();
        let slices = self.slices.take();
        let called = Python::attach(|py| -> PyResult<()> {
            let slices = slices.map(|s| PyList::new(py, s.map(|a| a.into_pyarray(py)))).transpose()?;
            callback.function.call1(py, (step, share, seconds_left, new, slices)).map(drop)
        });
        if let Err(e) = called {
            self.watch.stop(e);
        }
    }
}

impl Observer for Progress<'_> {
    fn progress(&mut self, step: u64, share: f64, seconds_left: f64) {
        self.step = step;
        if self.due() {
            self.tell(step, share, seconds_left);
        }
    }

    fn record(&mut self, record: &Record) {
        self.records.push(record.clone());
    }

    fn note(&mut self, text: &str) {
        info!("{text}");
    }

    fn warn(&mut self, text: &str) {
        warn!("{text}");
    }

    fn cancelled(&self) -> bool {
        self.watch.cancelled()
    }

    fn slices_due(&self) -> bool {
        self.due() && self.callback.as_ref().is_some_and(|c| c.slices)
    }

    fn slices(&mut self, _: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        if let [x, y, z] = slices {
            self.slices = Some([&x.1, &y.1, &z.1].map(Array3::clone));
        }
        Ok(())
    }
}
