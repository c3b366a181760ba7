//! Predicted views of a volume, and residuals of measured views.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::stray;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::parallel;
use conefield_core::registry::read;
use conefield_core::registry::{Kind, names};
use conefield_core::scan::Volume;
use conefield_core::voxel::{VoxelProjector, VoxelProjectorSpec};
use ndarray::Array3;
use serde_json::Value;

/// Default projector of iterative methods.
pub const PROJECTOR: &str = "joseph";

/// Largest relative difference between a volume's box and the scan's volume that is not reported.
const SAME_BOX: f64 = 0.01;

/// The voxel projector given by `value` as in a spec: a type name, or a table with settings.
pub fn projector(value: Value) -> Result<Box<dyn VoxelProjector>> {
    let found = value.to_string();
    let expected = || format!("a type of voxel projector: {}", names(Kind::VoxelProjector).join(", "));
    let name = value.as_str().or(value["type"].as_str());
    let known = name.is_some_and(|n| names(Kind::VoxelProjector).contains(&n));
    ensure(known, "projection", "projector", &found, expected())?;
    let spec: Box<dyn VoxelProjectorSpec> =
        read(value).map_err(|e| Error::invalid("projection", "projector", format!("{found}: {e}"), expected()))?;
    spec.build()
}

/// The voxel grid of `volume` in a scan with the volume `grid`: around the same centre. A volume of the same shape has
/// the same voxels; a file without voxel sizes (`sized` is false) fills the same box.
pub fn placed(volume: &Volume, grid: &VoxelGrid, sized: bool) -> VoxelGrid {
    let shape = volume.grid.shape;
    if shape == grid.shape {
        return *grid;
    }
    let size = grid.size();
    let fill = std::array::from_fn(|k| size[k] / shape[k] as f64);
    VoxelGrid { shape, spacing: if sized { volume.grid.spacing } else { fill }, center: grid.center }
}

/// A message if the box of the voxels `own` differs from the scan's volume `grid`.
pub fn oddity(own: &VoxelGrid, grid: &VoxelGrid) -> Option<String> {
    let (size, want) = (own.size(), grid.size());
    let differs = (0..3).any(|k| (size[k] / want[k] - 1.0).abs() > SAME_BOX);
    differs.then(|| {
        let mm = |s: [f64; 3]| format!("{:.1} x {:.1} x {:.1} mm", s[0], s[1], s[2]);
        format!("its box of {} differs from the {} of the scan's volume: its own box is used", mm(size), mm(want))
    })
}

/// Bytes that [`predicted`] needs besides the volume.
pub fn bytes(projector: &dyn VoxelProjector, geometry: &Geometry) -> u64 {
    let header = conefield_core::scan::ScanHeader {
        views: geometry.views.len(),
        detector: geometry.detector,
        volume: geometry.volume.shape,
    };
    4 * header.pixels() + projector.scratch(&header, header.views)
}

/// The line integrals of `volume`, whose values are per `unit_mm` millimetres, in the views of `geometry`, which also
/// positions the voxels.
pub fn predicted(
    volume: &Volume,
    geometry: &Geometry,
    unit_mm: f64,
    projector: &dyn VoxelProjector,
) -> Result<Array3<f32>> {
    geometry.validate("projection")?;
    let (found, expected) = (format!("{:?}", volume.data.shape()), format!("{:?}", geometry.volume.shape));
    ensure(volume.data.shape() == geometry.volume.shape, "projection", "shape of the volume", found, expected)?;
    if let Some(((x, y, z), value)) = stray(&volume.data) {
        return Err(Error::invalid("projection", format!("voxel [{x}, {y}, {z}]"), value, "a finite attenuation"));
    }
    let [rows, columns] = geometry.detector;
    let views: Vec<usize> = (0..geometry.views.len()).collect();
    let mut out = Array3::zeros((views.len(), rows, columns));
    let operator = projector.operator();
    operator.forward(geometry, &views, volume.data.view(), out.view_mut());
    operator.fault()?;
    if unit_mm != 1.0 {
        let per_unit = (1.0 / unit_mm) as f32;
        parallel::scale(&mut out, per_unit);
    }
    Ok(out)
}
