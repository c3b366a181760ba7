//! Runs: planning, reconstruction, pre-training, scoring.

use crate::arguments;
use crate::arrays::plain;
use crate::field::{Field, collect};
use crate::scan::Scan;
use crate::specs::SpecArgument;
use crate::volume::{made, taken};
use crate::work::{Callback, Progress, Watch, without_lock};
use conefield::explain::Explanation;
use conefield::memory::{self, Memory};
use conefield::method::{self, Planned, Read};
use conefield::record::{RunRecord, ScanRecord};
use conefield::session::{self, Request, Run};
use conefield::{files, pretraining, score, specs};
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::method::{Limits, PretrainJob};
use conefield_core::scan::{self, Volume};
use conefield_core::spec::load::to_toml;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics::{dice, label_map};
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Limits of training in command-line syntax.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Ends {
    steps: Option<u64>,
    seconds: Option<String>,
    at_most: Option<String>,
}

impl Ends {
    fn limits(&self) -> Result<Limits> {
        ensure(self.steps != Some(0), "arguments", "steps", 0, "at least 1")?;
        let seconds = arguments::seconds("seconds", self.seconds.as_ref())?;
        let at_most = arguments::seconds("at_most", self.at_most.as_ref())?;
        Ok(Limits { steps: self.steps, seconds, at_most, ..Limits::default() })
    }
}

/// Options of a run besides scan and volumes.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Wanted {
    spec: SpecArgument,
    backend: String,
    seed: u64,
    ends: Ends,
    budget: Option<String>,
    peak: Option<f64>,
    hold_out: Option<String>,
    /// Weights or a volume to start from.
    init: Option<PathBuf>,
    /// Whether the reference is the scan's truth.
    truth: bool,
}

impl Wanted {
    /// Plans the run; within a budget this measures the machine and chooses.
    fn planned<'a>(
        &self,
        scan: Arc<scan::Scan>,
        reference: Option<Volume>,
        start: Option<&Volume>,
        backend: &'a dyn Backend,
        watch: &Watch,
        begin: Instant,
    ) -> Result<Run<'a>> {
        let peak = arguments::peak(self.peak)?;
        let held = arguments::held_out(self.hold_out.as_ref(), scan.geometry.views.len())?;
        let read = |sets: &[String]| self.spec.read(sets);
        let request = Request {
            spec: self.spec.is_given().then_some(&read as Read<'_>),
            front: None,
            sets: self.spec.sets()?,
            init: self.init.clone(),
            limits: self.ends.limits()?,
            budget: arguments::seconds("budget", self.budget.as_ref())?,
            seed: self.seed,
        };
        let mut run = Run::in_memory(scan, held, reference, peak, request, backend, begin, &|| watch.cancelled())?;
        let plan = run.method.plan.as_mut();
        let starts = match plan.links() {
            [first, ..] => first.starts_from_volume(),
            [] => plan.starts_from_volume(),
        };
        let name = format!("a volume for {}, which starts from none", run.method.loaded.spec.name);
        ensure(start.is_none() || starts, "arguments", "init", name, "a method that starts from a volume")?;
        Ok(run)
    }
}

/// Describes what a spec builds, as text and as data; with a budget also what would run, and for how long.
#[pyfunction]
pub fn plan<'py>(
    py: Python<'py>,
    wanted: &str,
    scan: Option<&Bound<'py, Scan>>,
) -> PyResult<(Bound<'py, PyAny>, String, Bound<'py, PyAny>)> {
    let wanted: Wanted = arguments::read(py, wanted)?;
    let scan = scan.map(|s| s.get().scan.clone());
    let (explanation, schedule) = without_lock(py, |watch| {
        let backend = arguments::backend(&wanted.backend)?.open()?;
        match (&wanted.budget, scan) {
            (Some(_), None) => {
                Err(Error::invalid("arguments", "scan", "nothing", "a scan, which a budget is planned for"))
            }
            (Some(_), Some(scan)) => {
                let run = wanted.planned(scan.clone(), None, None, backend.as_ref(), watch, Instant::now())?;
                let Planned { loaded, plan, .. } = &run.method;
                let about = Some((scan.as_ref(), memory::Run::on_scan(&scan)));
                let schedule = serde_json::to_value(&run.schedule).unwrap_or(Value::Null);
                Ok((Explanation::new(loaded, plan.as_ref(), Some(backend.as_ref()), about)?, schedule))
            }
            (None, scan) => {
                let loaded = wanted.spec.read(&wanted.spec.sets()?)?;
                let plan = method::plan_without_files(&loaded, backend.as_ref())?;
                let about = scan.as_ref().map(|s| (s.as_ref(), memory::Run::on_scan(s)));
                Ok((Explanation::new(&loaded, plan.as_ref(), Some(backend.as_ref()), about)?, Value::Null))
            }
        }
    })?;
    Ok((plain(py, &explanation)?, explanation.text(), plain(py, &schedule)?))
}

/// The function called during a run, with the seconds between calls and whether it wants slices.
pub type CallbackArgument = Option<(Py<PyAny>, f64, bool)>;

/// The callback of a run.
pub fn callback(argument: CallbackArgument) -> Option<Callback> {
    argument.map(|(function, every, slices)| Callback {
        function,
        every: Duration::try_from_secs_f64(every).unwrap_or(Duration::MAX),
        slices,
    })
}

/// The place of an array in a record.
const IN_MEMORY: &str = "memory";

/// Volume, record and trained field.
type Reconstructed<'py> = (Bound<'py, PyAny>, Bound<'py, PyAny>, Option<Field>);

/// Reconstructs a scan.
#[pyfunction]
pub fn reconstruct<'py>(
    py: Python<'py>,
    scan: &Bound<'py, Scan>,
    wanted: &str,
    start: Option<&Bound<'py, PyAny>>,
    reference: Option<&Bound<'py, PyAny>>,
    function: CallbackArgument,
) -> PyResult<Reconstructed<'py>> {
    let begin = Instant::now();
    let wanted: Wanted = arguments::read(py, wanted)?;
    let [start, reference] = [start, reference].map(|v| v.map(taken).transpose());
    let (start, reference, function) = (start?, reference?, callback(function));
    let scan = scan.get();
    let (volume, record, field) = without_lock(py, |watch| {
        let backend =
            arguments::backend(&wanted.backend)?.open_for_run(arguments::seconds("budget", wanted.budget.as_ref())?)?;
        let reference = if wanted.truth { Some(scan.reference()?) } else { reference };
        let given = reference.as_ref().map(|_| wanted.truth);
        let mut run = wanted.planned(scan.scan.clone(), reference, start.as_ref(), backend.as_ref(), watch, begin)?;
        let mut progress = Progress::new(watch, function);
        let solved = run.solve(start.as_ref(), None, &mut progress)?;
        progress.finish();
        let (volume, written) =
            run.scored(&solved, &|result, backend| collect(result.voxels(backend)?.as_mut(), &|| watch.cancelled()))?;
        let loaded = &run.method.loaded;
        let init = wanted.init.as_ref().map(|path| path.display().to_string());
        let mut record = json!(RunRecord {
            scan: Some(ScanRecord::of(scan.path.as_deref().unwrap_or(Path::new(IN_MEMORY)), &scan.scan)?),
            init: init.or(start.as_ref().map(|_| IN_MEMORY.into())),
            reference: given.map(|file| if file { "truth" } else { IN_MEMORY }.into()),
            ..run.record(&solved, progress.records().last(), written)
        });
        record["spec_toml"] = to_toml(&loaded.spec)?.into();
        record["records"] = json!(progress.records());
        for absent in ["plan", "best_step"].into_iter().filter(|key| record.get(*key).is_none()).collect::<Vec<_>>() {
            record[absent] = Value::Null;
        }
        let field = session::field(solved.solution.result);
        let notes = specs::notes(loaded, wanted.seed)?;
        Ok((volume, record, field.map(|f| Field::new(f, notes))))
    })?;
    Ok((made(py, volume)?, plain(py, &record)?, field))
}

/// Trains a field on known volumes and writes weights to start other scans from.
#[pyfunction]
pub fn pretrain<'py>(
    py: Python<'py>,
    volumes: Vec<Bound<'py, PyAny>>,
    output: PathBuf,
    wanted: &str,
    function: CallbackArgument,
) -> PyResult<Bound<'py, PyAny>> {
    let wanted: Wanted = arguments::read(py, wanted)?;
    let volumes: Vec<Volume> = volumes.iter().map(taken).collect::<PyResult<_>>()?;
    let function = callback(function);
    let record = without_lock(py, |watch| {
        let safe = output.extension().is_some_and(|e| e.eq_ignore_ascii_case("safetensors"));
        ensure(safe, &output.display().to_string(), "file name", output.display(), "an end of .safetensors")?;
        ensure(!volumes.is_empty(), "arguments", "volumes", 0, "at least one volume")?;
        let loaded = wanted.spec.read(&wanted.spec.sets()?)?;
        let backend = arguments::backend(&wanted.backend)?.open()?;
        let mut plan = method::plan(&loaded, backend.as_ref())?;
        let voxels: Vec<u64> = volumes.iter().map(|v| v.data.len() as u64).collect();
        pretraining::check_memory(&voxels, &plan.outline())?;
        let (seed, limits) = (wanted.seed, wanted.ends.limits()?);
        let job = PretrainJob { volumes: &volumes, backend: backend.as_ref(), seed, limits };
        let mut progress = Progress::new(watch, function);
        let weights = pretraining::train(&loaded, plan.as_mut(), &job, &mut progress)?;
        progress.finish();
        files::write_weights(&output, &weights)?;
        let last = progress.records().last().cloned().unwrap_or_default();
        let numbers: usize = weights.tensors.values().map(|t| t.1.len()).sum();
        Ok(json!({
            "weights": output, "tensors": weights.tensors.keys().collect::<Vec<_>>(), "parameters": numbers,
            "steps": last.step, "train_s": last.seconds, "loss": last.loss, "records": progress.records(),
        }))
    })?;
    plain(py, &record)
}

/// The scores of a volume, or the Dice scores of two label maps.
#[pyfunction]
pub fn evaluate<'py>(
    py: Python<'py>,
    volume: &Bound<'py, PyAny>,
    reference: &Bound<'py, PyAny>,
    peak: Option<f64>,
    labels: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let (volume, reference) = (taken(volume)?, taken(reference)?);
    let found = without_lock(py, |_| {
        let held = [&volume, &reference].map(|v| v.data.len() as u64);
        Memory::of_volumes(&held).check()?;
        if labels {
            score::same_shape("the volume", volume.data.shape(), reference.data.shape())?;
            let [a, b] = [("the volume", &volume), ("the reference", &reference)];
            let [a, b] = [label_map(a.0, a.1.data.view())?, label_map(b.0, b.1.data.view())?];
            return Ok(json!({ "dice": dice(a.view(), b.view())? }));
        }
        let peak = score::peak(arguments::peak(peak)?, &reference);
        let mut all = json!(score::score("the volume", &volume, &reference, peak)?);
        all["peak"] = peak.into();
        Ok(all)
    })?;
    plain(py, &found)
}
