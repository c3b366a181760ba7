//! Line plots: quality against time, loss against step.

use crate::report::canvas::{number, write_png};
use crate::report::pixels::{Pixels, Rgb};
use conefield_core::{Error, Result};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};
use std::ops::Range;
use std::path::Path;
use std::sync::Once;

/// Options of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct CurveOptions {
    /// Areas around series, in their colours: the name of the series, then x with the lowest and highest y.
    pub bands: Vec<(String, Vec<Band>)>,
    /// A logarithmic x axis; points at zero or below are omitted.
    pub log_x: bool,
    /// A logarithmic y axis; points at zero or below are omitted.
    pub log_y: bool,
    /// Share of the x axis left free on either side.
    pub x_margin: f64,
    /// Width and height in pixels.
    pub size: [u32; 2],
}

/// `(x, [lowest y, highest y])`
pub type Band = (f64, [f64; 2]);

impl Default for CurveOptions {
    fn default() -> Self {
        Self { bands: vec![], log_x: false, log_y: false, x_margin: 0.0, size: [1200, 800] }
    }
}

/// The first eight are distinguishable with all but the rarest colour vision, and in grey (after Okabe and Ito).
pub(crate) const COLOURS: [RGBColor; 10] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    RGBColor(150, 150, 40),
    RGBColor(110, 60, 170),
    RGBColor(120, 70, 30),
];

pub(crate) const FONT: &str = "sans-serif";

/// Draws named series of `(x, y)` points as lines. Non-finite points leave a gap. Series with the same name share a
/// colour. The legend is in the emptiest corner.
pub fn curves_png(
    path: impl AsRef<Path>,
    title: &str,
    labels: [&str; 2],
    series: &[(String, Vec<(f64, f64)>)],
    options: &CurveOptions,
) -> Result<()> {
    panels_png(path, &[Panel { title, labels, series, options }])
}

/// One of several plots.
pub struct Panel<'a> {
    /// Its title.
    pub title: &'a str,
    /// Labels of the x axis and the y axis.
    pub labels: [&'a str; 2],
    /// See [`curves_png`].
    pub series: &'a [(String, Vec<(f64, f64)>)],
    /// Its options.
    pub options: &'a CurveOptions,
}

/// Draws plots side by side in one picture, as high as the highest of them.
pub fn panels_png(path: impl AsRef<Path>, panels: &[Panel<'_>]) -> Result<()> {
    let path = path.as_ref();
    let place = path.display().to_string();
    for panel in panels {
        let [width, height] = panel.options.size;
        if !(200..=10_000).contains(&width) || !(150..=10_000).contains(&height) {
            let expected = "200 to 10000 by 150 to 10000 pixels";
            return Err(Error::invalid(place, "size", format!("{:?}", panel.options.size), expected));
        }
    }
    let width: u32 = panels.iter().map(|p| p.options.size[0]).sum();
    let height = panels.iter().map(|p| p.options.size[1]).max().unwrap_or(0);
    register();
    let mut picture = Pixels::new(width, height, Rgb([255; 3]));
    {
        let mut area = BitMapBackend::with_buffer(&mut picture.bytes, (width, height)).into_drawing_area();
        for panel in panels {
            let (left, right) = area.split_horizontally(panel.options.size[0]);
            panel.draw(&place, &left)?;
            area = right;
        }
    }
    write_png(path, &picture)
}

pub(crate) type Area<'a> = DrawingArea<BitMapBackend<'a>, Shift>;
pub(crate) type Chart<'a, 'b> = ChartContext<'a, BitMapBackend<'b>, Cartesian2d<Axis, Axis>>;

/// An axis of either kind: with one type, drawing is compiled once.
pub(crate) enum Axis {
    Even(RangedCoordf64),
    Logarithmic(LogCoord<f64>),
}

impl Axis {
    pub fn new(range: Range<f64>, log: bool) -> Self {
        if log { Self::Logarithmic(range.log_scale().into()) } else { Self::Even(range.into()) }
    }
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        match self {
            Self::Even(axis) => axis.map(value, limit),
            Self::Logarithmic(axis) => axis.map(value, limit),
        }
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        match self {
            Self::Even(axis) => axis.key_points(hint),
            Self::Logarithmic(axis) => axis.key_points(hint),
        }
    }

    fn range(&self) -> Range<f64> {
        match self {
            Self::Even(axis) => axis.range(),
            Self::Logarithmic(axis) => axis.range(),
        }
    }
}

/// Drawing; an error is text.
pub(crate) type Drawn = Result<(), String>;

pub(crate) fn text_of<E: std::error::Error + Send + Sync>(e: DrawingAreaErrorKind<E>) -> String {
    e.to_string()
}

impl CurveOptions {
    /// Whether the axes can show the point.
    fn shows(&self, p: &(f64, f64)) -> bool {
        let fits = |v: f64, log: bool| v.abs() < 1e100 && (!log || v > 1e-100);
        fits(p.0, self.log_x) && fits(p.1, self.log_y)
    }
}

impl Panel<'_> {
    fn draw(&self, place: &str, area: &Area<'_>) -> Result<()> {
        let Self { series, options, .. } = *self;
        let all: Vec<(f64, f64)> = series.iter().flat_map(|(_, s)| s).copied().filter(|p| options.shows(p)).collect();
        if all.is_empty() {
            let expected = "at least one finite point (above zero on a logarithmic axis)";
            return Err(Error::invalid(place, "series", format!("{} without a point to draw", series.len()), expected));
        }
        let x = range(all.iter().map(|p| p.0), options.log_x, options.x_margin);
        let edges = options.bands.iter().flat_map(|(_, b)| b).flat_map(|(x, ys)| ys.map(|y| (*x, y)));
        let y = range(all.iter().copied().chain(edges.filter(|p| options.shows(p))).map(|p| p.1), options.log_y, 0.05);
        let corner = emptiest(&all, &x, &y, options);
        let drawn = self.draw_on(area, Axis::new(x, options.log_x), Axis::new(y, options.log_y), corner);
        drawn.map_err(|e| Error::invalid(place, "plot", e, "a series that can be drawn"))
    }

    fn draw_on(&self, area: &Area<'_>, x: Axis, y: Axis, corner: SeriesLabelPosition) -> Drawn {
        let em = self.em();
        area.fill(&WHITE).map_err(text_of)?;
        let mut chart = ChartBuilder::on(area)
            .caption(self.title, (FONT, em * 1.3))
            .margin(em)
            .x_label_area_size(em * 3.0)
            .y_label_area_size(em * 4.6)
            .build_cartesian_2d(x, y)
            .map_err(text_of)?;
        chart
            .configure_mesh()
            .x_desc(self.labels[0])
            .y_desc(self.labels[1])
            .axis_desc_style((FONT, em))
            .label_style((FONT, em * 0.85))
            .x_label_formatter(&|v| number(*v))
            .y_label_formatter(&|v| number(*v))
            .x_labels(9)
            .y_labels(9)
            .bold_line_style(BLACK.mix(0.15))
            .light_line_style(BLACK.mix(0.04))
            .draw()
            .map_err(text_of)?;
        self.bands(&mut chart)?;
        self.lines(&mut chart)?;
        chart
            .configure_series_labels()
            .position(corner)
            .margin((em * 0.8) as u32)
            .legend_area_size((em * 2.0) as u32)
            .label_font((FONT, em * 0.9))
            .background_style(WHITE.mix(0.85))
            .border_style(BLACK.mix(0.4))
            .draw()
            .map_err(text_of)?;
        area.present().map_err(text_of)
    }

    /// The font's size in pixels.
    fn em(&self) -> f64 {
        (f64::from(self.options.size[0].min(self.options.size[1] * 3 / 2)) / 55.0).clamp(12.0, 60.0)
    }

    /// The colour of a series: that of the first one with its name.
    fn colour(&self, name: &str) -> RGBColor {
        let mut names: Vec<&str> = vec![];
        for (name, _) in self.series {
            if !names.contains(&&name[..]) {
                names.push(name);
            }
        }
        COLOURS[names.iter().position(|n| *n == name).unwrap_or(0) % COLOURS.len()]
    }

    fn bands(&self, chart: &mut Chart<'_, '_>) -> Drawn {
        for (name, band) in &self.options.bands {
            for part in band.split(|(x, ys)| !ys.iter().all(|y| self.options.shows(&(*x, *y)))).filter(|b| b.len() > 1)
            {
                let above = part.iter().map(|(x, ys)| (*x, ys[1]));
                let outline: Vec<(f64, f64)> = part.iter().map(|(x, ys)| (*x, ys[0])).chain(above.rev()).collect();
                chart.draw_series([Polygon::new(outline, self.colour(name).mix(0.18))]).map_err(text_of)?;
            }
        }
        Ok(())
    }

    fn lines(&self, chart: &mut Chart<'_, '_>) -> Drawn {
        let em = self.em();
        let (stroke, length) = (((em / 8.0).round() as u32).max(2), (em * 1.6) as i32);
        let mut seen: Vec<&str> = vec![];
        for (name, points) in self.series {
            let colour = self.colour(name);
            let style = colour.stroke_width(stroke);
            let mut named = seen.contains(&&name[..]);
            seen.push(name);
            for part in points.split(|p| !self.options.shows(p)).filter(|p| !p.is_empty()) {
                // A line through a single point would be invisible.
                if let [p] = part {
                    chart.draw_series([Circle::new(*p, stroke as i32 + 1, colour.filled())]).map_err(text_of)?;
                }
                let drawn = chart.draw_series(LineSeries::new(part.iter().copied(), style)).map_err(text_of)?;
                if !named {
                    drawn.label(name).legend(move |(x, y)| PathElement::new([(x, y), (x + length, y)], style));
                    named = true;
                }
            }
        }
        Ok(())
    }
}

/// Lowest to highest value with a margin, never empty.
fn range(values: impl Iterator<Item = f64>, log: bool, margin: f64) -> Range<f64> {
    let (lo, hi) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if log {
        let (lo, hi) = if hi / lo > 1.0 + 1e-9 { (lo, hi) } else { (lo / 2.0, hi * 2.0) };
        let room = (hi / lo).powf(margin);
        return lo / room..hi * room;
    }
    // A range lost in rounding gives identical ticks, and the search for ticks would not end.
    let flat = hi - lo <= 1e-9 * lo.abs().max(hi.abs());
    let room = if !flat { (hi - lo) * margin } else { lo.abs().max(1.0) * 0.05 };
    lo - room..hi + room
}

/// The corner of the plot with the fewest points.
fn emptiest(points: &[(f64, f64)], x: &Range<f64>, y: &Range<f64>, options: &CurveOptions) -> SeriesLabelPosition {
    let part = |v: f64, r: &Range<f64>, log: bool| {
        if log { (v / r.start).ln() / (r.end / r.start).ln() } else { (v - r.start) / (r.end - r.start) }
    };
    let count = |&(right, upper): &(bool, bool)| {
        let inside = |p: &&(f64, f64)| {
            let (u, v) = (part(p.0, x, options.log_x), part(p.1, y, options.log_y));
            (if right { u > 0.6 } else { u < 0.4 }) && (if upper { v > 0.65 } else { v < 0.35 })
        };
        points.iter().filter(inside).count()
    };
    match [(true, false), (true, true), (false, true), (false, false)].into_iter().min_by_key(count) {
        Some((true, true)) => SeriesLabelPosition::UpperRight,
        Some((false, true)) => SeriesLabelPosition::UpperLeft,
        Some((false, false)) => SeriesLabelPosition::LowerLeft,
        _ => SeriesLabelPosition::LowerRight,
    }
}

/// Registers the font with the plotting crate, so that nothing depends on system fonts.
pub(crate) fn register() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        for (style, bytes) in [(FontStyle::Normal, dejavu::sans::regular()), (FontStyle::Bold, dejavu::sans::bold())] {
            if register_font(FONT, style, bytes).is_err() {
                tracing::error!("the embedded font could not be read: plots will fail");
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series() -> Vec<(String, Vec<(f64, f64)>)> {
        let curve = |top: f64, slow: f64| {
            (0..200).map(|i| (i as f64 * 3.0, top - 15.0 * (-(i as f64) / slow).exp())).collect::<Vec<_>>()
        };
        let mut gap = curve(33.0, 20.0);
        gap[100].1 = f64::NAN;
        vec![
            ("NAF".into(), curve(31.6, 60.0)),
            ("FISTA-TV".into(), curve(37.3, 25.0)),
            ("with a gap".into(), gap),
            ("FDK".into(), vec![(3.6, 22.9)]),
            ("nothing".into(), vec![]),
        ]
    }

    #[test]
    fn curves_are_drawn_on_either_axis() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let path = folder.join("curves.png");
        curves_png(&path, "Engine, 50 views", ["time (s)", "PSNR (dB)"], &series(), &CurveOptions::default()).unwrap();
        let image = Pixels::open(&path).unwrap();
        assert_eq!((image.width, image.height), (1200, 800));
        for colour in &COLOURS[..4] {
            assert!(image.colours().any(|p| p.0 == [colour.0, colour.1, colour.2]), "{colour:?} is not there");
        }
        let options = CurveOptions { log_x: true, ..Default::default() };
        let path = folder.join("curves_log.png");
        curves_png(&path, "Engine, 50 views", ["time (s)", "PSNR (dB)"], &series(), &options).unwrap();
        let options = CurveOptions { log_x: true, log_y: true, ..Default::default() };
        let loss = vec![("loss".to_string(), (0..500).map(|i| (i as f64, 3.0 / (1.0 + i as f64))).collect())];
        curves_png(folder.join("loss_log.png"), "", ["step", "loss"], &loss, &options).unwrap();
    }

    #[test]
    fn x_grows_to_the_right_and_y_upwards() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("line.png");
        // Along the bottom, then up on the right.
        let line = vec![("line".to_string(), vec![(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])];
        curves_png(&path, "", ["", ""], &line, &CurveOptions::default()).unwrap();
        let image = Pixels::open(&path).unwrap();
        let drawn: Vec<usize> =
            (0..).zip(image.colours()).filter(|(_, p)| p.0 == [0, 114, 178]).map(|(i, _)| i).collect();
        let width = image.width as usize;
        let mean = |of: &dyn Fn(usize) -> usize| drawn.iter().map(|i| of(*i)).sum::<usize>() / drawn.len();
        let (x, y) = (mean(&|i| i % width), mean(&|i| i / width));
        assert!(x > width / 2 && y > image.height as usize / 2, "{x} {y}");
    }

    #[test]
    fn panels_stand_side_by_side() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let path = folder.join("panels.png");
        let (series, options) = (series(), CurveOptions { size: [600, 400], ..Default::default() });
        let panel = |title| Panel { title, labels: ["x", "y"], series: &series, options: &options };
        panels_png(&path, &[panel("left"), panel("right")]).unwrap();
        let image = Pixels::open(&path).unwrap();
        assert_eq!((image.width, image.height), (1200, 400));
        // Both halves are equal, except for the titles.
        let same = (60..400).all(|y| (0..600).all(|x| image.get(x, y) == image.get(x + 600, y)));
        assert!(same);
        let nothing = vec![];
        let empty = Panel { title: "", labels: ["", ""], series: &nothing, options: &options };
        let path = folder.join("no-panel.png");
        assert!(panels_png(&path, &[panel("left"), empty]).is_err() && !path.exists());
    }

    #[test]
    fn a_band_is_drawn_around_its_series_in_its_colour() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path();
        let line = |y: f64| (0..10).map(|i| (1.0 + i as f64, y)).collect::<Vec<_>>();
        let series = vec![("low".to_string(), line(10.0)), ("high".to_string(), line(20.0))];
        let band: Vec<Band> = (0..10).map(|i| (1.0 + i as f64, [18.0, 22.0])).collect();
        let picture = |bands| {
            let path = folder.join("bands.png");
            let options = CurveOptions { bands, log_x: true, ..Default::default() };
            curves_png(&path, "", ["", ""], &series, &options).unwrap();
            Pixels::open(&path).unwrap()
        };
        // The second colour, lightened.
        let [r, g, b] = [213.0f64, 94.0, 0.0].map(|c| (255.0 + (c - 255.0) * 0.18).round());
        let like = |p: &[u8; 3]| [r, g, b].iter().zip(p).all(|(a, b)| (a - f64::from(*b)).abs() < 6.0);
        let count = |image: &Pixels| image.colours().filter(|p| like(&p.0)).count();
        let (with, without) = (picture(vec![("high".into(), band)]), picture(vec![]));
        assert!(count(&with) > 20_000 && count(&without) < 500, "{} {}", count(&with), count(&without));
        // A gap if one side cannot be shown.
        picture(vec![("high".into(), vec![(1.0, [18.0, f64::NAN]), (2.0, [18.0, 22.0]), (3.0, [18.0, 22.0])])]);
    }

    #[test]
    fn odd_series_do_not_break_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let one = |p| vec![("one".to_string(), vec![p])];
        for p in [(0.0, 0.0), (5.0, 1e-30), (1e12, -1e12)] {
            curves_png(&path, "", ["", ""], &one(p), &CurveOptions::default()).unwrap();
        }
        let close = vec![("close".to_string(), vec![(0.0, 1e12), (1e-30, 1e12 + 2e-4)])];
        curves_png(&path, "", ["", ""], &close, &CurveOptions::default()).unwrap();
        let both = CurveOptions { log_x: true, log_y: true, ..Default::default() };
        let far = vec![("far".to_string(), vec![(1e-99, 1e99), (1e99, 1e-99), (1e-300, 1e300)])];
        curves_png(&path, "", ["", ""], &far, &both).unwrap();
        curves_png(&path, "", ["", ""], &far, &CurveOptions::default()).unwrap();
        for p in [(f64::NAN, 0.0), (1.0, f64::INFINITY)] {
            let e = curves_png(&path, "", ["", ""], &one(p), &CurveOptions::default()).unwrap_err().to_string();
            assert!(e.contains("a.png") && e.contains("series"), "{e}");
        }
        let log = CurveOptions { log_x: true, ..Default::default() };
        assert!(curves_png(&path, "", ["", ""], &one((0.0, 1.0)), &log).is_err());
        let tiny = CurveOptions { size: [0, 0], ..Default::default() };
        assert!(curves_png(&path, "", ["", ""], &one((0.0, 1.0)), &tiny).is_err());
    }
}
