//! Search locations of plugins, and the plugins found.

use crate::library::Library;
use crate::spec;
use conefield_core::error::{Error, Result};
use conefield_core::spec::marks::types;
use serde_json::Value;
use std::env;
use std::path::{Path, PathBuf};

/// The environment variable that lists files and folders of plugins, like `PATH`.
pub const PATH_VARIABLE: &str = "CONEFIELD_PLUGIN_PATH";

/// Origin of a plugin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// Named on the command line.
    Named,
    /// Named in the environment.
    Environment,
    /// Found in the user's plugin folder.
    UserFolder,
    /// Named in a spec, with the user's permission.
    Spec,
}

impl Place {
    /// A readable description.
    pub fn words(self) -> &'static str {
        match self {
            Self::Named => "--plugin",
            Self::Environment => PATH_VARIABLE,
            Self::UserFolder => "user folder",
            Self::Spec => "spec",
        }
    }
}

/// A file that was found, and the result of loading it.
pub struct Found {
    /// Its path.
    pub path: PathBuf,
    /// Its origin.
    pub place: Place,
    /// The library, or the reason for refusing it.
    pub library: Result<Library>,
}

/// All plugins examined.
#[derive(Default)]
pub struct Plugins {
    /// In the order of discovery.
    pub found: Vec<Found>,
}

/// The user's plugin folder: `conefield/plugins` in the system's data folder.
pub fn user_folder() -> Option<PathBuf> {
    // A relative home would depend on the current folder, whose owner could then inject code.
    dirs::data_dir().filter(|d| d.is_absolute()).map(|d| d.join("conefield").join("plugins"))
}

impl Plugins {
    /// Loads and registers plugins from `named` (files and folders), the environment and the user's folder. Errors are
    /// kept with the plugin.
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

    /// Loads and registers the library at `path`, unless it is loaded already.
    pub fn load(&mut self, path: PathBuf, place: Place) -> Result<()> {
        if self.get(&path).is_none() {
            let library = Library::open(&path)?;
            spec::register(&library)?;
            self.found.push(Found { path, place, library: Ok(library) });
        }
        Ok(())
    }

    /// As [`Plugins::load`], but keeps the error with the file.
    fn note(&mut self, path: PathBuf, place: Place) {
        if let Err(e) = self.load(path.clone(), place) {
            self.found.push(Found { path, place, library: Err(e) });
        }
    }

    /// The library loaded from `path`.
    pub fn get(&self, path: &Path) -> Option<&Library> {
        let real = path.canonicalize().ok()?;
        self.loaded().find(|l| l.path == real)
    }

    /// All loaded libraries.
    pub fn loaded(&self) -> impl Iterator<Item = &Library> {
        self.found.iter().filter_map(|f| f.library.as_ref().ok())
    }

    /// The libraries whose types are used by the spec `tree`.
    pub fn used(&self, tree: &Value) -> Vec<&Library> {
        let types = types(tree);
        self.loaded().filter(|l| l.types.iter().any(|t| types.contains(&(t.kind, t.name.clone())))).collect()
    }
}

/// The plugins at `path`: the file itself, or every library in a folder.
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
