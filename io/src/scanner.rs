//! A scanner's data with a description: a TOML file with the positions of source and detector and the names of the data
//! files.
//!
//! ```toml
//! format = "conefield-scanner"
//! version = 1
//!
//! [files]                            # beside or below this file
//! projections = "scan.npz:counts"    # TIFF, .npy, .npz:ARRAY, .mat:ARRAY, .mha, a folder of images, or a list of those
//! flat = "scan.npz:flat"             # optional: the open beam; several images are averaged
//! dark = "scan.npz:dark"             # optional: no beam
//!
//! [circle]                           # or [vectors] or [rtk]
//! dso = 500.0                        # source to rotation axis
//! dsd = 800.0                        # source to detector plane; or, in place of both: beam = "parallel"
//! pixel = { u = 2.0, v = 2.0 }
//! offset = { u = 0.0, v = 0.0 }      # shift of the detector along its columns' and its rows' direction
//! tilt_deg = { u = 0.0, v = 0.0, normal = 0.0 }   # turns of the detector about its own axes; see View::tilted
//! start_deg = 0.0                    # the first view's angle
//! step_deg = 14.4                    # or range_deg = 360.0, or angles_deg = [...] or "FILE", counted from start_deg
//! direction = "counterclockwise"     # of the source, seen from +z; that of a turning object is the opposite
//!
//! [layout]                           # how the arrays lie; this is the default
//! axes = ["view", "row", "column"]      # two of them if the arrays have no third
//! flip_rows = false                  # true: the first row is the lowest
//! flip_columns = false
//!
//! [values]
//! kind = "counts"                    # or "line-integrals"
//! i0 = 20000.0                       # or "air"; in place of files.flat
//! floor = 1.0                        # optional: counts below are taken for this
//! flat_includes_dark = true          # false: the dark field has been taken off the flat field already
//!
//! [volume]                           # what to reconstruct
//! shape = [64, 64, 64]
//! spacing = [1.5625, 1.5625, 1.5625]
//! center = [0.0, 0.0, 0.0]
//! ```
//!
//! `[vectors]` has `cone_vec = [[...], ...]`, ASTRA's twelve numbers per view: source, detector centre, the step to the
//! next column (u) and to the next row (v), all in mm here, or the name of a file with them. `parallel_vec` has the
//! direction of the rays in place of the source. `[rtk]` has `file`, `pixel` and `offset`; see [`read_rtk_geometry`].
//! `[cil]` has the `file` that CIL wrote. All lengths are mm; angles are degrees, as their keys say.
//!
//! In an HDF5 file, `scan.h5:/PATH` names a data set; `scan.h5` alone means the projections, open beam, dark field or
//! angles that DXchange, NXtomo or CIL keep there. A vendor's description may replace this file; see [`vendor`].

mod cil;
mod differences;
mod his;
mod keys;
mod obi;
mod pixels;
mod skyscan;
mod turning;
mod txrm;
mod vendor;
mod xim;
mod xtekct;

pub(crate) use pixels::Pixels;
pub(crate) use vendor::{MOST_VIEWS, is_vendors};

use crate::hdf5::ScanPart;
use crate::rtk::read_rtk_geometry;
use crate::stack::{self, Names, StackAxis, StackLayout};
use crate::table::Numbers;
use crate::text::{self, described};
use crate::{ScanSize, folder, foreign, memory};
use conefield_core::error::ensure;
use conefield_core::geometry::{Geometry, Radians, View, VoxelGrid, norm};
use conefield_core::orbit::{self, Beam, CircularOrbit};
use conefield_core::scan::{Scan, Unit};
use conefield_core::{Error, Result};
use ndarray::{Array2, Array3, Axis};
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;
use vendor::Response;

pub(crate) const FORMAT: &str = "conefield-scanner";
pub(crate) const VERSION: u32 = 1;

/// Numbers per view in ASTRA's notation.
const VECTOR: usize = 12;

const GEOMETRIES: &str = "one of [circle], [vectors], [rtk] and [cil]";

/// The open-beam counts if there is no flat field.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "Value")]
pub enum I0 {
    /// The same for every pixel and view, dark value included.
    Number(f64),
    /// Estimated from the border of each view; see [`OpenBeam::Air`].
    Air,
}

impl TryFrom<Value> for I0 {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        let number = value.as_f64().map(Self::Number);
        let air = (value == "air").then_some(Self::Air);
        number.or(air).ok_or_else(|| text::misfit(&value, "a number of counts or \"air\""))
    }
}

/// Source of the open-beam counts. All are as the detector reports them, dark value included.
#[derive(Debug, Clone, PartialEq)]
pub enum OpenBeam {
    /// A flat field, `[row, column]`.
    Flat(Array2<f32>),
    /// One number for every pixel and view.
    Number(f64),
    /// Estimated per view from its border: the 85th percentile of the medians of 16 border segments. At least three of
    /// them must show air.
    Air,
}

/// Settings of the conversion from counts to line integrals.
#[derive(Debug, Clone, PartialEq)]
pub struct Conversion {
    /// The open beam.
    pub open: OpenBeam,
    /// Counts without a beam, `[row, column]`; 0 if `None`.
    pub dark: Option<Array2<f32>>,
    /// Counts above dark at or below this floor are raised to it, in the unit of the counts. `None`: 1, or 1/10000 of
    /// the open beam if that is less (counts scaled to 0 to 1).
    pub floor: Option<f64>,
}

/// What a detector counted, with the settings that turn it into line integrals.
#[derive(Debug, Clone)]
pub struct Counts {
    /// The counts, `[view, row, column]`.
    pub values: Array3<f32>,
    /// The settings.
    pub conversion: Conversion,
    place: String,
    geometry: Geometry,
    provenance: Value,
}

impl Counts {
    /// The file that errors name.
    pub fn place(&self) -> &str {
        &self.place
    }

    /// The scan of the `line_integrals` into which the counts were converted. `report` becomes `counts` of its provenance.
    pub fn scan(self, line_integrals: Array3<f32>, report: Value) -> Result<Scan> {
        let mut provenance = self.provenance;
        provenance["counts"] = report;
        straightened(&self.place, self.geometry, line_integrals, provenance)
    }
}

/// A scan as it is stored.
#[derive(Debug, Clone)]
pub enum Stored {
    /// Line integrals.
    Scan(Scan),
    /// Counts of a detector, not yet converted.
    Counts(Counts),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    #[serde(rename = "format")]
    _format: String,
    #[serde(rename = "version")]
    _version: u32,
    files: Files,
    circle: Option<Circle>,
    vectors: Option<Vectors>,
    rtk: Option<Rtk>,
    cil: Option<Cil>,
    #[serde(default)]
    layout: LayoutTable,
    #[serde(default)]
    values: ValuesTable,
    volume: VoxelGrid,
    /// The views, if a vendor's files give them.
    #[serde(skip)]
    views: Option<Vec<View>>,
    /// Rows and columns of the detector, if the description states them.
    #[serde(skip)]
    detector: Option<[usize; 2]>,
    /// What makes counts of the numbers in the images.
    #[serde(skip)]
    response: Response,
    /// Warnings for the user.
    #[serde(skip)]
    remarks: Vec<String>,
}

impl Description {
    /// Reads the description `path`, a vendor's or conefield's own.
    fn read(path: &Path) -> Result<Self> {
        if let Some(reader) = vendor::reader(path) {
            return reader(path);
        }
        refuse_images(path)?;
        described(path, FORMAT, VERSION)
    }
}

/// Refuses a folder or a file of images in place of the text that describes them.
fn refuse_images(path: &Path) -> Result<()> {
    let extension = folder::extension(path);
    let found = match &extension[..] {
        _ if path.is_dir() => "a folder".to_owned(),
        "tif" | "tiff" | "npy" | "npz" | "mat" | "mha" | "h5" | "hdf5" | "nxs" => {
            format!("a .{extension} file of projections")
        }
        _ => return foreign::refuse_file(path),
    };
    if path.is_dir() {
        foreign::refuse_folder(path)?;
    }
    let expected = "a text file that describes the scanner and names its projections (docs/guide/scan-in.md)";
    Err(Error::invalid(path.display().to_string(), "SCANNER.toml", found, expected))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Files {
    projections: Names,
    flat: Option<Names>,
    dark: Option<Names>,
}

#[derive(Deserialize, Clone, Copy, Default)]
#[serde(deny_unknown_fields, expecting = "u and v, as in { u = 0.2, v = 0.2 }")]
struct Uv {
    u: f64,
    v: f64,
}

#[derive(Deserialize, Clone, Copy, PartialEq)]
#[serde(rename_all = "lowercase")]
enum Direction {
    Counterclockwise,
    Clockwise,
}

/// Rotations of the detector about u, v and u × v.
#[derive(Deserialize, Clone, Copy, Default)]
#[serde(deny_unknown_fields, default)]
struct TiltTable {
    u: f64,
    v: f64,
    normal: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Circle {
    #[serde(default)]
    beam: Beam,
    dso: Option<f64>,
    dsd: Option<f64>,
    pixel: Uv,
    #[serde(default)]
    offset: Uv,
    #[serde(default)]
    tilt_deg: TiltTable,
    #[serde(default)]
    start_deg: f64,
    step_deg: Option<f64>,
    range_deg: Option<f64>,
    angles_deg: Option<Numbers>,
    direction: Direction,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Vectors {
    cone_vec: Option<Numbers>,
    parallel_vec: Option<Numbers>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Rtk {
    file: String,
    pixel: Uv,
    #[serde(default)]
    offset: Uv,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Cil {
    file: String,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
struct LayoutTable {
    axes: Option<Vec<StackAxis>>,
    flip_rows: bool,
    flip_columns: bool,
}

#[derive(Deserialize, Clone, Copy, Default, PartialEq)]
#[serde(rename_all = "kebab-case")]
enum ValueKind {
    #[default]
    Counts,
    LineIntegrals,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
struct ValuesTable {
    kind: ValueKind,
    i0: Option<I0>,
    floor: Option<f64>,
    flat_includes_dark: Option<bool>,
}

/// Reads the scan described by `path`, a TOML (or JSON) file, whose keys the module's source lists, or the file of a
/// vendor, which takes its place.
///
/// Files are relative to the description's folder and stay in it. Counts require a flat field, `i0` of the description or
/// `i0`, which replaces both; `floor` replaces the description's. The geometry is checked against the shape of the
/// projections.
pub fn read_scanner(path: impl AsRef<Path>, i0: Option<I0>, floor: Option<f64>) -> Result<Stored> {
    let path = path.as_ref();
    let place = path.display().to_string();
    let mut d = Description::read(path)?;
    text::warn(&place, std::mem::take(&mut d.remarks));
    let folder = folder::folder_of(path);
    d.volume.validate(&place)?;
    let layout = layout(&place, &d.layout)?;
    let i0 = open_beam(&place, &d, i0, floor)?;
    let read = |field: &str, part, names: &Names| stack::read_field(folder, &place, field, part, names, layout);
    let field = "files.projections";
    let mut values = stack::read(folder, &place, field, ScanPart::Projections, &d.files.projections, layout)?;
    d.response.apply(&mut values);
    let (count, rows, columns) = values.dim();
    if let Some([r, c]) = d.detector.filter(|found| *found != [rows, columns]) {
        let expected = format!("{r} x {c} (rows x columns), as the detector has");
        return Err(Error::invalid(&place, "files.projections", format!("{rows} x {columns}"), expected));
    }
    let views = views(folder, &place, &d, count)?;
    let geometry = Geometry { detector: [rows, columns], views, volume: d.volume };
    geometry.validate(&place)?;
    let provenance = json!({
        "format": "scanner",
        "file": path.file_name().map(|n| n.to_string_lossy()),
        "projections": d.files.projections,
        "counts": null,
    });
    if d.values.kind == ValueKind::LineIntegrals {
        return straightened(&place, geometry, values, provenance).map(Stored::Scan);
    }
    let open = match i0 {
        Some(I0::Number(n)) => OpenBeam::Number(n),
        Some(I0::Air) => OpenBeam::Air,
        None => {
            let expected = "files.flat, values.i0 or --i0; or values.kind = \"line-integrals\" if they are";
            let lacks = || Error::invalid(&place, "files.flat", "nothing to compare counts with", expected);
            OpenBeam::Flat(read("files.flat", ScanPart::Flat, d.files.flat.as_ref().ok_or_else(lacks)?)?)
        }
    };
    let dark = d.files.dark.as_ref().map(|n| read("files.dark", ScanPart::Dark, n)).transpose()?;
    let open = match (open, &dark, d.values.flat_includes_dark) {
        // The conversion subtracts the dark field again. It also reports fields of different shapes.
        (OpenBeam::Flat(flat), Some(dark), Some(false)) if flat.dim() == dark.dim() => OpenBeam::Flat(flat + dark),
        (open, ..) => open,
    };
    let conversion = Conversion { open, dark, floor: floor.or(d.values.floor) };
    Ok(Stored::Counts(Counts { values, conversion, place, geometry, provenance }))
}

/// The size of the scan that `path` describes. Reordering the values and converting counts take copies.
pub(crate) fn size(path: &Path) -> Result<ScanSize> {
    let place = path.display().to_string();
    let d = Description::read(path)?;
    d.volume.validate(&place)?;
    let folder = folder::folder_of(path);
    let pixels = stack::values(folder, &place, "files.projections", &d.files.projections)?;
    Ok(ScanSize {
        pixels,
        voxels: d.volume.len().unwrap_or(0) as u64,
        test_pixels: 0,
        reading: pixels.saturating_mul(8),
        views: 1,
    })
}

/// The scan of these views. Reverses rows or columns if that turns the views into conefield's own circles, on which rows run down and columns to
/// the right, as the source sees them: code that supports only circles then accepts the scan. RTK's rows run up, Nikon's
/// columns to the left.
fn straightened(place: &str, mut geometry: Geometry, mut projections: Array3<f32>, provenance: Value) -> Result<Scan> {
    let turned = |rows: bool, columns: bool| -> Vec<View> {
        let along = |axis: [f64; 3], reverse: bool| if reverse { axis.map(|x| 0.0 - x) } else { axis };
        geometry.views.iter().map(|w| View { u: along(w.u, columns), v: along(w.v, rows), ..*w }).collect()
    };
    for (rows, columns) in [(false, false), (true, false), (false, true), (true, true)] {
        let views = turned(rows, columns);
        if CircularOrbit::fit(&views).is_none() {
            continue;
        }
        geometry.views = views;
        for (axis, reverse) in [(1, rows), (2, columns)] {
            if reverse {
                projections.invert_axis(Axis(axis));
            }
        }
        projections = memory::in_order(place, "files.projections", projections)?;
        break;
    }
    let scan = Scan { geometry, projections, unit: Unit::default(), provenance };
    scan.validate(place)?;
    Ok(scan)
}

fn layout(place: &str, table: &LayoutTable) -> Result<StackLayout> {
    let all = [StackAxis::View, StackAxis::Row, StackAxis::Column];
    let stated = table.axes.as_deref().unwrap_or(&all);
    let lacked: Vec<StackAxis> = all.into_iter().filter(|a| !stated.contains(a)).collect();
    // Files of images that lack the views are stacked along the first axis.
    let whole = if lacked == [StackAxis::View] { [&lacked, stated] } else { [stated, &lacked] };
    let axes = <[StackAxis; 3]>::try_from(whole.concat()).ok();
    let Some(axes) = axes.filter(|_| lacked.len() < 2) else {
        let expected = "each of \"view\", \"row\" and \"column\" once, or two of them";
        return Err(Error::invalid(place, "layout.axes", format!("{stated:?}"), expected));
    };
    let lacked = lacked.first().copied().unwrap_or(StackAxis::View);
    Ok(StackLayout { axes, lacked, flip_rows: table.flip_rows, flip_columns: table.flip_columns })
}

/// The single open-beam value, or `None` if there is a flat field. Refuses contradictions.
fn open_beam(place: &str, d: &Description, i0: Option<I0>, floor: Option<f64>) -> Result<Option<I0>> {
    let said = d.values.i0;
    let flat = d.files.flat.is_some();
    let found = "a value without both files.flat and files.dark";
    let fits = d.values.flat_includes_dark.is_none() || (flat && d.files.dark.is_some());
    let expected = "both files, or no such value";
    ensure(fits, place, "values.flat_includes_dark", found, expected)?;
    if d.values.kind == ValueKind::LineIntegrals {
        let field = match (flat, d.files.dark.is_some(), said.or(i0), floor.or(d.values.floor)) {
            (true, ..) => "files.flat",
            (_, true, ..) => "files.dark",
            (_, _, Some(_), _) => "values.i0",
            (.., Some(_)) => "values.floor",
            _ => return Ok(None),
        };
        let found = "a value beside values.kind = \"line-integrals\"";
        return Err(Error::invalid(place, field, found, "nothing, or kind = \"counts\""));
    }
    ensure(!(flat && said.is_some()), place, "values.i0", "i0 beside files.flat", "one of them")?;
    if flat && i0.is_some() {
        tracing::info!("{place}: --i0 replaces files.flat, which is not read");
    }
    Ok(i0.or(said))
}

fn views(folder: &Path, place: &str, d: &Description, count: usize) -> Result<Vec<View>> {
    let (field, views) = match (&d.views, &d.circle, &d.vectors, &d.rtk, &d.cil) {
        (Some(views), ..) => ("views", views.clone()),
        (_, Some(c), None, None, None) => ("circle.angles_deg", circle(folder, place, c, &d.volume, count)?),
        (_, None, Some(v), None, None) => vectors(folder, place, v, &d.volume)?,
        (_, None, None, Some(r), None) => {
            lengths(place, "rtk", r.pixel, r.offset)?;
            let file = folder::inside(folder, place, "rtk.file", &r.file)?;
            ("rtk.file", read_rtk_geometry(&file, [r.pixel.v, r.pixel.u], [r.offset.v, r.offset.u])?)
        }
        (_, None, None, None, Some(c)) => {
            ("cil.file", cil::views(&folder::inside(folder, place, "cil.file", &c.file)?)?)
        }
        (_, None, None, None, None) => return Err(Error::invalid(place, "circle", "nothing", GEOMETRIES)),
        _ => return Err(Error::invalid(place, "circle", "several geometries", GEOMETRIES)),
    };
    let expected = format!("{count}, one for each view in the projections");
    ensure(views.len() == count, place, field, format!("{} of them", views.len()), expected)?;
    Ok(views)
}

fn circle(folder: &Path, place: &str, c: &Circle, volume: &VoxelGrid, count: usize) -> Result<Vec<View>> {
    let angles = angles(folder, place, c, count)?;
    let distances = distances(place, c)?;
    lengths(place, "circle", c.pixel, c.offset)?;
    let (pixel, offset) = ([c.pixel.v, c.pixel.u], [c.offset.v, c.offset.u]);
    let tilt = [("u", c.tilt_deg.u), ("v", c.tilt_deg.v), ("normal", c.tilt_deg.normal)];
    for (axis, x) in tilt {
        let fits = x.is_finite() && x.abs() < 90.0;
        ensure(fits, place, &format!("circle.tilt_deg.{axis}"), x, "degrees between -90 and 90")?;
    }
    let tilt = tilt.map(|(_, x)| Radians(x.to_radians()));
    let orbit = match distances {
        Some([dso, dsd]) => CircularOrbit { dso, dsd, pixel, offset, angles },
        None => CircularOrbit::parallel(volume, pixel, offset, angles),
    };
    Ok(orbit.views().into_iter().map(|v| v.tilted(tilt)).collect())
}

/// The field that has them, and the views of ASTRA's vectors.
fn vectors(folder: &Path, place: &str, v: &Vectors, volume: &VoxelGrid) -> Result<(&'static str, Vec<View>)> {
    let (field, rows) = match (&v.cone_vec, &v.parallel_vec) {
        (Some(rows), None) => ("vectors.cone_vec", rows),
        (None, Some(rows)) => ("vectors.parallel_vec", rows),
        (found, _) => {
            let found = if found.is_some() { "both" } else { "nothing" };
            return Err(Error::invalid(place, "vectors", found, "one of cone_vec and parallel_vec"));
        }
    };
    let rows = rows.rows(folder, place, field, VECTOR)?;
    let view = |(i, n): (usize, &Vec<f64>)| {
        let part = |k: usize| [n[k], n[k + 1], n[k + 2]];
        let view = View { source: part(0), detector: part(3), u: part(6), v: part(9) };
        if v.cone_vec.is_some() {
            return Ok(view);
        }
        let long = norm(view.source);
        let expected = "a direction: three finite numbers, not all 0";
        let (found, field) = (format!("{:?}", view.source), format!("{field}[{i}]"));
        ensure(long.is_finite() && long > 0.0, place, &field, found, expected)?;
        Ok(view.parallel(view.source.map(|x| x / long), volume))
    };
    Ok((field, rows.iter().enumerate().map(view).collect::<Result<_>>()?))
}

/// DSO and DSD of a cone beam; `None` for a parallel one.
fn distances(place: &str, c: &Circle) -> Result<Option<[f64; 2]>> {
    if c.beam == Beam::Parallel {
        let said = [("circle.dso", c.dso), ("circle.dsd", c.dsd)].into_iter().find_map(|(field, x)| Some((field, x?)));
        let expected = "no distance: a parallel beam has no source";
        return said.map_or(Ok(None), |(field, x)| Err(Error::invalid(place, field, x, expected)));
    }
    orbit::distances(place, "circle.", [c.dso, c.dsd], "beam = \"parallel\"").map(Some)
}

fn lengths(place: &str, table: &str, pixel: Uv, offset: Uv) -> Result<()> {
    orbit::check_pixel(place, &format!("{table}."), [pixel.v, pixel.u])?;
    for (field, x) in [("offset.u", offset.u), ("offset.v", offset.v)] {
        ensure(x.is_finite(), place, &format!("{table}.{field}"), x, "a finite length in mm")?;
    }
    Ok(())
}

/// The angles in radians.
fn angles(folder: &Path, place: &str, c: &Circle, count: usize) -> Result<Vec<f64>> {
    let from_start: Vec<f64> = match (c.step_deg, c.range_deg, &c.angles_deg) {
        (Some(step), None, None) => (0..count).map(|i| step * i as f64).collect(),
        (None, Some(range), None) => (0..count).map(|i| range * i as f64 / count as f64).collect(),
        (None, None, Some(list)) => list.rows(folder, place, "circle.angles_deg", 1)?.concat(),
        (None, None, None) => {
            let expected = "step_deg, range_deg or angles_deg";
            return Err(Error::invalid(place, "circle.step_deg", "no angles", expected));
        }
        _ => {
            let expected = "one of step_deg, range_deg and angles_deg";
            return Err(Error::invalid(place, "circle.step_deg", "several ways to say the angles", expected));
        }
    };
    let sign = if c.direction == Direction::Clockwise { -1.0 } else { 1.0 };
    Ok(from_start.iter().map(|a| (c.start_deg + sign * a).to_radians()).collect())
}

#[cfg(test)]
mod tests;
