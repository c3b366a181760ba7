//! A picture of a scan's geometry: source path, detector, volume, and the part of it seen by the views.

use crate::report::canvas::{number, sequential, write_png};
use crate::report::curves::{Area, Axis, Chart, Drawn, FONT, register, text_of};
use crate::report::pixels::{Pixels, Rgb};
use conefield_core::geometry::{Geometry, Vec3, View};
use conefield_core::{Error, Result};
use conefield_scans::diagnosis::{Setup, setup, share_of_views};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::ops::Range;
use std::path::Path;

/// Pixels of the picture, and the supersampling factor of the drawing: [`Pixels::halved`] takes it back.
const SIZE: [u32; 2] = [1480, 1180];
const FINER: u32 = 2;
/// Height of a line of text.
const EM: f64 = 17.0 * FINER as f64;
/// Maximum number of views drawn; evenly selected if there are more.
const SHOWN: usize = 90;
/// Points along the longer side of a map.
const POINTS: usize = 160;

const SOURCE: RGBColor = RGBColor(213, 94, 0);
const DETECTOR: RGBColor = RGBColor(0, 114, 178);
const INK: RGBColor = RGBColor(20, 20, 20);

/// Draws `geometry` from above (x to the right, y up) and from the side of its first view. Beside them it maps the
/// share of views that see each point of the volume's central slices x–y and x–z.
///
/// `title` is the heading. Refuses a geometry that fails [`Geometry::validate`].
pub fn survey_png(path: impl AsRef<Path>, title: &str, geometry: &Geometry) -> Result<()> {
    let path = path.as_ref();
    let picture = survey_picture(&path.display().to_string(), title, geometry)?;
    write_png(path, &picture)
}

/// The picture of [`survey_png`]; `place` is the name in errors.
pub(crate) fn survey_picture(place: &str, title: &str, geometry: &Geometry) -> Result<Pixels> {
    geometry.validate(place)?;
    register();
    let [width, height] = SIZE.map(|n| n * FINER);
    let mut fine = Pixels::new(width, height, Rgb([255; 3]));
    {
        let area = BitMapBackend::with_buffer(&mut fine.bytes, (width, height)).into_drawing_area();
        let picture = Picture { geometry, setup: setup(geometry) };
        picture.draw(&area, title).map_err(|e| Error::invalid(place, "picture", e, "a geometry that can be drawn"))?;
    }
    Ok(fine.halved())
}

struct Picture<'g> {
    geometry: &'g Geometry,
    setup: Setup,
}

/// The pixels of an area, the margins of axes and titles, and the part of the world shown in the rest.
struct Frame<'t> {
    title: &'t str,
    labels: [&'t str; 2],
    x: [f64; 2],
    y: [f64; 2],
}

impl Frame<'_> {
    /// Axes of equal scale, and a title.
    fn chart<'a, 'b>(&self, area: &'a Area<'b>) -> Result<Chart<'a, 'b>, String> {
        let (w, h) = area.dim_in_pixel();
        let (edge, left, foot, head, right) = (EM * 0.6, EM * 4.2, EM * 3.0, EM * 2.0, EM);
        let inner = [f64::from(w) - edge - left - right, f64::from(h) - foot - head];
        let size = [self.x[1] - self.x[0], self.y[1] - self.y[0]];
        // A millimetre is the same in both directions: the tighter one determines the scale.
        let mm = (size[0] / inner[0]).max(size[1] / inner[1]);
        let range = |r: [f64; 2], pixels: f64| {
            let middle = (r[0] + r[1]) / 2.0;
            Axis::new(middle - mm * pixels / 2.0..middle + mm * pixels / 2.0, false)
        };
        let at = ((edge + left + inner[0] / 2.0) as i32, (EM * 0.5) as i32);
        let style = (FONT, EM * 1.05).into_font().color(&INK).pos(Pos::new(HPos::Center, VPos::Top));
        area.draw(&Text::new(self.title.to_owned(), at, style)).map_err(text_of)?;
        let mut chart = ChartBuilder::on(area)
            .margin_top(head as i32)
            .margin_left(edge as i32)
            .margin_right(right as i32)
            .x_label_area_size(foot as i32)
            .y_label_area_size(left as i32)
            .build_cartesian_2d(range(self.x, inner[0]), range(self.y, inner[1]))
            .map_err(text_of)?;
        chart
            .configure_mesh()
            .x_desc(self.labels[0])
            .y_desc(self.labels[1])
            .axis_desc_style((FONT, EM * 0.9))
            .label_style((FONT, EM * 0.8))
            .x_label_formatter(&|v| number(*v))
            .y_label_formatter(&|v| number(*v))
            .x_labels(7)
            .y_labels(7)
            .bold_line_style(BLACK.mix(0.08))
            .light_line_style(TRANSPARENT)
            .draw()
            .map_err(text_of)?;
        Ok(chart)
    }
}

/// The smallest box around points, slightly enlarged.
fn around(points: impl Iterator<Item = (f64, f64)>) -> ([f64; 2], [f64; 2]) {
    let empty = [f64::INFINITY, f64::NEG_INFINITY];
    let (mut x, mut y) = (empty, empty);
    for p in points {
        (x, y) = ([x[0].min(p.0), x[1].max(p.0)], [y[0].min(p.1), y[1].max(p.1)]);
    }
    let room = 0.05 * (x[1] - x[0]).max(y[1] - y[0]);
    (([x[0] - room, x[1] + room]), [y[0] - room, y[1] + room])
}

fn line(chart: &mut Chart, points: Vec<(f64, f64)>, style: impl Into<ShapeStyle>) -> Drawn {
    chart.draw_series([PathElement::new(points, style)]).map(|_| ()).map_err(text_of)
}

/// The volume between two corners.
fn volume(chart: &mut Chart, corners: [(f64, f64); 2]) -> Drawn {
    let styles: [ShapeStyle; 2] = [RGBColor(94, 201, 98).mix(0.5).filled(), INK.stroke_width(2 * FINER)];
    chart.draw_series(styles.map(|style| Rectangle::new(corners, style))).map(|_| ()).map_err(text_of)
}

fn label(chart: &mut Chart, at: (f64, f64), anchor: Pos, colour: RGBColor, text: &str) -> Drawn {
    let style = (FONT, EM * 0.85).into_font().color(&colour).pos(anchor);
    chart.draw_series([Text::new(text.to_owned(), at, style)]).map(|_| ()).map_err(text_of)
}

fn circle(radius: f64) -> Vec<(f64, f64)> {
    (0..=360).map(|i| f64::from(i).to_radians().sin_cos()).map(|(s, c)| (radius * c, radius * s)).collect()
}

impl Picture<'_> {
    fn draw(&self, area: &Area, title: &str) -> Drawn {
        area.fill(&WHITE).map_err(text_of)?;
        let (width, height) = area.dim_in_pixel();
        let head = (EM * 2.2) as u32;
        let style = (FONT, EM * 1.25).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Top));
        area.draw(&Text::new(title.to_owned(), (EM as i32, (EM * 0.6) as i32), style)).map_err(text_of)?;
        let (_, rest) = area.split_vertically(head);
        let bar_width = (EM * 6.0) as u32;
        let (panels, bar) = rest.split_horizontally(width - bar_width);
        let (above, below) = panels.split_vertically((height - head) * 56 / 100);
        let middle = (width - bar_width) / 2;
        let ((top, axial), (side, coronal)) = (above.split_horizontally(middle), below.split_horizontally(middle));
        self.top_view(&top)?;
        self.side_view(&side)?;
        self.map(&axial, [0, 1])?;
        self.map(&coronal, [0, 2])?;
        self.bar(&bar)?;
        area.present().map_err(text_of)
    }

    fn views(&self) -> impl Iterator<Item = &View> {
        let all = &self.geometry.views;
        all.iter().step_by(all.len().div_ceil(SHOWN).max(1))
    }

    /// The ends of the detector along u and along v.
    fn ends(&self, view: &View) -> [[Vec3; 2]; 2] {
        let [rows, columns] = self.geometry.detector.map(|n| n as f64 / 2.0);
        let at = |r: f64, c: f64| std::array::from_fn(|k| view.detector[k] + r * view.v[k] + c * view.u[k]);
        [[at(0.0, -columns), at(0.0, columns)], [at(-rows, 0.0), at(rows, 0.0)]]
    }

    fn top_view(&self, area: &Area) -> Drawn {
        let flat = |p: Vec3| (p[0], p[1]);
        let [low, high] = self.geometry.volume.bounds();
        let seen = self.views().flat_map(|v| [v.source, self.ends(v)[0][0], self.ends(v)[0][1]]).chain([low, high]);
        let (x, mut y) = around(seen.map(flat));
        // Space for the legend at the top.
        y[1] += 0.12 * (y[1] - y[0]);
        let frame = Frame { title: "from above (+z)", labels: ["x (mm)", "y (mm)"], x, y };
        let mut chart = frame.chart(area)?;
        for view in self.views() {
            line(&mut chart, self.ends(view)[0].map(flat).to_vec(), DETECTOR.mix(0.25).stroke_width(FINER))?;
        }
        let fov = circle(self.setup.field_of_view.radius_mm);
        line(&mut chart, fov, INK.mix(0.5).stroke_width(FINER))?;
        volume(&mut chart, [(low[0], low[1]), (high[0], high[1])])?;
        self.sources(&mut chart, 0, flat)?;
        let middle = ((low[0] + high[0]) / 2.0, high[1]);
        label(&mut chart, middle, Pos::new(HPos::Center, VPos::Bottom), INK, "volume")?;
        self.turning(&mut chart, (x[1] - x[0]).max(y[1] - y[0]))?;
        self.legend(area)
    }

    /// An arrow from the first view's source in the direction of the orbit.
    fn turning(&self, chart: &mut Chart, size: f64) -> Drawn {
        let angles = &self.setup.angles;
        if angles.step_deg == 0.0 {
            return Ok(());
        }
        let first = self.geometry.views[0].source;
        let (radius, start) = (first[0].hypot(first[1]) * 0.9, angles.first_deg.to_radians());
        let way = angles.step_deg.signum();
        let at = |turn: f64, r: f64| ((start + way * turn).cos() * r, (start + way * turn).sin() * r);
        let arc = (0..=24).map(|i| at(0.06 + 0.5 * f64::from(i) / 24.0, radius)).collect();
        line(chart, arc, SOURCE.stroke_width(2 * FINER))?;
        let tip = at(0.6, radius);
        let wing = size * 0.02;
        let wings = [
            at(0.6 - wing * 1.6 / radius, radius + wing * 0.6),
            tip,
            at(0.6 - wing * 1.6 / radius, radius - wing * 0.6),
        ];
        chart.draw_series([Polygon::new(wings.to_vec(), SOURCE.filled())]).map(|_| ()).map_err(text_of)
    }

    /// The sources; of the first view also the detector along u (`axis` 0) or v (1), and the rays between them.
    fn sources(&self, chart: &mut Chart, axis: usize, flat: impl Fn(Vec3) -> (f64, f64)) -> Drawn {
        let dots = self.views().map(|v| Circle::new(flat(v.source), 3 * FINER as i32, SOURCE.mix(0.6).filled()));
        chart.draw_series(dots).map_err(text_of)?;
        let view = &self.geometry.views[0];
        let ends = self.ends(view)[axis].map(&flat);
        let source = flat(view.source);
        for end in ends {
            line(chart, vec![source, end], SOURCE.mix(0.8).stroke_width(FINER))?;
        }
        line(chart, ends.to_vec(), DETECTOR.stroke_width(4 * FINER))?;
        chart.draw_series([Circle::new(source, 6 * FINER as i32, SOURCE.filled())]).map(|_| ()).map_err(text_of)
    }

    /// A legend of colours and lines, in the corner that a circle leaves empty.
    fn legend(&self, area: &Area) -> Drawn {
        let rows = [
            (SOURCE, "source; large: view 0"),
            (DETECTOR, "detector; thick: view 0"),
            (INK, "circle: what all views see"),
        ];
        for (i, (colour, text)) in rows.into_iter().enumerate() {
            let at = ((EM * 5.4) as i32, (EM * (2.3 + 1.15 * i as f64)) as i32);
            let style = (FONT, EM * 0.85).into_font().color(&colour).pos(Pos::new(HPos::Left, VPos::Top));
            area.draw(&Text::new(text, at, style)).map_err(text_of)?;
        }
        Ok(())
    }

    /// The plane of the axis and the first view's source.
    fn side_view(&self, area: &Area) -> Drawn {
        let first = self.geometry.views[0].source;
        let r = first[0].hypot(first[1]).max(f64::MIN_POSITIVE);
        let (c, s) = (first[0] / r, first[1] / r);
        let flat = |p: Vec3| (p[0] * c + p[1] * s, p[2]);
        let [low, high] = self.geometry.volume.bounds();
        let corners: Vec<(f64, f64)> =
            (0..8).map(|i| flat(std::array::from_fn(|k| if i >> k & 1 == 1 { high[k] } else { low[k] }))).collect();
        let ends = self.ends(&self.geometry.views[0])[1];
        let (x, y) = around(self.views().map(|v| v.source).chain(ends).map(flat).chain(corners.iter().copied()));
        let labels = ["from the axis towards the source of view 0 (mm)", "z (mm)"];
        let frame = Frame { title: "from the side, in the plane of view 0", labels, x, y };
        let mut chart = frame.chart(area)?;
        let left = corners.iter().map(|p| p.0).fold(f64::INFINITY, f64::min);
        let right = corners.iter().map(|p| p.0).fold(f64::NEG_INFINITY, f64::max);
        volume(&mut chart, [(left, low[2]), (right, high[2])])?;
        let axis: Vec<(f64, f64)> = (0..80).map(|i| (0.0, y[0] + (y[1] - y[0]) * f64::from(i) / 79.0)).collect();
        // Dashes: a line from each even-numbered point to the next.
        for pair in axis.chunks(2) {
            line(&mut chart, pair.to_vec(), INK.mix(0.6).stroke_width(FINER))?;
        }
        self.sources(&mut chart, 1, flat)
    }

    /// The share of views over the volume's central slice along the axes `seen`, to the right and up.
    fn map(&self, area: &Area, seen: [usize; 2]) -> Drawn {
        const NAMES: [&str; 3] = ["x", "y", "z"];
        let grid = &self.geometry.volume;
        let [low, high] = grid.bounds();
        let room = 0.12 * seen.map(|k| grid.size()[k]).into_iter().fold(0.0, f64::max);
        let range = |k: usize| [low[k] - room, high[k] + room];
        let title = format!("{}–{} through the volume's middle", NAMES[seen[0]], NAMES[seen[1]]);
        let labels = seen.map(|k| format!("{} (mm)", NAMES[k]));
        let frame = Frame { title: &title, labels: [&labels[0], &labels[1]], x: range(seen[0]), y: range(seen[1]) };
        let mut chart = frame.chart(area)?;
        let (x, y) = (chart.x_range(), chart.y_range());
        let step = (x.end - x.start).max(y.end - y.start) / POINTS as f64;
        let count = |r: &Range<f64>| ((r.end - r.start) / step).ceil().max(1.0) as usize;
        let (nx, ny) = (count(&x), count(&y));
        let corners: Vec<[f64; 2]> =
            (0..nx * ny).map(|i| [x.start + step * (i % nx) as f64, y.start + step * (i / nx) as f64]).collect();
        let centre = |corner: &[f64; 2]| {
            let mut p = grid.center;
            (p[seen[0]], p[seen[1]]) = (corner[0] + step / 2.0, corner[1] + step / 2.0);
            p
        };
        let shares = share_of_views(self.geometry, &corners.iter().map(centre).collect::<Vec<_>>());
        let tiles = corners.iter().zip(shares).map(|([cx, cy], share)| {
            let c = sequential(share as f32);
            let end = ((cx + step).min(x.end), (cy + step).min(y.end));
            Rectangle::new([(*cx, *cy), end], RGBColor(c.0[0], c.0[1], c.0[2]).filled())
        });
        chart.draw_series(tiles).map_err(text_of)?;
        let (a, b) = ((low[seen[0]], low[seen[1]]), (high[seen[0]], high[seen[1]]));
        // Black on white is visible on every colour of the map.
        for (colour, width) in [(WHITE, 4 * FINER), (INK, 2 * FINER)] {
            line(&mut chart, vec![a, (b.0, a.1), b, (a.0, b.1), a], colour.stroke_width(width))?;
        }
        label(&mut chart, (b.0, a.1), Pos::new(HPos::Right, VPos::Bottom), INK, "volume ")
    }

    fn bar(&self, area: &Area) -> Drawn {
        let (width, height) = area.dim_in_pixel();
        let (left, right) = ((EM * 0.6) as i32, (EM * 1.9) as i32);
        let (top, foot) = ((EM * 4.0) as i32, height as i32 - (EM * 3.0) as i32);
        let at = |share: f64| foot - (share * f64::from(foot - top)).round() as i32;
        for y in top..foot {
            let share = f64::from(foot - 1 - y) / f64::from(foot - 1 - top);
            let c = sequential(share as f32);
            let colour = RGBColor(c.0[0], c.0[1], c.0[2]).filled();
            area.draw(&Rectangle::new([(left, y), (right, y + 1)], colour)).map_err(text_of)?;
        }
        area.draw(&Rectangle::new([(left, top), (right, foot)], INK.stroke_width(FINER))).map_err(text_of)?;
        let style = |pos| (FONT, EM * 0.85).into_font().color(&INK).pos(pos);
        for share in [0.0, 0.25, 0.5, 0.75, 1.0] {
            let text = format!("{:.0} %", 100.0 * share);
            let place = (right + (EM * 0.3) as i32, at(share));
            area.draw(&Text::new(text, place, style(Pos::new(HPos::Left, VPos::Center)))).map_err(text_of)?;
        }
        for (i, text) in ["views that", "see a point"].into_iter().enumerate() {
            let place = (width as i32 / 2, (EM * (0.9 + 1.2 * i as f64)) as i32);
            area.draw(&Text::new(text, place, style(Pos::new(HPos::Center, VPos::Top)))).map_err(text_of)?;
        }
        Ok(())
    }
}
