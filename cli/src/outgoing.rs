//! Writing of voxels to a file: shows progress and keeps what the end of a run needs.

use crate::progress::Progress;
use crate::signals;
use conefield::hounsfield::{Calibration, Levels};
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, Voxels, copy};
use conefield_core::scan::{Affine, Volume};
use conefield_core::{Error, Result};
use conefield_evaluation::report::MiddleSlices;
use conefield_io::DicomTemplate;
use ndarray::{Array3, ArrayViewMut3};
use std::path::Path;

/// Writes `voxels` to `path` without keeping any, with `affine` if they have none of their own; in Hounsfield units if
/// there is a calibration, and then returns its water and air. DICOM gets patient and study from `template`.
pub fn write_only(
    path: &Path,
    voxels: &mut dyn Voxels,
    affine: Option<Affine>,
    hu: Option<&Calibration>,
    template: Option<&DicomTemplate>,
) -> Result<Option<Levels>> {
    let mut outgoing = Outgoing::new(path, voxels);
    outgoing.affine = outgoing.affine.or(affine);
    let levels = hu.map(|hu| hu.measure(&mut outgoing)).transpose()?;
    outgoing.done = 0;
    match &levels {
        Some(levels) => conefield_io::write_voxels_of(path, &mut levels.of(&mut outgoing), template)?,
        None => conefield_io::write_voxels_of(path, &mut outgoing, template)?,
    }
    Ok(levels)
}

/// What is kept of written voxels.
pub struct WrittenVolume {
    /// The middle slices.
    pub slices: MiddleSlices,
    /// All voxels, if requested.
    pub whole: Option<Volume>,
}

/// Writes `voxels` to `path`, with `affine` if they have none of their own; keeps all of them if `keep`.
pub fn write(path: &Path, voxels: &mut dyn Voxels, affine: Option<Affine>, keep: bool) -> Result<WrittenVolume> {
    let grid = voxels.grid();
    let affine = voxels.affine().or(affine);
    let whole = keep.then(|| Volume { data: Array3::zeros(grid.shape), grid, affine });
    let kept = WrittenVolume { slices: MiddleSlices::new(grid), whole };
    let mut outgoing = Outgoing { kept: Some(kept), affine, ..Outgoing::new(path, voxels) };
    conefield_io::write_voxels(path, &mut outgoing)?;
    outgoing.kept.ok_or_else(|| Error::unsupported("writing a volume", "it was not kept"))
}

struct Outgoing<'a> {
    voxels: &'a mut dyn Voxels,
    affine: Option<Affine>,
    kept: Option<WrittenVolume>,
    place: String,
    progress: Progress,
    done: usize,
}

impl<'a> Outgoing<'a> {
    fn new(path: &Path, voxels: &'a mut dyn Voxels) -> Self {
        Self {
            affine: voxels.affine(),
            kept: None,
            voxels,
            place: path.display().to_string(),
            progress: Progress::new("export", None),
            done: 0,
        }
    }
}

impl Voxels for Outgoing<'_> {
    fn grid(&self) -> VoxelGrid {
        self.voxels.grid()
    }

    fn affine(&self) -> Option<Affine> {
        self.affine
    }

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        if signals::caught().is_some() {
            return Err(Error::Cancelled { place: self.place.clone() });
        }
        self.voxels.fill(part, out.view_mut())?;
        if let Some(kept) = &mut self.kept {
            kept.slices.gather(part, out.view());
            if let Some(whole) = &mut kept.whole {
                let [x, y, z] = part.clone();
                copy(whole.data.slice_mut(ndarray::s![x, y, z]), out.view());
            }
        }
        self.done += out.len();
        self.progress.reach(self.done as f64 / self.voxels.grid().len().unwrap_or(usize::MAX) as f64);
        Ok(())
    }
}
