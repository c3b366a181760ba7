//! Density control: adds Gaussians where there are too few, and removes those that contribute nothing.
//!
//! At regular intervals, Gaussians whose centres have the largest loss gradient, averaged over the steps since, are
//! doubled: a small one is cloned; a large one is split into two, sampled from it and narrower by a factor of 1.6. Each
//! gets half the density (Zha et al. 2024, section 4.3, after Kerbl et al. 2023). A Gaussian of too low density is
//! pruned. Slots are limited: if they run out, the Gaussians with the largest gradients are doubled.

use super::shape::{CENTRE, DENSITY, FREE, NUMBERS, ROTATION, SCALE, Shape, before_softplus};
use crate::training::{Callback, Kept, Run, State};
use conefield_core::arena::Layout;
use conefield_core::error::{Result, ensure};
use conefield_core::random::stream;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::f32::consts::TAU;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

/// Its name in checkpoints.
const NAME: &str = "density-control";
/// Factor by which the halves of a split Gaussian are narrower.
const NARROWER: f32 = 1.6;

/// Settings of the density control.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Control {
    /// Steps between density updates.
    pub every: u64,
    /// Share of the run after which density control starts.
    pub from: f64,
    /// Share of the run after which density control ends.
    pub until: f64,
    /// The pull above which a Gaussian is doubled: the loss gradient, divided by the largest line integral, for a shift
    /// by half the detector.
    pub pull: f64,
    /// Width, in sides of the cube, above which a Gaussian is split instead of cloned.
    pub split: f64,
    /// Density, as a share of the attenuation that stages see as 1, below which a Gaussian is pruned.
    pub prune: f64,
}

impl Default for Control {
    /// The published values: steps 500 to 15,000 of 30,000.
    fn default() -> Self {
        Self { every: 100, from: 500.0 / 30_000.0, until: 0.5, pull: 5e-5, split: 0.05, prune: 1e-5 }
    }
}

impl Control {
    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        ensure(self.every > 0, "spec", "every", self.every, "at least 1")?;
        let shares = 0.0 <= self.from && self.from <= self.until && self.until <= 1.0;
        let found = format!("{} until {}", self.from, self.until);
        ensure(shares, "spec", "from", found, "two shares of the run, in order")?;
        for (key, x) in [("pull", self.pull), ("split", self.split), ("prune", self.prune)] {
            ensure(x.is_finite() && x >= 0.0, "spec", key, x, "a finite number, 0 or more")?;
        }
        Ok(())
    }
}

/// The callback for these settings.
pub struct DensityControl {
    settings: Control,
    /// Converts a derivative with respect to the centre to a pull.
    scale: f32,
    pulls: Arc<Mutex<Pulls>>,
    shape: [usize; 1],
    /// The pulls in the checkpoint that is being written.
    kept: OnceLock<Pulls>,
}

/// Pulls of Gaussians on their centres since the last act: sums, and numbers of steps, per slot. Training adds to them.
#[derive(Debug, Default, Clone)]
pub struct Pulls {
    /// Lengths of the derivatives with respect to the centre.
    pub sums: Vec<f32>,
    /// Steps with such a derivative.
    pub counts: Vec<f32>,
}

/// Locks the pulls, also after a panic: they are plain numbers.
pub fn lock(pulls: &Mutex<Pulls>) -> MutexGuard<'_, Pulls> {
    pulls.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Pulls {
    /// For `most` slots.
    pub fn new(most: usize) -> Self {
        Self { sums: vec![0.0; most], counts: vec![0.0; most] }
    }

    /// Adds those of a step.
    pub fn add(&mut self, grads: &[f32]) {
        for ((g, sum), count) in grads.chunks(NUMBERS).zip(&mut self.sums).zip(&mut self.counts) {
            let size = (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]).sqrt();
            if size > 0.0 {
                *sum += size;
                *count += 1.0;
            }
        }
    }
}

impl DensityControl {
    /// Acts on `pulls`; `scale` converts a derivative with respect to the centre to a pull.
    pub fn new(settings: Control, pulls: Arc<Mutex<Pulls>>, scale: f64) -> Self {
        let shape = [lock(&pulls).sums.len()];
        Self { settings, scale: scale as f32, pulls, shape, kept: OnceLock::new() }
    }

    /// Bytes for `most` slots.
    pub fn bytes(most: usize) -> u64 {
        // Pulls, and their copy in a checkpoint.
        16 * most as u64
    }

    /// Prunes, clones and splits; reports the numbers.
    fn act(&mut self, run: &mut Run<'_>) -> Result<()> {
        run.exe.fetch(&mut run.model)?;
        let mut pulls = lock(&self.pulls);
        let arena = &mut run.model.arena;
        let set = self.settings;
        let (mut free, mut wanted, mut pruned) = (vec![], vec![], 0);
        for (i, p) in arena.params.chunks_mut(NUMBERS).enumerate() {
            if p[DENSITY] > FREE && Shape::of(p).density < set.prune {
                p[DENSITY] = FREE;
                pruned += 1;
            }
            if p[DENSITY] <= FREE {
                free.push(i);
                continue;
            }
            let pull = self.scale * pulls.sums[i] / pulls.counts[i].max(1.0);
            if pull >= set.pull as f32 {
                wanted.push((pull, i));
            }
        }
        wanted.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut rng = stream(run.job.seed ^ 0xde75_17e5, run.step);
        let mut normal = || {
            let (a, b): (f32, f32) = (rng.random(), rng.random());
            (-2.0 * (1.0 - a).ln()).sqrt() * (TAU * b).cos()
        };
        let (mut cloned, mut split) = (0, 0);
        for (&(_, from), &to) in wanted.iter().zip(&free) {
            let parent: [f32; NUMBERS] = std::array::from_fn(|k| arena.params[from * NUMBERS + k]);
            let shape = Shape::of(&parent);
            let half = before_softplus(0.5 * shape.density) as f32;
            let large = shape.longest() > set.split;
            for (place, new) in [(from, false), (to, true)] {
                let own = place * NUMBERS..(place + 1) * NUMBERS;
                let p = &mut arena.params[own.clone()];
                p.copy_from_slice(&parent);
                p[DENSITY] = half;
                if large {
                    // c + R·(s ∘ n), with R's column k being row k of M times s_k.
                    for k in 0..3 {
                        let along = normal() * (shape.deviations[k] * shape.deviations[k]) as f32;
                        (0..3).for_each(|j| p[CENTRE + j] += along * shape.inverse[k][j] as f32);
                        p[SCALE + k] -= NARROWER.ln();
                    }
                    (0..3).for_each(|j| p[CENTRE + j] = p[CENTRE + j].clamp(0.0, 1.0));
                }
                if new || large {
                    arena.first[own.clone()].fill(0.0);
                    arena.second[own].fill(0.0);
                }
            }
            if large { split += 1 } else { cloned += 1 }
        }
        for i in free.iter().skip(cloned + split) {
            let own = i * NUMBERS..(i + 1) * NUMBERS;
            arena.params[own.start + ROTATION] = 1.0;
            arena.first[own.clone()].fill(0.0);
            arena.second[own].fill(0.0);
        }
        run.exe.renew();
        pulls.sums.fill(0.0);
        pulls.counts.fill(0.0);
        let there = pulls.sums.len() + cloned + split - free.len();
        run.tally.window.events.push(format!("{cloned} cloned, {split} split, {pruned} pruned: {there} Gaussians"));
        Ok(())
    }
}

impl Callback for DensityControl {
    fn name(&self) -> &'static str {
        NAME
    }

    fn before_step(&mut self, run: &mut Run<'_>) -> Result<()> {
        self.kept = OnceLock::new();
        let share = run.clock.share(run.step);
        let due = run.step > 0 && run.step.is_multiple_of(self.settings.every);
        if due && (self.settings.from..=self.settings.until).contains(&share) { self.act(run) } else { Ok(()) }
    }

    fn state<'a>(&'a self, _: &'a Layout) -> Result<State<'a>> {
        let pulls = self.kept.get_or_init(|| lock(&self.pulls).clone());
        let tensor = |name: &str, values: &'a [f32]| (format!("{NAME}.{name}"), &self.shape[..], values);
        let tensors = vec![tensor("sums", &pulls.sums), tensor("counts", &pulls.counts)];
        State::new(NAME, &Value::Null, tensors)
    }

    fn restore(&mut self, kept: &Kept<'_>, _: &Run<'_>) -> Result<()> {
        kept.value::<()>()?;
        let tensor = |name: &str| kept.tensor(&format!("{NAME}.{name}"), &self.shape);
        *lock(&self.pulls) = Pulls { sums: tensor("sums")?, counts: tensor("counts")? };
        Ok(())
    }
}
