//! Slices of a field while it trains.

use crate::common::{model, neural_field, planned, scan, volume};
use conefield_backend_cpu::Cpu;
use conefield_core::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::method::{Job, Observer, Record};
use conefield_core::parts::Part;
use ndarray::{Array3, s};
use serde_json::json;

/// Takes slices at intervals of `every` steps.
struct Slices {
    every: u64,
    step: u64,
    last: Vec<(Part, Array3<f32>)>,
    times: u64,
    losses: Vec<Option<f64>>,
}

impl Observer for Slices {
    fn progress(&mut self, step: u64, _: f64, _: f64) {
        self.step = step;
    }
    fn record(&mut self, record: &Record) {
        self.losses.push(record.loss);
    }
    fn note(&mut self, _: &str) {}
    fn slices_due(&self) -> bool {
        self.step.is_multiple_of(self.every)
    }
    fn slices(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<()> {
        assert_eq!((grid.shape, slices.len()), ([16; 3], 3));
        (self.last, self.times) = (slices.to_vec(), self.times + 1);
        Ok(())
    }
}

#[test]
fn slices_are_those_of_the_field_and_change_nothing() {
    let value = neural_field(
        8,
        json!({
            "callbacks": [{"type": "rollback"}, {"type": "fft-mask", "epoch": 2, "threshold": 1e-6}],
            "training": {"steps": 40, "rays": 64, "report_every": 5}, "optimizer": {"lr": 0.01},
        }),
    );
    let (scan, cpu) = (scan(), Cpu::new());
    let mut plan = planned(&value, &cpu).unwrap();
    let mut run = |every: u64| {
        let mut seen = Slices { every, step: 0, last: vec![], times: 0, losses: vec![] };
        let job = Job { seed: 7, ..Job::new(&scan, &cpu) };
        (plan.run(&job, &mut seen).unwrap(), seen)
    };
    let ((plain, without), (watched, with)) = (run(u64::MAX), run(1));
    assert_eq!((without.times, with.times), (1, 41));
    assert_eq!(with.losses, without.losses);
    let whole = volume(&watched);
    for (part, values) in &with.last {
        let [x, y, z] = part.clone();
        assert_eq!(whole.data.slice(s![x, y, z]), values.view());
    }
    let thick = |k: usize| with.last[k].0.each_ref().map(|r| (r.start, r.len()));
    assert_eq!(thick(1), [(0, 16), (8, 1), (0, 16)]);
    assert!(*model(plain).arena.params == *model(watched).arena.params);
}
