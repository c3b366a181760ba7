//! A scan: projections with their geometry; a volume: voxels with their grid.

use crate::error::{Result, ensure};
use crate::geometry::{Geometry, VoxelGrid};
use ndarray::{Array3, ArrayView2};
use serde::{Deserialize, Serialize};

/// The length unit of the data set that a scan came from. Inside the program lengths are mm and attenuation is
/// 1/mm; volumes go back out in `1/unit`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unit {
    /// What the data set calls it, e.g. `mm`, `m`, `cube half side`.
    pub name: String,
    /// Millimetres a unit.
    pub mm: f64,
}

impl Default for Unit {
    fn default() -> Self {
        Self { name: "mm".into(), mm: 1.0 }
    }
}

/// Measured line integrals `A = -ln(I/I0)` with the geometry they were taken in.
#[derive(Debug, Clone)]
pub struct Scan {
    /// Source, detector and volume, in mm.
    pub geometry: Geometry,
    /// Line integrals, `[view, row, column]`, no unit.
    pub projections: Array3<f32>,
    /// The data set's own unit of length.
    pub unit: Unit,
    /// How the scan came about (simulated from what, with which noise; read from which file).
    pub provenance: serde_json::Value,
}

impl Scan {
    /// One view, `[row, column]`.
    pub fn view(&self, view: usize) -> ArrayView2<'_, f32> {
        self.projections.index_axis(ndarray::Axis(0), view)
    }

    /// Refuses a scan whose parts do not fit each other or whose values are not finite.
    pub fn validate(&self, place: &str) -> Result<()> {
        self.geometry.validate(place)?;
        let g = &self.geometry;
        let want = [g.views.len(), g.detector[0], g.detector[1]];
        ensure(
            self.projections.shape() == want,
            place,
            "projections.shape",
            format!("{:?}", self.projections.shape()),
            format!("{want:?} (views, rows, columns)"),
        )?;
        ensure(
            self.unit.mm.is_finite() && self.unit.mm > 0.0,
            place,
            "unit.mm",
            self.unit.mm,
            "a positive finite number of millimetres",
        )?;
        if let Some((at, x)) = self.projections.indexed_iter().find(|(_, x)| !x.is_finite()) {
            return Err(crate::Error::invalid(
                place,
                format!("projections[{}, {}, {}]", at.0, at.1, at.2),
                x,
                "a finite line integral",
            ));
        }
        Ok(())
    }

    /// The scan without the views in `held_out`, and a scan of those alone. Indices past the last view are refused.
    pub fn split(&self, held_out: &[usize]) -> Result<(Scan, Scan)> {
        let n = self.geometry.views.len();
        for &v in held_out {
            ensure(v < n, "held-out views", "view", v, format!("an index below {n}"))?;
        }
        let (out, keep): (Vec<usize>, Vec<usize>) = (0..n).partition(|v| held_out.contains(v));
        ensure(!keep.is_empty(), "held-out views", "views", "all of them", "at least one view left to train on")?;
        Ok((self.select(&keep), self.select(&out)))
    }

    fn select(&self, views: &[usize]) -> Scan {
        let mut geometry = self.geometry.clone();
        geometry.views = views.iter().map(|&v| self.geometry.views[v]).collect();
        Scan {
            geometry,
            projections: self.projections.select(ndarray::Axis(0), views),
            unit: self.unit.clone(),
            provenance: self.provenance.clone(),
        }
    }
}

/// Rows of voxel index → millimetres, the last one `[0, 0, 0, 1]`.
pub type Affine = [[f64; 4]; 4];

/// Voxels of attenuation (or any other quantity) with their place in the world.
#[derive(Debug, Clone)]
pub struct Volume {
    /// Values, `[x, y, z]`.
    pub data: Array3<f32>,
    /// Where the voxels are, in mm.
    pub grid: VoxelGrid,
    /// Voxel indices to the patient's or file's own coordinates in mm (NIfTI's affine, RAS), row-major, if known.
    pub affine: Option<Affine>,
}

impl Volume {
    /// A volume centred on the rotation axis.
    pub fn centered(data: Array3<f32>, spacing: [f64; 3]) -> Self {
        let s = data.shape();
        let grid = VoxelGrid { shape: [s[0], s[1], s[2]], spacing, center: [0.0; 3] };
        Self { data, grid, affine: None }
    }

    /// Every value through `f`.
    pub fn mapped(mut self, f: impl Fn(f32) -> f32 + Sync + Send) -> Self {
        self.data.par_mapv_inplace(f);
        self
    }
}
