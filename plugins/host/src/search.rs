//! Where plugins are looked for, and what was found there.

use crate::library::Library;
use crate::spec;
use conefield_core::error::{Error, Result};
use serde_json::Value;
use std::collections::BTreeSet;
use std::env;
use std::path::{Path, PathBuf};

/// The variable that lists files and folders of plugins, as `PATH` lists folders.
pub const PATH_VARIABLE: &str = "CONEFIELD_PLUGIN_PATH";

/// Who named a plugin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// The command line.
    Named,
    /// The environment.
    Environment,
    /// The user's folder of plugins.
    UserFolder,
    /// A spec, with the user's leave.
    Spec,
}

impl Place {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Named => "--plugin",
            Self::Environment => PATH_VARIABLE,
            Self::UserFolder => "user folder",
            Self::Spec => "spec",
        }
    }
}

/// A file that was found, with what became of it.
pub struct Found {
    /// Where.
    pub path: PathBuf,
    /// Who named it.
    pub place: Place,
    /// The library, or why it was refused.
    pub library: Result<Library>,
}

/// Every plugin that was looked at.
#[derive(Default)]
pub struct Plugins {
    /// In the order in which they were found.
    pub found: Vec<Found>,
}

/// The folder in which a user's plugins are looked for: `conefield/plugins` in the system's folder for data.
pub fn user_folder() -> Option<PathBuf> {
    // A home that is a relative name would be one folder here and another there: whoever owns the current one could bring code.
    dirs::data_dir().filter(|d| d.is_absolute()).map(|d| d.join("conefield").join("plugins"))
}

impl Plugins {
    /// Loads and registers what `named` (files and folders) and the environment name and what lies in the user's folder.
    /// What is wrong with a plugin is noted with it.
    pub fn search(named: &[PathBuf]) -> Self {
        let mut plugins = Self::default();
        let environment: Vec<PathBuf> = env::var_os(PATH_VARIABLE).iter().flat_map(env::split_paths).collect();
        let places = [
            (Place::Named, named.to_vec()),
            (Place::Environment, environment.into_iter().filter(|p| !p.as_os_str().is_empty()).collect()),
            (Place::UserFolder, user_folder().into_iter().filter(|f| f.is_dir()).collect()),
        ];
        for (place, paths) in places {
            for path in paths {
                match files(&path) {
                    Ok(files) => files.into_iter().for_each(|file| plugins.note(file, place)),
                    Err(e) => plugins.found.push(Found { path, place, library: Err(e) }),
                }
            }
        }
        plugins
    }

    /// Loads and registers the library at `path`, if it is not there yet.
    pub fn load(&mut self, path: PathBuf, place: Place) -> Result<()> {
        if self.get(&path).is_none() {
            let library = Library::open(&path)?;
            spec::register(&library)?;
            self.found.push(Found { path, place, library: Ok(library) });
        }
        Ok(())
    }

    /// As [`Plugins::load`]; what is wrong is kept with the file.
    fn note(&mut self, path: PathBuf, place: Place) {
        if let Err(e) = self.load(path.clone(), place) {
            self.found.push(Found { path, place, library: Err(e) });
        }
    }

    /// The library that was loaded from `path`.
    pub fn get(&self, path: &Path) -> Option<&Library> {
        let real = path.canonicalize().ok()?;
        self.loaded().find(|l| l.path == real)
    }

    /// Every library that is loaded.
    pub fn loaded(&self) -> impl Iterator<Item = &Library> {
        self.found.iter().filter_map(|f| f.library.as_ref().ok())
    }

    /// The libraries whose types the spec `tree` names.
    pub fn used(&self, tree: &Value) -> Vec<&Library> {
        let mut names = BTreeSet::new();
        collect_types(tree, &mut names);
        self.loaded().filter(|l| l.types.iter().any(|t| names.contains(t.name.as_str()))).collect()
    }
}

/// The values of every key `type`.
fn collect_types<'a>(tree: &'a Value, names: &mut BTreeSet<&'a str>) {
    match tree {
        Value::Object(map) => {
            names.extend(map.get("type").and_then(Value::as_str));
            map.values().for_each(|v| collect_types(v, names));
        }
        Value::Array(all) => all.iter().for_each(|v| collect_types(v, names)),
        _ => {}
    }
}

/// The plugins that `path` names: itself, or every library of a folder.
fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_path_buf()]);
    }
    let io = |e| Error::io(path, e);
    let mut all = vec![];
    for entry in std::fs::read_dir(path).map_err(io)? {
        let file = entry.map_err(io)?.path();
        if file.extension().is_some_and(|e| e == env::consts::DLL_EXTENSION) {
            all.push(file);
        }
    }
    all.sort();
    Ok(all)
}
