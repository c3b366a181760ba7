//! A spec with its plan and what that takes.

use crate::budget::front::Unknowns;
use crate::files;
use crate::memory::{self, Memory};
use crate::specs;
use conefield_core::Result;
use conefield_core::backend::Backend;
use conefield_core::method::{Context, Plan};
use conefield_core::spec::load::Loaded;
use serde_json::Value;
use std::path::Path;

/// A spec that is built and priced.
pub struct Planned {
    pub loaded: Loaded,
    pub plan: Box<dyn Plan>,
    pub memory: Memory,
}

impl Planned {
    /// What it solves for.
    pub fn unknowns(&self) -> Unknowns {
        unknowns(self.plan.as_ref())
    }
}

/// What a method solves for; a chain, what its first method does.
pub fn unknowns(plan: &dyn Plan) -> Unknowns {
    if plan.pipeline().is_some() { Unknowns::Field } else { Unknowns::Voxels }
}

/// Builds a spec for `backend`: every stage once. Refusals name the line of the spec.
pub fn plan(loaded: &Loaded, backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    let context = Context { backend, weights: &|path| files::read_weights(path) };
    loaded.spec.method.plan(&context).map_err(|e| loaded.locate(e))
}

/// Builds a spec without reading the weights that it names.
pub fn plan_without_files(loaded: &Loaded, backend: &dyn Backend) -> Result<Box<dyn Plan>> {
    let context = Context { backend, weights: &|_| Ok(Default::default()) };
    loaded.spec.method.plan(&context).map_err(|e| loaded.locate(e))
}

/// Reads and builds a spec, and refuses what does not fit into memory. `run` says what else a run holds.
pub fn planned(spec: &str, sets: &[String], backend: &dyn Backend, run: &memory::Run) -> Result<Planned> {
    let loaded = specs::read(spec, sets)?;
    let plan = plan(&loaded, backend)?;
    let tables = smaller_tables(&loaded);
    let smaller = tables.iter().filter_map(|(bits, set)| {
        let loaded = specs::read(spec, &[sets, std::slice::from_ref(set)].concat()).ok()?;
        Some((*bits, plan_without_files(&loaded, backend).ok()?))
    });
    let memory = run.memory(plan.as_ref());
    memory.check(|available| run.smaller(plan.as_ref(), available, smaller))?;
    Ok(Planned { loaded, plan, memory })
}

/// Settings that make the tables of a hash grid smaller, from the largest that is smaller than now.
fn smaller_tables(loaded: &Loaded) -> Vec<(u32, String)> {
    let paths = ["encoder", "methods.0.encoder"];
    let found = paths.into_iter().find_map(|path| {
        let pointer = format!("/{}/log2_table_size", path.replace('.', "/"));
        Some((path, loaded.tree.pointer(&pointer)?.as_u64()?))
    });
    let Some((path, bits)) = found else { return vec![] };
    (10..bits as u32).rev().map(|bits| (bits, format!("{path}.log2_table_size={bits}"))).collect()
}

/// The setting that starts the method `tree` from the file `path`: weights or a volume. Of a chain its first method starts
/// from it.
pub fn init(tree: &Value, path: &Path) -> String {
    if let Some(first) = tree["methods"].get(0) {
        return format!("methods.0.{}", init(first, path));
    }
    let file = toml::Value::String(path.display().to_string());
    match conefield_io::is_volume(path) {
        false => format!("initializer={{ type = \"mci\", weights = {file} }}"),
        true if tree.get("initializer").is_some() => format!("initializer={{ type = \"volume\", path = {file} }}"),
        true => format!("start={file}"),
    }
}
