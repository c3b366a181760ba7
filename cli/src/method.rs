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
use conefield_core::spec::SceneSettings;
use conefield_core::spec::load::Loaded;
use conefield_io::ScanSize;
use conefield_solvers::{iterative, surround};

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
    scene: SceneSettings,
    /// Whether a volume is read to start from.
    from_volume: bool,
}

impl Parts {
    /// Builds a spec for `backend`.
    pub fn of(loaded: &Loaded, backend: &dyn Backend) -> Result<Self> {
        let solver = loaded.spec.solver.build().map_err(|e| loaded.locate(e))?;
        let pipeline = specs::pipeline(loaded, solver.as_ref())?;
        let compiled = pipeline.as_ref().map(|p| backend.compile(p)).transpose()?.map(|c| c.1).unwrap_or_default();
        let start = loaded.spec.initializer.as_ref().map(|i| i.volume()).transpose();
        let from_volume = start.map_err(|e| loaded.locate(e))?.flatten().is_some();
        Ok(Self { solver, pipeline, compiled, scene: loaded.spec.scene.clone(), from_volume })
    }

    /// A run of it on a scan of this size, without reference, held-out views and checkpoint.
    pub fn run(&self, scan: ScanSize) -> memory::Run {
        let mut solver = memory::working(self.solver.as_ref(), &scan);
        if self.pipeline.is_none() || self.solver.successor(&self.scene).is_some() {
            solver[1] += iterative::memory(&self.scene, scan.voxels);
        }
        // Solvers of voxels work in that volume. It is there twice while a file's order is turned into the program's.
        if self.pipeline.is_some() && self.from_volume {
            solver[1] += 8 * scan.voxels;
        }
        memory::Run {
            scan,
            split: false,
            reference: false,
            field: self.pipeline.is_some(),
            parameters: self.pipeline.as_ref().map_or(0, |p| p.layout().len() as u64),
            backend: self.compiled.scratch_bytes as u64,
            kept: self.solver.memory_per_parameter(),
            solver,
            surround: surround::memory(self.scene.surround, scan.pixels),
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

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_backend_cpu::Cpu;

    #[test]
    fn a_mask_of_voxels_is_reckoned_where_a_solver_of_voxels_has_one() {
        let scan = ScanSize { pixels: 1 << 16, voxels: 1 << 18, test_pixels: 0, reading: 0 };
        let takes = |spec: &str, support: &str| {
            let loaded = specs::read(spec, &[format!("scene.support={support}")]).unwrap();
            let [_, voxels] = Parts::of(&loaded, &Cpu::new()).unwrap().run(scan).solver;
            voxels
        };
        for (spec, mask) in [("fista-tv", 1 << 18), ("field-tv", 1 << 18), ("fast", 0)] {
            assert_eq!(takes(spec, "carve"), takes(spec, "box") + mask, "{spec}");
        }
    }

    #[test]
    fn a_volume_that_a_field_learns_first_is_reckoned() {
        let scan = ScanSize { pixels: 1 << 16, voxels: 1 << 18, test_pixels: 0, reading: 0 };
        let takes = |sets: &[String]| {
            let loaded = specs::read("fast", sets).unwrap();
            let [_, voxels] = Parts::of(&loaded, &Cpu::new()).unwrap().run(scan).solver;
            voxels
        };
        let from = "initializer={ type = \"volume\", path = \"some.nii.gz\" }".to_owned();
        assert_eq!(takes(&[from]), takes(&[]) + (8 << 18));
    }
}
