//! Reads the finest level of an OME-Zarr pyramid: version 0.4 on Zarr 2, axes z, y, x, chunks uncompressed or
//! compressed by zlib or gzip.

use crate::affine::{self, Affine};
use crate::folder;
use crate::input::{Input, must_unpack};
use crate::npy;
use crate::number::{ByteOrder, Number};
use crate::text::{self, shortened};
use conefield_core::error::ensure;
use conefield_core::finite::stray;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array3, ArrayView3, s};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Files that mark a folder of Zarr, of any version.
const MARKS: [&str; 4] = [".zattrs", ".zgroup", ".zarray", "zarr.json"];

/// Whether `folder` is a Zarr folder.
pub(crate) fn is_zarr(folder: &Path) -> bool {
    MARKS.iter().any(|m| folder.join(m).is_file())
}

/// `.zattrs` of the pyramid.
#[derive(Deserialize)]
struct Attributes {
    multiscales: Vec<Multiscale>,
    /// conefield's own attributes, which the format does not define.
    conefield: Option<OwnAttributes>,
}

#[derive(Deserialize)]
struct OwnAttributes {
    affine: Affine,
}

#[derive(Deserialize)]
struct Multiscale {
    axes: Vec<PyramidAxis>,
    datasets: Vec<Level>,
    #[serde(default, rename = "coordinateTransformations")]
    transforms: Vec<Transform>,
}

#[derive(Deserialize)]
struct PyramidAxis {
    name: String,
    unit: Option<String>,
}

#[derive(Deserialize)]
struct Level {
    path: String,
    #[serde(rename = "coordinateTransformations")]
    transforms: Vec<Transform>,
}

/// A step from voxel indices to lengths, along z, y and x.
#[derive(Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Transform {
    Identity,
    Scale { scale: [f64; 3] },
    Translation { translation: [f64; 3] },
}

impl Multiscale {
    /// Millimetres per unit of length.
    fn unit(&self, place: &str) -> Result<f64> {
        let names: Vec<&str> = self.axes.iter().map(|a| a.name.as_str()).collect();
        let expected = "[\"z\", \"y\", \"x\"]: one volume, one number per voxel";
        ensure(names == ["z", "y", "x"], place, "multiscales[0].axes", format!("{names:?}"), expected)?;
        let unit = self.axes[0].unit.as_deref();
        let known = match unit {
            None | Some("millimeter") => Some(1.0),
            Some("nanometer") => Some(1e-6),
            Some("micrometer") => Some(0.001),
            Some("centimeter") => Some(10.0),
            Some("meter") => Some(1000.0),
            Some(_) => None,
        };
        match known.filter(|_| self.axes.iter().all(|a| a.unit.as_deref() == unit)) {
            Some(mm) => Ok(mm),
            None => {
                let found = format!("{:?}", self.axes.iter().map(|a| a.unit.as_deref()).collect::<Vec<_>>());
                let expected = "the same for all axes: nanometer, micrometer, millimeter, centimeter or meter";
                Err(Error::invalid(place, "multiscales[0].axes.unit", found, expected))
            }
        }
    }
}

/// `.zarray` of a level.
#[derive(Deserialize)]
struct LevelArray {
    zarr_format: u32,
    /// z, y, x.
    shape: [usize; 3],
    chunks: [usize; 3],
    dtype: String,
    order: String,
    compressor: Option<Compressor>,
    filters: Option<Vec<serde_json::Value>>,
    #[serde(default = "dot")]
    dimension_separator: String,
}

#[derive(Deserialize)]
struct Compressor {
    id: String,
}

/// Zarr's default between the numbers of a chunk's name.
fn dot() -> String {
    ".".into()
}

/// A level, checked as far as its description goes.
struct Stored {
    folder: PathBuf,
    /// Path of `.zarray`, for errors.
    place: String,
    array: LevelArray,
    number: Number,
    order: ByteOrder,
    /// Undoes the compression of a chunk.
    unpack: fn(Input) -> Input,
}

impl Stored {
    /// The level in the folder `name` of the pyramid at `path`.
    fn open(path: &Path, name: &str) -> Result<Self> {
        let attributes = path.join(".zattrs").display().to_string();
        let folder = folder::within(path, &attributes, "multiscales[0].datasets[0].path", name)?;
        let file = folder.join(".zarray");
        let place = file.display().to_string();
        let array: LevelArray = text::read(&file)?;
        ensure(array.zarr_format == 2, &place, "zarr_format", array.zarr_format, "2")?;
        let names = [array.shape, array.chunks].concat();
        let found = format!("{:?} in chunks of {:?}", array.shape, array.chunks);
        ensure(!names.contains(&0), &place, "shape", found, "at least one voxel along each axis")?;
        // Unlike NumPy, Zarr always states the byte order.
        let element = npy::element(&array.dtype).filter(|_| array.dtype.starts_with(['<', '>', '|']));
        let (number, order) = element.ok_or_else(|| {
            let expected = "a real number of 8 to 64 bits such as \"<f4\" or \"|u1\"";
            Error::invalid(&place, "dtype", shortened(&array.dtype), expected)
        })?;
        let unpack: fn(Input) -> Input = match array.compressor.as_ref().map(|c| c.id.as_str()) {
            None => |plain| plain,
            Some("zlib") => Input::inflate,
            Some("gzip") => Input::gunzip,
            Some(other) => {
                let expected = "zlib, gzip or none (rewrite the array with one of them)";
                return Err(Error::invalid(place, "compressor.id", shortened(other), expected));
            }
        };
        let filters = array.filters.as_ref().map_or(0, Vec::len);
        ensure(filters == 0, &place, "filters", format!("{filters} filters"), "none")?;
        ensure(array.order == "C", &place, "order", shortened(&array.order), "C")?;
        let separator = &array.dimension_separator;
        ensure(["/", "."].contains(&&separator[..]), &place, "dimension_separator", shortened(separator), "/ or .")?;
        Ok(Self { folder, place, array, number, order, unpack })
    }

    /// Voxels along x, y and z.
    fn shape(&self) -> [usize; 3] {
        let [z, y, x] = self.array.shape;
        [x, y, z]
    }

    /// Indices of all chunks, along x, y and z.
    fn each_chunk(&self) -> impl Iterator<Item = [usize; 3]> {
        let [nz, ny, nx]: [usize; 3] = std::array::from_fn(|k| self.array.shape[k].div_ceil(self.array.chunks[k]));
        (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [x, y, z])))
    }

    /// The file of a chunk. Zarr lets chunks without values be missing; so does an interrupted copy, which must not
    /// pass for empty space.
    fn file(&self, [x, y, z]: [usize; 3]) -> Result<PathBuf> {
        let name = [z, y, x].map(|n| n.to_string()).join(&self.array.dimension_separator);
        folder::inside(&self.folder, &self.place, "chunk", &name)
    }

    /// Refuses more voxels than the chunks can hold.
    fn must_hold(&self, voxels: usize) -> Result<()> {
        let mut packed = 0u64;
        for at in self.each_chunk() {
            let file = self.file(at)?;
            packed = packed.saturating_add(file.metadata().map_err(|e| Error::io(&file, e))?.len());
        }
        let bytes = (voxels as u64).saturating_mul(self.number.bytes() as u64);
        must_unpack(packed, bytes, voxels as u64).map_err(|expected| {
            let found = format!("{bytes} bytes in chunks of {packed} bytes");
            Error::invalid(&self.place, "shape", found, expected)
        })
    }

    /// The values of a chunk in the file's order, padding included.
    fn values(&self, at: [usize; 3]) -> Result<Vec<f32>> {
        let count = self.array.chunks.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
        let mut input = (self.unpack)(Input::open_plain(&self.file(at)?)?);
        input.singles("chunk", count.unwrap_or(usize::MAX), self.number, self.order)
    }
}

/// Finest level of the pyramid at `path`, with its voxel sizes and affine.
fn finest(path: &Path) -> Result<(Stored, VoxelGrid, Affine)> {
    if path.join("zarr.json").is_file() && !path.join(".zattrs").is_file() {
        let what = format!("{}: a folder of Zarr 3", path.display());
        return Err(Error::unsupported(what, "write it as OME-Zarr 0.4, which is on Zarr 2"));
    }
    let file = path.join(".zattrs");
    let place = file.display().to_string();
    let attributes: Attributes = text::read(&file)?;
    let (multiscale, level) = match &attributes.multiscales[..] {
        [one] if !one.datasets.is_empty() => (one, &one.datasets[0]),
        all => {
            let found = format!("{} with {} levels", all.len(), all.first().map_or(0, |m| m.datasets.len()));
            return Err(Error::invalid(place, "multiscales", found, "one pyramid with at least one level"));
        }
    };
    let mm = multiscale.unit(&place)?;
    let (mut scale, mut shift) = ([1.0; 3], [0.0; 3]);
    for transform in level.transforms.iter().chain(&multiscale.transforms) {
        match transform {
            Transform::Identity => {}
            Transform::Scale { scale: by } => {
                scale = std::array::from_fn(|k| scale[k] * by[k]);
                shift = std::array::from_fn(|k| shift[k] * by[k]);
            }
            Transform::Translation { translation } => shift = std::array::from_fn(|k| shift[k] + translation[k]),
        }
    }
    let xyz = |v: [f64; 3]| [v[2] * mm, v[1] * mm, v[0] * mm];
    let (spacing, first) = (xyz(scale), xyz(shift));
    let stored = Stored::open(path, &level.path)?;
    let grid = VoxelGrid { shape: stored.shape(), spacing, center: [0.0; 3] };
    grid.validate(&place)?;
    let [x, y, z] = spacing;
    let upright = affine::from_columns([[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]], first);
    let affine = match attributes.conefield {
        Some(own) if !affine::is_regular(&own.affine) || !affine::fits(&own.affine, spacing) => {
            let found = format!("{:?}", own.affine);
            let expected = format!("three independent voxel axes of lengths {spacing:?} mm");
            return Err(Error::invalid(place, "conefield.affine", found, expected));
        }
        Some(own) => own.affine,
        None if affine::is_regular(&upright) => upright,
        None => {
            let found = format!("{spacing:?} and {first:?} mm");
            return Err(Error::invalid(place, "coordinateTransformations", found, "finite numbers that span a volume"));
        }
    };
    Ok((stored, grid, affine))
}

/// Number of voxels, from the descriptions.
pub(crate) fn shape(path: &Path) -> Result<[usize; 3]> {
    finest(path).map(|(stored, ..)| stored.shape())
}

/// Reads the finest level, chunk by chunk. The affine is RAS, in mm, and `grid.center` is `[0, 0, 0]`.
pub(crate) fn read(path: &Path) -> Result<Volume> {
    let (stored, grid, affine) = finest(path)?;
    let voxels = grid.len().unwrap_or(usize::MAX);
    stored.must_hold(voxels)?;
    allowance::numbers(&stored.place, "shape", voxels)?;
    let mut data = Array3::zeros(grid.shape);
    let [cz, cy, cx] = stored.array.chunks;
    for at in stored.each_chunk() {
        let values = stored.values(at)?;
        let chunk = ArrayView3::from_shape([cz, cy, cx], &values)
            .map_err(|e| Error::invalid(&stored.place, "chunks", e, "a size that can be addressed"))?;
        let [x, y, z] = std::array::from_fn(|k| {
            let from = at[k] * [cx, cy, cz][k];
            from..grid.shape[k].min(from.saturating_add([cx, cy, cz][k]))
        });
        let part = chunk.slice(s![..z.len(), ..y.len(), ..x.len()]);
        if let Some(((k, j, i), value)) = stray(&part) {
            let voxel = [x.start + i, y.start + j, z.start + k];
            let place = path.display().to_string();
            return Err(Error::invalid(place, format!("voxel {voxel:?}"), value, "a finite number"));
        }
        data.slice_mut(s![x, y, z]).assign(&part.t());
    }
    Ok(Volume { data, grid, affine: Some(affine) })
}

#[cfg(test)]
mod tests {
    use crate::read_volume;
    use crate::testing::{gzip, says};
    use std::fs;
    use std::path::Path;

    /// A pyramid of one level with 2 x 1 x 3 voxels along x, y, z, in chunks of two slices.
    fn small(path: &Path, array: &str, attributes: &str, pack: impl Fn(&[u8]) -> Vec<u8>) {
        let _ = fs::remove_dir_all(path);
        fs::create_dir_all(path.join("s0")).unwrap();
        fs::write(path.join(".zattrs"), attributes).unwrap();
        fs::write(path.join("s0/.zarray"), array).unwrap();
        let chunk = |values: [i16; 4]| pack(&values.map(i16::to_be_bytes).concat());
        fs::write(path.join("s0/0.0.0"), chunk([1, 2, 3, 4])).unwrap();
        fs::write(path.join("s0/1.0.0"), chunk([5, -6, 0, 0])).unwrap();
    }

    const ARRAY: &str = r#"{ "zarr_format": 2, "shape": [3, 1, 2], "chunks": [2, 1, 2], "dtype": ">i2", "order": "C",
        "fill_value": 0, "filters": null, "compressor": null }"#;
    const ATTRIBUTES: &str = r#"{ "multiscales": [{ "version": "0.4", "axes": [
        { "name": "z", "type": "space", "unit": "micrometer" }, { "name": "y", "type": "space", "unit": "micrometer" },
        { "name": "x", "type": "space", "unit": "micrometer" }], "datasets": [{ "path": "s0",
        "coordinateTransformations": [{ "type": "scale", "scale": [4000, 3000, 2000] },
        { "type": "translation", "translation": [3000, 2000, 1000] }] }] }] }"#;

    #[test]
    fn arrays_of_other_programs_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.zarr");
        let packed = ARRAY.replace(r#""compressor": null"#, r#""compressor": { "id": "gzip", "level": 1 }"#);
        for gzipped in [false, true] {
            match gzipped {
                false => small(&path, ARRAY, ATTRIBUTES, <[u8]>::to_vec),
                true => small(&path, &packed, ATTRIBUTES, gzip),
            }
            let v = read_volume(&path).unwrap();
            assert_eq!((v.grid.shape, v.grid.spacing), ([2, 1, 3], [2.0, 3.0, 4.0]));
            assert_eq!(v.affine.unwrap()[2], [0.0, 0.0, 4.0, 3.0]);
            assert_eq!(v.data.t().iter().copied().collect::<Vec<_>>(), [1.0, 2.0, 3.0, 4.0, 5.0, -6.0]);
        }
    }

    #[test]
    fn what_is_no_volume_is_refused_with_its_field() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.zarr");
        let refused = |words: &[&str]| says(read_volume(&path), &[&["a.zarr"], words].concat());
        for (from, to, words) in [
            ("\"zarr_format\": 2", "\"zarr_format\": 3", &["s0/.zarray: zarr_format", "found 3"][..]),
            (">i2", "<c8", &["dtype", "<c8"]),
            (">i2", "é", &["dtype"]),
            (">i2", ">f8", &["chunk", "8 bytes", "32 bytes"]),
            ("\"C\"", "\"F\"", &["order", "\"F\""]),
            ("\"filters\": null", "\"filters\": [{ \"id\": \"delta\" }]", &["filters"]),
            ("\"compressor\": null", "\"compressor\": { \"id\": \"blosc\" }", &["compressor.id", "blosc", "zlib"]),
            ("\"compressor\": null", "\"compressor\": { \"id\": \"zlib\" }", &["0.0.0", "zlib stream"]),
            ("\"fill_value\"", "\"dimension_separator\": \"..\", \"fill_value\"", &["dimension_separator"]),
            ("[3, 1, 2]", "[3, 1]", &[".zarray:1:"]),
            ("[3, 1, 2]", "[5, 1, 2]", &["chunk", "2.0.0"]),
            ("[3, 1, 2]", "[4294967296, 4294967296, 4294967296]", &["shape", "addressed"]),
            ("[3, 1, 2]", "[0, 1, 2]", &["shape", "at least one"]),
            ("[2, 1, 2]", "[2, 0, 2]", &["shape", "at least one"]),
            ("[2, 1, 2]", "[4294967296, 4294967296, 4294967296]", &["chunk", "addressed"]),
            ("[2, 1, 2]", "[3, 1, 2]", &["chunk", "8 bytes", "12 bytes"]),
        ] {
            small(&path, &ARRAY.replace(from, to), ATTRIBUTES, <[u8]>::to_vec);
            refused(words);
        }
        for (from, to, words) in [
            ("\"z\"", "\"c\"", &[".zattrs: multiscales[0].axes", "\"c\""][..]),
            ("\"unit\": \"micrometer\" }]", "\"unit\": \"meter\" }]", &["axes.unit", "the same"]),
            ("micrometer", "parsec", &["axes.unit", "parsec"]),
            ("\"s0\"", "\"../b\"", &["datasets[0].path", "../b"]),
            ("\"s0\"", "\"s1\"", &["datasets[0].path", "s1"]),
            ("[4000, ", "[0, ", &["spacing", "sides"]),
            ("\"scale\": [4000, ", "\"scale\": [", &[".zattrs:4:"]),
            ("\"type\": \"scale\"", "\"type\": \"shear\"", &[".zattrs", "shear"]),
            (
                "{ \"multi",
                "{ \"conefield\": { \"affine\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]] }, \"multi",
                &["conefield.affine", "independent"],
            ),
            ("\"multiscales\": [", "\"multiscales\": [], \"rest\": [", &["multiscales", "found 0"]),
            ("\"multiscales\"", "\"labels\"", &[".zattrs", "multiscales"]),
        ] {
            small(&path, ARRAY, &ATTRIBUTES.replace(from, to), <[u8]>::to_vec);
            refused(words);
        }
        let floats = ARRAY.replace(">i2", ">f4");
        small(&path, &floats, ATTRIBUTES, |b| [b, &f32::NAN.to_be_bytes(), &f32::NAN.to_be_bytes()].concat());
        refused(&["voxel [0, 0, 1]", "NaN"]);
        fs::remove_file(path.join("s0/1.0.0")).unwrap();
        refused(&["chunk", "1.0.0"]);
        fs::remove_file(path.join(".zattrs")).unwrap();
        fs::write(path.join("zarr.json"), "{}").unwrap();
        refused(&["Zarr 3", "0.4"]);
    }
}
