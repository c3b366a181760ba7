//! `conefield plugins list`

use crate::out;
use clap::Args;
use conefield::plugins;
use conefield_core::Result;
use conefield_plugins::search::{PATH_VARIABLE, user_folder};
use conefield_plugins::{Found, Place};
use serde::Serialize;

/// List the plugins with their stages, or why one was refused.
#[derive(Args)]
pub struct List {
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct ListedFile {
    path: String,
    place: Place,
    #[serde(skip_serializing_if = "Option::is_none")]
    plugin: Option<ListedPlugin>,
    /// The reason for refusing it.
    #[serde(skip_serializing_if = "Option::is_none")]
    refused: Option<String>,
}

#[derive(Serialize)]
struct ListedPlugin {
    name: String,
    version: String,
    licence: String,
    abi: String,
    stages: Vec<ListedStage>,
}

#[derive(Serialize)]
struct ListedStage {
    kind: String,
    #[serde(rename = "type")]
    name: String,
    doc: String,
}

impl ListedFile {
    fn of(found: &Found) -> Self {
        let plugin = found.library.as_ref().ok().map(|l| ListedPlugin {
            name: l.name.clone(),
            version: l.version.clone(),
            licence: l.licence.clone(),
            abi: format!("{}.{}", l.abi.0, l.abi.1),
            stages: l
                .types
                .iter()
                .map(|t| ListedStage { kind: t.kind.to_string(), name: t.name.clone(), doc: t.doc.clone() })
                .collect(),
        });
        Self {
            path: found.path.display().to_string(),
            place: found.place,
            plugin,
            refused: found.library.as_ref().err().map(ToString::to_string),
        }
    }

    fn lines(&self) -> Vec<String> {
        let place = format!("{} ({})", self.path, self.place.words());
        let mut lines = vec![];
        if let Some(p) = &self.plugin {
            lines.push(format!("{} {}, {}, ABI {}: {place}", p.name, p.version, p.licence, p.abi));
            let rows: Vec<Vec<String>> =
                p.stages.iter().map(|s| vec![format!("  {}", s.kind), s.name.clone(), s.doc.clone()]).collect();
            lines.push(out::table(&rows, &[]));
        }
        lines.extend(self.refused.iter().map(|e| format!("refused: {place}\n  {e}")));
        lines
    }
}

impl List {
    pub fn run(self) -> Result<()> {
        let rows: Vec<ListedFile> = plugins::with(|p| p.found.iter().map(ListedFile::of).collect());
        if self.json {
            return out::json(&serde_json::json!({ "plugins": rows }));
        }
        if rows.is_empty() {
            let folder = user_folder().map_or("no folder of this user".into(), |f| f.display().to_string());
            return out::say(&format!("no plugins: none by --plugin or {PATH_VARIABLE}, none in {folder}"));
        }
        out::say(&rows.iter().flat_map(ListedFile::lines).collect::<Vec<_>>().join("\n"))
    }
}
