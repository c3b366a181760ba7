//! Predicted views of a volume, and residuals of measured views.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::stray;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::parallel;
use conefield_core::registry::read;
use conefield_core::registry::{Kind, names};
use conefield_core::scan::Volume;
use conefield_core::voxel::{VoxelProjector, VoxelProjectorSpec};
use ndarray::{Array3, s};
use serde_json::Value;
use std::time::{Duration, Instant};

/// Default projector of iterative methods.
pub const PROJECTOR: &str = "joseph";

/// Views that are projected first, and how long a part of the views takes at least, unless it is the last.
const FIRST: usize = 8;
const PART: Duration = Duration::from_secs(2);

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
/// positions the voxels. Calls `progress` with the share of finished views every few seconds; an error of it ends the
/// work.
pub fn predicted(
    volume: &Volume,
    geometry: &Geometry,
    unit_mm: f64,
    projector: &dyn VoxelProjector,
    progress: &mut dyn FnMut(f64) -> Result<()>,
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
    let (mut done, mut some) = (0, FIRST);
    while done < views.len() {
        let (part, start) = (done..views.len().min(done + some), Instant::now());
        done = part.end;
        operator.forward(geometry, &views[part.clone()], volume.data.view(), out.slice_mut(s![part, .., ..]));
        operator.fault()?;
        progress(done as f64 / views.len() as f64)?;
        // Fewer calls prepare the volume less often.
        some = if start.elapsed() < PART { 2 * some } else { some };
    }
    if unit_mm != 1.0 {
        let per_unit = (1.0 / unit_mm) as f32;
        parallel::scale(&mut out, per_unit);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_projectors::simulate::{PhantomKind, Protocol, phantom_of};

    #[test]
    fn views_do_not_depend_on_the_parts_and_progress_ends_them() {
        let volume = phantom_of(PhantomKind::Head, 24);
        let geometry =
            Protocol::r2(&volume.grid).with_detector([20, 20]).with_views(29).geometry(&volume.grid).unwrap();
        for name in names(Kind::VoxelProjector) {
            let projector = projector(name.into()).unwrap();
            let mut shares = vec![];
            let mut heard = |share| {
                shares.push(share);
                Ok(())
            };
            let parts = predicted(&volume, &geometry, 1.0, projector.as_ref(), &mut heard).unwrap();
            let mut whole = Array3::zeros(parts.dim());
            let views: Vec<usize> = (0..29).collect();
            projector.operator().forward(&geometry, &views, volume.data.view(), whole.view_mut());
            assert!(parts == whole && shares.len() > 1 && shares.is_sorted() && shares.last() == Some(&1.0), "{name}");
            let mut ends = |_| Err(Error::Aborted { part: "the projection".into() });
            assert!(predicted(&volume, &geometry, 1.0, projector.as_ref(), &mut ends).is_err(), "{name}");
        }
    }
}
