//! Specs: by name, file or dict, with overridden settings.

use crate::arguments;
use crate::arrays::plain;
use crate::errors::OrRaise;
use conefield::specs;
use conefield_core::spec::load::{Loaded, to_toml};
use conefield_core::{Error, Result};
use pyo3::prelude::*;
use serde::Deserialize;
use serde_json::{Map, Value};

/// A spec as given in Python.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpecArgument {
    /// The name of a shipped spec, the type of a method, or a file.
    name: Option<String>,
    /// A whole spec.
    table: Option<Value>,
    /// Overridden settings, by their path in the spec.
    sets: Map<String, Value>,
}

impl SpecArgument {
    /// Whether a spec is given at all.
    pub fn is_given(&self) -> bool {
        self.name.is_some() || self.table.is_some()
    }

    /// Its overridden settings, in the syntax of `--set`.
    pub fn sets(&self) -> Result<Vec<String>> {
        self.sets.iter().map(|(path, value)| Ok(format!("{path}={}", inline(path, value)?))).collect()
    }

    /// Reads the spec with `sets` on top.
    pub fn read(&self, sets: &[String]) -> Result<Loaded> {
        match (&self.name, &self.table) {
            (Some(name), _) => specs::read(name, sets),
            (None, Some(table)) => specs::parse(&table.to_string(), "spec", sets),
            (None, None) => Err(Error::invalid("arguments", "spec", "nothing", "a name, a file or a dict")),
        }
    }
}

/// A value as one line of TOML.
fn inline(path: &str, value: &Value) -> Result<String> {
    let value = toml::Value::try_from(value).map_err(|e| {
        Error::invalid(format!("--set {path}"), "value", e, "a number, a text, a list or a table, not None")
    })?;
    Ok(value.to_string())
}

/// All names of specs.
#[pyfunction]
pub fn spec_names() -> Vec<&'static str> {
    specs::names()
}

/// The spec as TOML, with all defaults written out.
#[pyfunction]
pub fn spec_text(py: Python<'_>, spec: &str) -> PyResult<String> {
    let spec: SpecArgument = arguments::read(py, spec)?;
    let text = || to_toml(&spec.read(&spec.sets()?)?.spec);
    text().or_raise(py)
}

/// The JSON Schema of specs.
#[pyfunction]
pub fn schema(py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
    plain(py, &conefield_core::spec::schema::spec())
}
