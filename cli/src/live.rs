//! `live.png`: the middle slices of a field during training.

use conefield::files;
use conefield_core::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::Part;
use conefield_evaluation::report::MiddleSlices;
use ndarray::Array3;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The live picture and its interval.
pub struct Live {
    path: PathBuf,
    every: Duration,
    last: Instant,
}

impl Live {
    /// Draws `path` every `seconds` seconds.
    pub fn new(path: PathBuf, seconds: f64) -> Self {
        Self { path, every: Duration::from_secs_f64(seconds), last: Instant::now() }
    }

    /// Whether it is time for the next picture.
    pub fn due(&self) -> bool {
        self.last.elapsed() >= self.every
    }

    /// Draws `slices` of `grid` and returns the path. The picture is replaced atomically.
    pub fn draw(&mut self, grid: VoxelGrid, slices: &[(Part, Array3<f32>)]) -> Result<&Path> {
        let mut middle = MiddleSlices::new(grid);
        slices.iter().for_each(|(part, values)| middle.gather(part, values.view()));
        files::picture(&self.path, None, &middle)?;
        self.last = Instant::now();
        Ok(&self.path)
    }
}
