//! A trained field, whose values can be had at the voxels of any grid.

use crate::backend::{Backend, Executable};
use crate::error::{Error, Result};
use crate::geometry::VoxelGrid;
use crate::parts::{Part, Voxels};
use crate::pipeline::{Masked, Model, Pipeline};
use crate::scan::Affine;
use crate::scene::{Scene, SceneSettings};
use crate::support::Support;
use ndarray::ArrayViewMut3;
use serde::{Deserialize, Serialize};

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
    /// Channels that normalizers removed, in order.
    pub masks: Vec<Masked>,
    /// Where in the volume the object can be, if that was found out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<Support>,
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
        placement.grid.validate("placement")?;
        let mut scene = Scene::with_attenuation(placement.grid, settings, placement.attenuation)?;
        if let Some(support) = placement.support.clone() {
            scene = scene.within(support, settings);
        }
        pipeline.fit(&scene)?;
        let mut model = Model::random(pipeline, 0);
        for masked in &placement.masks {
            model.mask(masked)?;
        }
        load(&mut model)?;
        Ok(Self { model, scene, unit_mm: placement.unit_mm })
    }

    /// Its values at the voxels of `grid`, in 1/unit of the scan.
    pub fn voxels(&self, backend: &dyn Backend, grid: VoxelGrid) -> Result<FieldVoxels<'_>> {
        let (exe, _) = backend.compile(&self.model.pipeline)?;
        let scale = (self.scene.attenuation * self.unit_mm) as f32;
        Ok(FieldVoxels { field: self, grid, exe, scale, points: vec![], places: vec![], values: vec![] })
    }
}

/// A field's values at the voxels of a grid, evaluated where they are asked for; 0 where the object cannot be.
pub struct FieldVoxels<'a> {
    field: &'a TrainedField,
    grid: VoxelGrid,
    exe: Box<dyn Executable>,
    scale: f32,
    points: Vec<[f32; 3]>,
    /// Which of the voxels at hand the points are.
    places: Vec<usize>,
    values: Vec<f32>,
}

impl FieldVoxels<'_> {
    /// Bytes that evaluation works in, beside what the backend needs.
    pub const BYTES: u64 = 24 * POINTS as u64;
}

impl Voxels for FieldVoxels<'_> {
    fn grid(&self) -> VoxelGrid {
        self.grid
    }

    fn affine(&self) -> Option<Affine> {
        None
    }

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let Self { field, grid, exe, scale, points, places, values } = self;
        let [xs, ys, zs] = part;
        // In the order in which `out` is gone through.
        let mut voxels = xs.clone().flat_map(|x| ys.clone().flat_map(move |y| zs.clone().map(move |z| [x, y, z])));
        let mut out = out.iter_mut();
        let mut at = 0;
        loop {
            points.clear();
            places.clear();
            let mut taken = 0;
            for (i, voxel) in voxels.by_ref().take(POINTS).enumerate() {
                let p = grid.voxel(voxel);
                if field.scene.holds(p) {
                    points.push(field.scene.to_unit(p));
                    places.push(i);
                }
                taken = i + 1;
            }
            if taken == 0 {
                return Ok(());
            }
            values.resize(points.len(), 0.0);
            exe.evaluate(&field.model, points, values)?;
            values.iter_mut().for_each(|m| *m *= *scale);
            let mut known = places.iter().zip(values.iter()).peekable();
            for (i, out) in out.by_ref().take(taken).enumerate() {
                *out = known.next_if(|(at, _)| **at == i).map_or(0.0, |(_, value)| *value);
            }
            if let Some(i) = values.iter().position(|m| !m.is_finite()) {
                let value = values[i];
                let (i, [ny, nz]) = (at + places[i], [ys.len(), zs.len()]);
                let voxel = [xs.start + i / (ny * nz), ys.start + i / nz % ny, zs.start + i % nz];
                let (field, expected) = (format!("voxel {voxel:?}"), "a finite number; a smaller solver.lr may help");
                return Err(Error::invalid("the trained field", field, value, expected));
            }
            at += taken;
        }
    }
}
