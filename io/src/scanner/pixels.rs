//! The images of vendors' detectors, recognized by their first bytes. `scanner.toml` can name them too.

use super::{his, obi, txrm, xim};
use crate::hdf5::ScanPart;
use conefield_core::{Error, Result};
use ndarray::Array3;
use std::path::Path;

/// A format of images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pixels {
    /// Varian's XIM.
    Xim,
    /// Varian's HND and HNC.
    Obi,
    /// Elekta's and PerkinElmer's HIS.
    His,
    /// Zeiss' TXRM.
    Txrm,
}

impl Pixels {
    /// The format of a file that starts with `head`.
    pub fn of(head: &[u8]) -> Option<Self> {
        [(xim::MAGIC, Self::Xim), (obi::MAGIC, Self::Obi), (his::MAGIC, Self::His), (txrm::MAGIC, Self::Txrm)]
            .into_iter()
            .find_map(|(magic, format)| head.starts_with(magic).then_some(format))
    }

    /// Views, rows and columns of `path`, from its header.
    pub fn shape(self, path: &Path) -> Result<[usize; 3]> {
        let one = |[rows, columns]: [usize; 2]| [1, rows, columns];
        match self {
            Self::Xim => xim::head(path).map(|h| one(h.size)),
            Self::Obi => obi::head(path).map(|h| one(h.size)),
            Self::His => his::shape(path),
            Self::Txrm => txrm::shape(path),
        }
    }

    /// The numbers of `part`, `[view, row, column]`; a file without parts holds projections or a field of its own.
    pub fn read(self, path: &Path, part: ScanPart) -> Result<Array3<f32>> {
        let (shape, values) = match self {
            Self::Xim => xim::read(path)?,
            Self::Obi => obi::read(path)?,
            Self::His => his::read(path)?,
            Self::Txrm => return txrm::read(path, part),
        };
        Array3::from_shape_vec(shape, values)
            .map_err(|e| Error::invalid(path.display().to_string(), "pixels", e, "as many as the header says"))
    }
}
