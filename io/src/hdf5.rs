//! HDF5: one data set of a file, or part of a scan that is stored in a known layout.
//!
//! `hdf5-reader` reads the file's structure and decompresses its chunks (deflate, shuffle, Fletcher-32). This module
//! bounds its memory by the size of the file, reads values chunk by chunk, and refuses a data set with unwritten chunks
//! instead of reading them as zeros. [`layout`] knows where DXchange, NXtomo and CIL keep the parts of a scan.
//!
//! Sources: HDF5 File Format Specification 3.0; Data Exchange (dxfile), NeXus application definition NXtomo.

mod layout;
#[cfg(test)]
mod tests;

use crate::input::must_unpack;
use crate::memory;
use crate::number::{ByteOrder, Number};
use conefield_core::error::ensure;
use conefield_core::{Error, Result, allowance, files};
use hdf5_reader::datatype_api::H5Type;
use hdf5_reader::{Dataset, Datatype, FileStorage, Hdf5File, OpenOptions, SliceInfo, SliceInfoElem};
use layout::Layout;
use ndarray::{ArrayD, Dimension, IxDyn};
use std::path::Path;
use std::sync::Arc;

/// The bytes that an HDF5 file starts with.
pub(crate) const MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";

/// Deflate expands to at most this many times its size.
const DEFLATE_LIMIT: u64 = 1032;

/// The longest chunk that HDF5 allows, in bytes.
const LONGEST_CHUNK: u64 = u32::MAX as u64;

/// Most bytes (or one frame) of a data set without chunks that are read at a time.
const SLAB_BYTES: u64 = 16 << 20;

/// Filters that are not read, by their registered numbers.
const FILTERS: &[(u32, &str)] = &[
    (4, "szip"),
    (305, "LZO"),
    (307, "bzip2"),
    (32_000, "LZF"),
    (32_001, "Blosc"),
    (32_002, "MAFISC"),
    (32_003, "Snappy"),
    (32_004, "LZ4"),
    (32_008, "bitshuffle"),
    (32_013, "ZFP"),
    (32_014, "fpzip"),
    (32_015, "Zstandard"),
    (32_016, "B3D"),
    (32_017, "SZ"),
    (32_018, "FCIDECOMP"),
    (32_019, "JPEG"),
    (32_024, "SZ3"),
    (32_026, "Blosc2"),
];

/// The part of a scan to read from a file that holds all of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ScanPart {
    Projections,
    Flat,
    Dark,
}

/// The shape of the result of [`read`], from headers and image keys alone.
pub(crate) fn shape(path: &Path, name: Option<&str>, part: ScanPart) -> Result<Vec<usize>> {
    let file = Container::open(path)?;
    let (data, kept) = Layout::find(&file, name)?.frames(&file, part)?;
    let mut shape = file.shape(&data)?;
    if let Some(kept) = kept {
        shape[0] = kept.iter().filter(|k| **k).count();
    }
    Ok(shape)
}

/// Reads all of the data set `name`, or `part` of the scan in the group `name` (or in the file if there is no name). Also
/// returns whether the first axis is the views: it is in a scan, not in a plain data set.
///
/// Accepts two or three axes of integers of 1 to 8 bytes or floats of 4 or 8; the axes keep the file's order. Refuses
/// other types, sizes that the file cannot hold, missing chunks and values that are not finite.
pub(crate) fn read(path: &Path, name: Option<&str>, part: ScanPart) -> Result<(ArrayD<f32>, bool)> {
    let file = Container::open(path)?;
    let layout = Layout::find(&file, name)?;
    let (data, kept) = layout.frames(&file, part)?;
    Ok((file.values(&data, kept.as_deref())?, !matches!(layout, Layout::Plain(_))))
}

/// Shape and numbers of the small data set `name`, or the projection angles of a scan's layout. Converted to degrees if
/// the data set's unit is radians.
pub(crate) fn read_exact(path: &Path, name: Option<&str>) -> Result<(Vec<usize>, Vec<f64>)> {
    let file = Container::open(path)?;
    let (data, keys) = Layout::find(&file, name)?.angles(&file)?;
    let mut shape = file.shape(&data)?;
    let mut values = file.small(&data)?;
    if let Some(keys) = keys {
        file.one_each(&data, values.len(), keys.len())?;
        let mut keys = keys.iter();
        values.retain(|_| keys.next() == Some(&0));
        shape = vec![values.len()];
    }
    // CIL calls the attribute `angle_unit`.
    let unit = ["units", "angle_unit"].iter().find_map(|name| file.text_attribute(&data, name));
    if unit.is_some_and(|u| u.to_ascii_lowercase().starts_with("rad")) {
        values.iter_mut().for_each(|x| *x = x.to_degrees());
    }
    Ok((shape, values))
}

/// An open file.
pub(crate) struct Container {
    place: String,
    file: Hdf5File,
    /// Bytes on disk.
    size: u64,
}

impl Container {
    pub fn open(path: &Path) -> Result<Self> {
        let place = path.display().to_string();
        let (file, size) = files::open(path)?;
        let chunk = size.saturating_mul(DEFLATE_LIMIT).min(LONGEST_CHUNK);
        let bound = |bytes: u64| usize::try_from(bytes).unwrap_or(usize::MAX);
        let options = OpenOptions::default()
            .with_chunk_cache_bytes(0)
            .with_max_chunk_bytes(bound(chunk))
            .with_max_read_bytes(bound(size.max(SLAB_BYTES)))
            .with_max_object_header_bytes(bound(size));
        let file = FileStorage::from_file(file)
            .and_then(|storage| Hdf5File::from_storage_with_options(Arc::new(storage), options))
            .map_err(|e| Error::invalid(&place, "HDF5", e, "a whole HDF5 file"))?;
        let end = file.superblock().eof_address;
        let expected = format!("{end} bytes, as the file says: it is cut off");
        ensure(end <= size, &place, "HDF5", format!("{size} bytes"), expected)?;
        Ok(Self { place, file, size })
    }

    /// An error about `field` of this file.
    pub fn invalid(&self, field: &str, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(&self.place, field, found, expected)
    }

    fn broken(&self, data: &Dataset, e: &hdf5_reader::error::Error) -> Error {
        let hdf5_reader::error::Error::UnsupportedFilter(text) = e else {
            return self.invalid(data.name(), e, "data that is not damaged, unpacked or packed by deflate");
        };
        let number = text.strip_prefix("filter id ").and_then(|n| n.parse::<u32>().ok());
        let name = FILTERS.iter().find(|(id, _)| Some(*id) == number).map_or("a filter", |(_, name)| name);
        Error::unsupported(
            format!("{}: {}: packed by {name} ({text}), which is not read", self.place, data.name()),
            "unpack it with `h5repack -f NONE IN.h5 OUT.h5` (HDF5's tool needs the filter's plugin, as hdf5plugin for \
             Python has it), or save it with gzip",
        )
    }

    /// The data set at `path`, if there is one.
    pub fn data(&self, path: &str) -> Option<Dataset> {
        self.file.dataset(path).ok()
    }

    /// The data set at `path`.
    pub fn needed(&self, path: &str) -> Result<Dataset> {
        self.file.dataset(path).map_err(|e| self.invalid(path, e, "a data set"))
    }

    /// Names of the groups at the root.
    fn root_groups(&self) -> Vec<String> {
        self.file.root_group().and_then(|g| g.member_names()).map(|(groups, _)| groups).unwrap_or_default()
    }

    /// The shape; every axis is at least 1 and the file can hold all values.
    fn shape(&self, data: &Dataset) -> Result<Vec<usize>> {
        let shape: Vec<usize> = data.shape().iter().map(|&n| usize::try_from(n).unwrap_or(usize::MAX)).collect();
        let text = || format!("{:?}", data.shape());
        let expected = "at least one value along every axis";
        ensure(!shape.contains(&0), &self.place, data.name(), text(), expected)?;
        let count = data.shape().iter().try_fold(1u64, |n, &s| n.checked_mul(s));
        let (number, _) = self.number(data)?;
        let bytes = count.and_then(|n| n.checked_mul(number.bytes() as u64));
        let (Some(count), Some(bytes)) = (count, bytes) else {
            return Err(self.invalid(data.name(), text(), "a size that can be addressed"));
        };
        let fits = match data.chunks() {
            Some(_) => must_unpack(self.size, bytes, count),
            None if bytes > self.size => Err(format!("at most {} bytes, the size of the file", self.size)),
            None => Ok(()),
        };
        fits.map_err(|expected| self.invalid(data.name(), format!("{} of {bytes} bytes", text()), expected))?;
        Ok(shape)
    }

    /// Storage type of the values.
    fn number(&self, data: &Dataset) -> Result<(Number, ByteOrder)> {
        stored(data.dtype()).ok_or_else(|| {
            let found: String = format!("{:?}", data.dtype()).chars().take(80).collect();
            self.invalid(data.name(), found, "integers of 1 to 8 bytes or floats of 4 or 8")
        })
    }

    /// The values of the `kept` frames along the first axis, or of all.
    fn values(&self, data: &Dataset, kept: Option<&[bool]>) -> Result<ArrayD<f32>> {
        let mut shape = self.shape(data)?;
        let Some([_, rows, columns]) = three(data.shape(), 1) else {
            let expected = "two axes (row, column) or three (view, row, column)";
            return Err(self.invalid(data.name(), format!("{shape:?}"), expected));
        };
        // The place of each frame in the result.
        let mut count = 0;
        let places: Vec<Option<usize>> = (0..shape[0])
            .map(|i| {
                let place = kept.is_none_or(|k| k.get(i) == Some(&true)).then_some(count);
                count += usize::from(place.is_some());
                place
            })
            .collect();
        let values = match data.chunks() {
            Some(_) => self.chunked(data, &places, [rows, columns], count * rows * columns)?,
            None => self.contiguous(data, &places, rows * columns, count * rows * columns)?,
        };
        shape[0] = count;
        let array = ArrayD::from_shape_vec(IxDyn(&shape), values)
            .map_err(|e| self.invalid(data.name(), e, "values of its shape"))?;
        memory::all_finite(&self.place, array, &|at| format!("{}{:?}", data.name(), at.slice()))
    }

    /// Reads frames of `rows` and `columns` chunk by chunk, in the order of the file, each to its place; memory grows with
    /// the `total` values read.
    fn chunked(
        &self,
        data: &Dataset,
        places: &[Option<usize>],
        [rows, columns]: [usize; 2],
        total: usize,
    ) -> Result<Vec<f32>> {
        let (number, order) = self.number(data)?;
        let shape = [places.len(), rows, columns];
        // The stored and the decompressed chunk.
        let chunk =
            data.chunks().into_iter().flatten().fold(number.bytes() as u64, |n, k| n.saturating_mul(u64::from(k)));
        allowance::memory(&self.place, data.name(), chunk.min(LONGEST_CHUNK).saturating_mul(2))?;
        let mut out: Vec<f32> = Vec::new();
        let mut decoded: Vec<f32> = Vec::new();
        let (mut seen, mut wanted) = (0u64, 1u64);
        for chunk in data.iter_chunks().map_err(|e| self.broken(data, &e))? {
            let chunk = chunk.map_err(|e| self.broken(data, &e))?;
            let found = three(chunk.offsets(), 0).zip(three(chunk.shape(), 1));
            let Some((at, size)) = found.filter(|(at, size)| (0..3).all(|k| at[k] < shape[k] && size[k] > 0)) else {
                let found = format!("a chunk at {:?}", chunk.offsets());
                return Err(self.invalid(data.name(), found, format!("chunks within {:?}", data.shape())));
            };
            wanted = shape.iter().zip(&size).map(|(s, n)| s.div_ceil(*n) as u64).product();
            seen += 1;
            let held = chunk.bytes().len() / number.bytes();
            allowance::numbers(&self.place, data.name(), held.saturating_sub(decoded.capacity()))?;
            decoded.clear();
            number.singles(order, chunk.bytes(), &mut decoded);
            let [depth, height, width] = size;
            if depth.checked_mul(height).and_then(|n| n.checked_mul(width)) != Some(decoded.len()) {
                let found = format!("a chunk of {} values", decoded.len());
                return Err(self.invalid(data.name(), found, format!("chunks of {:?}", chunk.shape())));
            }
            let [frame, row, column] = at;
            let [height_in, width_in] = [height.min(rows - row), width.min(columns - column)];
            for (d, place) in places[frame..].iter().take(depth).enumerate() {
                let Some(place) = place else { continue };
                let end = (place + 1) * rows * columns;
                if out.len() < end {
                    let more = end - out.len();
                    memory::grow(&mut out, more, total, &self.place, data.name())?;
                    out.resize(end, 0.0);
                }
                for h in 0..height_in {
                    let from = (d * height + h) * width;
                    let to = (place * rows + row + h) * columns + column;
                    out[to..to + width_in].copy_from_slice(&decoded[from..from + width_in]);
                }
            }
        }
        let expected = format!("{wanted}: the file was not written to its end");
        let whole = seen >= wanted && out.len() >= total;
        ensure(whole, &self.place, data.name(), format!("{seen} chunks of values"), expected)?;
        Ok(out)
    }

    /// Reads a few frames at a time.
    fn contiguous(&self, data: &Dataset, places: &[Option<usize>], frame: usize, total: usize) -> Result<Vec<f32>> {
        let (number, _) = self.number(data)?;
        let step = (SLAB_BYTES / (frame as u64 * number.bytes() as u64).max(1)).max(1) as usize;
        let mut out: Vec<f32> = Vec::new();
        memory::grow(&mut out, total, usize::MAX, &self.place, data.name())?;
        allowance::memory(&self.place, data.name(), 2 * (step.min(places.len()) * frame * number.bytes()) as u64)?;
        for (from, places) in (0u64..).step_by(step).zip(places.chunks(step)) {
            if places.iter().all(Option::is_none) {
                continue;
            }
            let mut selection = SliceInfo::all(data.ndim());
            selection.selections[0] = SliceInfoElem::Slice { start: from, end: from + places.len() as u64, step: 1 };
            let slab = data.read_slice::<Single>(&selection).map_err(|e| self.broken(data, &e))?;
            for (values, _) in slab.outer_iter().zip(places).filter(|(_, place)| place.is_some()) {
                out.extend(values.iter().map(|x| x.0));
            }
        }
        Ok(out)
    }

    /// The values of a small data set.
    pub fn small(&self, data: &Dataset) -> Result<Vec<f64>> {
        let shape = self.shape(data)?;
        let (number, order) = self.number(data)?;
        let count: usize = shape.iter().product();
        allowance::memory(&self.place, data.name(), 2 * (count as u64).saturating_mul(8))?;
        let mut raw = vec![0; count * number.bytes()];
        data.read_raw_bytes_into(&mut raw).map_err(|e| self.broken(data, &e))?;
        let mut values = Vec::with_capacity(count);
        number.doubles(order, &raw, &mut values);
        Ok(values)
    }

    /// Refuses `found` values of `data` unless there is one per frame.
    fn one_each(&self, data: &Dataset, found: usize, frames: usize) -> Result<()> {
        let expected = format!("{frames}, one for each frame");
        ensure(found == frames, &self.place, data.name(), format!("{found} values"), expected)
    }

    /// A text attribute of `data`.
    pub fn text_attribute(&self, data: &Dataset, name: &str) -> Option<String> {
        data.attribute(name).ok()?.read_string().ok()
    }

    /// A number attribute of `data`.
    pub fn number_attribute(&self, data: &Dataset, name: &str) -> Option<f64> {
        let attribute = data.attribute(name).ok()?;
        let as_integer =
            || attribute.read_scalar::<i64>().map(|x| x as f64).or(attribute.read_scalar::<i32>().map(f64::from));
        let as_float = || attribute.read_scalar::<f64>().or(attribute.read_scalar::<f32>().map(f64::from));
        as_float().or_else(|_| as_integer()).ok().filter(|x| x.is_finite())
    }
}

/// Positions or sizes along frames, rows and columns; if there are two, each row is a frame, and `row` is that of its only
/// row. `None` for another number of axes.
fn three(all: &[u64], row: u64) -> Option<[usize; 3]> {
    let three = match *all {
        [frame, column] => [frame, row, column],
        [frame, row, column] => [frame, row, column],
        _ => return None,
    };
    Some(three.map(|n| usize::try_from(n).unwrap_or(usize::MAX)))
}

/// How values of the type `dtype` are stored; `None` if they are not numbers.
fn stored(dtype: &Datatype) -> Option<(Number, ByteOrder)> {
    let (kind, size, order) = match *dtype {
        Datatype::FixedPoint { size, signed, byte_order } => (if signed { 'i' } else { 'u' }, size, byte_order),
        Datatype::FloatingPoint { size, byte_order } => ('f', size, byte_order),
        _ => return None,
    };
    let number = Number::of(kind, size.into())?;
    let order = match order {
        hdf5_reader::ByteOrder::LittleEndian => ByteOrder::Little,
        hdf5_reader::ByteOrder::BigEndian => ByteOrder::Big,
    };
    Some((number, order))
}

/// A number of any stored type, read as `f32`: one type, for which the reader's generic code is compiled once.
#[derive(Clone)]
struct Single(f32);

impl H5Type for Single {
    fn hdf5_type() -> Datatype {
        f32::hdf5_type()
    }

    fn element_size(dtype: &Datatype) -> usize {
        stored(dtype).map_or(0, |(number, _)| number.bytes())
    }

    fn from_bytes(bytes: &[u8], dtype: &Datatype) -> hdf5_reader::error::Result<Self> {
        let one = Self::decode_vec(bytes, dtype, 1).transpose()?.and_then(|mut all| all.pop());
        one.ok_or_else(|| hdf5_reader::error::Error::InvalidData("no number".into()))
    }

    fn decode_vec(raw: &[u8], dtype: &Datatype, count: usize) -> Option<hdf5_reader::error::Result<Vec<Self>>> {
        let (number, order) = stored(dtype)?;
        let mut all = Vec::with_capacity(count);
        number.singles(order, raw.get(..count.checked_mul(number.bytes())?)?, &mut all);
        // In place: the layouts are the same.
        Some(Ok(all.into_iter().map(Self).collect()))
    }
}
