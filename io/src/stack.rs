//! Stacks of projections and single fields from TIFF, `.npy`, `.npz`, `.mat`, MetaImage, HDF5 and the images of vendors'
//! detectors, reordered to `[view, row, column]`.

use crate::hdf5::{self, ScanPart};
use crate::input::Input;
use crate::scanner::Pixels;
use crate::size::product;
use crate::{folder, foreign, mat, memory, metaimage, npy, npz, text, tiff};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use ndarray::{Array2, Array3, ArrayD, Axis, Ix3};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Bytes that suffice to recognize a file: the first lines of a MetaImage.
const HEAD: usize = 264;

/// One axis of a stack.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum StackAxis {
    View,
    Row,
    Column,
}

/// The order of axes in a file's arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct StackLayout {
    /// The meaning of a stack's three axes; an array with two has them in the same order, without `lacked`.
    pub axes: [StackAxis; 3],
    /// The axis that arrays with two axes lack: the view of an image, the row of a sinogram.
    pub lacked: StackAxis,
    /// Whether the first row is the lowest along v.
    pub flip_rows: bool,
    pub flip_columns: bool,
}

impl StackLayout {
    /// Reorders the file's three-dimensional array to `[view, row, column]`.
    fn arrange(&self, place: &str, a: Array3<f32>) -> Result<Array3<f32>> {
        let mut a = a.permuted_axes([StackAxis::View, StackAxis::Row, StackAxis::Column].map(|axis| self.at(axis)));
        if self.flip_rows {
            a.invert_axis(Axis(1));
        }
        if self.flip_columns {
            a.invert_axis(Axis(2));
        }
        memory::in_order(place, "image", a)
    }

    /// Index of an axis.
    fn at(&self, axis: StackAxis) -> usize {
        self.axes.iter().position(|&x| x == axis).unwrap_or(0)
    }
}

/// One file or several.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, try_from = "Value")]
pub(crate) enum Names {
    One(String),
    Many(Vec<String>),
}

impl TryFrom<Value> for Names {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        let name = |one: &Value| one.as_str().map(str::to_owned);
        let names = match &value {
            Value::Array(all) => all.iter().map(name).collect::<Option<_>>().map(Self::Many),
            one => name(one).map(Self::One),
        };
        names.ok_or_else(|| text::misfit(&value, "a file name or a list of file names"))
    }
}

/// A file and, for `.npz`, `.mat` and HDF5, the array in it.
struct StackFile {
    path: PathBuf,
    array: Option<String>,
}

/// Reads a stack `[view, row, column]` from a sequence of files, each with one view (two axes) or several.
///
/// Names are relative to `folder` and stay in it. A folder stands for its TIFF files, if it has none for its `.npy` files,
/// and then for the images of a vendor, in the order of the numbers in their names. From an HDF5 file that holds a whole
/// scan, `part` is read.
pub(crate) fn read(
    folder: &Path,
    place: &str,
    field: &str,
    part: ScanPart,
    names: &Names,
    layout: StackLayout,
) -> Result<Array3<f32>> {
    let (sources, oddities) = sources(folder, place, field, names)?;
    text::warn(&format!("{place}: {field}"), oddities);
    let mut named = folder::NamedFiles::default();
    sources.iter().try_for_each(|s| named.once(place, field, &s.path, s.array.as_deref()))?;
    let mut values: Vec<f32> = Vec::new();
    // Rows, columns and numbers of the first file.
    let mut first = None;
    let mut views = 0;
    for source in &sources {
        let (stack, numbers) = raw(source, part, layout)?;
        let file = source.path.display().to_string();
        let stack = layout.arrange(&file, stack)?;
        if sources.len() == 1 {
            return Ok(stack);
        }
        let (count, rows, columns) = stack.dim();
        let (size, usual) = first.get_or_insert_with(|| ([rows, columns], numbers.clone()));
        let like = |what: String| format!("{what}, as in {}", sources[0].path.display());
        let expected = like(format!("{} x {} (rows x columns)", size[0], size[1]));
        ensure(*size == [rows, columns], &file, "image", format!("{rows} x {columns}"), expected)?;
        let shown = |n: &Option<String>| n.clone().unwrap_or_else(|| "another format".into());
        ensure(numbers == *usual, &file, "numbers", shown(&numbers), like(shown(usual)))?;
        memory::grow(&mut values, stack.len(), usize::MAX, place, field)?;
        values.extend(stack.iter());
        views += count;
    }
    let [rows, columns] = first.map_or([0; 2], |(size, _)| size);
    Array3::from_shape_vec((views, rows, columns), values)
        .map_err(|e| Error::invalid(place, field, e, "one image per view"))
}

/// Number of values that [`read`] returns, from the headers of its files.
pub(crate) fn values(folder: &Path, place: &str, field: &str, names: &Names) -> Result<u64> {
    let mut sum = 0u64;
    for StackFile { path, array } in sources(folder, place, field, names)?.0 {
        let (head, array) = (Input::open(&path)?.take(HEAD)?, array.as_deref());
        sum = sum.saturating_add(if head.starts_with(npz::MAGIC) {
            product(npz::shape(&path, array)?)
        } else if tiff::is_tiff(&head) {
            tiff::values(&path)?
        } else if head.starts_with(npy::MAGIC) {
            product(npy::shape(&mut Input::open(&path)?)?)
        } else if mat::is_mat(&head) {
            product(mat::shape(&path, array)?)
        } else if head.starts_with(hdf5::MAGIC) {
            product(hdf5::shape(&path, array, ScanPart::Projections)?)
        } else if let Some(pixels) = Pixels::of(&head) {
            product(pixels.shape(&path)?)
        } else if metaimage::is_header(&head) {
            product(metaimage::shape(&path)?)
        } else {
            0
        });
    }
    Ok(sum)
}

/// Reads a flat or dark field `[row, column]`: the mean of its images.
pub(crate) fn read_field(
    folder: &Path,
    place: &str,
    field: &str,
    part: ScanPart,
    names: &Names,
    layout: StackLayout,
) -> Result<Array2<f32>> {
    let stack = read(folder, place, field, part, names, layout)?;
    stack.mean_axis(Axis(0)).ok_or_else(|| Error::invalid(place, field, "no image", "at least one"))
}

/// The file's three-dimensional array in its own order, and how a TIFF or `.npy` stores a number; an array with
/// two axes gets the one that `layout` says it lacks, of length one.
fn raw(source: &StackFile, part: ScanPart, layout: StackLayout) -> Result<(Array3<f32>, Option<String>)> {
    let path = &source.path;
    let place = path.display().to_string();
    let third = |shape: &[usize]| {
        let expected = "two axes, as layout.axes says";
        ensure(layout.lacked == StackAxis::View, &place, "shape", format!("{shape:?}"), expected)
    };
    let three = |a: ArrayD<f32>| {
        if a.ndim() == 3 {
            third(a.shape())?;
        }
        let a = if a.ndim() == 2 { a.insert_axis(Axis(layout.at(layout.lacked))) } else { a };
        a.into_dimensionality::<Ix3>().map_err(|e| Error::invalid(&place, "shape", e, "two or three axes"))
    };
    let sets: &[&[&str]] = &[&["view", "row", "column"], &["row", "column"]];
    let head = Input::open(path)?.take(HEAD)?;
    if head.starts_with(npz::MAGIC) {
        return Ok((three(npz::read(path, source.array.as_deref(), sets)?)?, None));
    }
    if mat::is_mat(&head) {
        return Ok((three(mat::read(path, source.array.as_deref(), sets)?)?, None));
    }
    // Pages, slices of MetaImage and frames of a scan in HDF5 are always views: they move to the layout's view axis.
    let pages = |a: Array3<f32>| {
        third(a.shape())?;
        Ok::<_, Error>(match layout.at(StackAxis::View) {
            1 => a.permuted_axes([1, 0, 2]),
            2 => a.permuted_axes([1, 2, 0]),
            _ => a,
        })
    };
    if head.starts_with(hdf5::MAGIC) {
        let (values, views_first) = hdf5::read(path, source.array.as_deref(), part)?;
        let values = three(values)?;
        return Ok((if views_first { pages(values)? } else { values }, None));
    }
    if let Some(array) = &source.array {
        let expected = "an .npz archive, a .mat file or an HDF5 file, whose arrays have names";
        return Err(Error::invalid(place, "array", format!("the name \"{array}\""), expected));
    }
    if head.starts_with(npy::MAGIC) {
        let (array, numbers) = npy::read_counts(&mut Input::open(path)?, sets)?;
        return Ok((three(array)?, Some(numbers.to_string())));
    }
    if tiff::is_tiff(&head) {
        let stack = tiff::read(path)?;
        return Ok((pages(stack.values)?, Some(stack.numbers)));
    }
    if let Some(format) = Pixels::of(&head) {
        return Ok((pages(format.read(path, part)?)?, Some(format!("{format:?}"))));
    }
    if metaimage::is_header(&head) {
        // Columns are its x, rows its y.
        return Ok((pages(metaimage::read(path)?.data.reversed_axes())?, None));
    }
    foreign::refuse(path, &head)?;
    let expected = "TIFF (49 49 2a 00 or 4d 4d 00 2a), NumPy's .npy (93 4e 55 4d) or .npz (50 4b 03 04), \
                    MATLAB's .mat (4d 41 54 4c), HDF5 (89 48 44 46), MetaImage (NDims = 3), HIS, HND, HNC, XIM or TXRM";
    let start = &head[..head.len().min(8)];
    Err(Error::invalid(place, "format", format!("{start:02x?} at the start"), expected))
}

/// The files that `names` stand for, and what is odd about the numbers in the names of folders' files.
fn sources(folder: &Path, place: &str, field: &str, names: &Names) -> Result<(Vec<StackFile>, Vec<String>)> {
    let (mut all, mut oddities) = (Vec::new(), Vec::new());
    match names {
        Names::One(name) => oddities.extend(source(folder, place, field, name, &mut all)?),
        Names::Many(names) => {
            ensure(!names.is_empty(), place, field, "an empty list", "file names")?;
            for (i, name) in names.iter().enumerate() {
                oddities.extend(source(folder, place, &format!("{field}[{i}]"), name, &mut all)?);
            }
        }
    }
    Ok((all, oddities))
}

/// Adds the files that `name` stands for to `all`; what is odd about them.
fn source(folder: &Path, place: &str, field: &str, name: &str, all: &mut Vec<StackFile>) -> Result<Option<String>> {
    let (file, array) = folder::split(name);
    let path = match array {
        Some(_) => folder::inside(folder, place, field, file)?,
        None => folder::within(folder, place, field, file)?,
    };
    if array.is_some() || path.is_file() {
        all.push(StackFile { path, array: array.map(str::to_owned) });
        return Ok(None);
    }
    let mut chosen = Vec::new();
    for ends in [&["tif", "tiff"][..], &["npy"], &["his"], &["hnd", "hnc"], &["xim"]] {
        if chosen.is_empty() {
            chosen = folder::names(&path, ends)?;
        }
    }
    if chosen.is_empty() {
        foreign::refuse_folder(&path)?;
        let found = format!("a folder \"{file}\" without them");
        let expected = "a folder with .tif, .tiff, .npy, .his, .hnd, .hnc or .xim files";
        return Err(Error::invalid(place, field, found, expected));
    }
    for name in &chosen {
        let path = folder::inside(folder, place, field, &format!("{}/{name}", file.trim_end_matches('/')))?;
        all.push(StackFile { path, array: None });
    }
    Ok(folder::oddity(&chosen))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{npy_bytes, says};

    const PLAIN: StackLayout = StackLayout {
        axes: [StackAxis::View, StackAxis::Row, StackAxis::Column],
        lacked: StackAxis::View,
        flip_rows: false,
        flip_columns: false,
    };

    #[test]
    fn axes_and_flips_bring_every_layout_to_view_row_column() {
        use StackAxis::{Column, Row, View};
        let want = Array3::from_shape_fn((2, 3, 4), |(v, r, c)| (100 * v + 10 * r + c) as f32);
        for axes in [[View, Row, Column], [View, Column, Row], [Row, View, Column], [Column, Row, View]] {
            for (flip_rows, flip_columns) in [(false, false), (true, false), (false, true), (true, true)] {
                let layout = StackLayout { axes, lacked: View, flip_rows, flip_columns };
                let mut a = want.clone();
                if flip_rows {
                    a.invert_axis(Axis(1));
                }
                if flip_columns {
                    a.invert_axis(Axis(2));
                }
                let order = axes.map(|x| x as usize);
                assert_eq!(layout.arrange("a", a.permuted_axes(order)).unwrap(), want, "{layout:?}");
            }
        }
    }

    #[test]
    fn an_array_with_two_axes_gets_the_one_it_lacks() {
        use StackAxis::{Column, Row, View};
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a.npy"), npy_bytes("|u1", false, "(2, 3)", &[0, 1, 2, 3, 4, 5])).unwrap();
        let name = Names::One("a.npy".into());
        let read = |axes, lacked| {
            let layout = StackLayout { axes, lacked, ..PLAIN };
            super::read(dir.path(), "s.toml", "files.projections", ScanPart::Projections, &name, layout).unwrap()
        };
        let image = read([View, Row, Column], View);
        assert_eq!((image.dim(), image[[0, 1, 0]]), ((1, 2, 3), 3.0));
        let sinogram = read([View, Column, Row], Row);
        assert_eq!((sinogram.dim(), sinogram[[1, 0, 0]]), ((2, 1, 3), 3.0));
        let turned = read([Column, View, Row], Row);
        assert_eq!((turned.dim(), turned[[1, 0, 0]]), ((3, 1, 2), 1.0));
    }

    #[test]
    fn folders_lists_and_names_are_read_and_what_leads_out_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let at = |n: &str| dir.path().join(n);
        std::fs::create_dir(at("views")).unwrap();
        for i in [2usize, 10, 1] {
            let image = npy_bytes("|u1", false, "(1, 2)", &[i as u8, 7]);
            std::fs::write(at(&format!("views/p{i}.npy")), image).unwrap();
        }
        let read =
            |names: Names| super::read(dir.path(), "s.toml", "files.projections", ScanPart::Projections, &names, PLAIN);
        let one = |n: &str| read(Names::One(n.into()));
        assert_eq!(one("views").unwrap().slice(ndarray::s![.., 0, 0]).to_vec(), [1.0, 2.0, 10.0]);
        let many = |n: &[&str]| read(Names::Many(n.iter().map(|s| s.to_string()).collect()));
        assert_eq!(
            many(&["views/p10.npy", "views/p1.npy"]).unwrap().slice(ndarray::s![.., 0, 0]).to_vec(),
            [10.0, 1.0]
        );
        std::fs::write(at("odd.npy"), npy_bytes("|u1", false, "(2, 2)", &[0; 4])).unwrap();
        std::fs::write(at("wide.npy"), npy_bytes("<u2", false, "(1, 2)", &[0; 4])).unwrap();
        std::fs::create_dir(at("empty")).unwrap();
        for (found, words) in [
            (many(&["views/p1.npy", "odd.npy"]), ["odd.npy", "2 x 2", "1 x 2"]),
            (many(&["views/p1.npy", "wide.npy"]), ["wide.npy: numbers", "found 16-bit", "expected 8-bit"]),
            (many(&[]), ["s.toml", "files.projections", "empty list"]),
            (many(&["odd.npy", "/etc/passwd"]), ["s.toml", "files.projections[1]", "inside the folder"]),
            (one("odd.npy.npz:a"), ["s.toml", "files.projections", "odd.npy.npz"]),
            (one("empty"), ["s.toml", "files.projections", ".tif"]),
        ] {
            says(found, &words);
        }
    }
}
