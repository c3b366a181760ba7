//! Scans: projections with their geometry.

use crate::arguments;
use crate::arrays::{fitting, plain};
use crate::geometry::Geometry;
use crate::volume::{made, taken};
use crate::work::without_lock;
use conefield::memory::Memory;
use conefield::parse;
use conefield::simulation::{self, Changes};
use conefield::{files, input};
use conefield_core::error::ensure;
use conefield_core::scan::{self, Unit, Volume};
use conefield_core::words::counted;
use conefield_projectors::simulate::DetectorNoise;
use conefield_scans::diagnosis::survey;
use numpy::{PyArray3, PyReadonlyArray3};
use pyo3::prelude::*;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

/// Measured line integrals with their geometry. Immutable: its arrays are read-only.
#[pyclass(frozen, module = "conefield._native")]
pub struct Scan {
    pub scan: Arc<scan::Scan>,
    /// The path it was read from.
    pub path: Option<PathBuf>,
    truth: Truth,
}

/// The volume that a scan was simulated from.
#[derive(Clone)]
enum Truth {
    Unknown,
    Known(Arc<Volume>),
    /// That of the scan at this path.
    Of(Arc<Stored>),
}

/// A truth that is still in its file.
struct Stored {
    /// The absolute path of the scan.
    scan: PathBuf,
    /// The file with the volume.
    file: PathBuf,
    /// Its size and the time of its last change when the scan was read.
    stamp: Stamp,
}

type Stamp = Option<(u64, SystemTime)>;

/// Size and time of the last change of a file.
fn stamp(file: &Path) -> Stamp {
    let info = file.metadata().ok()?;
    Some((info.len(), info.modified().ok()?))
}

impl Truth {
    /// The truth of the scan at `path`. An error of its file is one when the truth is needed.
    fn of(path: &Path) -> conefield_core::Result<Self> {
        let scan = std::path::absolute(path).map_err(|e| conefield_core::Error::io(path, e))?;
        let file = match conefield_io::truth_file(&scan) {
            Ok(None) => return Ok(Self::Unknown),
            Ok(Some(file)) => file,
            Err(_) => scan.clone(),
        };
        let stamp = stamp(&file);
        Ok(Self::Of(Arc::new(Stored { scan, file, stamp })))
    }
}

impl Stored {
    /// Reads the volume. Refuses one that is no longer that of the scan.
    fn read(&self) -> conefield_core::Result<Option<Volume>> {
        let (file, expected) = (self.file.display().to_string(), "the file as it was when the scan was read");
        let now = stamp(&self.file);
        ensure(now.is_none() || now == self.stamp, &file, "truth", "a file that has changed", expected)?;
        conefield_io::read_truth(&self.scan)
    }
}

impl Scan {
    /// Another scan of the same object, made from this one.
    pub fn with(&self, scan: scan::Scan) -> Self {
        Self { scan: Arc::new(scan), path: self.path.clone(), truth: self.truth.clone() }
    }

    /// The volume it was simulated from, if known; read from the scan's files if necessary.
    pub fn truth(&self) -> conefield_core::Result<Option<Volume>> {
        match &self.truth {
            Truth::Known(truth) => Ok(Some(Volume::clone(truth))),
            Truth::Of(stored) => stored.read(),
            Truth::Unknown => Ok(None),
        }
    }

    /// The truth as the reference of a run; an error if there is none.
    pub fn reference(&self) -> conefield_core::Result<Volume> {
        let place = self.path.as_ref().map_or("scan".into(), |p| p.display().to_string());
        let truth = self.truth()?.ok_or_else(|| {
            conefield_core::Error::invalid(&place, "reference \"truth\"", "a scan without a truth", "a volume")
        })?;
        input::check_reference(&place, &truth, &self.scan)?;
        Ok(truth)
    }
}

#[pymethods]
impl Scan {
    #[new]
    fn new(
        py: Python<'_>,
        projections: PyReadonlyArray3<'_, f32>,
        geometry: &Bound<'_, Geometry>,
        unit: (String, f64),
    ) -> PyResult<Self> {
        let (name, mm) = unit;
        let (projections, geometry) = (fitting(&projections)?, geometry.get().0.clone());
        let provenance = serde_json::json!({ "made": "in Python" });
        let scan = scan::Scan { geometry, projections, unit: Unit { name, mm }, provenance };
        without_lock(py, |_| {
            scan.validate("scan")?;
            files::warn_of(Path::new("scan"), &survey(&scan), false);
            Ok(())
        })?;
        Ok(Self { scan: Arc::new(scan), path: None, truth: Truth::Unknown })
    }

    /// The line integrals, without copying.
    #[getter]
    #[allow(unsafe_code)]
    fn projections<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let projections = &slf.get().scan.projections;
        // SAFETY: the array lives in an `Arc` held by the scan, the class is frozen, and the new array keeps the scan
        // alive. It is read-only from here on, so that nobody writes data that others may read.
        let array = unsafe { PyArray3::borrow_from_array(projections, slf.clone().into_any()) };
        array.getattr("flags")?.setattr("writeable", false)?;
        Ok(array)
    }

    #[getter]
    fn geometry(&self) -> Geometry {
        Geometry(self.scan.geometry.clone())
    }

    #[getter]
    fn unit(&self) -> (String, f64) {
        (self.scan.unit.name.clone(), self.scan.unit.mm)
    }

    #[getter]
    fn provenance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        plain(py, &self.scan.provenance)
    }

    #[getter(truth)]
    fn truth_volume<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        without_lock(py, |_| self.truth())?.map(|v| made(py, v)).transpose()
    }

    /// The scan without the views `held` (indices or a mask), and a scan of only these.
    fn split(&self, held: &Bound<'_, PyAny>) -> PyResult<(Self, Self)> {
        let (py, held) = (held.py(), arguments::views(held, "held", self.scan.geometry.views.len())?);
        let (kept, aside) = without_lock(py, |_| self.scan.split(&held))?;
        let of = |scan| Self { scan: Arc::new(scan), path: None, truth: self.truth.clone() };
        Ok((of(kept), of(aside)))
    }

    fn __len__(&self) -> usize {
        self.scan.geometry.views.len()
    }

    fn __repr__(&self) -> String {
        let h = self.scan.header();
        let ([rows, columns], [x, y, z]) = (h.detector, h.volume);
        let unit = &self.scan.unit.name;
        let views = counted(h.views, "view");
        format!("Scan({views} of {rows} x {columns}, volume {x} x {y} x {z}, unit {unit:?})")
    }
}

/// Reads a scan in any format.
#[pyfunction]
pub fn read_scan(py: Python<'_>, path: PathBuf) -> PyResult<Scan> {
    let (truth, scan) = without_lock(py, |_| {
        Memory::of_views(&conefield_io::scan_size(&path)?).check()?;
        Ok((Truth::of(&path)?, files::scan(&path)?))
    })?;
    Ok(Scan { scan: Arc::new(scan), path: Some(path), truth })
}

/// Writes a scan to a folder in conefield's own format.
#[pyfunction]
pub fn write_scan(py: Python<'_>, path: PathBuf, scan: &Bound<'_, Scan>) -> PyResult<()> {
    let scan = scan.get();
    without_lock(py, |_| conefield_io::write_scan(&path, &scan.scan, scan.truth()?.as_ref()))
}

/// Options of `simulate`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wanted {
    protocol: String,
    views: Option<usize>,
    detector: Option<[usize; 2]>,
    offset: Option<[f64; 2]>,
    angles: Option<String>,
    noise: Option<String>,
    seed: Option<u64>,
    downsample: usize,
    values: String,
    source: String,
}

/// Simulates a scan of a known volume, by a protocol or in a geometry.
#[pyfunction]
pub fn simulate(
    py: Python<'_>,
    volume: &Bound<'_, PyAny>,
    wanted: &str,
    geometry: Option<&Bound<'_, Geometry>>,
) -> PyResult<Scan> {
    let volume = taken(volume)?;
    let wanted: Wanted = arguments::read(py, wanted)?;
    let geometry = geometry.map(|g| g.get().0.clone());
    let (scan, truth) = without_lock(py, |_| {
        let values = arguments::optional("values", Some(&wanted.values), parse::values)?.unwrap_or(parse::Values::AsIs);
        let noise = arguments::optional("noise", wanted.noise.as_ref(), parse::noise)?;
        let angles = arguments::optional("angles", wanted.angles.as_ref(), parse::angles)?;
        if let Some(geometry) = geometry {
            let expected = "1 with a geometry: the volume is taken as it stands";
            ensure(wanted.downsample == 1, "arguments", "downsample", wanted.downsample, expected)?;
            let volume = values.attenuation(&wanted.source, volume)?;
            let noise = noise.unwrap_or(DetectorNoise::None);
            let scan = simulation::scan_in(&volume, geometry, noise, wanted.seed.unwrap_or(0))?;
            // The volume is the truth only on the reconstructed voxels.
            let same = scan.geometry.volume == volume.grid;
            return Ok((scan, same.then_some(volume)));
        }
        let volume = simulation::prepared(&wanted.source, volume, values, wanted.downsample)?;
        let changes = Changes {
            views: wanted.views,
            detector: wanted.detector,
            offset: wanted.offset,
            angles,
            noise,
            seed: wanted.seed,
        };
        let protocol = simulation::protocol(&wanted.protocol, &volume.grid)?;
        let protocol = simulation::changed(protocol, &changes, "arguments")?;
        let (scan, truth) = simulation::scan(volume, values, &protocol, &wanted.source, &|_| {})?;
        Ok((scan, Some(truth)))
    })?;
    let truth = truth.map_or(Truth::Unknown, |truth| Truth::Known(Arc::new(truth)));
    Ok(Scan { scan: Arc::new(scan), path: None, truth })
}
