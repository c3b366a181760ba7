//! Trained fields, which can be evaluated at the voxels of any grid.

use crate::allowance;
use crate::backend::{Backend, Executable};
use crate::error::{Error, Result, ensure};
use crate::finite::stray;
use crate::geometry::VoxelGrid;
use crate::parts::{Part, Voxels};
use crate::pipeline::{Model, Pipeline};
use crate::scan::Affine;
use crate::scene::{Scene, SceneSettings};
use crate::stage::UnitGrid;
use crate::support::Support;
use ndarray::{ArrayViewMut3, s};
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Points evaluated at once.
const POINTS: usize = 1 << 20;

/// A model with the scene of its training.
pub struct TrainedField {
    /// Stages and parameters.
    pub model: Model,
    /// The mapping between the world and the stages.
    pub scene: Scene,
    /// Millimetres per unit of the scan.
    pub unit_mm: f64,
}

/// The data stored with spec and weights to restore the field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Placement {
    /// The grid that the field was trained for.
    pub grid: VoxelGrid,
    /// The attenuation that counts as 1 for the stages, in 1/mm.
    pub attenuation: f64,
    /// Millimetres per unit of the scan.
    pub unit_mm: f64,
    /// The encoder's remaining channels after each masking, in order.
    pub masks: Vec<Vec<usize>>,
    /// Where the object can be inside the volume, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<Support>,
}

impl Placement {
    /// Refuses numbers that no run produces; `place` is the file name.
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
    /// The data to store.
    pub fn placement(&self) -> Placement {
        Placement {
            grid: self.scene.grid,
            attenuation: self.scene.attenuation,
            unit_mm: self.unit_mm,
            masks: self.model.masks().to_vec(),
            support: self.scene.support.as_deref().cloned(),
        }
    }

    /// The field of these stages with `placement` and the parameters that `load` puts into its model.
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

/// A field's values at the voxels of a grid, evaluated on demand; 0 where the object cannot be.
pub struct FieldVoxels<'a> {
    model: &'a Model,
    exe: Box<dyn Executable>,
    sampler: Sampler<'a>,
}

impl FieldVoxels<'_> {
    /// Working memory of the evaluation in bytes, besides that of the backend.
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
        match stray(&out) {
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

/// Evaluates a model at the voxels of a grid.
pub struct Sampler<'a> {
    scene: &'a Scene,
    grid: VoxelGrid,
    scale: f32,
    points: Vec<[f32; 3]>,
    /// Voxel indices of the current points.
    places: Vec<usize>,
    values: Vec<f32>,
}

impl<'a> Sampler<'a> {
    /// A sampler for the voxels of `grid`, for a model in `scene` and a scan with `unit_mm` millimetres per unit.
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
        if model.pipeline.field.on_grid().is_some() {
            return self.fill_grid(model, exe, [xs, ys, zs], out);
        }
        let Self { scene, grid, scale, points, places, values } = self;
        // In the iteration order of `out`.
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

    /// [`Sampler::fill`] for a field with whole grids, a few planes at a time.
    fn fill_grid(
        &mut self,
        model: &Model,
        exe: &mut dyn Executable,
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
            exe.values(model, &UnitGrid { first, spacing, shape }, values)?;
            let places = (start..end).flat_map(|x| ys.clone().flat_map(move |y| zs.clone().map(move |z| [x, y, z])));
            let mut part = out.slice_mut(s![start - xs.start..end - xs.start, .., ..]);
            for ((out, value), voxel) in part.iter_mut().zip(values.iter()).zip(places) {
                *out = if scene.holds(grid.voxel(voxel)) { value * *scale } else { 0.0 };
            }
        }
        Ok(())
    }
}
