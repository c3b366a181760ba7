//! Ends training when the error of held-out views stops falling, and keeps the state with the lowest error.

use crate::training::run::{Run, strayed};
use crate::training::{Callback, CallbackSpec, Kept, State};
use crate::waiting::Waited;
use conefield_core::checkpoint::tensors_of;
use conefield_core::method::Record;
use conefield_core::pages::{Pages, copy};
use conefield_core::prelude::*;

/// Its name in specs and checkpoints, and the prefix of its tensors.
const NAME: &str = "patience";
const PREFIX: &str = "patience.";

/// Settings of `patience`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Patience {
    /// Ends the run when the held-out views' error has not fallen for this many records; the best one is kept. A
    /// decaying learning rate keeps falling until the end of the run, so late improvements may be missed.
    pub records: u64,
}

impl Default for Patience {
    fn default() -> Self {
        Self { records: 5 }
    }
}

conefield_core::stage_type!(
    CallbackSpec,
    "patience",
    Patience,
    "ends a run that no longer predicts held-out views better"
);

impl CallbackSpec for Patience {
    fn build(&self) -> Result<Box<dyn Callback>> {
        ensure(self.records > 0, "spec", "records", 0, "at least 1")?;
        Ok(Box::new(Waiting { records: self.records, waited: Waited::default(), copy: None }))
    }
}

/// The callback that [`Patience`] builds.
struct Waiting {
    records: u64,
    /// Reset when channels are removed.
    waited: Waited,
    /// The best parameters.
    copy: Option<Pages>,
}

impl Callback for Waiting {
    fn name(&self) -> &'static str {
        NAME
    }

    fn begin(&mut self, run: &mut Run<'_>) -> Result<()> {
        if run.job.held_out.is_none() {
            run.observer.note("patience needs held-out views, and there are none: it does not end this run");
        }
        Ok(())
    }

    fn masked(&mut self) {
        (self.waited, self.copy) = (Waited::default(), None);
    }

    /// Ends the run after too many records without improvement.
    fn at_record(&mut self, record: &mut Record, run: &mut Run<'_>) -> Result<()> {
        // Short runs have records in between; they do not count.
        let counts = run.step.is_multiple_of(run.report_every) || run.clock.done(run.step) >= 1.0;
        let Some(held_out) = record.held_out.filter(|_| counts) else { return Ok(()) };
        let kept = self.waited.is_better(held_out) && self.keep(run)?;
        self.waited.count(record.step, held_out, kept);
        run.settled |= self.waited.since >= self.records;
        Ok(())
    }

    /// Restores the best state.
    fn finish(&mut self, run: &mut Run<'_>) -> Result<()> {
        if let (Some(kept), Some(best)) = (&self.copy, self.waited.best) {
            copy(&mut run.model.arena.params, kept);
            // What fetches parameters after this must not take the last ones from the device.
            run.exe.renew();
            run.best = Some(best);
        }
        Ok(())
    }

    fn state<'a>(&'a self, layout: &'a Layout) -> Result<State<'a>> {
        let tensors = self.copy.iter().flat_map(|copy| tensors_of(PREFIX, layout, &[&**copy])).collect();
        State::new(NAME, &self.waited, tensors)
    }

    fn restore(&mut self, kept: &Kept<'_>, run: &Run<'_>) -> Result<()> {
        self.waited = kept.value()?;
        if self.waited.best.is_some() {
            let layout = run.model.pipeline.layout();
            let mut params = Pages::zeros(layout.len());
            kept.parts(layout, &mut [&mut *params])?;
            self.copy = Some(params);
        }
        Ok(())
    }

    fn needs_held_out(&self) -> bool {
        true
    }

    /// One copy of the parameters.
    fn bytes(&self, parameters: u64) -> u64 {
        size_of::<f32>() as u64 * parameters
    }

    fn describe(&self) -> Option<String> {
        let records = if self.records == 1 { "a record".into() } else { format!("{} records", self.records) };
        Some(format!("ends after {records} without a smaller held-out error"))
    }
}

impl Waiting {
    /// Copies the parameters, unless the state is not finite, which later checks report.
    fn keep(&mut self, run: &mut Run<'_>) -> Result<bool> {
        run.exe.fetch(&mut run.model)?;
        if strayed(&run.model.arena).is_some() {
            return Ok(false);
        }
        let params = &run.model.arena.params;
        match &mut self.copy {
            Some(kept) => copy(kept, params),
            None => self.copy = Some(params.clone()),
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::stage::Mixture;
    use conefield_backend_cpu::Cpu;
    use conefield_core::backend::{Adam, Executable, StepStats, Work};
    use conefield_core::method::{Best, Job, Silent};
    use conefield_core::pipeline::{Model, Pipeline};
    use conefield_core::scan::Volume;
    use conefield_core::scene::{Scene, SceneSettings};
    use conefield_projectors::simulate::{Ellipsoid, Protocol, scan_ellipsoids};
    use ndarray::Array3;

    /// A device with an arena of its own, in which every parameter is 9.
    struct Remote {
        loaded: bool,
    }

    impl Executable for Remote {
        fn step(&mut self, _: &mut Model, _: &Work<'_>) -> Result<StepStats> {
            Ok(StepStats::default())
        }
        fn update(&mut self, _: &mut Model, _: &Adam) -> Result<()> {
            Ok(())
        }
        fn evaluate(&mut self, _: &Model, _: &[[f32; 3]], _: &mut [f32]) -> Result<()> {
            Ok(())
        }
        fn encode(&mut self, _: &Model, _: &[[f32; 3]]) -> Result<Vec<f32>> {
            Ok(vec![])
        }
        fn render(&mut self, _: &Model, _: &[UnitRay], _: &mut [f32]) -> Result<()> {
            Ok(())
        }
        fn fetch(&mut self, model: &mut Model) -> Result<()> {
            if self.loaded {
                model.arena.params.fill(9.0);
            }
            Ok(())
        }
        fn renew(&mut self) {
            self.loaded = false;
        }
    }

    /// As a callback does that opens the closed levels at the end of a run.
    #[test]
    fn the_best_state_stays_when_parameters_are_fetched_after_it() {
        let grid = Volume::centered(Array3::zeros((8, 8, 8)), [1.0; 3]).grid;
        let geometry = Protocol::r2(&grid).with_detector([8, 8]).with_views(2).geometry(&grid).unwrap();
        let ball = Ellipsoid { center: [0.0; 3], axes: [2.0; 3], value: 0.1 };
        let (scan, backend) = (scan_ellipsoids(&[ball], geometry), Cpu::new());
        let (job, scene) = (Job::new(&scan, &backend), Scene::new(&scan, &SceneSettings::default()).unwrap());
        let pipeline = Pipeline::alone(Box::new(Mixture { most: 1 })).unwrap();
        let (model, mut silent) = (Model::random(pipeline, 1), Silent);
        let best = model.arena.params.clone();
        let mut run = Run::new(&job, &scene, &mut silent, model, Box::new(Remote { loaded: true }));
        let found = Best { step: 1, held_out: 0.1 };
        let waited = Waited { best: Some(found), since: 1 };
        let mut waiting = Waiting { records: 1, waited, copy: Some(best.clone()) };
        run.exe.fetch(&mut run.model).unwrap();
        waiting.finish(&mut run).unwrap();
        run.exe.fetch(&mut run.model).unwrap();
        assert_eq!((&run.model.arena.params[..], run.best), (&best[..], Some(found)));
    }
}
