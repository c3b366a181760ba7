//! A trained field, whose values can be had at the voxels of any grid.

use crate::allowance;
use crate::backend::{Backend, Executable};
use crate::error::{Error, Result, ensure};
use crate::geometry::VoxelGrid;
use crate::parts::{Part, Voxels};
use crate::pipeline::{Model, Pipeline};
use crate::scan::Affine;
use crate::scene::{Scene, SceneSettings};
use crate::stage::{OnGrid, UnitGrid};
use crate::support::Support;
use ndarray::{ArrayViewMut3, s};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Points that are evaluated at once.
const POINTS: usize = 1 << 20;

/// A model with the scene that it was trained in.
pub struct TrainedField {
    /// Stages and parameters.
    pub model: Model,
    /// Between the world and what stages see.
    pub scene: Scene,
    /// Millimetres a unit of the scan.
    pub unit_mm: f64,
}

/// What is to be kept beside spec and weights to have the field again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Placement {
    /// The grid that the field was trained for.
    pub grid: VoxelGrid,
    /// The attenuation that stages see as 1, in 1/mm.
    pub attenuation: f64,
    /// Millimetres a unit of the scan.
    pub unit_mm: f64,
    /// The encoder's channels that stayed each time some were removed, in order.
    pub masks: Vec<Vec<usize>>,
    /// Where in the volume the object can be, if that was found out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<Support>,
}

impl Placement {
    /// Refuses numbers that no run leaves; `place` is the file that holds it.
    pub fn validate(&self, place: &str) -> Result<()> {
        self.grid.validate(&format!("{place}: placement"))?;
        for (field, x) in [("attenuation", self.attenuation), ("unit_mm", self.unit_mm)] {
            let good = x.is_finite() && x > 0.0;
            ensure(good, place, &format!("placement.{field}"), x, "a finite number above 0")?;
        }
        Ok(())
    }
}

impl TrainedField {
    /// What is to be kept.
    pub fn placement(&self) -> Placement {
        Placement {
            grid: self.scene.grid,
            attenuation: self.scene.attenuation,
            unit_mm: self.unit_mm,
            masks: self.model.masks().to_vec(),
            support: self.scene.support.as_deref().cloned(),
        }
    }

    /// The field of these stages where `placement` says, with the parameters that `load` puts into its model.
    pub fn restore(
        mut pipeline: Pipeline,
        settings: &SceneSettings,
        placement: &Placement,
        load: &mut dyn FnMut(&mut Model) -> Result<()>,
    ) -> Result<Self> {
        placement.validate("weights")?;
        let parameters = pipeline.layout().len() as u64;
        // Parameters, gradients and both moments.
        allowance::memory("weights", "parameters", parameters.saturating_mul(16))?;
        let mut scene = Scene::with_attenuation(placement.grid, settings, placement.attenuation)?;
        if let Some(support) = placement.support.clone() {
            scene = scene.within(support, settings);
        }
        pipeline.fit(&scene)?;
        let mut model = Model::random(pipeline, 0);
        for keep in &placement.masks {
            model.mask(keep.clone())?;
        }
        load(&mut model)?;
        Ok(Self { model, scene, unit_mm: placement.unit_mm })
    }

    /// Its values at the voxels of `grid`, in 1/unit of the scan.
    pub fn voxels(&self, backend: &dyn Backend, grid: VoxelGrid) -> Result<FieldVoxels<'_>> {
        let (exe, _) = backend.compile(&self.model.pipeline)?;
        Ok(FieldVoxels { model: &self.model, exe, sampler: Sampler::new(&self.scene, self.unit_mm, grid) })
    }
}

/// A field's values at the voxels of a grid, evaluated where they are asked for; 0 where the object cannot be.
pub struct FieldVoxels<'a> {
    model: &'a Model,
    exe: Box<dyn Executable>,
    sampler: Sampler<'a>,
}

impl FieldVoxels<'_> {
    /// Bytes that evaluation works in, beside what the backend needs.
    pub const BYTES: u64 = 24 * POINTS as u64;
}

impl Voxels for FieldVoxels<'_> {
    fn grid(&self) -> VoxelGrid {
        self.sampler.grid
    }

    fn affine(&self) -> Option<Affine> {
        None
    }

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        self.sampler.fill(self.model, self.exe.as_mut(), part, out.view_mut())?;
        match out.indexed_iter().find(|(_, m)| !m.is_finite()) {
            None => Ok(()),
            Some(((x, y, z), value)) => {
                let voxel = [part[0].start + x, part[1].start + y, part[2].start + z];
                let (field, expected) =
                    (format!("voxel {voxel:?}"), "a finite number; a smaller optimizer.lr may help");
                Err(Error::invalid("the trained field", field, value, expected))
            }
        }
    }
}

/// Samples a model at the voxels of a grid.
pub struct Sampler<'a> {
    scene: &'a Scene,
    grid: VoxelGrid,
    scale: f32,
    points: Vec<[f32; 3]>,
    /// Which of the voxels at hand the points are.
    places: Vec<usize>,
    values: Vec<f32>,
}

impl<'a> Sampler<'a> {
    /// For the voxels of `grid` and a model in `scene`, of a scan with `unit_mm` millimetres a unit.
    pub fn new(scene: &'a Scene, unit_mm: f64, grid: VoxelGrid) -> Self {
        let scale = (scene.attenuation * unit_mm) as f32;
        Self { scene, grid, scale, points: vec![], places: vec![], values: vec![] }
    }

    /// The values of `part`, in 1/unit of the scan; 0 where the object cannot be.
    pub fn fill(
        &mut self,
        model: &Model,
        exe: &mut dyn Executable,
        [xs, ys, zs]: &Part,
        mut out: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        if let Some(field) = model.pipeline.field.on_grid() {
            return self.fill_grid(field, &model.arena.params, [xs, ys, zs], out);
        }
        let Self { scene, grid, scale, points, places, values } = self;
        // In the order in which `out` is gone through.
        let mut voxels = xs.clone().flat_map(|x| ys.clone().flat_map(move |y| zs.clone().map(move |z| [x, y, z])));
        let mut out = out.iter_mut();
        loop {
            points.clear();
            places.clear();
            let mut taken = 0;
            for (i, voxel) in voxels.by_ref().take(POINTS).enumerate() {
                let p = grid.voxel(voxel);
                if scene.holds(p) {
                    points.push(scene.to_unit(p));
                    places.push(i);
                }
                taken = i + 1;
            }
            if taken == 0 {
                return Ok(());
            }
            values.resize(points.len(), 0.0);
            exe.evaluate(model, points, values)?;
            let mut known = places.iter().zip(values.iter()).peekable();
            for (i, out) in out.by_ref().take(taken).enumerate() {
                *out = known.next_if(|(at, _)| **at == i).map_or(0.0, |(_, value)| value * *scale);
            }
        }
    }

    /// [`Sampler::fill`] of a field that has whole grids, some planes at a time.
    fn fill_grid(
        &mut self,
        field: &dyn OnGrid,
        params: &[f32],
        [xs, ys, zs]: [&Range<usize>; 3],
        mut out: ArrayViewMut3<'_, f32>,
    ) -> Result<()> {
        let Self { scene, grid, scale, values, .. } = self;
        let planes = (POINTS / (ys.len() * zs.len()).max(1)).max(1);
        for start in xs.clone().step_by(planes) {
            let end = (start + planes).min(xs.end);
            let first = scene.to_unit(grid.voxel([start, ys.start, zs.start])).map(f64::from);
            let shape = [end - start, ys.len(), zs.len()];
            let spacing = grid.spacing.map(|s| s / scene.side);
            values.resize(shape.iter().product(), 0.0);
            field.values(params, &UnitGrid { first, spacing, shape }, values);
            let places = (start..end).flat_map(|x| ys.clone().flat_map(move |y| zs.clone().map(move |z| [x, y, z])));
            let mut part = out.slice_mut(s![start - xs.start..end - xs.start, .., ..]);
            for ((out, value), voxel) in part.iter_mut().zip(values.iter()).zip(places) {
                *out = if scene.holds(grid.voxel(voxel)) { value * *scale } else { 0.0 };
            }
        }
        Ok(())
    }
}
