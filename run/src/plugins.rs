//! The plugins of this run: found before the command starts, or named by a spec that the user lets load them.

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
/// Whether a spec may load what it names.
static LEAVE: AtomicBool = AtomicBool::new(false);

/// Does something with the plugins.
pub fn with<T>(f: impl FnOnce(&mut Plugins) -> T) -> T {
    f(&mut PLUGINS.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Loads what `named`, the environment and the user's folder have; `leave`: so may specs.
pub fn search(named: &[PathBuf], leave: bool) {
    LEAVE.store(leave, Ordering::Relaxed);
    with(|plugins| *plugins = Plugins::search(named));
}

/// Refuses to go on without a plugin that the command line names; warns of others that are refused.
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

/// Loads the plugins that a spec names, if the user has given leave; otherwise they must be loaded already.
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

/// A plugin whose stages a run uses.
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

    /// In words.
    pub fn line(&self) -> String {
        format!("{} {} ({})", self.name, self.version, self.path)
    }
}

/// The plugins whose stages the spec `tree` names.
pub fn used(tree: &Value) -> Vec<Used> {
    with(|plugins| plugins.used(tree).into_iter().map(Used::of).collect())
}

/// What must be the same for a run to be resumed; nothing where no plugin is used.
pub fn identity(used: &[Used]) -> Option<(String, String)> {
    let all: Vec<String> = used.iter().map(|u| format!("{} {}", u.name, u.version)).collect();
    (!all.is_empty()).then(|| ("plugins".into(), all.join(", ")))
}
