//! `conefield explain`

use crate::out;
use clap::Args;
use conefield::backend::{self, BackendChoice};
use conefield::explain::Explanation;
use conefield::memory::{self, Memory};
use conefield::{files, method, specs};
use conefield_core::Result;
use conefield_scans::diagnosis::survey;
use std::path::PathBuf;

/// Show what a spec builds: stages, widths, parameters, memory, work.
#[derive(Args)]
pub struct ExplainArgs {
    #[arg(help = specs::help())]
    spec: String,
    /// Change a setting, such as encoder.levels=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Also estimate the memory for this scan.
    #[arg(long)]
    scan: Option<PathBuf>,
    #[arg(long, value_name = "BACKEND", default_value_t, help = backend::HELP)]
    backend: BackendChoice,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl ExplainArgs {
    pub fn run(self) -> Result<()> {
        let loaded = specs::read(&self.spec, &self.sets)?;
        // Weights named by an initializer are not read here: a spec is explained without them.
        let backend = self.backend.open()?;
        let plan = method::plan_without_files(&loaded, backend.as_ref())?;
        let backend = Some(backend.as_ref());
        let explanation = match &self.scan {
            None => Explanation::new(&loaded, plan.as_ref(), backend, None)?,
            Some(path) => {
                let size = conefield_io::scan_size(path)?;
                Memory::of_views(&size).check()?;
                let scan = conefield_scans::read_scan(path)?;
                files::warn_of(path, &survey(&scan), plan.needs(&scan.header()).surround > 0);
                Explanation::new(&loaded, plan.as_ref(), backend, Some((&scan, memory::Run::on(size))))?
            }
        };
        if self.json { out::json(&explanation) } else { out::say(&explanation.text()) }
    }
}
