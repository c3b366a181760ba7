//! Stages written in Python: registered under a name, built if a spec names them, tested by the conformance kit.

use crate::arguments;
use crate::arrays::owned;
use crate::encoder::PythonEncoder;
use crate::errors::{OrRaise, raised as exception};
use crate::regularizer::PythonRegularizer;
use crate::work::without_lock;
use conefield_conformance::{Report, With, check_type};
use conefield_core::registry::{self, Kind, Make, Registered, StageType};
use conefield_core::regularizer::{Regularizer, RegularizerSpec};
use conefield_core::settings::EncoderSpec;
use conefield_core::stage::Encoder;
use conefield_core::{Error, Result};
use ndarray::{Array, ArrayD, Dimension};
use numpy::{Element, PyReadonlyArrayDyn};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The owner of these types, in messages.
const OWNER: &str = "Python";

/// The classes by kind and name. A class registered again, e.g. when a notebook cell is run twice, replaces the old
/// one.
static CLASSES: Mutex<BTreeMap<(Kind, String), Py<PyAny>>> = Mutex::new(BTreeMap::new());

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Exceptions raised by Python stages during one piece of Rust work. A kernel has no result to return them in.
#[derive(Default)]
pub struct Raised {
    first: Mutex<Option<PyErr>>,
    /// The last exception in whose words an error was reported.
    quoted: Mutex<Option<PyErr>>,
}

impl Raised {
    /// Keeps the first exception.
    pub fn note(&self, error: PyErr) {
        locked(&self.first).get_or_insert(error);
    }

    /// Whether there is an exception.
    pub fn any(&self) -> bool {
        locked(&self.first).is_some()
    }

    /// Returns and clears the exception.
    pub fn take(&self) -> Option<PyErr> {
        locked(&self.first).take()
    }

    /// The exception that `text` quotes.
    pub fn cause(&self, py: Python<'_>, text: &str) -> Option<PyErr> {
        let quoted = locked(&self.quoted).take();
        quoted.filter(|e| text.contains(&words(py, e)))
    }
}

thread_local! {
    /// Exceptions of the current thread's work: stages built during it report theirs here.
    static CURRENT: RefCell<Arc<Raised>> = RefCell::default();
}

/// Runs `work`, with `raised` collecting the exceptions of its stages.
pub fn within<T>(raised: &Arc<Raised>, work: impl FnOnce() -> T) -> T {
    let before = CURRENT.replace(raised.clone());
    let done = work();
    CURRENT.set(before);
    done
}

/// The object of a stage, under the name of its type.
pub struct StageObject {
    pub name: &'static str,
    pub object: Py<PyAny>,
    /// One call at a time: attributes are set on the object before it. Acquired before the GIL, never after.
    turn: Mutex<()>,
    raised: Arc<Raised>,
}

impl StageObject {
    /// An object whose exceptions are those of the current thread's work.
    fn new(name: &'static str, object: Py<PyAny>) -> Self {
        Self { name, object, turn: Mutex::new(()), raised: CURRENT.with_borrow(Arc::clone) }
    }

    /// Runs `call` with the GIL, one at a time; `None` if it or another stage has failed.
    pub fn call<T>(&self, call: impl FnOnce(Python<'_>, &Bound<'_, PyAny>) -> PyResult<T>) -> Option<T> {
        if self.raised.any() {
            return None;
        }
        let _turn = locked(&self.turn);
        Python::attach(|py| call(py, self.object.bind(py)).map_err(|e| self.raised.note(e)).ok())
    }

    /// The exception of a failed call as an error. It stays until the work ends, whose caller raises it.
    pub fn fault(&self) -> Result<()> {
        if !self.raised.any() {
            return Ok(());
        }
        Python::attach(|py| {
            // The lock is free while the exception is put into words, which may run Python.
            let raised = locked(&self.raised.first).as_ref().map(|e| e.clone_ref(py));
            raised.map_or(Ok(()), |e| Err(Error::unsupported(self.name, words(py, &e))))
        })
    }

    /// The array that `call` has returned. Refuses a shape other than `want`.
    pub fn shaped<R: Element + Clone, D: Dimension>(
        &self,
        found: &Bound<'_, PyAny>,
        want: &[usize],
        call: &str,
    ) -> PyResult<Array<R, D>> {
        let found = array::<R>(found)?;
        let shape = found.shape().to_vec();
        match found.into_dimensionality() {
            Ok(array) if shape == want => Ok(array),
            _ => {
                let (found, expected) = (format!("an array of shape {shape:?}"), format!("{want:?}"));
                Python::attach(|py| Err(exception(py, &Error::invalid(self.name, call, found, expected))))
            }
        }
    }
}

/// An attribute that may be missing or None.
pub fn optional<'py, T>(object: &Bound<'py, PyAny>, name: &str) -> PyResult<Option<T>>
where
    T: for<'a> FromPyObject<'a, 'py, Error: Into<PyErr>>,
{
    match object.getattr_opt(name)? {
        Some(value) if !value.is_none() => value.extract().map(Some).map_err(Into::into),
        _ => Ok(None),
    }
}

/// `value` as an array of this number type.
pub fn array<R: Element + Clone>(value: &Bound<'_, PyAny>) -> PyResult<ArrayD<R>> {
    let (py, arguments) = (value.py(), PyDict::new(value.py()));
    arguments.set_item("dtype", numpy::dtype::<R>(py))?;
    let made = py.import("numpy")?.call_method("asarray", (value,), Some(&arguments))?;
    Ok(owned(&made.extract::<PyReadonlyArrayDyn<'_, R>>()?))
}

/// The kind of a stage.
fn kind(py: Python<'_>, name: &str) -> PyResult<Kind> {
    let all = || Kind::ALL.iter().map(|k| k.name()).collect::<Vec<_>>().join(", ");
    Kind::named(name).ok_or_else(|| exception(py, &Error::invalid("stage", "kind", name, all())))
}

/// Registers a class, so that a spec can name it as a type of this kind: an encoder or a regularizer.
#[pyfunction]
pub fn register(py: Python<'_>, kind_name: &str, name: String, doc: String, class: Py<PyAny>) -> PyResult<()> {
    let kind = kind(py, kind_name)?;
    let key = (kind, name.clone());
    if !locked(&CLASSES).contains_key(&key) {
        let own: &'static str = name.clone().leak();
        let settings = move |settings: Value| Written { name: own, settings };
        let make = match kind {
            Kind::Encoder => Make::new::<dyn EncoderSpec>(Box::new(move |v| Ok(Box::new(settings(v))))),
            Kind::Regularizer => Make::new::<dyn RegularizerSpec>(Box::new(move |v| Ok(Box::new(settings(v))))),
            _ => return Err(exception(py, &Error::invalid("stage", "kind", kind_name, "encoder or regularizer"))),
        };
        // The settings are known only to the class, which may be replaced: any key is allowed here.
        let schema = json!({ "type": "object" });
        registry::add(vec![StageType::loaded(OWNER, name, doc, schema, make)]).or_raise(py)?;
    }
    let old = locked(&CLASSES).insert(key, class);
    drop(old);
    Ok(())
}

/// All types of a kind available to specs.
#[pyfunction]
pub fn stage_names(py: Python<'_>, kind_name: &str) -> PyResult<Vec<&'static str>> {
    kind(py, kind_name).map(registry::names)
}

/// Settings of a Python stage.
struct Written {
    /// The name of its type.
    name: &'static str,
    settings: Value,
}

impl Written {
    /// A new object of its class.
    fn object(&self, kind: Kind) -> Result<Py<PyAny>> {
        Python::attach(|py| {
            let class = locked(&CLASSES).get(&(kind, self.name.to_owned())).map(|c| c.clone_ref(py));
            let class = class.ok_or_else(|| Error::unsupported(self.name, "no class is registered under this name"))?;
            let make = || -> PyResult<Py<PyAny>> {
                let settings = py.import("json")?.call_method1("loads", (self.settings.to_string(),))?;
                class.call(py, (), Some(settings.cast::<PyDict>()?))
            };
            make().map_err(|e| self.refused(py, e))
        })
    }

    /// The stage that `new` makes of a new object.
    fn stage<T>(&self, kind: Kind, new: fn(Python<'_>, StageObject) -> PyResult<Result<T>>) -> Result<T> {
        let of = StageObject::new(self.name, self.object(kind)?);
        Python::attach(|py| new(py, of).unwrap_or_else(|e| Err(Error::unsupported(self.name, quoted(py, e)))))
    }

    /// The error for settings that a class refuses.
    fn refused(&self, py: Python<'_>, e: PyErr) -> Error {
        let why = format!("{}, which {} refuses: {}", self.settings, self.name, quoted(py, e));
        Error::invalid("spec", "", why, "settings that the class takes")
    }
}

/// An exception as text for an error of the current thread's work, whose cause it becomes.
fn quoted(py: Python<'_>, e: PyErr) -> String {
    let text = words(py, &e);
    let old = CURRENT.with_borrow(|raised| locked(&raised.quoted).replace(e));
    drop(old);
    text
}

/// An exception as text.
fn words(py: Python<'_>, e: &PyErr) -> String {
    let kind = e.get_type(py).name().map(|n| n.to_string()).unwrap_or_default();
    format!("{kind}: {}", e.value(py))
}

impl Registered for Written {
    fn type_name(&self) -> &'static str {
        self.name
    }

    fn keys(&self) -> serde_json::Result<Value> {
        Ok(self.settings.clone())
    }
}

impl EncoderSpec for Written {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(self.stage(Kind::Encoder, PythonEncoder::new)?))
    }
}

impl RegularizerSpec for Written {
    fn build(&self) -> Result<Box<dyn Regularizer>> {
        Ok(Box::new(self.stage(Kind::Regularizer, PythonRegularizer::new)?))
    }
}

/// Name, outcome and evidence of each property of a stage.
type Properties = Vec<(&'static str, &'static str, String)>;

/// Runs the conformance kit on a stage type: returns whether it passes, the report, and each property.
#[pyfunction]
pub fn check_stage(py: Python<'_>, kind_name: &str, table: &str) -> PyResult<(bool, String, Properties)> {
    let kind = kind(py, kind_name)?;
    let table: Value = arguments::read(py, table)?;
    let found = without_lock(py, |_| check_type(kind, &table, &With::ON_THE_HOST))?;
    let reports: Vec<Report> = found.into_iter().map(|(_, report)| report).collect();
    let text = reports.iter().map(Report::to_string).collect();
    Ok((reports.iter().all(Report::passed), text, reports.iter().flat_map(properties).collect()))
}

fn properties(report: &Report) -> Properties {
    report.properties().map(|(name, outcome, text)| (name, outcome, text.to_owned())).collect()
}
