//! Pictures of volumes: middle slices side by side, with differences.

use crate::report::canvas::{Align, Canvas, diverging, grey, number, round_above, write_png};
use crate::report::middle::MiddleSlices;
use crate::report::pixels::Rgb;
use conefield_core::{Error, Result};
use std::ops::Range;
use std::path::Path;

const INK: Rgb = Rgb([20; 3]);
const PAPER: Rgb = Rgb([255; 3]);
/// Width in pixels to which small volumes are enlarged, and maximum width of large ones.
const WIDTH: [f64; 2] = [1000.0, 4000.0];
const GAP: u32 = 8;
/// Maximum columns side by side; more are placed below, so that slices and captions stay legible.
const COLUMNS: usize = 5;

/// A middle slice, named after the axis perpendicular to it.
#[derive(Clone, Copy)]
struct Plane {
    name: &'static str,
    axes: &'static str,
    /// The perpendicular axis, and the two visible axes: to the right and up.
    cut: usize,
    seen: [usize; 2],
}

const AXIAL: Plane = Plane { name: "axial", axes: "x → y ↑", cut: 2, seen: [0, 1] };
const CORONAL: Plane = Plane { name: "coronal", axes: "x → z ↑", cut: 1, seen: [0, 2] };
const SAGITTAL: Plane = Plane { name: "sagittal", axes: "y → z ↑", cut: 0, seen: [1, 2] };
const PLANES: [Plane; 3] = [AXIAL, CORONAL, SAGITTAL];

/// One picture of the grid.
enum Cell<'a> {
    Empty,
    Values(&'a MiddleSlices),
    /// Of a plane of its own.
    Slice(Plane, &'a MiddleSlices),
    /// Result and reference.
    Difference(&'a MiddleSlices, &'a MiddleSlices),
    /// Red, green and blue from 0 to 1.
    Colours([&'a MiddleSlices; 3]),
}

struct Row<'a> {
    plane: Plane,
    /// Text under the plane's name.
    note: &'a str,
    cells: Vec<Cell<'a>>,
}

/// Draws the middle slices of a result: side by side, or with those of `reference` and their difference in rows. A
/// difference is blue below and red above, on a scale that the picture shows.
pub fn result_png(path: impl AsRef<Path>, reference: Option<&MiddleSlices>, result: &MiddleSlices) -> Result<()> {
    let path = path.as_ref();
    if let Some(r) = reference {
        let cells = || vec![Cell::Values(r), Cell::Values(result), Cell::Difference(result, r)];
        let rows = PLANES.map(|plane| Row { plane, note: "", cells: cells() });
        return draw(path, &["reference", "result", "result − reference"], &rows, r.window());
    }
    let captions = PLANES.map(|p| format!("{}  {}", p.name, p.axes));
    let cells = PLANES.map(|p| Cell::Slice(p, result)).into();
    let row = Row { plane: Plane { name: "", axes: "", ..AXIAL }, note: "", cells };
    draw(path, &captions.each_ref().map(String::as_str), &[row], result.window())
}

/// Draws the three middle slices (axial, coronal, sagittal) of every panel side by side, grey from `window[0]` to
/// `window[1]`.
pub fn slices_png(path: impl AsRef<Path>, panels: &[(&str, &MiddleSlices)], window: [f32; 2]) -> Result<()> {
    let (captions, volumes): (Vec<&str>, Vec<&MiddleSlices>) = panels.iter().copied().unzip();
    let rows = PLANES.map(|plane| Row { plane, note: "", cells: volumes.iter().map(|v| Cell::Values(v)).collect() });
    draw(path.as_ref(), &captions, &rows, window)
}

/// Draws results next to a reference, each under its caption (e.g. `NAF 28.1 dB`): axial and coronal middle slices, and
/// below each the result minus the reference.
pub fn compare_png(
    path: impl AsRef<Path>,
    reference: (&str, &MiddleSlices),
    results: &[(&str, &MiddleSlices)],
    window: [f32; 2],
) -> Result<()> {
    let (captions, volumes): (Vec<&str>, Vec<&MiddleSlices>) = [reference].iter().chain(results).copied().unzip();
    let mut rows = Vec::new();
    for plane in [AXIAL, CORONAL] {
        rows.push(Row { plane, note: "", cells: volumes.iter().map(|v| Cell::Values(v)).collect() });
        let differences = volumes[1..].iter().map(|v| Cell::Difference(v, reference.1));
        rows.push(Row { plane, note: "difference", cells: [Cell::Empty].into_iter().chain(differences).collect() });
    }
    draw(path.as_ref(), &captions, &rows, window)
}

/// Draws features as colours beside the attenuation: `colours` are red, green and blue from 0 to 1, or NaN where there
/// is nothing to show.
pub fn features_png(path: impl AsRef<Path>, attenuation: &MiddleSlices, colours: [&MiddleSlices; 3]) -> Result<()> {
    let cells = || vec![Cell::Values(attenuation), Cell::Colours(colours)];
    let rows = PLANES.map(|plane| Row { plane, note: "", cells: cells() });
    draw(path.as_ref(), &["attenuation", "features"], &rows, attenuation.window())
}

/// Bands of columns of nearly equal length, at most [`COLUMNS`] each.
fn bands(columns: usize) -> Vec<Range<usize>> {
    let bands = columns.div_ceil(COLUMNS).max(1);
    let wide = columns.div_ceil(bands).max(1);
    (0..columns).step_by(wide).map(|from| from..(from + wide).min(columns)).collect()
}

fn draw(path: &Path, captions: &[&str], rows: &[Row], window: [f32; 2]) -> Result<()> {
    let place = path.display().to_string();
    if captions.is_empty() {
        return Err(Error::invalid(place, "panels", "none", "at least one volume"));
    }
    if !(window[0].is_finite() && window[1].is_finite() && window[0] < window[1]) {
        let expected = "two finite numbers, the first below the second";
        return Err(Error::invalid(place, "window", format!("{window:?}"), expected));
    }
    for cell in rows.iter().flat_map(|r| &r.cells) {
        check(&place, cell)?;
    }
    let columns = captions.len();
    let bands = bands(columns);
    // Columns at the same position have the same width in every band.
    let wide = bands[0].len();
    let place_mm = |c: usize| most((c..columns).step_by(wide).flat_map(|c| rows.iter().map(move |r| r.size(c)[0])));
    let width_mm: Vec<f64> = (0..wide).map(place_mm).collect();
    let height_mm: Vec<f64> = rows.iter().map(|r| most((0..columns).map(|c| r.size(c)[1]))).collect();
    // At least one voxel per pixel, unless the picture becomes too large.
    let finest = rows.iter().flat_map(|r| &r.cells).filter_map(Cell::volume).flat_map(|v| v.grid.spacing);
    let finest = finest.fold(f64::INFINITY, f64::min);
    let total: f64 = width_mm.iter().sum();
    let tallest: f64 = height_mm.iter().sum::<f64>() * bands.len() as f64;
    let scale = (1.0 / finest).max(WIDTH[0] / total).min(WIDTH[1] / total).min(2.0 * WIDTH[1] / tallest);
    let pixels = |mm: f64| ((mm * scale).round() as u32).max(1);
    let widths: Vec<u32> = width_mm.iter().map(|w| pixels(*w)).collect();
    let heights: Vec<u32> = height_mm.iter().map(|h| pixels(*h)).collect();
    let text = (f64::from(widths.iter().sum::<u32>()) / 60.0).clamp(15.0, 40.0) as f32;

    let spread = difference_spread(rows);
    let named = rows.iter().any(|r| !r.plane.name.is_empty());
    let left = if named { (text * 6.2) as u32 } else { GAP };
    let top = (text * 1.9) as u32;
    let bars = (text * if spread.is_some() { 8.4 } else { 4.6 }) as u32;
    let inner: u32 = heights.iter().map(|h| h + GAP).sum();
    let band = top + inner;
    let width = left + widths.iter().map(|w| w + GAP).sum::<u32>() + bars;
    let mut canvas = Canvas::new(width, (band * bands.len() as u32).max((text * 9.0) as u32), PAPER)?;

    for (n, columns) in bands.into_iter().enumerate() {
        let first = band * n as u32;
        let mut x = left;
        for (c, &wide) in columns.zip(&widths) {
            let at = (x as f32 + wide as f32 / 2.0, first as f32 + text * 0.35);
            let shown = canvas.shortened(captions[c], text, wide as f32);
            canvas.text(at, Align::Middle, text, INK, &shown);
            let mut y = first + top;
            for (row, &height) in rows.iter().zip(&heights) {
                if let Some(cell) = row.cells.get(c) {
                    draw_cell(&mut canvas, [x, y, wide, height], row, cell, scale, window, spread.unwrap_or(1.0));
                }
                y += height + GAP;
            }
            x += wide + GAP;
        }
        let mut y = first + top;
        for (row, &height) in rows.iter().zip(&heights) {
            let middle = y as f32 + height as f32 / 2.0;
            let lines = [row.plane.name, if row.note.is_empty() { row.plane.axes } else { row.note }];
            for (i, line) in lines.iter().enumerate() {
                let at = (left as f32 - text * 0.6, middle + text * (i as f32 * 1.2 - 1.2));
                canvas.text(at, Align::Right, text * if i == 0 { 1.0 } else { 0.85 }, INK, line);
            }
            y += height + GAP;
        }
    }
    let x = left + widths.iter().map(|w| w + GAP).sum::<u32>();
    let bar = [x + (text * 0.5) as u32, top, (text * 0.9) as u32, inner.saturating_sub(GAP)];
    draw_bar(&mut canvas, bar, text, [f64::from(window[0]), f64::from(window[1])], grey);
    if let Some(s) = spread {
        let bar = [bar[0] + (text * 4.0) as u32, bar[1], bar[2], bar[3]];
        draw_bar(&mut canvas, bar, text, [-f64::from(s), f64::from(s)], |t| diverging(2.0 * t - 1.0));
    }
    write_png(path, &canvas.image)
}

fn most(all: impl Iterator<Item = f64>) -> f64 {
    all.fold(0.0, f64::max)
}

fn check(place: &str, cell: &Cell) -> Result<()> {
    let Some(v) = cell.volume() else { return Ok(()) };
    v.grid.validate(place)?;
    let (what, others) = match cell {
        Cell::Difference(_, r) => ("result", vec![*r]),
        Cell::Colours(c) => ("colour", c.to_vec()),
        _ => return Ok(()),
    };
    match others.into_iter().find(|o| o.grid.shape != v.grid.shape) {
        Some(other) => {
            let (found, expected) = (format!("{:?}", v.grid.shape), format!("{:?}", other.grid.shape));
            Err(Error::invalid(place, format!("shape of a {what}"), found, format!("{expected}, the other's")))
        }
        None => Ok(()),
    }
}

impl Cell<'_> {
    fn volume(&self) -> Option<&MiddleSlices> {
        match self {
            Cell::Empty => None,
            Cell::Values(v) | Cell::Slice(_, v) | Cell::Difference(v, _) | Cell::Colours([v, ..]) => Some(v),
        }
    }

    /// The plane that it shows in a row of `plane`.
    fn plane(&self, plane: Plane) -> Plane {
        if let Cell::Slice(own, _) = self { *own } else { plane }
    }
}

impl Row<'_> {
    /// Width and height of a cell in mm.
    fn size(&self, column: usize) -> [f64; 2] {
        let cell = self.cells.get(column);
        let size = cell.and_then(|c| Some((c.plane(self.plane), c.volume()?.grid.size())));
        size.map_or([0.0; 2], |(plane, s)| plane.seen.map(|k| s[k]))
    }
}

/// A round number that bounds all but half a percent of the shown differences; `None` without differences.
fn difference_spread(rows: &[Row]) -> Option<f32> {
    let mut all: Vec<f32> = Vec::new();
    let mut any = false;
    for row in rows {
        for cell in &row.cells {
            if let Cell::Difference(v, r) = cell {
                any = true;
                let d = &v.across[row.plane.cut] - &r.across[row.plane.cut];
                all.extend(d.iter().map(|x| x.abs()).filter(|x| x.is_finite()));
            }
        }
    }
    any.then(|| round_above(all))
}

fn draw_cell(
    canvas: &mut Canvas,
    [x, y, width, height]: [u32; 4],
    row: &Row,
    cell: &Cell,
    scale: f64,
    window: [f32; 2],
    spread: f32,
) {
    let Some(v) = cell.volume() else { return };
    let plane = cell.plane(row.plane);
    // `[right, up]`
    let size = plane.seen.map(|k| (v.grid.size()[k] * scale).round().max(1.0) as u32);
    let (w, h) = (size[0].min(width), size[1].min(height));
    let (x, y) = (x + (width - w) / 2, y + (height - h) / 2);
    let n = v.across[plane.cut].dim();
    // Nearest-neighbour interpolation, so that the picture shows the actual voxels.
    canvas.fill(x, y, w, h, |dx, dy| {
        let i = ((f64::from(dx) + 0.5) / f64::from(w) * n.0 as f64) as usize;
        let j = ((f64::from(h - 1 - dy) + 0.5) / f64::from(h) * n.1 as f64) as usize;
        let at = |v: &MiddleSlices| v.across[plane.cut][[i.min(n.0 - 1), j.min(n.1 - 1)]];
        match cell {
            Cell::Empty => PAPER,
            Cell::Values(v) | Cell::Slice(_, v) => grey((at(v) - window[0]) / (window[1] - window[0])),
            Cell::Difference(v, r) => diverging((at(v) - at(r)) / spread),
            Cell::Colours(c) => mixed(c.map(at)),
        }
    });
}

/// Red, green and blue from 0 to 1; paper colour if one is unknown.
fn mixed(colours: [f32; 3]) -> Rgb {
    if colours.iter().all(|c| c.is_finite()) { Rgb(colours.map(|c| grey(c).0[0])) } else { PAPER }
}

/// A colour bar, lowest value at the bottom, with its ends and middle labelled.
fn draw_bar(
    canvas: &mut Canvas,
    [x, y, width, height]: [u32; 4],
    text: f32,
    ends: [f64; 2],
    colour: impl Fn(f32) -> Rgb,
) {
    let height = height.min((text * 22.0) as u32).max((text * 6.0) as u32);
    canvas.fill(x, y, width, height, |dx, dy| {
        let frame = dx == 0 || dy == 0 || dx + 1 == width || dy + 1 == height;
        if frame { Rgb([90; 3]) } else { colour(1.0 - dy as f32 / height as f32) }
    });
    for (i, value) in [ends[1], (ends[0] + ends[1]) / 2.0, ends[0]].into_iter().enumerate() {
        let at = y as f32 + (height as f32 - text * 0.85) * i as f32 / 2.0;
        canvas.text((x as f32 + width as f32 + text * 0.3, at), Align::Left, text * 0.85, INK, &number(value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::pixels::Pixels;
    use conefield_core::scan::Volume;
    use ndarray::Array3;
    use ndarray::s;

    fn ball(shape: [usize; 3], spacing: [f64; 3], blur: f64) -> MiddleSlices {
        let mut v = Volume::centered(Array3::zeros((shape[0], shape[1], shape[2])), spacing);
        let grid = v.grid;
        for ((x, y, z), value) in v.data.indexed_iter_mut() {
            let p = grid.voxel([x, y, z]);
            let r = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            let off = ((p[0] - 6.0).powi(2) + (p[1] - 8.0).powi(2) + (p[2] - 10.0).powi(2)).sqrt();
            let soft = |d: f64, at: f64| 1.0 / (1.0 + ((d - at) / blur).exp());
            *value = (0.5 * soft(r, 20.0) + 0.4 * soft(off, 5.0)) as f32;
        }
        MiddleSlices::of(&v)
    }

    #[test]
    fn small_volumes_make_a_wide_picture_with_the_right_aspect() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let path = folder.join("slices.png");
        // Thick slices: half as many voxels along z for the same ball.
        let (a, b) = (ball([48, 48, 24], [1.0, 1.0, 2.0], 0.3), ball([48, 48, 24], [1.0, 1.0, 2.0], 1.5));
        result_png(&path, Some(&a), &b).unwrap();
        let image = Pixels::open(&path).unwrap();
        assert!(image.width >= 900, "{}", image.width);
        // Equal sides in mm are equal sides in pixels: three square rows.
        assert!(image.height > 1000 && image.height < 1200, "{}", image.height);
        // The difference contains red and blue.
        assert!(image.colours().any(|p| p.0[0] > 150 && p.0[2] < 120));
        assert!(image.colours().any(|p| p.0[2] > 150 && p.0[0] < 120));
    }

    #[test]
    fn the_planes_of_a_result_alone_stand_side_by_side() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let path = folder.join("alone.png");
        result_png(&path, None, &ball([40, 40, 20], [1.0; 3], 0.5)).unwrap();
        let image = Pixels::open(&path).unwrap();
        // Three of the same width, the axial one twice as high as the others.
        assert!(image.width > 900 && image.height < image.width / 2, "{:?}", (image.width, image.height));
        let black = |x: u32| (0..image.height).filter(|y| image.get(x, *y).0.iter().all(|c| *c < 60)).count();
        let (axial, coronal) = (black(20), black(20 + image.width * 3 / 10));
        assert!(coronal > 50 && axial > coronal * 3 / 2, "{axial} {coronal}");
    }

    #[test]
    fn many_results_stand_in_bands_of_legible_columns() {
        assert_eq!(bands(5), [0..5]);
        assert_eq!(bands(6), [0..3, 3..6]);
        assert_eq!(bands(9), [0..5, 5..9]);
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let blurred: Vec<MiddleSlices> = (0..8).map(|i| ball([24; 3], [2.0; 3], 0.5 + 0.4 * f64::from(i))).collect();
        let names: Vec<String> = (0..8).map(|i| format!("method {i} 2{i}.00 dB")).collect();
        let results: Vec<(&str, &MiddleSlices)> = names.iter().map(|n| &n[..]).zip(&blurred).collect();
        let sizes = [4, 8].map(|n| {
            let path = folder.join(format!("compare{n}.png"));
            compare_png(&path, ("reference", &ball([24; 3], [2.0; 3], 0.3)), &results[..n], [0.0, 1.0]).unwrap();
            let image = Pixels::open(&path).unwrap();
            (image.width, image.height)
        });
        // A second band below the first, with columns of the same width.
        assert_eq!((sizes[1].0, sizes[1].1), (sizes[0].0, 2 * sizes[0].1));
        assert!(sizes[0].0 >= 1000, "{sizes:?}");
        let path = folder.join("slices8.png");
        slices_png(&path, &results, [0.0, 1.0]).unwrap();
        assert!(Pixels::open(&path).unwrap().width >= 1000);
    }

    /// Each axis has a colour, dark in its lower half and bright in its upper one: a corner of a slice tells where it lies.
    #[test]
    fn features_are_drawn_in_colours_beside_the_attenuation_axes_to_the_right_and_up() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("features.png");
        let values = |f: &dyn Fn([usize; 3]) -> f32| {
            MiddleSlices::of(&Volume::centered(Array3::from_shape_fn((8, 8, 8), |(x, y, z)| f([x, y, z])), [1.0; 3]))
        };
        let along = |axis: usize, ends: [f32; 2]| values(&|at| ends[usize::from(at[axis] >= 4)]);
        let (red, green, blue) = (along(0, [0.2, 0.8]), along(1, [0.2, 0.8]), along(2, [0.4, 0.6]));
        features_png(&path, &values(&|at| at.iter().sum::<usize>() as f32), [&red, &green, &blue]).unwrap();
        let image = Pixels::open(&path).unwrap();
        let (dark, bright, low, high) = (51, 204, 102, 153);
        let coloured = |x: u32, y: u32| matches!(image.get(x, y).0, [51 | 204, 51 | 204, 102 | 153]);
        let rows: Vec<u32> = (0..image.height).filter(|y| (0..image.width).any(|x| coloured(x, *y))).collect();
        let cells: Vec<&[u32]> = rows.chunk_by(|a, b| a + 1 == *b).collect();
        assert_eq!(cells.len(), 3);
        // Each slice lies in the upper half of the axis that it cuts. From the upper left corner to the lower right one.
        let axial = [[dark, bright, high], [bright, bright, high], [dark, dark, high], [bright, dark, high]];
        let coronal = [[dark, bright, high], [bright, bright, high], [dark, bright, low], [bright, bright, low]];
        let sagittal = [[bright, dark, high], [bright, bright, high], [bright, dark, low], [bright, bright, low]];
        for (rows, want) in cells.into_iter().zip([axial, coronal, sagittal]) {
            let (top, bottom) = (rows[0], rows[rows.len() - 1]);
            let columns: Vec<u32> = (0..image.width).filter(|x| coloured(*x, top)).collect();
            let (left, right) = (columns[0], columns[columns.len() - 1]);
            let found = [(left, top), (right, top), (left, bottom), (right, bottom)].map(|(x, y)| image.get(x, y).0);
            assert_eq!(found, want);
        }
        // Paper where a colour is not known.
        let nothing = values(&|_| f32::NAN);
        features_png(&path, &red, [&nothing, &green, &blue]).unwrap();
        assert!(!Pixels::open(&path).unwrap().colours().any(|c| matches!(c.0, [_, 51 | 204, 102 | 153])));
        let other = MiddleSlices::of(&Volume::centered(Array3::zeros((8, 8, 9)), [1.0; 3]));
        let e = features_png(&path, &red, [&red, &other, &blue]).unwrap_err().to_string();
        assert!(e.contains("[8, 8, 9]"), "{e}");
    }

    #[test]
    fn slices_gathered_part_by_part_are_those_of_the_whole() {
        let values = Array3::from_shape_fn((3, 4, 5), |(x, y, z)| (100 * x + 10 * y + z) as f32);
        let v = Volume::centered(values, [1.0; 3]);
        let whole = MiddleSlices::of(&v);
        let mut gathered = MiddleSlices::new(v.grid);
        for (x, z) in [(0..2, 0..3), (0..2, 3..5), (2..3, 0..3), (2..3, 3..5)] {
            gathered.gather(&[x.clone(), 0..4, z.clone()], v.data.slice(s![x, .., z]));
        }
        assert_eq!(gathered.across, whole.across);
        assert_eq!(whole.across[1][[2, 4]], 224.0);
    }

    #[test]
    fn wrong_use_is_refused_in_words() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let (a, b) = (ball([4; 3], [1.0; 3], 1.0), ball([5; 3], [1.0; 3], 1.0));
        let refused = |r: Result<()>, word: &str| {
            let e = r.unwrap_err().to_string();
            assert!(e.contains("a.png") && e.contains(word), "{e}");
        };
        refused(slices_png(&path, &[], [0.0, 1.0]), "panels");
        refused(slices_png(&path, &[("a", &a)], [1.0, 1.0]), "window");
        refused(result_png(&path, Some(&a), &b), "shape of a result");
        // A single voxel and a zero difference are handled.
        let dot = MiddleSlices::of(&Volume::centered(Array3::zeros((1, 1, 1)), [1.0; 3]));
        assert_eq!(dot.window(), [0.0, 1.0]);
        result_png(&path, Some(&dot), &dot).unwrap();
    }
}
