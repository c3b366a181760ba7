//! Conversion of raw counts to line integrals: arithmetic only, no files.
//!
//! Beer-Lambert law: of `I0` photons `I = I0·exp(−∫μ dl)` arrive, so that `A = ∫μ dl = −ln(I/I0)`. A detector adds a
//! dark value `d` to its counts, and each pixel has its own gain, which the flat field `f` (a view without object)
//! records: `A = −ln((I − d)/(f − d))`.

use crate::corrections::filling::Filling;
use crate::diagnosis::bad_pixels::{from_fields, outliers};
use crate::diagnosis::border::border_medians;
use crate::diagnosis::quantiles::{middle, quantile};
use conefield_core::error::ensure;
use conefield_core::finite::stray;
use conefield_core::parallel;
use conefield_core::{Error, Result};
use conefield_io::{Conversion, OpenBeam};
use ndarray::{Array2, Array3, ArrayView2, Axis, Zip};
use serde::Serialize;

/// If a larger share of pixels is bad, the fields are wrong, not the detector.
const MOST_BAD: f64 = 0.2;
/// If a larger share of values is clamped, the image is unusable.
const MOST_CLAMPED: f64 = 0.5;

/// Statistics of the conversion.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CountsReport {
    /// Counts of the open beam above dark, `[lowest, median, highest]` over pixels (flat) or views (air).
    pub open_beam: [f64; 3],
    /// The floor used.
    pub floor: f64,
    /// Share of good pixels' values at or below the floor.
    pub clamped: f64,
    /// Dead or hot pixels according to the flat and dark fields.
    pub bad_by_fields: usize,
    /// Pixels that differ from their neighbours in nearly every view.
    pub bad_by_outliers: usize,
    /// Share of pixels interpolated from neighbours: the two above, relative to all pixels.
    pub bad: f64,
}

/// Converts `counts` (`[view, row, column]`) to line integrals in place. Errors name `place`.
///
/// Pixels are bad if the fields show it (response below a tenth or above three times the median, dark value above half
/// the median response) or if they stand out from their neighbours in nine of ten views. They get the mean of the good
/// pixels around them. Refuses fields whose shape differs from the views', values that are not finite, an open beam or
/// a floor that is not positive, more than a fifth bad pixels and more than half clamped values.
pub fn line_integrals(
    counts: Array3<f32>,
    conversion: &Conversion,
    place: &str,
) -> Result<(Array3<f32>, CountsReport)> {
    let mut values = counts;
    let (views, rows, columns) = values.dim();
    let pixels = rows * columns;
    check_counts(place, &values)?;
    let dark = conversion.dark.as_ref();
    if let Some(d) = dark {
        check_field(place, "dark", d, [rows, columns])?;
        parallel::over(values.axis_iter_mut(Axis(0)), |_, mut v| v -= d);
    }
    let response = response(place, conversion, [rows, columns])?;
    let mut open = open_beam(place, conversion, views)?;
    let mut bad = Array2::from_elem((rows, columns), false);
    let from_air = |bad: &_| open_beam_of_air(place, &values, bad);
    if conversion.open == OpenBeam::Air {
        open = from_air(&bad)?;
    }
    let typical = response.as_ref().map_or_else(|| spread(open.clone()).1, |r| middle(r.view()));
    let known = from_fields(response.as_ref().map(|r| r.view()), dark.map(|d| d.view()), typical);
    known.iter().for_each(|&at| bad[at] = true);
    refuse_bad(place, known.len(), pixels)?;
    if conversion.open == OpenBeam::Air && !known.is_empty() {
        open = from_air(&bad)?;
    }
    let (low, mid, high) = spread(response.as_ref().map_or_else(|| open.clone(), |r| good(r, &bad)));
    let floor = conversion.floor.map_or_else(|| (1e-4 * mid).min(1.0), |f| f as f32);
    let expected = format!("above 0 and below the open beam, {mid} counts above dark");
    ensure(floor > 0.0 && floor < mid, place, "floor", floor, expected)?;

    // Without a flat field every pixel has the same response. A dead pixel's response would only produce infinities.
    let response = response.map(|r| r.mapv(|x| x.max(floor))).unwrap_or_else(|| Array2::ones((rows, columns)));
    parallel::over(values.axis_iter_mut(Axis(0)).zip(&open), |_, (mut view, &open)| {
        Zip::from(&mut view).and(&response).for_each(|x, &r| *x = (open * r / x.max(floor)).ln());
    });
    let staying = outliers(values.view(), &bad);
    staying.iter().for_each(|&at| bad[at] = true);
    let count = known.len() + staying.len();
    refuse_bad(place, count, pixels)?;
    let clamped = clamped(&values, &open, &response, &bad, floor);
    let clamped = clamped as f64 / (views as f64 * (pixels - count).max(1) as f64);
    if clamped > MOST_CLAMPED {
        let found = format!("{:.1} % of them at or below {floor} above dark", 100.0 * clamped);
        let expected = "light in most pixels: are these counts, and is the dark field theirs?";
        return Err(Error::invalid(place, "counts", found, expected));
    }
    let filling = Filling::new(&bad).ok_or_else(|| too_bad(place, count, pixels))?;
    parallel::over(values.axis_iter_mut(Axis(0)), |_, v| filling.fill(v));
    let report = CountsReport {
        open_beam: [low, mid, high].map(f64::from),
        floor: floor.into(),
        clamped,
        bad_by_fields: known.len(),
        bad_by_outliers: staying.len(),
        bad: count as f64 / pixels as f64,
    };
    report.log(place);
    Ok((values, report))
}

impl CountsReport {
    fn log(&self, place: &str) {
        let Self { open_beam, floor, clamped, bad_by_fields, bad_by_outliers, .. } = self;
        tracing::info!(
            "{place}: open beam {:.4}; {:.3} % of the values at or below the floor of {}; {} bad pixels \
             ({bad_by_fields} by flat and dark, {bad_by_outliers} as outliers)",
            open_beam[1],
            100.0 * clamped,
            *floor as f32,
            bad_by_fields + bad_by_outliers,
        );
        if *clamped > 0.001 {
            tracing::warn!("{place}: {:.2} % of the values have no light left and are clamped", 100.0 * clamped);
        }
    }
}

fn check_counts(place: &str, counts: &Array3<f32>) -> Result<()> {
    ensure(!counts.is_empty(), place, "counts", format!("{:?}", counts.shape()), "at least one pixel of one view")?;
    match stray(counts) {
        Some(((v, r, c), x)) => Err(Error::invalid(place, format!("counts[{v}, {r}, {c}]"), x, "a finite number")),
        None => Ok(()),
    }
}

/// The flat field minus dark, `[row, column]`, if there is one.
fn response(place: &str, conversion: &Conversion, detector: [usize; 2]) -> Result<Option<Array2<f32>>> {
    let OpenBeam::Flat(flat) = &conversion.open else { return Ok(None) };
    check_field(place, "flat", flat, detector)?;
    Ok(Some(conversion.dark.as_ref().map_or_else(|| flat.clone(), |d| flat - d)))
}

/// The open beam above dark, one number per view: 1 if the flat field has a number per pixel, 0 if it must be estimated
/// from the border.
fn open_beam(place: &str, conversion: &Conversion, views: usize) -> Result<Vec<f32>> {
    match &conversion.open {
        OpenBeam::Flat(_) => Ok(vec![1.0; views]),
        OpenBeam::Number(x) => {
            let above = (x - f64::from(conversion.dark.as_ref().map_or(0.0, |d| middle(d.view())))) as f32;
            ensure(x.is_finite() && above > 0.0, place, "i0", x, "a finite number above the dark value")?;
            Ok(vec![above; views])
        }
        OpenBeam::Air => Ok(vec![0.0; views]),
    }
}

/// The open beam of each view, estimated from its border without the `bad` pixels.
fn open_beam_of_air(place: &str, values: &Array3<f32>, bad: &Array2<bool>) -> Result<Vec<f32>> {
    let expected = "light at the border: with nothing there, give I0 as a number or a flat field";
    let of_view = |(v, view): (usize, ArrayView2<f32>)| {
        let open = quantile(&border_medians(view, |r, c| !bad[[r, c]]), 0.85).unwrap_or(0.0);
        ensure(open > 0.0, place, &format!("air of view {v}"), format!("{open} counts above dark"), expected)?;
        Ok(open)
    };
    values.axis_iter(Axis(0)).enumerate().map(of_view).collect()
}

/// Number of line integrals from counts at or below `floor`, without the `bad` pixels.
fn clamped(values: &Array3<f32>, open: &[f32], response: &Array2<f32>, bad: &Array2<bool>, floor: f32) -> usize {
    let of_view = |(view, &open): (ArrayView2<f32>, &f32)| {
        let mut n = 0usize;
        // Only clamped counts give exactly this value.
        Zip::from(&view)
            .and(response)
            .and(bad)
            .for_each(|&x, &r, &b| n += usize::from(!b && x == (open * r / floor).ln()));
        n
    };
    parallel::map(values.axis_iter(Axis(0)).zip(open), |_, view| of_view(view)).into_iter().sum()
}

fn check_field(place: &str, field: &str, image: &Array2<f32>, want: [usize; 2]) -> Result<()> {
    let expected = format!("{} x {} (rows x columns), as the projections", want[0], want[1]);
    let (rows, columns) = image.dim();
    ensure([rows, columns] == want, place, field, format!("{rows} x {columns}"), expected)?;
    match stray(image) {
        Some(((r, c), x)) => Err(Error::invalid(place, format!("{field}[{r}, {c}]"), x, "a finite number")),
        None => Ok(()),
    }
}

fn good(a: &Array2<f32>, bad: &Array2<bool>) -> Vec<f32> {
    a.iter().zip(bad).filter(|(_, b)| !**b).map(|(x, _)| *x).collect()
}

/// Lowest, median, highest.
fn spread(mut values: Vec<f32>) -> (f32, f32, f32) {
    values.sort_unstable_by(f32::total_cmp);
    let at = |share| quantile(&values, share).unwrap_or(0.0);
    (at(0.0), at(0.5), at(1.0))
}

fn too_bad(place: &str, bad: usize, pixels: usize) -> Error {
    let found = format!("{bad} of {pixels}");
    Error::invalid(
        place,
        "dead and hot pixels",
        found,
        "fewer than a fifth: are flat and dark field those of this scan?",
    )
}

fn refuse_bad(place: &str, bad: usize, pixels: usize) -> Result<()> {
    if bad as f64 > MOST_BAD * pixels as f64 { Err(too_bad(place, bad, pixels)) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth() -> Array3<f32> {
        Array3::from_shape_fn((6, 24, 32), |(v, i, j)| {
            let d = ((i as f32 - 11.5) / 8.0).powi(2) + ((j as f32 - 15.5 - v as f32) / 8.0).powi(2);
            2.0 * (1.0 - d).max(0.0)
        })
    }

    fn flat() -> Array2<f32> {
        Array2::from_shape_fn((24, 32), |(i, j)| 20000.0 - 100.0 * (i + j) as f32 + 110.0)
    }

    fn counts(a: &Array3<f32>, flat: &Array2<f32>, dark: f32) -> Array3<f32> {
        Array3::from_shape_fn(a.dim(), |(v, i, j)| dark + (flat[[i, j]] - dark) * (-a[[v, i, j]]).exp())
    }

    fn worst(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
        a.iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn every_way_to_say_the_open_beam_gives_the_line_integrals() {
        let a = truth();
        let dark = Some(Array2::from_elem((24, 32), 110.0));
        let fields = Conversion { open: OpenBeam::Flat(flat()), dark: dark.clone(), floor: None };
        let (found, report) = line_integrals(counts(&a, &flat(), 110.0), &fields, "t").unwrap();
        assert!(worst(&found, &a) < 1e-5);
        assert_eq!((report.clamped, report.bad, report.floor), (0.0, 0.0, 1.0));
        assert_eq!(report.open_beam, [14600.0, 17300.0, 20000.0]);
        let even = Array2::from_elem((24, 32), 5000.0);
        for open in [OpenBeam::Number(5000.0), OpenBeam::Air] {
            let c = Conversion { open, dark: dark.clone(), floor: None };
            let (found, report) = line_integrals(counts(&a, &even, 110.0), &c, "t").unwrap();
            assert!(worst(&found, &a) < 1e-5 && report.open_beam[1] == 4890.0, "{c:?} {report:?}");
            // A pixel that is hot in the dark field.
            let mut hot = Conversion { dark: dark.clone(), ..c };
            hot.dark.as_mut().unwrap()[[0, 9]] = 4000.0;
            let (found, report) = line_integrals(counts(&a, &even, 110.0), &hot, "t").unwrap();
            assert!(worst(&found, &a) < 1e-5 && report.bad_by_fields == 1, "{hot:?} {report:?}");
        }
        // Intensities of 0 to 1.
        let c = Conversion { open: OpenBeam::Number(1.0), dark: None, floor: None };
        let (found, report) = line_integrals(a.mapv(|x| (-x).exp()), &c, "t").unwrap();
        assert!(worst(&found, &a) < 1e-5 && (report.floor - 1e-4).abs() < 1e-9);
    }

    #[test]
    fn bad_pixels_are_filled_and_starved_ones_clamped() {
        let a = truth();
        let mut f = flat();
        let mut raw = counts(&a, &f, 110.0);
        // Dead in the flat field and in the views; stuck in the views alone; no light in one view.
        f[[3, 4]] = 111.0;
        raw.slice_mut(ndarray::s![.., 3, 4]).fill(110.0);
        raw.slice_mut(ndarray::s![.., 20, 30]).fill(60000.0);
        raw[[2, 11, 17]] = 90.0;
        let dark = Some(Array2::from_elem((24, 32), 110.0));
        let c = Conversion { open: OpenBeam::Flat(f), dark, floor: Some(2.0) };
        let (found, report) = line_integrals(raw, &c, "t").unwrap();
        assert_eq!((report.bad_by_fields, report.bad_by_outliers), (1, 1));
        assert!((report.bad - 2.0 / 768.0).abs() < 1e-12);
        assert!((report.clamped - 1.0 / (6.0 * 766.0)).abs() < 1e-12, "{report:?}");
        let top = found[[2, 11, 17]];
        assert!((top - ((20000.0f32 - 2800.0) / 2.0).ln()).abs() < 1e-4, "{top}");
        for v in 0..6 {
            for at in [[v, 3, 4], [v, 20, 30]] {
                assert!((found[at] - a[at]).abs() < 0.02, "{at:?} {} {}", found[at], a[at]);
            }
        }
    }

    #[test]
    fn what_cannot_be_is_refused_in_words() {
        let refused = |raw: Array3<f32>, c: Conversion, words: &[&str]| {
            let e = line_integrals(raw, &c, "s.toml").unwrap_err().to_string();
            assert!(e.contains("s.toml") && words.iter().all(|w| e.contains(w)), "{words:?} are not all in: {e}");
        };
        let raw = || counts(&truth(), &flat(), 110.0);
        let with = |open| Conversion { open, dark: None, floor: None };
        let shape = Array2::zeros((24, 31));
        refused(raw(), with(OpenBeam::Flat(shape.clone())), &["flat", "24 x 31", "24 x 32"]);
        refused(raw(), Conversion { dark: Some(shape), ..with(OpenBeam::Air) }, &["dark", "24 x 31", "24 x 32"]);
        let mut nan = flat();
        nan[[1, 2]] = f32::NAN;
        refused(raw(), with(OpenBeam::Flat(nan)), &["flat[1, 2]", "NaN"]);
        let mut odd = raw();
        odd[[1, 2, 3]] = f32::INFINITY;
        refused(odd, with(OpenBeam::Air), &["counts[1, 2, 3]", "inf"]);
        for i0 in [0.0, -5.0, f64::NAN, f64::INFINITY] {
            refused(raw(), with(OpenBeam::Number(i0)), &["i0", "above the dark value"]);
        }
        let zero = || Array3::zeros((6, 24, 32));
        refused(zero(), with(OpenBeam::Flat(flat())), &["100.0 %", "light in most pixels"]);
        refused(zero(), with(OpenBeam::Number(1e4)), &["100.0 %", "light in most pixels"]);
        refused(zero(), with(OpenBeam::Air), &["air of view 0", "light at the border"]);
        refused(raw(), with(OpenBeam::Flat(Array2::zeros((24, 32)))), &["floor", "open beam"]);
        let swapped = Conversion { dark: Some(flat()), ..with(OpenBeam::Flat(Array2::from_elem((24, 32), 110.0))) };
        refused(raw(), swapped, &["s.toml"]);
        for floor in [0.0, -1.0, f64::NAN, 1e9] {
            refused(raw(), Conversion { floor: Some(floor), ..with(OpenBeam::Flat(flat())) }, &["floor", "above 0"]);
        }
        refused(Array3::zeros((0, 4, 4)), with(OpenBeam::Air), &["at least one pixel"]);
    }
}
