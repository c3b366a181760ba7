//! Part of a scan: some views, a piece of the detector, rotated images, larger pixels. The geometry is adapted.

use conefield_core::error::ensure;
use conefield_core::geometry::norm;
use conefield_core::scan::Scan;
use conefield_core::{Error, Result};
use ndarray::{Axis, s};
use std::collections::HashSet;
use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// Some of the views, by index from 0.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ViewChoice {
    /// Every n-th view, starting with the first.
    Every(usize),
    /// First, last and step of each range, in order.
    Pieces(Vec<[usize; 3]>),
}

impl FromStr for ViewChoice {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let form = "expected view numbers from 0, such as 3,7,9 or 0-719:10 (0 to 719 in steps of 10), or every:10";
        if let Some(k) = text.strip_prefix("every:") {
            return k.parse().ok().filter(|k| *k > 0).map(Self::Every).ok_or_else(|| form.to_owned());
        }
        let number = |text: &str| text.trim().parse::<usize>().ok();
        let piece = |text: &str| {
            let (range, step) = match text.split_once(':') {
                Some((range, step)) => (range, number(step)?),
                None => (text, 1),
            };
            let (first, last) = match range.split_once('-') {
                Some((first, last)) => (number(first)?, number(last)?),
                None => (number(range)?, number(range)?),
            };
            (step > 0 && first <= last).then_some([first, last, step])
        };
        let pieces: Option<Vec<_>> = text.split(',').map(piece).collect();
        pieces.map(Self::Pieces).ok_or_else(|| form.to_owned())
    }
}

impl fmt::Display for ViewChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Every(k) => write!(f, "every:{k}"),
            Self::Pieces(pieces) => {
                let text = |&[first, last, step]: &[usize; 3]| match (first == last, step) {
                    (true, _) => first.to_string(),
                    (_, 1) => format!("{first}-{last}"),
                    _ => format!("{first}-{last}:{step}"),
                };
                f.write_str(&pieces.iter().map(text).collect::<Vec<_>>().join(","))
            }
        }
    }
}

impl ViewChoice {
    /// The indices, out of `n` views. Refuses an index beyond the last and a repeated one.
    pub fn of(&self, n: usize) -> Result<Vec<usize>> {
        let refused = |found: String, expected: String| Err(Error::invalid("command line", "--views", found, expected));
        let pieces = match self {
            Self::Every(k) => return Ok((0..n).step_by(*k).collect()),
            Self::Pieces(pieces) => pieces,
        };
        if let Some(last) =
            pieces.iter().map(|&[first, last, step]| last - (last - first) % step).find(|last| *last >= n)
        {
            return refused(
                format!("{self}, which includes view {last}"),
                format!("numbers below {n}, the views of the scan"),
            );
        }
        let all: Vec<usize> = pieces.iter().flat_map(|&[first, last, step]| (first..=last).step_by(step)).collect();
        let mut seen = HashSet::new();
        match all.iter().find(|v| !seen.insert(**v)) {
            Some(twice) => refused(format!("{self}, which repeats view {twice}"), "each view once".into()),
            None => Ok(all),
        }
    }
}

/// A range of detector rows or columns, as NumPy's slices: the end is excluded, and a negative number counts from the
/// end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lines {
    from: Option<i64>,
    to: Option<i64>,
}

impl FromStr for Lines {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let form = || "expected FROM:TO, such as 100:900, 50: or 10:-10 (the end is left out)".to_owned();
        let end = |text: &str| match text.trim() {
            "" => Ok(None),
            n => n.parse::<i64>().map(Some).map_err(|_| form()),
        };
        let (from, to) = text.split_once(':').ok_or_else(form)?;
        Ok(Self { from: end(from)?, to: end(to)? })
    }
}

impl fmt::Display for Lines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let end = |n: Option<i64>| n.map_or(String::new(), |n| n.to_string());
        write!(f, "{}:{}", end(self.from), end(self.to))
    }
}

impl Lines {
    /// The range, out of `n` lines. Unlike in NumPy, ends beyond the detector and an empty range are refused.
    fn of(self, option: &str, n: usize) -> Result<Range<usize>> {
        let place = |end: i64| if end < 0 { end.saturating_add(n as i64) } else { end };
        let (from, to) = (self.from.map_or(0, place), self.to.map_or(n as i64, place));
        let fits = 0 <= from && from < to && to <= n as i64;
        let expected = format!("at least one, and none beyond the {n} that the detector has");
        ensure(fits, "command line", option, self, expected)?;
        Ok(from as usize..to as usize)
    }
}

/// How larger pixels average.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mean {
    /// Mean of line integrals.
    LineIntegrals,
    /// Mean of the transmitted share of the beam, exp(−A), as a larger pixel would measure it.
    Light,
}

/// The part of a scan to keep. Order: views, rotated and flipped images, a piece of them, larger pixels.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Selection {
    /// The views; all if `None`.
    pub views: Option<ViewChoice>,
    /// Quarter turns of the images, as NumPy's `rot90`: from rows to columns, counterclockwise in printed arrays. Like
    /// the flips, this describes the order of pixels in the file: source and detector stay, and so do u along columns
    /// and v along rows.
    pub turns: u8,
    /// Whether the first row becomes the last.
    pub flip_rows: bool,
    /// Whether the first column becomes the last.
    pub flip_columns: bool,
    /// The rows; all if `None`.
    pub rows: Option<Lines>,
    /// The columns; all if `None`.
    pub columns: Option<Lines>,
    /// Side of a new pixel in the remaining old ones; 0 and 1 change nothing. A detector with fewer rows than that is
    /// binned along its columns. Lines at the end that fill no pixel are dropped.
    pub bin: usize,
}

impl Selection {
    /// The part of `scan`.
    pub fn of(&self, scan: Scan) -> Result<Scan> {
        self.take(scan, Mean::LineIntegrals)
    }

    /// Applies the selection's detector part to all views.
    pub fn of_detector(&self, scan: Scan) -> Result<Scan> {
        Self { views: None, ..self.clone() }.of(scan)
    }

    pub(crate) fn take(&self, mut scan: Scan, mean: Mean) -> Result<Scan> {
        if let Some(views) = &self.views {
            let chosen = views.of(scan.geometry.views.len())?;
            scan.geometry.views = chosen.iter().map(|&v| scan.geometry.views[v]).collect();
            scan.projections = scan.projections.select(Axis(0), &chosen);
        }
        self.turn(&mut scan);
        let [rows, columns] = scan.geometry.detector;
        let lines = |lines: Option<Lines>, option, n| lines.map_or(Ok(0..n), |l| l.of(option, n));
        crop(&mut scan, lines(self.rows, "--rows", rows)?, lines(self.columns, "--columns", columns)?);
        if self.bin <= 1 {
            return Ok(scan);
        }
        let [rows, columns] = scan.geometry.detector;
        let most = rows.max(columns);
        let room = format!("at most {most}, the detector's longer side");
        ensure(self.bin <= most, "command line", "--bin", self.bin, room)?;
        if mean == Mean::LineIntegrals {
            return Ok(scan.binned(self.bin));
        }
        scan.projections.par_mapv_inplace(|a| (-a).exp());
        let mut binned = scan.binned(self.bin);
        binned.projections.par_mapv_inplace(|t| 0.0 - t.max(f32::MIN_POSITIVE).ln());
        Ok(binned)
    }

    /// Rotates and flips the images.
    fn turn(&self, scan: &mut Scan) {
        let turns = self.turns % 4;
        if turns == 0 && !self.flip_rows && !self.flip_columns {
            return;
        }
        let mut images = scan.projections.view();
        // A quarter turn: rows and columns are exchanged, then the first row becomes the last.
        for _ in 0..turns {
            images.swap_axes(1, 2);
            images.invert_axis(Axis(1));
        }
        for (flip, axis) in [(self.flip_rows, 1), (self.flip_columns, 2)] {
            if flip {
                images.invert_axis(Axis(axis));
            }
        }
        scan.projections = images.as_standard_layout().into_owned();
        if turns % 2 == 1 {
            let g = &mut scan.geometry;
            g.detector.reverse();
            for view in &mut g.views {
                // A wide pixel becomes a high one.
                let times = norm(view.v) / norm(view.u);
                view.u = view.u.map(|x| x * times);
                view.v = view.v.map(|x| x / times);
            }
        }
    }
}

/// Crops the detector, which moves its centre.
fn crop(scan: &mut Scan, rows: Range<usize>, columns: Range<usize>) {
    let detector = scan.geometry.detector;
    let piece = [rows.len(), columns.len()];
    if piece == detector {
        return;
    }
    let middle = |range: &Range<usize>| (range.start + range.end) as f64 / 2.0 - 0.5;
    let (row, column) = (middle(&rows), middle(&columns));
    for view in &mut scan.geometry.views {
        view.detector = view.pixel(detector, row, column);
    }
    scan.geometry.detector = piece;
    scan.projections = scan.projections.slice(s![.., rows, columns]).as_standard_layout().into_owned();
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
    use conefield_core::scan::Unit;
    use ndarray::Array3;

    /// Eight views of 6 rows and 8 columns, each pixel with its own number; pixels are not square.
    fn scan() -> Scan {
        let mm = Millimetres;
        let view = |i: u8| {
            View::circular(Radians(f64::from(i)), mm(100.0), mm(150.0), [mm(2.0), mm(1.0)], [mm(3.0), mm(-1.0)])
        };
        let geometry = Geometry {
            detector: [6, 8],
            views: (0..8).map(view).collect(),
            volume: VoxelGrid { shape: [4; 3], spacing: [1.0; 3], center: [0.0; 3] },
        };
        let projections = Array3::from_shape_fn((8, 6, 8), |(v, r, c)| (100 * v + 10 * r + c) as f32 / 97.0);
        Scan { geometry, projections, unit: Unit::default(), provenance: serde_json::Value::Null }
    }

    fn choice(text: &str) -> ViewChoice {
        text.parse().unwrap()
    }

    #[test]
    fn views_are_named_in_words() {
        assert_eq!(choice("0-719:10").of(720).unwrap(), (0..720).step_by(10).collect::<Vec<_>>());
        assert_eq!(choice("0-6:3").of(8).unwrap(), [0, 3, 6]);
        assert_eq!(choice("0-6:10").of(6).unwrap(), [0]);
        assert_eq!(choice("9, 3,7").of(10).unwrap(), [9, 3, 7]);
        assert_eq!(choice("5,0-2").of(6).unwrap(), [5, 0, 1, 2]);
        assert_eq!(choice("every:3").of(8).unwrap(), [0, 3, 6]);
        for (text, again) in [("0-719:10", "0-719:10"), ("9,3-3,4-5", "9,3,4-5"), ("every:2", "every:2")] {
            assert_eq!(choice(text).to_string(), again);
        }
        for text in ["", "a", "3-1", "0-9:0", "every:0", "every:", "-1", "1,,2", "0-9:", "1:2:3"] {
            assert!(text.parse::<ViewChoice>().is_err(), "{text}");
        }
        let e = choice("0-8").of(8).unwrap_err().to_string();
        assert!(e.contains("--views") && e.contains("0-8") && e.contains("below 8"), "{e}");
        let e = choice("1,0-2").of(8).unwrap_err().to_string();
        assert!(e.contains("repeats view 1"), "{e}");
    }

    #[test]
    fn lines_are_those_of_numpy() {
        let lines = |text: &str| text.parse::<Lines>().unwrap().of("--rows", 10);
        for (text, want) in [("2:5", 2..5), (":", 0..10), ("-3:", 7..10), (":-2", 0..8), ("1:-1", 1..9)] {
            assert_eq!(lines(text).unwrap(), want, "{text}");
        }
        for text in ["5:5", "7:2", "0:11", "-11:", "10:"] {
            let e = lines(text).unwrap_err().to_string();
            assert!(e.contains("--rows") && e.contains(text) && e.contains("10"), "{e}");
        }
        for text in ["5", "a:b", "1:2:3", ""] {
            assert!(text.parse::<Lines>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_part_is_the_slice_of_the_array_and_its_pixels_stand_where_they_stood() {
        let whole = scan();
        let selection = Selection {
            views: Some(choice("1-7:2")),
            rows: Some("1:5".parse().unwrap()),
            columns: Some("2:-1".parse().unwrap()),
            ..Selection::default()
        };
        let part = selection.of(whole.clone()).unwrap();
        part.validate("part").unwrap();
        assert_eq!(part.projections, whole.projections.slice(s![1..8;2, 1..5, 2..7]));
        assert_eq!(part.geometry.views.len(), 4);
        for (n, v) in [1, 3, 5, 7].into_iter().enumerate() {
            let (a, b) = (&part.geometry.views[n], &whole.geometry.views[v]);
            assert_eq!((a.source, a.u, a.v), (b.source, b.u, b.v));
            let (here, there) = (a.pixel([4, 5], 3.0, 0.0), b.pixel([6, 8], 4.0, 2.0));
            assert!((0..3).all(|k| (here[k] - there[k]).abs() < 1e-12), "{here:?} {there:?}");
        }
        let all = Selection::default().of(whole.clone()).unwrap();
        assert_eq!((all.projections, all.geometry), (whole.projections, whole.geometry));
    }

    #[test]
    fn images_are_turned_as_by_rot90() {
        let whole = scan();
        // np.rot90(image)[i, j] is image[j, columns − 1 − i].
        let turned = Selection { turns: 1, ..Selection::default() }.of(whole.clone()).unwrap();
        turned.validate("turned").unwrap();
        assert_eq!(turned.geometry.detector, [8, 6]);
        for (at, x) in turned.projections.indexed_iter() {
            assert_eq!(*x, whole.projections[[at.0, at.2, 7 - at.1]]);
        }
        let view = turned.geometry.views[3];
        assert!((norm(view.u) - 2.0).abs() < 1e-12 && (norm(view.v) - 1.0).abs() < 1e-12);
        assert_eq!(view.detector, whole.geometry.views[3].detector);
        let back = Selection { turns: 3, ..Selection::default() }.of(turned).unwrap();
        assert_eq!(back.projections, whole.projections);
        let half = Selection { turns: 2, ..Selection::default() }.of(whole.clone()).unwrap();
        let flips = Selection { flip_rows: true, flip_columns: true, ..Selection::default() };
        assert_eq!(half.projections, flips.of(whole.clone()).unwrap().projections);
        assert_eq!(half.projections, whole.projections.slice(s![.., ..;-1, ..;-1]));
    }

    #[test]
    fn larger_pixels_hold_means_of_what_they_saw() {
        let whole = scan();
        let bin = Selection { bin: 2, ..Selection::default() };
        assert_eq!(bin.of(whole.clone()).unwrap().projections, whole.binned(2).projections);
        // The mean of light and darkness is half the light, not the mean of their logarithms.
        let mut two = whole.clone();
        two.projections.indexed_iter_mut().for_each(|((_, _, c), x)| *x = if c % 2 == 0 { 0.0 } else { 10.0 });
        let light = bin.take(two, Mean::Light).unwrap().projections[[0, 0, 0]];
        assert!((light - 2f32.ln()).abs() < 1e-3, "{light}");
        // A detector with fewer rows is binned along its columns.
        let mut one = whole.clone();
        one.geometry.detector[0] = 1;
        one.projections = whole.projections.slice(ndarray::s![.., ..1, ..]).to_owned();
        let binned = bin.of(one.clone()).unwrap();
        assert_eq!(binned.geometry.detector, [1, one.geometry.detector[1] / 2]);
        let mean = 0.5 * (one.projections[[0, 0, 0]] + one.projections[[0, 0, 1]]);
        assert!((binned.projections[[0, 0, 0]] - mean).abs() < 1e-6);
        assert_eq!(binned.geometry.views[0].v, one.geometry.views[0].v);
        let too_large = Selection { bin: 99, ..Selection::default() }.of(whole).unwrap_err().to_string();
        assert!(too_large.contains("--bin") && too_large.contains("the detector's longer side"), "{too_large}");
    }
}
