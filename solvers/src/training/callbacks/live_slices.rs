//! Sends the middle slices of the field during training, whenever the observer requests them.

use crate::training::Callback;
use crate::training::run::Run;
use crate::watched::middle;
use conefield_core::error::Result;
use conefield_core::trained::Sampler;
use ndarray::Array3;

/// Evaluates the field on the three middle slices of its grid. Does not affect the run.
#[derive(Default)]
pub struct LiveSlices;

impl Callback for LiveSlices {
    fn name(&self) -> &'static str {
        "live-slices"
    }

    fn between_steps(&mut self, run: &mut Run<'_>) -> Result<()> {
        if !run.observer.slices_due() {
            return Ok(());
        }
        run.clock.pause();
        let grid = run.scene.grid;
        let mut sampler = Sampler::new(run.scene, run.job.scan.unit.mm, grid);
        let mut slices = vec![];
        for part in middle(grid.shape) {
            let mut values = Array3::zeros(part.each_ref().map(|r| r.len()));
            sampler.fill(&run.model, run.exe.as_mut(), &part, values.view_mut())?;
            slices.push((part, values));
        }
        run.observer.slices(grid, &slices)?;
        run.clock.resume();
        Ok(())
    }
}
