//! Voxels on their way to a file: progress is told and what the end of a run needs of them is kept.

use crate::out::duration;
use crate::progress::Progress;
use crate::signals;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, Voxels};
use conefield_core::scan::{Affine, Volume};
use conefield_core::{Error, Result};
use conefield_report::MiddleSlices;
use ndarray::{Array3, ArrayViewMut3};
use std::path::Path;
use std::time::Instant;

/// What is kept of voxels that were written.
pub struct WrittenVolume {
    /// The middle slices.
    pub slices: MiddleSlices,
    /// All of them, if that was asked for.
    pub whole: Option<Volume>,
}

/// Writes `voxels` to `path`, with `affine` if they have none of their own, and keeps all of them with `keep`.
pub fn write(path: &Path, voxels: &mut dyn Voxels, affine: Option<Affine>, keep: bool) -> Result<WrittenVolume> {
    let grid = voxels.grid();
    let affine = voxels.affine().or(affine);
    let mut outgoing = Outgoing {
        slices: MiddleSlices::new(grid),
        whole: keep.then(|| Volume { data: Array3::zeros(grid.shape), grid, affine }),
        affine,
        voxels,
        place: path.display().to_string(),
        progress: Progress::new("export", None),
        start: Instant::now(),
        done: 0,
    };
    conefield_io::write_voxels(path, &mut outgoing)?;
    Ok(WrittenVolume { slices: outgoing.slices, whole: outgoing.whole })
}

struct Outgoing<'a> {
    voxels: &'a mut dyn Voxels,
    affine: Option<Affine>,
    slices: MiddleSlices,
    whole: Option<Volume>,
    place: String,
    progress: Progress,
    start: Instant,
    done: usize,
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
        self.slices.gather(part, out.view());
        if let Some(whole) = &mut self.whole {
            let [x, y, z] = part.clone();
            whole.data.slice_mut(ndarray::s![x, y, z]).assign(&out);
        }
        self.done += out.len();
        let share = self.done as f64 / self.voxels.grid().len().unwrap_or(usize::MAX) as f64;
        let left = self.start.elapsed().as_secs_f64() * (1.0 - share) / share;
        self.progress.show(share, |_| format!("{} left", duration(left)));
        Ok(())
    }
}
