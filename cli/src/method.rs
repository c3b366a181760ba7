//! A spec with what it builds.

use crate::budget::front::Kind;
use crate::files;
use crate::memory::{self, Memory};
use crate::specs;
use conefield_core::Result;
use conefield_core::arena::Arena;
use conefield_core::backend::{Backend, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::solver::Solver;
use conefield_core::spec::SurroundRule;
use conefield_core::spec::load::Loaded;
use conefield_io::ScanSize;
use conefield_solvers::surround;

/// A spec, what it builds and what that takes.
pub struct Method {
    pub loaded: Loaded,
    pub parts: Parts,
    pub memory: Memory,
}

impl Method {
    /// What it works on.
    pub fn kind(&self) -> Kind {
        if self.parts.pipeline.is_some() { Kind::Field } else { Kind::Voxels }
    }
}

/// What a spec builds.
pub struct Parts {
    pub solver: Box<dyn Solver>,
    /// Of specs that train a field.
    pub pipeline: Option<Pipeline>,
    /// What the backend made of it; empty without a pipeline.
    pub compiled: Explain,
    surround: SurroundRule,
}

impl Parts {
    /// Builds a spec for `backend`.
    pub fn of(loaded: &Loaded, backend: &dyn Backend) -> Result<Self> {
        let solver = loaded.spec.solver.build().map_err(|e| loaded.locate(e))?;
        let pipeline = specs::pipeline(loaded, solver.as_ref())?;
        let compiled = pipeline.as_ref().map(|p| backend.compile(p)).transpose()?.map(|c| c.1).unwrap_or_default();
        Ok(Self { solver, pipeline, compiled, surround: loaded.spec.scene.surround })
    }

    /// A run of it on a scan of this size, without reference, held-out views and checkpoint.
    pub fn run(&self, scan: ScanSize) -> memory::Run {
        memory::Run {
            scan,
            split: false,
            reference: false,
            field: self.pipeline.is_some(),
            parameters: self.pipeline.as_ref().map_or(0, |p| p.layout().len() as u64),
            backend: self.compiled.scratch_bytes as u64,
            kept: self.solver.memory_per_parameter(),
            solver: memory::working(self.solver.as_ref(), &scan),
            surround: surround::memory(self.surround, scan.pixels),
            resume: false,
        }
    }

    /// Refuses weights to start from that cannot be read or do not fit.
    pub fn check_weights(&self, loaded: &Loaded) -> Result<()> {
        if let Some(i) = &loaded.spec.initializer
            && i.volume().map_err(|e| loaded.locate(e))?.is_none()
        {
            let initializer = i.build(&|path| files::read_weights(path)).map_err(|e| loaded.locate(e))?;
            if let Some(layout) = self.pipeline.as_ref().map(|p| p.layout()) {
                initializer.apply(layout, &mut Arena::new(layout.len()))?;
            }
        }
        Ok(())
    }
}
