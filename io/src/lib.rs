//! Reading and writing of every file format that conefield supports, one module per format.
//!
//! - Volumes: [`read_volume`], [`write_volume`], [`write_voxels`] (NIfTI, MetaImage, NRRD, NumPy, TIFF stacks,
//!   OME-Zarr, a DICOM series).
//! - Scans: [`read_scan`], [`read_truth`], [`read_data_set`], which also reads test views (conefield's own folder,
//!   R2-Gaussian's folder, NAF's file); [`write_scan`], [`write_r2`], [`write_naf`], [`write_rtk`] (for RTK).
//! - Projections from scanners: [`read_scanner`] (a description in TOML; TIFF, NumPy, HDF5, RTK's XML geometry; the
//!   files of vendors), as [`Stored`]: line integrals or counts.
//! - Sizes, before memory is allocated: [`scan_size`], [`scanner_size`], [`volume_voxels`].
//! - Weights: [`read_weights`], [`write_weights`]; checkpoints: [`read_checkpoint`], [`write_checkpoint`]
//!   (safetensors).
//! - Curves and images for TensorBoard: [`EventFile`].
//!
//! Readers recognize a format by a file's content, check a header before they allocate what it claims, and name the
//! file, the field, the value found and the value expected in errors. Lengths are converted to millimetres once, here.
//! Voxel values stay in `1/unit` of their scan.
//!
//! Writers write beside the final name, sync and rename ([`write_atomic`]), so a half-written file never appears under
//! the final name. A folder that grows while a command works is a [`Lease`]: locked, with the earlier folder preserved
//! until the new work is complete. Several processes can write one folder, each with a [`SharedLease`].

mod affine;
mod atomic;
mod checkpoint;
mod dicom;
mod events;
mod file_order;
mod folder;
mod foreign;
mod hdf5;
mod header;
mod input;
mod lease;
mod lock;
mod mat;
mod memory;
mod metaimage;
mod naf;
mod nifti;
mod npy;
mod npz;
mod nrrd;
mod number;
mod orbit;
mod packing;
mod pickle;
mod r2;
mod rays;
mod rtk;
mod rtk_folder;
mod scan;
mod scan_folder;
mod scanner;
mod size;
mod stack;
mod table;
mod text;
mod tiff;
mod unit;
mod volume;
mod weights;
mod zarr;

#[cfg(test)]
mod testing;

pub(crate) use atomic::write_folder_atomic;
pub use atomic::{discard_unfinished, is_unfinished, write_atomic, write_text_atomic};
pub use checkpoint::{read_checkpoint, write_checkpoint};
pub use dicom::DicomTemplate;
pub use events::EventFile;
pub use file_order::{PACKED_BYTES, SLAB_BYTES};
pub use folder::folder_of;
pub use lease::{Contents, FolderLock, Lease, Progressed, SharedLease, is_aside, try_alone};
pub use naf::write_naf;
pub use r2::write_r2;
pub use rtk::read_rtk_geometry;
pub use rtk_folder::write_rtk;
pub use scan::{DataSet, Parts, read_data_set, read_scan, read_truth, scan_unit, scanner_file, truth_file};
pub use scan_folder::write_scan;
pub use scanner::{Conversion, Counts, I0, OpenBeam, Stored, read_scanner};
pub use size::{ScanSize, scan_size, scanner_size, volume_voxels};
pub use volume::{
    check_shape, data_file, is_volume, is_volume_name, packed_bytes, read_volume, write_volume, write_voxels,
    write_voxels_of,
};
pub use weights::{Tensor, read_weights, write_weights};
