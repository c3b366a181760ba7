//! Draws the conventions of docs/guide/geometry.md, with all positions computed by the library: `cargo run -p
//! conefield-evaluation --features plots --example draw_geometry` writes docs/images/geometry-*.svg. A test here compares.

use conefield_core::geometry::{Geometry, Millimetres, Radians, Vec3, View, VoxelGrid};
use conefield_core::orbit::CircularOrbit;
use std::fmt::Write;
use std::path::PathBuf;

const INK: &str = "#222222";
const SOURCE: &str = "#d55e00";
const DETECTOR: &str = "#0072b2";
const VOLUME: &str = "#2a8a4a";
const FAINT: &str = "#9a9a9a";

type Point = (f64, f64);

/// An SVG drawing; points are in pixels, y down.
struct Svg {
    size: Point,
    body: String,
}

/// Style of a line.
#[derive(Clone, Copy)]
struct Line {
    colour: &'static str,
    width: f64,
    dashed: bool,
    arrow: bool,
}

const fn line(colour: &'static str) -> Line {
    Line { colour, width: 1.5, dashed: false, arrow: false }
}

impl Line {
    const fn dashed(self) -> Self {
        Self { dashed: true, ..self }
    }

    const fn arrow(self) -> Self {
        Self { arrow: true, ..self }
    }

    const fn wide(self, width: f64) -> Self {
        Self { width, ..self }
    }
}

impl Svg {
    fn new(width: f64, height: f64) -> Self {
        Self { size: (width, height), body: String::new() }
    }

    fn element(&mut self, text: std::fmt::Arguments<'_>) {
        // Writing to a String does not fail.
        let _ = writeln!(self.body, "{text}");
    }

    fn path(&mut self, points: &[Point], style: Line) {
        let list: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", p.0, p.1)).collect();
        let dashes = if style.dashed { " stroke-dasharray=\"5 4\"" } else { "" };
        let tip = if style.arrow { format!(" marker-end=\"url(#tip{})\"", &style.colour[1..]) } else { String::new() };
        self.element(format_args!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{}\"{dashes}{tip}/>",
            list.join(" "),
            style.colour,
            style.width
        ));
    }

    fn area(&mut self, points: &[Point], colour: &str, opacity: f64) {
        let list: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", p.0, p.1)).collect();
        self.element(format_args!(
            "<polygon points=\"{}\" fill=\"{colour}\" fill-opacity=\"{opacity}\" stroke=\"{colour}\"/>",
            list.join(" ")
        ));
    }

    fn dot(&mut self, at: Point, colour: &str, radius: f64) {
        self.element(format_args!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius}\" fill=\"{colour}\"/>", at.0, at.1));
    }

    /// A text; `anchor` is start, middle or end.
    fn text(&mut self, at: Point, anchor: &str, colour: &str, text: &str) {
        self.element(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\">{text}</text>",
            at.0, at.1
        ));
    }

    fn title(&mut self, at: Point, text: &str) {
        self.element(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"start\" fill=\"{INK}\" font-weight=\"bold\">{text}</text>",
            at.0, at.1
        ));
    }

    fn finish(self) -> String {
        let (w, h) = self.size;
        let tip = |c: &str| {
            format!(
                "<marker id=\"tip{}\" viewBox=\"0 0 10 10\" refX=\"8\" refY=\"5\" markerWidth=\"11\" markerHeight=\"11\" \
                 markerUnits=\"userSpaceOnUse\" orient=\"auto\"><path d=\"M0,1 L9,5 L0,9 z\" fill=\"{c}\"/></marker>",
                &c[1..]
            )
        };
        let tips = [INK, SOURCE, DETECTOR, VOLUME, FAINT].map(tip).concat();
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}\" height=\"{h}\" viewBox=\"0 0 {w} {h}\" \
             font-family=\"DejaVu Sans, Verdana, sans-serif\" font-size=\"14\">\n<defs>{tips}</defs>\n\
             <rect width=\"{w}\" height=\"{h}\" fill=\"white\"/>\n{}</svg>\n",
            self.body
        )
    }
}

/// The geometry to draw: a view at `angle` with a shifted detector.
fn geometry(angle_deg: f64, offset: [f64; 2]) -> Geometry {
    let mm = Millimetres;
    let view =
        |a: f64| View::circular(Radians(a.to_radians()), mm(200.0), mm(330.0), [mm(30.0), mm(30.0)], offset.map(mm));
    Geometry {
        detector: [4, 6],
        views: vec![view(angle_deg), view(angle_deg + 24.0)],
        volume: VoxelGrid { shape: [4, 5, 3], spacing: [20.0, 16.0, 24.0], center: [0.0; 3] },
    }
}

fn middle(a: Point, b: Point) -> Point {
    ((a.0 + b.0) / 2.0, (a.1 + b.1) / 2.0)
}

/// The orbit from above, and one view from the side.
fn world() -> String {
    let mut s = Svg::new(980.0, 560.0);
    from_above(&mut s);
    from_side(&mut s);
    s.finish()
}

fn from_above(s: &mut Svg) {
    let angle: f64 = 38.0;
    let g = geometry(angle, [0.0, 25.0]);
    let (o, scale) = ((270.0, 290.0), 1.05);
    let flat = |p: Vec3| (o.0 + scale * p[0], o.1 - scale * p[1]);
    s.title((20.0, 28.0), "From above (+z)");
    let ring = |r: f64, from: f64, to: f64| -> Vec<Point> {
        let at = |i: i32| (from + (to - from) * f64::from(i) / 72.0).to_radians();
        (0..=72).map(|i| flat([r * at(i).cos(), r * at(i).sin(), 0.0])).collect()
    };
    s.path(&ring(200.0, 0.0, 360.0), line(FAINT).dashed());
    s.path(&[flat([-235.0, 0.0, 0.0]), flat([245.0, 0.0, 0.0])], line(INK).arrow());
    s.path(&[flat([0.0, -222.0, 0.0]), flat([0.0, 240.0, 0.0])], line(INK).arrow());
    s.text(flat([238.0, -20.0, 0.0]), "middle", INK, "x");
    s.text(flat([15.0, 232.0, 0.0]), "middle", INK, "y");
    let [lo, hi] = g.volume.bounds();
    s.area(
        &[[lo[0], lo[1]], [hi[0], lo[1]], [hi[0], hi[1]], [lo[0], hi[1]]].map(|p| flat([p[0], p[1], 0.0])),
        VOLUME,
        0.2,
    );
    let corner = flat([lo[0], hi[1], 0.0]);
    s.text((corner.0 + 5.0, corner.1 + 17.0), "start", VOLUME, "volume");
    let view = &g.views[0];
    let ends = [-0.5, 5.5].map(|c| flat(view.pixel(g.detector, 1.5, c)));
    let source = flat(view.source);
    for end in ends {
        s.path(&[source, end], line(SOURCE));
    }
    s.path(&ends, line(DETECTOR).wide(6.0));
    let foot = geometry(angle, [0.0; 2]).views[0].detector;
    s.path(&[source, flat(foot)], line(FAINT).dashed());
    s.dot(source, SOURCE, 6.0);
    s.text((source.0 + 12.0, source.1 - 8.0), "start", SOURCE, "source");
    let next = flat(g.views[1].source);
    s.dot(next, SOURCE, 4.0);
    s.text((next.0 + 8.0, next.1 - 8.0), "start", SOURCE, "next view");
    s.path(&ring(184.0, angle + 3.0, angle + 20.0), line(SOURCE).arrow());
    s.path(&ring(90.0, 0.0, angle - 2.0), line(INK).arrow());
    s.text(flat([102.0, 28.0, 0.0]), "start", INK, "a");
    // The detector's own direction, and the distance of its centre from the projection of the axis.
    let beside = |c: f64, away: f64| {
        let p = view.pixel(g.detector, 1.5, c);
        let n = view.normal().0;
        flat(std::array::from_fn(|k| p[k] + away * n[k]))
    };
    s.path(&[beside(0.5, 18.0), beside(4.5, 18.0)], line(DETECTOR).arrow());
    let at = beside(4.9, 22.0);
    s.text((at.0, at.1 + 5.0), "middle", DETECTOR, "u");
    let at = beside(-0.7, 10.0);
    s.text((at.0 + 4.0, at.1 - 6.0), "middle", DETECTOR, "column 0");
    s.dot(flat(view.detector), DETECTOR, 5.0);
    s.dot(flat(foot), INK, 4.0);
    let between = middle(flat(foot), flat(view.detector));
    s.text((between.0 - 16.0, between.1 + 26.0), "end", INK, "offset u &gt; 0");
    s.path(&[(between.0 - 14.0, between.1 + 22.0), (between.0 - 2.0, between.1 + 4.0)], line(INK).wide(1.0));
    let dso = middle(source, flat([0.0; 3]));
    s.text((dso.0 - 6.0, dso.1 - 14.0), "end", INK, "DSO");
    s.text(
        (20.0, 545.0),
        "start",
        INK,
        "DSD: from the source to the detector's plane. Start: the first view's a. a grows from +x to +y.",
    );
}

/// The same view in the plane of source and axis.
fn from_side(s: &mut Svg) {
    let o = (760.0, 250.0);
    let side = geometry(0.0, [25.0, 0.0]);
    let [lo, hi] = side.volume.bounds();
    let flat = |p: Vec3| (o.0 + 0.9 * p[0], o.1 - 0.9 * p[2]);
    s.title((580.0, 28.0), "From the side (a = 0, y points away)");
    s.path(&[flat([0.0, 0.0, -170.0]), flat([0.0, 0.0, 190.0])], line(INK).arrow());
    s.text(flat([-12.0, 0.0, 182.0]), "middle", INK, "z");
    s.path(&[flat([-150.0, 0.0, 0.0]), flat([225.0, 0.0, 0.0])], line(INK).arrow());
    s.text(flat([222.0, 0.0, -22.0]), "middle", INK, "x");
    s.area(
        &[[lo[0], lo[2]], [hi[0], lo[2]], [hi[0], hi[2]], [lo[0], hi[2]]].map(|p| flat([p[0], 0.0, p[1]])),
        VOLUME,
        0.2,
    );
    let view = &side.views[0];
    let ends = [-0.5, 3.5].map(|r| flat(view.pixel(side.detector, r, 2.5)));
    for end in ends {
        s.path(&[flat(view.source), end], line(SOURCE));
    }
    s.path(&ends, line(DETECTOR).wide(6.0));
    s.dot(flat(view.source), SOURCE, 6.0);
    let top = flat(view.pixel(side.detector, 0.0, 2.5));
    s.text((top.0 - 14.0, top.1 + 5.0), "end", DETECTOR, "row 0");
    let (from, to) = (flat(view.pixel(side.detector, 1.0, 2.5)), flat(view.pixel(side.detector, 3.2, 2.5)));
    s.path(&[(from.0 - 18.0, from.1), (to.0 - 18.0, to.1)], line(DETECTOR).arrow());
    s.text((to.0 - 18.0, to.1 + 18.0), "middle", DETECTOR, "v (−z)");
    s.dot(flat(view.detector), DETECTOR, 5.0);
    s.dot(flat([-130.0, 0.0, 0.0]), INK, 4.0);
    let between = flat([-130.0, 0.0, -12.0]);
    s.text((between.0 + 10.0, between.1 + 6.0), "start", INK, "offset v");
    s.text((590.0, 450.0), "start", INK, "A positive offset along v moves the detector down,");
    s.text((590.0, 470.0), "start", INK, "towards −z. R2-Gaussian and NAF count theirs towards");
    s.text((590.0, 490.0), "start", INK, "+z; along u all have the same sign.");
}

/// The array of a view as seen from the source, and the meaning of an import's flips.
fn detector() -> String {
    let mut s = Svg::new(980.0, 400.0);
    s.title((20.0, 28.0), "projections[view, row, column], seen from the source");
    let g = geometry(0.0, [0.0; 2]);
    let [rows, columns] = g.detector;
    let view = &g.views[0];
    let (o, scale) = ((270.0, 190.0), 1.45);
    // At a = 0 the source looks along −x: y to the right, z up.
    let flat = |p: Vec3| (o.0 + scale * p[1], o.1 - scale * p[2]);
    let at = |r: f64, c: f64| flat(view.pixel(g.detector, r, c));
    for r in 0..=rows {
        let r = r as f64 - 0.5;
        s.path(&[at(r, -0.5), at(r, columns as f64 - 0.5)], line(FAINT));
    }
    for c in 0..=columns {
        let c = c as f64 - 0.5;
        s.path(&[at(-0.5, c), at(rows as f64 - 0.5, c)], line(FAINT));
    }
    for (r, c) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (3.0, 5.0)] {
        let p = at(r, c);
        s.text((p.0, p.1 + 5.0), "middle", DETECTOR, &format!("{r},{c}"));
    }
    s.path(&[at(-0.9, -0.5), at(-0.9, 2.0)], line(DETECTOR).arrow());
    s.text((at(-0.9, 2.2).0, at(-0.9, 2.2).1 + 5.0), "start", DETECTOR, "u: column to column (+y at a = 0)");
    s.path(&[at(-0.5, -0.9), at(1.5, -0.9)], line(DETECTOR).arrow());
    s.text((at(2.0, -0.8).0, at(1.9, -0.8).1 + 5.0), "end", DETECTOR, "v (−z)");
    s.dot(flat(view.detector), SOURCE, 5.0);
    let centre = flat(view.detector);
    s.text((centre.0 + 9.0, centre.1 + 17.0), "start", SOURCE, "detector");
    s.text((20.0, 330.0), "start", INK, "Pixel (r, c): detector + (r − (R−1)/2)·v + (c − (C−1)/2)·u");
    s.text((20.0, 354.0), "start", INK, "R = 4, C = 6 here: the middle of an even number is between two.");

    s.title((560.0, 28.0), "import: how the file's rows and columns lie");
    for (i, (name, rows, columns)) in [
        ("as here, NAF, R2", false, false),
        ("flip_rows", true, false),
        ("flip_columns", false, true),
        ("both", true, true),
    ]
    .into_iter()
    .enumerate()
    {
        let corner = (580.0 + 200.0 * (i % 2) as f64, 60.0 + 150.0 * (i / 2) as f64);
        let at = |x: f64, y: f64| {
            let x = if columns { 90.0 - x } else { x };
            let y = if rows { 90.0 - y } else { y };
            (corner.0 + x, corner.1 + y)
        };
        s.path(&[at(0.0, 0.0), at(90.0, 0.0), at(90.0, 90.0), at(0.0, 90.0), at(0.0, 0.0)], line(FAINT));
        // A letter that looks different in each orientation.
        s.path(&[at(62.0, 20.0), at(30.0, 20.0), at(30.0, 74.0)], line(DETECTOR).wide(6.0));
        s.path(&[at(30.0, 46.0), at(54.0, 46.0)], line(DETECTOR).wide(6.0));
        s.dot(at(6.0, 6.0), SOURCE, 5.0);
        s.text((corner.0, corner.1 + 110.0), "start", INK, name);
    }
    s.text((580.0, 354.0), "start", INK, "An F in the file's image and the file's first pixel (dot),");
    s.text((580.0, 374.0), "start", INK, "as they really lie, seen from the source.");
    s.finish()
}

/// Volume and vectors in space.
fn space() -> String {
    let mut s = Svg::new(980.0, 520.0);
    let orbit = CircularOrbit { dso: 200.0, dsd: 330.0, pixel: [30.0, 30.0], offset: [0.0, 0.0], angles: vec![0.35] };
    let g = Geometry {
        volume: VoxelGrid { center: [10.0, 30.0, 20.0], ..geometry(0.0, [0.0; 2]).volume },
        views: orbit.views(),
        ..geometry(0.0, [0.0; 2])
    };
    // x towards the reader, y to the right, z up.
    let onto = |o: Point, p: Vec3| (o.0 + 1.35 * p[1] - 0.84 * p[0], o.1 - 1.35 * p[2] + 0.49 * p[0]);
    s.title((20.0, 28.0), "A view: source, detector, u, v");
    let o = (270.0, 250.0);
    let flat = |p: Vec3| onto(o, p);
    axes(&mut s, &flat, 105.0, ["x", "y", "z"]);
    s.path(&[flat([0.0, 0.0, -80.0]), flat([0.0, 0.0, 0.0])], line(INK).dashed());
    let view = &g.views[0];
    let corner = |r: f64, c: f64| flat(view.pixel(g.detector, r, c));
    let corners = [corner(-0.5, -0.5), corner(-0.5, 5.5), corner(3.5, 5.5), corner(3.5, -0.5)];
    s.area(&corners, DETECTOR, 0.18);
    for c in corners {
        s.path(&[flat(view.source), c], line(SOURCE).wide(0.8));
    }
    let tip = |d: Vec3, n: f64| flat(std::array::from_fn(|k| view.detector[k] + n * d[k]));
    s.path(&[flat(view.detector), tip(view.u, 1.6)], line(DETECTOR).wide(2.5).arrow());
    s.path(&[flat(view.detector), tip(view.v, 1.6)], line(DETECTOR).wide(2.5).arrow());
    let (u, v) = (tip(view.u, 1.8), tip(view.v, 1.6));
    s.text((u.0 + 4.0, u.1 + 5.0), "start", DETECTOR, "u");
    s.text((v.0 + 12.0, v.1), "middle", DETECTOR, "v");
    s.dot(flat(view.detector), DETECTOR, 5.0);
    s.text((corners[0].0, corners[0].1 - 8.0), "middle", DETECTOR, "pixel 0,0");
    s.dot(flat(view.source), SOURCE, 6.0);
    let at = flat(view.source);
    s.text((at.0, at.1 + 24.0), "middle", SOURCE, "source");
    let note = [
        "u and v are as long as a pixel: from a pixel's centre to that of",
        "the next column and of the next row. Each view may have its own.",
        "ASTRA's cone_vec: the twelve numbers of source, detector, u, v.",
    ];
    for (i, text) in note.into_iter().enumerate() {
        s.text((20.0, 450.0 + 22.0 * i as f64), "start", INK, text);
    }

    s.title((560.0, 28.0), "The volume: data[x, y, z], z fastest in memory");
    let o = (730.0, 240.0);
    let flat = |p: Vec3| onto(o, p);
    axes(&mut s, &flat, 115.0, ["x", "y", "z"]);
    let [lo, hi] = g.volume.bounds();
    let vertex = |i: usize| flat(std::array::from_fn(|k| if i >> k & 1 == 1 { hi[k] } else { lo[k] }));
    for face in [[0b001, 0b011, 0b111, 0b101], [0b100, 0b101, 0b111, 0b110], [0b010, 0b011, 0b111, 0b110]] {
        s.area(&face.map(vertex), VOLUME, 0.12);
    }
    for (a, b) in [(0b000, 0b001), (0b000, 0b010), (0b000, 0b100)] {
        s.path(&[vertex(a), vertex(b)], line(VOLUME).dashed());
    }
    let first = flat(g.volume.voxel([0; 3]));
    s.dot(first, VOLUME, 5.0);
    s.text((first.0 - 76.0, first.1 - 70.0), "end", VOLUME, "voxel [0, 0, 0]");
    s.path(&[(first.0 - 74.0, first.1 - 68.0), (first.0 - 5.0, first.1 - 5.0)], line(VOLUME).wide(1.0));
    let centre = flat(g.volume.center);
    s.path(&[flat([0.0; 3]), centre], line(SOURCE).arrow());
    s.text((centre.0 + 6.0, centre.1 - 6.0), "start", SOURCE, "center");
    s.text((560.0, 388.0), "start", INK, "center: from the world's origin to the middle of the grid.");
    s.text((560.0, 410.0), "start", INK, "spacing: a voxel's size along x, y, z; they may differ.");

    s.title((560.0, 448.0), "RTK's axes, and those of files");
    s.text((560.0, 472.0), "start", INK, "RTK's (x, y, z) are (y, z, x) here: it turns about its y.");
    s.text((560.0, 494.0), "start", INK, "NIfTI: RAS. MetaImage, DICOM: LPS, x and y the other way.");
    s.finish()
}

fn axes(s: &mut Svg, flat: &dyn Fn(Vec3) -> Point, length: f64, names: [&str; 3]) {
    for (k, name) in names.into_iter().enumerate() {
        let mut p = [0.0; 3];
        p[k] = length;
        s.path(&[flat([0.0; 3]), flat(p)], line(INK).arrow());
        p[k] = length + 14.0;
        let at = flat(p);
        s.text((at.0, at.1 + 5.0), "middle", INK, name);
    }
}

/// Files and their required content.
fn drawings() -> Vec<(PathBuf, String)> {
    let docs = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../docs/images");
    [("world", world()), ("detector", detector()), ("space", space())]
        .into_iter()
        .map(|(name, text)| (docs.join(format!("geometry-{name}.svg")), text))
        .collect()
}

fn main() -> conefield_core::Result<()> {
    for (path, text) in drawings() {
        conefield_io::write_text_atomic(&path, &text)?;
        println!("{}", path.display());
    }
    Ok(())
}

#[test]
fn the_drawings_in_docs_are_current() {
    for (path, text) in drawings() {
        let file = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(
            file == text,
            "write {} anew: cargo run -p conefield-evaluation --features plots --example draw_geometry",
            path.display()
        );
    }
}
