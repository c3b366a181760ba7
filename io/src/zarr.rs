//! OME-Zarr: a folder with a pyramid of chunks, for volumes too large for a viewer to load at once.
//!
//! Written is version 0.4 on Zarr 2, which every reader supports: arrays `0` (the volume), `1` (half as many voxels
//! along each axis), … down to a single chunk; axes z, y, x in mm, 32-bit floats in chunks of 64³ compressed by zlib.
//! Each chunk is computed from the eight below it as soon as they are written, so that few chunks are in memory at once
//! whatever the volume's size.
//!
//! Source: ngff.openmicroscopy.org/0.4, zarr-specs.readthedocs.io (v2). The format supports scale and translation, no
//! rotation: an affine of the volume's own is kept in an attribute that only conefield reads.

mod read;

pub(crate) use read::{is_zarr, read, shape};

use crate::affine;
use crate::{folder, number, write_folder_atomic, write_text_atomic};
use conefield_core::finite::stray;
use conefield_core::parts::Voxels;
use conefield_core::{Error, Result};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use ndarray::{Array3, ArrayView3, s};
use serde_json::{Value, json};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Voxels along each side of a chunk.
const SIDE: usize = 64;

/// Writes the folder `path`; an existing folder is replaced only if it holds nothing but such a pyramid.
pub(crate) fn write(path: &Path, voxels: &mut dyn Voxels) -> Result<()> {
    let known = |name: &str| [".zattrs", ".zgroup"].contains(&name) || name.bytes().all(|b| b.is_ascii_digit());
    folder::may_replace(path, "OME-Zarr", &known, &[".zattrs"])?;
    write_folder_atomic(path, &mut |folder| {
        let shapes = shapes(voxels.grid().shape);
        let file = |name: &str, value: &Value| write_text_atomic(folder.join(name), &format!("{value:#}\n"));
        file(".zgroup", &json!({ "zarr_format": 2 }))?;
        file(".zattrs", &attributes(path, voxels, shapes.len()))?;
        for (level, [x, y, z]) in shapes.iter().enumerate() {
            let array = folder.join(level.to_string());
            fs::create_dir(&array).map_err(|e| Error::io(&array, e))?;
            let value = json!({
                "zarr_format": 2, "shape": [z, y, x], "chunks": [SIDE, SIDE, SIDE], "dtype": "<f4", "order": "C",
                "fill_value": 0.0, "filters": null, "compressor": { "id": "zlib", "level": 1 }, "dimension_separator": "/",
            });
            write_text_atomic(array.join(".zarray"), &format!("{value:#}\n"))?;
        }
        let top = shapes.len() - 1;
        Pyramid { folder, path, shapes }.chunk(voxels, top, [0; 3]).map(drop)
    })
}

/// The shapes of all levels, [x, y, z], down to a single chunk.
fn shapes(full: [usize; 3]) -> Vec<[usize; 3]> {
    let half = |s: &[usize; 3]| s.iter().any(|n| *n > SIDE).then(|| s.map(|n| n.div_ceil(2)));
    std::iter::successors(Some(full), half).collect()
}

/// The pyramid's metadata.
fn attributes(path: &Path, voxels: &dyn Voxels, levels: usize) -> Value {
    let spacing = voxels.grid().spacing;
    let (affine, own) = affine::of(voxels, &path.display().to_string());
    let first = affine::column(&affine, 3);
    let zyx = |v: [f64; 3]| [v[2], v[1], v[0]];
    let data_set = |level: usize| {
        let times = (1u64 << level) as f64;
        // The centre of a voxel that covers 2ⁿ voxels along each axis.
        let shift: [f64; 3] = std::array::from_fn(|k| first[k] + 0.5 * (times - 1.0) * spacing[k]);
        json!({ "path": level.to_string(), "coordinateTransformations": [
            { "type": "scale", "scale": zyx(spacing.map(|s| s * times)) },
            { "type": "translation", "translation": zyx(shift) },
        ] })
    };
    let axes = ["z", "y", "x"].map(|name| json!({ "name": name, "type": "space", "unit": "millimeter" }));
    let mut found = json!({ "multiscales": [{
        "version": "0.4", "name": path.file_stem().map(|n| n.to_string_lossy()), "axes": axes, "type": "mean",
        "datasets": (0..levels).map(data_set).collect::<Vec<_>>(),
    }] });
    if own {
        found["conefield"] = json!({ "affine": affine });
    }
    if let Some(hu) = voxels.hounsfield() {
        found["multiscales"][0]["metadata"] = json!({ "values": hu });
    }
    found
}

struct Pyramid<'a> {
    /// The folder to write to.
    folder: &'a Path,
    /// The path that errors name.
    path: &'a Path,
    shapes: Vec<[usize; 3]>,
}

impl Pyramid<'_> {
    /// Writes the chunk `at` (along x, y, z) of `level` and all chunks below it; returns its voxels, [x, y, z].
    fn chunk(&self, voxels: &mut dyn Voxels, level: usize, at: [usize; 3]) -> Result<Array3<f32>> {
        let size: [usize; 3] = std::array::from_fn(|k| SIDE.min(self.shapes[level][k] - at[k] * SIDE));
        let mut values = Array3::zeros(size);
        if level == 0 {
            let part = std::array::from_fn(|k| at[k] * SIDE..at[k] * SIDE + size[k]);
            voxels.fill(&part, values.view_mut())?;
            if let Some(((x, y, z), v)) = stray(&values) {
                let voxel: [usize; 3] = [x + at[0] * SIDE, y + at[1] * SIDE, z + at[2] * SIDE];
                let place = self.path.display().to_string();
                return Err(Error::invalid(place, format!("voxel {voxel:?}"), v, "a finite number"));
            }
        } else {
            for octant in 0..8 {
                // Chunks above each other follow each other: they share pages of a volume on the disk.
                let side = [octant >> 2, octant >> 1 & 1, octant & 1];
                let below: [usize; 3] = std::array::from_fn(|k| 2 * at[k] + side[k]);
                if (0..3).any(|k| below[k] * SIDE >= self.shapes[level - 1][k]) {
                    continue;
                }
                let half = halved(self.chunk(voxels, level - 1, below)?.view());
                let [x, y, z] = std::array::from_fn(|k| {
                    let from = side[k] * SIDE / 2;
                    from..from + half.shape()[k]
                });
                values.slice_mut(s![x, y, z]).assign(&half);
            }
        }
        self.store(level, at, values.view())?;
        Ok(values)
    }

    /// Writes a chunk, padded with zeros where the volume ends within it.
    fn store(&self, level: usize, at: [usize; 3], values: ArrayView3<f32>) -> Result<()> {
        let file: PathBuf = [level, at[2], at[1], at[0]].iter().map(usize::to_string).collect();
        let file = self.folder.join(file);
        let io = |e| Error::io(&file, e);
        let mut whole = Array3::<f32>::zeros([SIDE; 3]);
        let [x, y, z] = std::array::from_fn(|k| 0..values.shape()[k]);
        whole.slice_mut(s![z, y, x]).assign(&values.t());
        if let Some(folder) = file.parent() {
            fs::create_dir_all(folder).map_err(io)?;
        }
        let mut packed = Vec::new();
        let mut encoder = ZlibEncoder::new(&mut packed as &mut dyn Write, Compression::fast());
        number::write(&mut encoder, whole.as_slice().unwrap_or_default()).map_err(io)?;
        encoder.finish().map_err(io)?;
        let mut to = File::create(&file).map_err(io)?;
        to.write_all(&packed).and_then(|()| to.sync_all()).map_err(io)
    }
}

/// Means of 2 × 2 × 2 voxels, of fewer at the end of the volume.
fn halved(values: ArrayView3<f32>) -> Array3<f32> {
    let shape = [0, 1, 2].map(|k| values.shape()[k].div_ceil(2));
    Array3::from_shape_fn(shape, |(x, y, z)| {
        let [x, y, z] = [x, y, z].map(|n| 2 * n);
        let block = values.slice(s![
            x..(x + 2).min(values.shape()[0]),
            y..(y + 2).min(values.shape()[1]),
            z..(z + 2).min(values.shape()[2])
        ]);
        (block.iter().map(|v| f64::from(*v)).sum::<f64>() / block.len() as f64) as f32
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;
    use conefield_core::scan::Volume;
    use flate2::read::ZlibDecoder;
    use std::io::Read;

    fn chunk(path: &Path) -> Array3<f32> {
        let mut raw = Vec::new();
        ZlibDecoder::new(fs::File::open(path).unwrap()).read_to_end(&mut raw).unwrap();
        let values = raw.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Array3::from_shape_vec([SIDE; 3], values).unwrap()
    }

    #[test]
    fn chunks_hold_the_voxels_and_the_level_above_their_means() {
        let value = |x: usize, y: usize, z: usize| (x + 100 * y) as f32 - 3.5 * z as f32;
        let data = Array3::from_shape_fn((70, 5, 66), |(x, y, z)| value(x, y, z));
        let mut volume = Volume::centered(data, [0.5, 0.75, 2.0]);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.zarr");
        write(&path, &mut &volume).unwrap();
        let last = chunk(&path.join("0/1/0/1"));
        assert_eq!([last[[1, 4, 5]], last[[0, 0, 0]]], [value(69, 4, 65), value(64, 0, 64)]);
        assert_eq!([last[[2, 0, 0]], last[[0, 5, 0]], last[[0, 0, 6]]], [0.0; 3]);
        let up = chunk(&path.join("1/0/0/0"));
        // Along y the fifth row is averaged alone.
        assert_eq!(up[[32, 2, 34]], (value(68, 4, 64) + value(69, 4, 65)) / 2.0);
        let text = fs::read_to_string(path.join(".zattrs")).unwrap();
        let v: Value = serde_json::from_str(&text).unwrap();
        let sets = v["multiscales"][0]["datasets"].as_array().unwrap();
        assert_eq!(sets.len(), 2);
        assert_eq!(sets[1]["coordinateTransformations"][0]["scale"], json!([4.0, 1.5, 1.0]));
        let first = volume.grid.voxel([0; 3]);
        assert_eq!(sets[1]["coordinateTransformations"][1]["translation"][0], json!(first[2] + 1.0));
        // Overwrites its own output, but nothing else.
        volume.data[[0, 0, 0]] = f32::NAN;
        says(write(&path, &mut &volume), &["a.zarr: voxel [0, 0, 0]", "NaN"]);
        assert_eq!(chunk(&path.join("0/0/0/0"))[[0, 0, 0]], 0.0);
        volume.data[[0, 0, 0]] = 1.0;
        write(&path, &mut &volume).unwrap();
        assert_eq!(chunk(&path.join("0/0/0/0"))[[0, 0, 0]], 1.0);
        fs::write(path.join("notes.txt"), "mine").unwrap();
        assert!(write(&path, &mut &volume).unwrap_err().to_string().contains("notes.txt"));
    }
}
