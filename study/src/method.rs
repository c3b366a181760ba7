//! A spec as a part of a comparison: built once, under a name that serves for the table and for a folder.

use conefield_core::backend::Backend;
use conefield_core::error::ensure;
use conefield_core::method::Plan;
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result};
use conefield_run::{files, method, specs};
use std::path::Path;

/// A spec with what is changed of it.
pub struct Method {
    /// Its own name.
    pub name: String,
    /// As --spec has it.
    pub spec: String,
    /// As --set has them.
    pub sets: Vec<String>,
    /// As --init has it.
    pub init: Option<String>,
    /// All of that read.
    pub loaded: Loaded,
    /// What it builds.
    pub plan: Box<dyn Plan>,
}

impl Method {
    /// Reads and builds `spec` under `name`, or else under its own.
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
            let start = method::init(&loaded.tree, Path::new(file));
            loaded = specs::read(spec, &[sets, &[start]].concat())?;
        }
        let plan = method::plan(&loaded, backend)?;
        let own = if loaded.spec.name.is_empty() { files::stem(spec) } else { loaded.spec.name.clone() };
        let name = name.map_or(own, str::to_owned);
        check_name(&name, &loaded.source, "name")?;
        Ok(Self { name, spec: spec.into(), sets: sets.to_vec(), init: init.map(str::to_owned), loaded, plan })
    }

    /// Refuses one that is called as one of `others`.
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

/// What a name must be to serve as a folder's.
pub const FOLDER_NAME: &str = "a name for a folder: letters, digits, and between them spaces and ._+()-";

/// Refuses a name that cannot be a folder's.
pub fn check_name(name: &str, place: &str, field: &str) -> Result<()> {
    let begins = name.starts_with(|c: char| c.is_alphanumeric());
    let plain = name.chars().all(|c| c.is_alphanumeric() || " ._+()-".contains(c)) && !name.ends_with([' ', '.']);
    ensure(begins && plain && name.len() <= 100, place, field, format!("{name:?}"), FOLDER_NAME)
}
