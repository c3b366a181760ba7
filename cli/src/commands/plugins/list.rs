//! `conefield plugins list`

use crate::out;
use clap::Args;
use conefield::plugins;
use conefield_core::Result;
use conefield_plugins::Found;
use conefield_plugins::search::{PATH_VARIABLE, user_folder};
use serde_json::{Value, json};

/// List the plugins with their stages, or why one was refused.
#[derive(Args)]
pub struct List {
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// A plugin, or the reason for refusing it.
fn object(Found { path, place, library }: &Found) -> Value {
    let path = path.display().to_string();
    match library {
        Ok(l) => {
            let stage = |kind: String, name: &str, doc: &str| json!({ "kind": kind, "type": name, "doc": doc });
            let stages: Vec<Value> = l.types.iter().map(|t| stage(t.kind.to_string(), &t.name, &t.doc)).collect();
            let abi = format!("{}.{}", l.abi.0, l.abi.1);
            let plugin =
                json!({ "name": l.name, "version": l.version, "licence": l.licence, "abi": abi, "stages": stages });
            json!({ "path": path, "place": place, "plugin": plugin })
        }
        Err(e) => json!({ "path": path, "place": place, "refused": e.to_string() }),
    }
}

/// The same for people.
fn lines(Found { path, place, library }: &Found) -> String {
    let place = format!("{} ({})", path.display(), place.words());
    match library {
        Ok(l) => {
            let rows: Vec<Vec<String>> =
                l.types.iter().map(|t| vec![format!("  {}", t.kind), t.name.clone(), t.doc.clone()]).collect();
            let (major, minor) = l.abi;
            let about = format!("{} {}, {}, ABI {major}.{minor}: {place}", l.name, l.version, l.licence);
            format!("{about}\n{}", out::table(&rows, &[]))
        }
        Err(e) => format!("refused: {place}\n  {e}"),
    }
}

impl List {
    pub fn run(self) -> Result<()> {
        plugins::with(|plugins| {
            let found = &plugins.found;
            if self.json {
                return out::json(&json!({ "plugins": found.iter().map(object).collect::<Vec<_>>() }));
            }
            if found.is_empty() {
                let folder = user_folder().map_or("no folder of this user".into(), |f| f.display().to_string());
                return out::say(&format!("no plugins: none by --plugin or {PATH_VARIABLE}, none in {folder}"));
            }
            out::say(&found.iter().map(lines).collect::<Vec<_>>().join("\n"))
        })
    }
}
