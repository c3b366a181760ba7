//! Plugins of this run: found at start, or named by a spec that the user permits to load them.

use conefield_core::spec::load::Draft;
use conefield_core::{Error, Result};
use conefield_plugins::{Library, Place, Plugins};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use tracing::{debug, warn};

static PLUGINS: Mutex<Plugins> = Mutex::new(Plugins { found: vec![] });
/// Whether specs may load plugins.
static LEAVE: AtomicBool = AtomicBool::new(false);

/// Calls `f` with the plugins.
pub fn with<T>(f: impl FnOnce(&mut Plugins) -> T) -> T {
    f(&mut PLUGINS.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Loads the plugins in `named`, in the environment and in the user's folder. With `leave`, specs may load plugins too.
pub fn search(named: &[PathBuf], leave: bool) {
    LEAVE.store(leave, Ordering::Relaxed);
    with(|plugins| *plugins = Plugins::search(named));
}

/// Fails if a plugin named on the command line was refused; logs warnings about others.
pub fn settle() -> Result<()> {
    with(|plugins| {
        for found in &mut plugins.found {
            match &found.library {
                Ok(l) => debug!("plugin {} ({})", l.owner(), found.place.words()),
                Err(e) if found.place != Place::Named => warn!("plugin refused: {e}"),
                Err(_) => {
                    let gone = Error::unsupported("plugin", "refused before");
                    return std::mem::replace(&mut found.library, Err(gone)).map(drop);
                }
            }
        }
        Ok(())
    })
}

/// Loads the plugins that a spec names, if the user permits it; otherwise they must be loaded already.
pub fn of_spec(draft: &Draft) -> Result<()> {
    for (place, path) in draft.plugins() {
        with(|plugins| {
            if plugins.get(&path).is_none() && !LEAVE.load(Ordering::Relaxed) {
                let expected = format!(
                    "permission: --allow-plugins-from-spec for all plugins of the spec, or --plugin {} for this one",
                    path.display()
                );
                return Err(Error::invalid(&place, "plugins.paths", path.display(), expected));
            }
            plugins.load(path, Place::Spec)
        })?;
    }
    Ok(())
}

/// A plugin whose stages are used in a run.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Used {
    name: String,
    version: String,
    licence: String,
    path: String,
}

impl Used {
    fn of(l: &Library) -> Self {
        Self {
            name: l.name.clone(),
            version: l.version.clone(),
            licence: l.licence.clone(),
            path: l.path.display().to_string(),
        }
    }

    /// The path of its library.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Whether a plugin of this name is loaded.
    pub fn is_loaded(&self) -> bool {
        with(|plugins| plugins.found.iter().any(|f| f.library.as_ref().is_ok_and(|l| l.name == self.name)))
    }

    /// Text for people.
    pub fn line(&self) -> String {
        format!("{} {} ({})", self.name, self.version, self.path)
    }
}

/// The plugins whose stages the spec `tree` uses.
pub fn used(tree: &Value) -> Vec<Used> {
    with(|plugins| plugins.used(tree).into_iter().map(Used::of).collect())
}

/// The plugins' identity, which must match when a run is resumed; `None` without plugins.
pub fn identity(used: &[Used]) -> Option<(String, String)> {
    let all: Vec<String> = used.iter().map(|u| format!("{} {}", u.name, u.version)).collect();
    (!all.is_empty()).then(|| ("plugins".into(), all.join(", ")))
}
