//! A spec in a comparison: built once, with a name that is valid in tables and as a folder.

use crate::{files, method, specs};
use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::method::Plan;
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result};
use serde::Serialize;
use std::path::Path;

/// A spec with changed settings.
#[derive(Serialize)]
pub struct Method {
    /// Its name.
    pub name: String,
    /// Value of `--spec`.
    pub spec: String,
    /// Values of `--set`.
    #[serde(rename = "set")]
    pub sets: Vec<String>,
    /// Value of `--init`.
    pub init: Option<String>,
    /// The parsed spec.
    #[serde(skip)]
    pub loaded: Loaded,
    /// The plan.
    #[serde(skip)]
    pub plan: Box<dyn Plan>,
}

impl Method {
    /// Reads and builds `spec`, named `name` or by default as the spec itself.
    pub fn read(
        spec: &str,
        name: Option<&str>,
        sets: &[String],
        init: Option<&str>,
        backend: &dyn Backend,
    ) -> Result<Self> {
        let mut loaded = specs::read(spec, sets)?;
        if let Some(file) = init {
            ensure(Path::new(file).exists(), "init", file, "nothing", "weights or a volume")?;
            let start = method::init(&loaded, Path::new(file))?;
            loaded = specs::read(spec, &[sets, &[start]].concat())?;
        }
        let plan = method::plan(&loaded, backend)?;
        let own = if loaded.spec.name.is_empty() { files::stem(spec) } else { loaded.spec.name.clone() };
        let name = name.map_or(own, str::to_owned);
        check_name(&name, &loaded.source, "name")?;
        Ok(Self { name, spec: spec.into(), sets: sets.to_vec(), init: init.map(str::to_owned), loaded, plan })
    }

    /// Refuses a name that occurs in `others`.
    pub fn differs(&self, others: &[Self]) -> Result<()> {
        match others.iter().find(|m| m.name.to_lowercase() == self.name.to_lowercase()) {
            Some(other) => {
                let found = format!("{:?}, the name of {}", self.name, other.loaded.source);
                Err(Error::invalid(&self.loaded.source, "name", found, "a unique name, for table and folder"))
            }
            None => Ok(()),
        }
    }
}

/// Description of names that are valid as folders.
pub const FOLDER_NAME: &str = "a name for a folder: letters, digits, and between them spaces and ._+()-";

/// Refuses a name that is not valid as a folder.
pub fn check_name(name: &str, place: &str, field: &str) -> Result<()> {
    let begins = name.starts_with(|c: char| c.is_alphanumeric());
    let plain = name.chars().all(|c| c.is_alphanumeric() || " ._+()-".contains(c)) && !name.ends_with([' ', '.']);
    ensure(begins && plain && name.len() <= 100, place, field, format!("{name:?}"), FOLDER_NAME)
}
