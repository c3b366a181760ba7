//! Pre-training on known volumes, voxel by voxel: `L = |μ(x) − voxel|`, NI-NeRF's mapping-consistency initialization.
//! Every other scan reuses the LayerNorm and the field learned there.

use crate::losses::L1;
use crate::optimizer::Optimizer;
use crate::schedule::Clock;
use crate::training::run::strayed;
use conefield_core::arena::Arena;
use conefield_core::backend::{Executable, Work};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::method::{Job, Limits, Observer, PretrainJob, Record};
use conefield_core::pipeline::{Model, Pipeline};
use conefield_core::random::stream;
use conefield_core::scan::Volume;
use conefield_core::scene::{Scene, SceneSettings};
use ndarray::Axis;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Consecutive steps on one volume before the next.
const TURN: u64 = 25;

/// Settings for learning known volumes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Pretraining {
    /// Points per step.
    pub points: usize,
    /// Steps of `conefield pretrain`.
    pub steps: u64,
}

impl Default for Pretraining {
    fn default() -> Self {
        Self { points: 65_536, steps: 1000 }
    }
}

impl Pretraining {
    /// Refuses invalid settings.
    pub fn validate(&self) -> Result<()> {
        ensure((1..=1 << 22).contains(&self.points), "spec", "points", self.points, "1 to 2^22")?;
        ensure(self.steps > 0, "spec", "steps", 0, "at least 1: without a step the field stays untrained")
    }
}

/// Trains a field on the volumes of `job`, in turn. Each volume has its own encoder; everything after the encoder is
/// shared. Records metrics at regular intervals.
pub fn pretrain(
    (pipeline, mut exe): (Pipeline, Box<dyn Executable>),
    (optimizer, settings, report_every): (&Optimizer, &Pretraining, u64),
    seen: &SceneSettings,
    job: &PretrainJob<'_>,
    observer: &mut dyn Observer,
) -> Result<Model> {
    let scenes: Vec<Scene> = job.volumes.iter().map(|v| scene(v, seen)).collect::<Result<_>>()?;
    ensure(!scenes.is_empty(), "pretrain", "volumes", 0, "at least one volume")?;
    let mut model = Model::random(pipeline, job.seed);
    let shared_from = model.pipeline.ranges()[0].end;
    let mut waiting: Vec<Arena> = vec![model.arena.clone(); scenes.len() - 1];
    let ends = Limits { steps: Some(settings.steps), ..Limits::default() };
    let mut clock = Clock::new(ends, job.limits, 0.0);
    let mut points = Vec::with_capacity(settings.points);
    let (mut step, mut loss, mut since) = (0u64, 0.0, 0u64);
    let mut at = 0;
    clock.resume();
    while clock.done(step) < 1.0 {
        if observer.cancelled() {
            return Err(Error::Interrupted { step });
        }
        if step > 0 && step.is_multiple_of(TURN) && !waiting.is_empty() {
            exe.fetch(&mut model)?;
            exe.renew();
            let mut next = waiting.remove(0);
            let Arena { params, first, second, .. } = &model.arena;
            next.params[shared_from..].copy_from_slice(&params[shared_from..]);
            next.first[shared_from..].copy_from_slice(&first[shared_from..]);
            next.second[shared_from..].copy_from_slice(&second[shared_from..]);
            waiting.push(std::mem::replace(&mut model.arena, next));
            at = (at + 1) % scenes.len();
        }
        draw(&job.volumes[at], &scenes[at], job.seed, step, settings.points, &mut points);
        let found = fit(exe.as_mut(), &mut model, &points, step, job.seed)?;
        step += 1;
        let share = clock.share(step);
        let adam = optimizer.adam(step, 0.0, share);
        exe.update(&mut model, &adam)?;
        (loss, since) = (loss + found, since + 1);
        let share = clock.done(step);
        observer.progress(step, share, clock.left(share));
        if step.is_multiple_of(report_every) || share >= 1.0 {
            let samples_per_s = Some((step * settings.points as u64) as f64 / clock.seconds());
            let record = Record {
                step,
                seconds: clock.seconds(),
                loss: Some(loss / since as f64),
                lr: Some(adam.lr),
                samples_per_s,
                ..Record::default()
            };
            observer.record(&record);
            (loss, since) = (0.0, 0);
        }
    }
    exe.fetch(&mut model)?;
    // The last update follows the last loss.
    strayed(&model.arena).map_or(Ok(model), |what| Err(Error::Diverged { step, what }))
}

/// Computes gradients of the L1 loss at known points; returns the loss.
fn fit(exe: &mut dyn Executable, model: &mut Model, points: &[([f32; 3], f32)], step: u64, seed: u64) -> Result<f64> {
    let work = Work { step, seed, loss: &L1 {}, rays: &[], points, priors: &[] };
    let stats = exe.step(model, &work)?;
    if !stats.loss.is_finite() {
        return Err(Error::Diverged { step, what: format!("the loss is {}", stats.loss) });
    }
    Ok(stats.loss)
}

/// Fits all of `model` to `volume`, in 1/mm, within the scene of a scan: a warm start, which the job's deadline may cut
/// short. Resets the optimizer's moments to 0.
pub fn learn(
    (optimizer, settings): (&Optimizer, &Pretraining),
    exe: &mut dyn Executable,
    model: &mut Model,
    (volume, scene): (&Volume, &Scene),
    steps: u64,
    job: &Job<'_>,
    observer: &dyn Observer,
) -> Result<()> {
    let mut points = Vec::with_capacity(settings.points);
    for step in 0..steps {
        if observer.cancelled() {
            return Err(Error::Interrupted { step: 0 });
        }
        if job.limits.deadline.is_some_and(|end| Instant::now() >= end) {
            break;
        }
        draw(volume, scene, job.seed, step, settings.points, &mut points);
        fit(exe, model, &points, step, job.seed)?;
        exe.update(model, &optimizer.adam(step + 1, 0.0, (step + 1) as f64 / steps as f64))?;
    }
    exe.fetch(model)?;
    exe.renew();
    model.arena.first.fill(0.0);
    model.arena.second.fill(0.0);
    Ok(())
}

/// The scene of a simulated scan of `volume`: the attenuation scale comes from the sums along x and y, which rays of a
/// scan would measure.
fn scene(volume: &Volume, settings: &SceneSettings) -> Result<Scene> {
    volume.grid.validate("volume")?;
    let longest = volume.grid.size().into_iter().fold(0.0, f64::max);
    let attenuation = settings.attenuation.of(1.0, longest, &|| {
        let mut sums: Vec<f64> = vec![];
        for axis in 0..2 {
            let spacing = volume.grid.spacing[axis];
            sums.extend(volume.data.sum_axis(Axis(axis)).iter().map(|&s| f64::from(s) * spacing));
        }
        let k = ((sums.len() as f64 * 0.995) as usize).min(sums.len() - 1);
        Ok(*sums.select_nth_unstable_by(k, f64::total_cmp).1)
    })?;
    let expected = "values whose sums along a line are below 3.4e38";
    ensure(attenuation.is_finite(), "volume", "values", "values that are too large", expected)?;
    ensure(attenuation > 0.0, "volume", "values", "no attenuation", "a volume of an object that absorbs")?;
    Scene::with_attenuation(volume.grid, settings, attenuation)
}

/// Draws random voxels' centres inside the object's support, with their values.
fn draw(volume: &Volume, scene: &Scene, seed: u64, step: u64, count: usize, out: &mut Vec<([f32; 3], f32)>) {
    let mut rng = stream(seed ^ 0x70_7265, step);
    let shape = volume.grid.shape;
    out.clear();
    for _ in 0..count {
        let mut any = || -> [usize; 3] { std::array::from_fn(|k| rng.random_range(0..shape[k])) };
        let first = any();
        // A support that is a tiny part of the volume must not cause a long loop.
        let held = std::iter::once(first).chain((0..1000).map(|_| any())).find(|i| scene.holds(volume.grid.voxel(*i)));
        let index = held.unwrap_or(first);
        out.push((scene.voxel(index), (f64::from(volume.data[index]) / scene.attenuation) as f32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::geometry::VoxelGrid;
    use conefield_core::support::{Cylinder, Support};
    use ndarray::Array3;

    /// The unit cube fits the support: voxels outside would all lie on its sides.
    #[test]
    fn only_voxels_of_the_support_are_drawn() {
        let grid = VoxelGrid { shape: [16; 3], spacing: [1.0; 3], center: [0.0; 3] };
        let inside = |i: usize, j: usize| (i as f64 - 7.5).hypot(j as f64 - 7.5) < 4.0;
        let data = Array3::from_shape_fn(grid.shape, |(x, y, _)| f32::from(u8::from(inside(x, y))));
        let scene = Scene::with_attenuation(grid, &SceneSettings::default(), 1.0).unwrap();
        let mut points = vec![];
        let volume = Volume { grid, data, affine: None };
        draw(&volume, &scene, 1, 0, 500, &mut points);
        assert!(points.iter().any(|p| p.1 == 0.0));
        let cylinder = Support::cylinder(Cylinder { center: [0.0; 2], radius: 4.0 }, &grid).unwrap();
        let scene = scene.within(cylinder, &SceneSettings::default());
        draw(&volume, &scene, 1, 0, 500, &mut points);
        assert!(points.len() == 500 && points.iter().all(|p| p.1 == 1.0));
    }

    #[test]
    fn values_without_a_scale_are_named() {
        for (value, want) in [(1e38, "too large"), (0.0, "no attenuation")] {
            let volume = Volume::centered(Array3::from_elem((4, 4, 4), value), [1.0; 3]);
            let e = scene(&volume, &SceneSettings::default()).unwrap_err().to_string();
            assert!(e.contains(want), "{e}");
        }
    }

    #[test]
    fn settings_that_train_nothing_are_refused() {
        let settings = Pretraining::default();
        assert!(settings.validate().is_ok());
        for (wrong, key) in
            [(Pretraining { points: 0, ..settings.clone() }, "points"), (Pretraining { steps: 0, ..settings }, "steps")]
        {
            let e = wrong.validate().unwrap_err().to_string();
            assert!(e.contains(key), "{e}");
        }
    }
}
