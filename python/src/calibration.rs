//! Calibration: the geometry of a scan, estimated from its views.

use crate::arguments;
use crate::arrays::plain;
use crate::run::{CallbackArgument, callback};
use crate::scan::Scan;
use crate::work::{Progress, without_lock};
use conefield::memory::{self, Memory};
use conefield_core::error::ensure;
use conefield_core::method::Observer;
use conefield_core::{Error, Result};
use conefield_io::ScanSize;
use conefield_scans::calibration::{Parameter, Settings, Watch, calibrate as search, directions, jitter};
use pyo3::prelude::*;
use serde::Deserialize;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;
use tracing::warn;

/// Options of `calibrate`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wanted {
    parameters: Vec<String>,
    pixels: usize,
    jitter: bool,
    backend: String,
}

impl Wanted {
    fn settings(&self) -> Result<Settings> {
        ensure((16..=1024).contains(&self.pixels), "arguments", "pixels", self.pixels, "16 to 1024")?;
        let read = |name: &String| {
            let names = Parameter::ALL.map(Parameter::name).join(", ");
            let unknown =
                |_| Error::invalid("arguments", "parameters", format!("{name:?}"), format!("some of {names}"));
            name.parse().map_err(unknown)
        };
        let parameters = self.parameters.iter().map(read).collect::<Result<_>>()?;
        Ok(Settings { parameters, width: self.pixels, curves: true })
    }
}

/// Passes progress on to Python, as one part of the work.
struct Part<'a, 'b> {
    progress: &'a Mutex<Progress<'b>>,
    begin: Instant,
    from: f64,
    share: f64,
}

impl Watch for Part<'_, '_> {
    fn cancelled(&self) -> bool {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner).cancelled()
    }

    fn progress(&self, share: f64) {
        let share = self.from + self.share * share;
        let left = self.begin.elapsed().as_secs_f64() * (1.0 - share) / share.max(1e-6);
        self.progress.lock().unwrap_or_else(PoisonError::into_inner).progress(0, share, left);
    }
}

/// Estimates the position of the detector. Returns the corrected scan and the result.
#[pyfunction]
pub fn calibrate<'py>(
    py: Python<'py>,
    scan: &Bound<'py, Scan>,
    wanted: &str,
    function: CallbackArgument,
) -> PyResult<(Scan, Bound<'py, PyAny>)> {
    let wanted: Wanted = arguments::read(py, wanted)?;
    let (scan, function) = (scan.get(), callback(function));
    let (corrected, result) = without_lock(py, |watch| {
        let settings = wanted.settings()?;
        let backend = arguments::backend(&wanted.backend)?.open()?;
        // The corrected scan is a copy, and not every scan has a volume.
        let size = memory::Run::on_scan(&scan.scan).scan;
        let size = ScanSize { test_pixels: size.pixels, voxels: 1, ..size };
        Memory::of_calibration(&size, &settings, wanted.jitter, backend.as_ref())?.check()?;
        let progress = Mutex::new(Progress::new(watch, function));
        let parts = if wanted.jitter { 3.0 } else { 2.0 };
        let begin = Instant::now();
        let part = |i: f64| Part { progress: &progress, begin, from: i / parts, share: 1.0 / parts };
        let found = search(&scan.scan, &settings, backend.as_ref(), &part(0.0))?;
        let directions = directions(&scan.scan, backend.as_ref(), &part(1.0))?;
        if let Some(advice) = directions.and_then(|d| d.advice()) {
            warn!("{advice}");
        }
        let mut corrected = scan.scan.as_ref().clone();
        let source = scan.path.as_ref().map_or("a scan in memory".into(), |p| p.display().to_string());
        found.correct(&mut corrected, &source);
        let shifts =
            wanted.jitter.then(|| jitter(&corrected, wanted.pixels, backend.as_ref(), &part(2.0))).transpose()?;
        if let Some(shifts) = &shifts {
            shifts.correct(&mut corrected);
        }
        progress.lock().unwrap_or_else(PoisonError::into_inner).finish();
        Ok((corrected, found.json(directions, shifts.as_ref())))
    })?;
    Ok((scan.with(corrected), plain(py, &result)?))
}
