//! Finds where in the support the field is empty, while it trains, so that steps take no samples there: an occupancy grid
//! (Müller et al. 2022, Instant-NGP) over the cells that the support is carved from.
//!
//! Every few steps the field is looked at in one point of each cell, another one each time. A cell keeps the highest
//! attenuation that was found, which decays from look to look, and is empty where that of the cell and of its neighbours is
//! small. Cells that the support leaves out are empty from the first step. What comes up in an empty cell is found by the
//! looks, and by the rays that take all samples: these pull at the field everywhere.

use crate::support::{cells, widened};
use conefield_core::backend::Executable;
use conefield_core::checkpoint::Resume;
use conefield_core::error::{Error, Result};
use conefield_core::geometry::VoxelGrid;
use conefield_core::occupancy::Occupancy;
use conefield_core::pipeline::Model;
use conefield_core::random::{mix, unit};
use conefield_core::scene::Scene;
use conefield_core::spec::{OccupancyRule, Refined};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What is left of a cell's highest attenuation from one look to the next.
const DECAY: f32 = 0.9;
/// The highest attenuation that is told apart, in the scale that stages see: how long a cell is remembered for it ends.
const HIGHEST: f32 = 100.0;
/// Change of the share of occupied cells that is worth a word.
const NOTABLE: f64 = 0.05;
/// Under this name the cells' attenuations go into a checkpoint.
const NAME: &str = "occupancy.highest";

/// What it knows beside the cells' attenuations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Since {
    /// The step from which attenuations count: the first, or the one at which the run last went back.
    step: u64,
    /// The share of occupied cells that was last told.
    told: Option<f64>,
}

/// Follows where the field is empty.
pub struct Refinement {
    settings: Refined,
    seed: u64,
    grid: VoxelGrid,
    low: [f32; 3],
    side: [f32; 3],
    /// Cells of the support, and which these are.
    held: Vec<bool>,
    cells: Vec<u32>,
    /// Of each cell, in the scale that stages see.
    highest: Vec<f32>,
    since: Since,
    occupancy: Option<Occupancy>,
    points: Vec<[f32; 3]>,
    values: Vec<f32>,
}

impl Refinement {
    /// Follows a run in `scene`, if the rule is to; from where `resume` stood.
    pub fn new(
        rule: &OccupancyRule,
        scene: &Scene,
        seed: u64,
        since: Since,
        resume: Option<&Resume>,
    ) -> Result<Option<Self>> {
        let OccupancyRule::Refined(settings) = *rule else { return Ok(None) };
        let grid = cells(&scene.grid);
        let [nx, ny, nz] = grid.shape;
        let [low, high] = grid.bounds().map(|p| scene.to_unit(p));
        let all = (0..nx * ny * nz).map(|i| grid.voxel([i / (ny * nz), i / nz % ny, i % nz]));
        let held: Vec<bool> = all.map(|p| scene.holds(p)).collect();
        let mut refinement = Self {
            settings,
            seed: seed ^ 0x6f63_6375_7079,
            low,
            side: std::array::from_fn(|k| (high[k] - low[k]) / grid.shape[k] as f32),
            cells: (0..held.len() as u32).filter(|&i| held[i as usize]).collect(),
            highest: vec![0.0; held.len()],
            held,
            grid,
            since,
            occupancy: None,
            points: vec![],
            values: vec![],
        };
        if let Some(resume) = resume {
            refinement.highest = match resume.weights.tensors.get(NAME) {
                Some((shape, values)) if shape[..] == refinement.grid.shape => values.clone(),
                other => {
                    let found = other.map_or("nothing".into(), |(shape, _)| format!("shape {shape:?}"));
                    let expected = format!("a tensor of shape {:?}", refinement.grid.shape);
                    return Err(Error::invalid(&resume.place, NAME, found, expected));
                }
            };
        }
        let step = resume.map_or(0, |r| r.standing.step);
        // The cells as the last look left them.
        refinement.decide(step.saturating_sub(1) / settings.every * settings.every);
        Ok(Some(refinement))
    }

    /// Where the next step takes samples, if not everywhere.
    pub fn occupancy(&self) -> Option<&Occupancy> {
        self.occupancy.as_ref()
    }

    /// What a checkpoint has to keep beside [`Refinement::tensor`].
    pub fn since(&self) -> Since {
        self.since
    }

    /// The cells' attenuations, for a checkpoint.
    pub fn tensor(&self) -> (String, &[usize], &[f32]) {
        (NAME.into(), &self.grid.shape, &self.highest)
    }

    /// Looks at the field before step `step` (from 0), where it is time to. Says what is left where that has changed.
    pub fn look(&mut self, step: u64, model: &Model, exe: &mut dyn Executable) -> Result<Option<String>> {
        // What the field is in its first steps says nothing of what it will be.
        if !step.is_multiple_of(self.settings.every) || step < self.since.step.saturating_add(self.settings.after / 2) {
            return Ok(None);
        }
        self.place(step / self.settings.every);
        self.values.resize(self.points.len(), 0.0);
        exe.evaluate(model, &self.points, &mut self.values)?;
        for (&cell, value) in self.cells.iter().zip(&self.values) {
            let highest = &mut self.highest[cell as usize];
            *highest = (*highest * DECAY).max(value.abs()).min(HIGHEST);
        }
        let share = self.decide(step);
        let change = share - self.since.told.unwrap_or(1.0);
        Ok((change.abs() >= NOTABLE).then(|| {
            self.since.told = Some(share);
            format!("step {step}: samples are taken in {:.0}% of the support's cells", 100.0 * share)
        }))
    }

    /// Forgets all, after step `step` took the run back to another state.
    pub fn forget(&mut self, step: u64) {
        self.since.step = step;
        self.highest.fill(0.0);
        self.decide(step);
    }

    /// A point in each cell of the support. Those of a cell's looks fill it evenly (Roberts 2018, the sequence R3, shifted
    /// at random from cell to cell).
    fn place(&mut self, look: u64) {
        const STRIDES: [f64; 3] = [0.819_172_513_396_164_5, 0.671_043_606_703_789_3, 0.549_700_477_901_970_3];
        let shift = STRIDES.map(|s| (look as f64 * s).fract() as f32);
        let [_, ny, nz] = self.grid.shape;
        let Self { low, side, seed, cells, points, .. } = self;
        let place = |&i: &u32| {
            let cell = i as usize;
            let at = [cell / (ny * nz), cell / nz % ny, cell % nz];
            std::array::from_fn(|k| {
                let within = unit(mix(*seed, 3 * u64::from(i) + k as u64)) + shift[k];
                low[k] + (at[k] as f32 + within.fract()) * side[k]
            })
        };
        points.clear();
        points.par_extend(cells.par_iter().map(place));
    }

    /// Which cells are occupied after the look of step `step`. Returns their share of the support.
    fn decide(&mut self, step: u64) -> f64 {
        let [low, side, shape] = [self.low, self.side, self.grid.shape.map(|n| n as f32)];
        let high = std::array::from_fn(|k| low[k] + shape[k] * side[k]);
        let mut occupied = self.held.clone();
        if step >= self.since.step.saturating_add(self.settings.after) {
            let full: Vec<bool> = self.highest.iter().map(|&m| m >= self.settings.below as f32).collect();
            occupied.iter_mut().zip(widened(&full, self.grid.shape)).for_each(|(o, near)| *o &= near);
        }
        if !occupied.contains(&true) {
            // A field without anything in it has yet to begin.
            occupied.clone_from(&self.held);
        }
        let count = occupied.iter().filter(|o| **o).count();
        let all = count == occupied.len();
        self.occupancy = (!all).then(|| Occupancy::new([low, high], self.grid.shape, &occupied, self.settings.probe));
        count as f64 / self.cells.len().max(1) as f64
    }
}
