//! RTK's `ThreeDCircularProjectionGeometry` in XML.
//!
//! Source of the formulas: RTK's documentation, "3D Circular Projection Geometry". RTK rotates about y; at gantry angle
//! 0 its source is on +z, image columns run along +x and image rows along +y. Its `(x, y, z)` is conefield's
//! `(y, z, x)`, so that the gantry angle is the angle of [`View::circular`]. The rotated axes are the rows of
//! `R = Rz(−InPlane)·Rx(−OutOfPlane)·Ry(−Gantry)`. Along them the source is at `(SourceOffsetX, SourceOffsetY, SID)`
//! and the detector's point (0, 0) at `(ProjectionOffsetX, ProjectionOffsetY, SID − SDD)`. A point of the world is
//! projected onto the detector by the matrix
//! `T(SourceOffset − ProjectionOffset)·diag(−SDD, −SDD, 1 | −SID)·T(−SourceOffset)·R`.
//!
//! RTK names no unit of length; conefield uses mm. Angles are degrees.

use crate::text::{self, read_foreign};
use crate::write_text_atomic;
use conefield_core::error::ensure;
use conefield_core::geometry::{Vec3, View, cross, dot, norm, sub};
use conefield_core::{Error, Result};
use roxmltree::Node;
use std::path::Path;

const ROOT: &str = "RTKThreeDCircularGeometry";
/// Longest file, in bytes: fifty thousand views.
const LONGEST: u64 = 64 << 20;

/// RTK's nine numbers of one projection, lengths in mm, angles in degrees.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Projection {
    pub sid: f64,
    pub sdd: f64,
    pub gantry: f64,
    pub out_of_plane: f64,
    pub in_plane: f64,
    pub source: [f64; 2],
    pub detector: [f64; 2],
}

/// The names of their elements.
const NAMES: [&str; 9] = [
    "SourceToIsocenterDistance", "SourceToDetectorDistance", "GantryAngle", "OutOfPlaneAngle", "InPlaneAngle",
    "SourceOffsetX", "SourceOffsetY", "ProjectionOffsetX", "ProjectionOffsetY",
];

/// Converts RTK's axes to conefield's.
fn ours(p: Vec3) -> Vec3 {
    [p[2], p[0], p[1]]
}

fn theirs(p: Vec3) -> Vec3 {
    [p[1], p[2], p[0]]
}

impl Projection {
    /// The numbers, in the order of [`NAMES`].
    fn numbers(&mut self) -> [&mut f64; NAMES.len()] {
        let Self { sid, sdd, gantry, out_of_plane, in_plane, source: [sx, sy], detector: [dx, dy] } = self;
        [sid, sdd, gantry, out_of_plane, in_plane, sx, sy, dx, dy]
    }

    /// The number that an element of this name sets.
    fn field(&mut self, name: &str) -> Option<&mut f64> {
        // The second name is from old files.
        let at = NAMES.iter().position(|n| *n == name || (*n == "GantryAngle" && name == "Angle"))?;
        self.numbers().into_iter().nth(at)
    }

    /// The rotated axes in RTK's world, one per row.
    fn axes(&self) -> [Vec3; 3] {
        let [a, b, g] = [self.in_plane, self.out_of_plane, self.gantry].map(|x| (-x).to_radians().sin_cos());
        let ((sa, ca), (sb, cb), (sg, cg)) = (a, b, g);
        // Rx·Ry; Rz then mixes the first two rows.
        let xy = [[cg, 0.0, sg], [sb * sg, cb, -sb * cg], [-cb * sg, sb, cb * cg]];
        let mix = |p: f64, q: f64| std::array::from_fn(|k| p * xy[0][k] + q * xy[1][k]);
        [mix(ca, -sa), mix(sa, ca), xy[2]]
    }

    /// The view, for a pixel size and a shift of the image's centre along v and u, in mm.
    pub fn view(&self, pixel: [f64; 2], offset: [f64; 2]) -> View {
        let [x, y, z] = self.axes();
        let at = |p: f64, q: f64, r: f64| ours(std::array::from_fn(|k| p * x[k] + q * y[k] + r * z[k]));
        View {
            source: at(self.source[0], self.source[1], self.sid),
            detector: at(self.detector[0] + offset[1], self.detector[1] + offset[0], self.sid - self.sdd),
            u: ours(x.map(|c| c * pixel[1])),
            v: ours(y.map(|c| c * pixel[0])),
        }
    }

    /// RTK's projection matrix, 3 × 4.
    fn matrix(&self) -> [[f64; 4]; 3] {
        let r = self.axes();
        // In the rotated frame, relative to the source: s = R·p − (SourceOffset, SID).
        let seen: [[f64; 4]; 3] = std::array::from_fn(|i| {
            let shift = [self.source[0], self.source[1], self.sid][i];
            [r[i][0], r[i][1], r[i][2], -shift]
        });
        std::array::from_fn(|i| {
            std::array::from_fn(|j| match i {
                2 => seen[2][j],
                _ => -self.sdd * seen[i][j] + (self.source[i] - self.detector[i]) * seen[2][j],
            })
        })
    }

    /// The numbers of a view, and whether its rows run against RTK's; `None` if rows and columns are not orthogonal.
    fn of(view: &View) -> Option<(Self, bool)> {
        let unit = |a: Vec3| a.map(|x| x / norm(a));
        let (r, c) = (theirs(unit(view.u)), theirs(unit(view.v)));
        if dot(r, c).abs() > 1e-6 {
            return None;
        }
        let (source, detector) = (theirs(view.source), theirs(view.detector));
        // RTK's third axis points from the detector to the source, which fixes the direction of its rows.
        let reversed = dot(cross(r, c), sub(source, detector)) < 0.0;
        let c = if reversed { c.map(|x| -x) } else { c };
        let n = cross(r, c);
        // n = (−cos b·sin g, sin b, cos b·cos g) with b = −OutOfPlane and g = −Gantry.
        let b = n[1].atan2(n[0].hypot(n[2]));
        let (g, a) = match b.cos() {
            x if x > 1e-9 => ((-n[0]).atan2(n[2]), (-r[1]).atan2(c[1])),
            // Along the rotation axis only the sum of the two angles matters.
            _ => (0.0, c[0].atan2(r[0])),
        };
        let turn = |x: f64| (-x).to_degrees().rem_euclid(360.0);
        let projection = Self {
            sid: dot(n, source),
            sdd: dot(n, sub(source, detector)),
            gantry: turn(g),
            out_of_plane: turn(b),
            in_plane: turn(a),
            source: [dot(r, source), dot(c, source)],
            detector: [dot(r, detector), dot(c, detector)],
        };
        Some((projection, reversed))
    }
}

/// Reads the views of RTK's geometry file (version 2 or 3).
///
/// The file lacks the pixels, which RTK keeps in the image. `pixel` is the pixel size and `offset` the position of the
/// image's centre on the detector (ITK's origin plus half the distance to the last pixel), both `[along v, along u]` in
/// mm. Rows run along RTK's y, which is up (+z).
///
/// As in RTK, a number that a projection omits is inherited from the projection before. Refuses a matrix that
/// contradicts the numbers, a cylindrical detector and a parallel beam.
pub fn read_rtk_geometry(path: &Path, pixel: [f64; 2], offset: [f64; 2]) -> Result<Vec<View>> {
    let place = path.display().to_string();
    let text = read_foreign(path, LONGEST)?;
    let document = text::xml(&place, &text, "RTK's geometry")?;
    let root = document.root_element();
    let name = root.tag_name().name();
    ensure(name == ROOT, &place, "root element", format!("<{name}>"), format!("<{ROOT}>"))?;
    let version = root.attribute("version").unwrap_or("nothing");
    ensure(["2", "3"].contains(&version), &place, "version", version, "2 or 3")?;
    let mut state = Projection::default();
    let mut views = Vec::new();
    for node in root.children().filter(Node::is_element) {
        if node.tag_name().name() != "Projection" {
            set(&place, node, &mut state)?;
            continue;
        }
        let mut matrix = None;
        for inner in node.children().filter(Node::is_element) {
            match inner.tag_name().name() {
                "Matrix" => matrix = Some(inner),
                _ => set(&place, inner, &mut state)?,
            }
        }
        for (field, x) in [("SourceToIsocenterDistance", state.sid), ("SourceToDetectorDistance", state.sdd)] {
            if x == 0.0 {
                let expected = "a distance other than 0 (parallel beams are not read)";
                return Err(Error::invalid(line_of(&place, node), field, x, expected));
            }
        }
        if let Some(m) = matrix {
            check_matrix(&place, m, &state)?;
        }
        views.push(state.view(pixel, offset));
    }
    ensure(!views.is_empty(), &place, "Projection", "none", "one for each view")?;
    Ok(views)
}

/// The place with the line of `node`. For errors only: it reads the text from its start.
fn line_of(place: &str, node: Node) -> String {
    format!("{place}: line {}", node.document().text_pos_at(node.range().start).row)
}

fn number(place: &str, node: Node) -> Result<f64> {
    let text = node.text().unwrap_or_default().trim();
    let found = text.parse::<f64>().ok().filter(|x| x.is_finite());
    found.ok_or_else(|| {
        let shown: String = text.chars().take(60).collect();
        Error::invalid(line_of(place, node), node.tag_name().name(), format!("\"{shown}\""), "a number")
    })
}

fn set(place: &str, node: Node, state: &mut Projection) -> Result<()> {
    let name = node.tag_name().name();
    if let Some(field) = state.field(name) {
        *field = number(place, node)?;
    } else if name == "RadiusCylindricalDetector" && number(place, node)? != 0.0 {
        let what = format!("{place}: {name}");
        return Err(Error::unsupported(what, "only flat detectors are read"));
    } else if !name.starts_with("Collimation") && name != "RadiusCylindricalDetector" {
        let expected = "the elements of RTK's ThreeDCircularProjectionGeometry";
        return Err(Error::invalid(line_of(place, node), "element", format!("<{name}>"), expected));
    }
    Ok(())
}

fn check_matrix(place: &str, node: Node, projection: &Projection) -> Result<()> {
    let text = node.text().unwrap_or_default();
    let found: Vec<f64> = text.split_whitespace().map(|t| t.parse().unwrap_or(f64::NAN)).collect();
    let want = projection.matrix();
    let want: Vec<f64> = want.into_iter().flatten().collect();
    let near = |a: f64, b: f64| (a - b).abs() <= 1e-3 + 1e-6 * b.abs();
    if found.len() == 12 && found.iter().zip(&want).all(|(a, b)| near(*a, *b)) {
        return Ok(());
    }
    let expected = format!("{want:.6?}, which the other numbers give");
    Err(Error::invalid(line_of(place, node), "Matrix", format!("{found:.6?}"), expected))
}

/// Writes `views` as RTK's geometry file, version 3, in mm.
///
/// Returns whether the rows of the projections run against RTK's, as on conefield's own circles: they must then be
/// flipped for RTK. Refuses detectors whose rows and columns are not orthogonal, scans in which only some views have
/// reversed rows, and numbers that are not finite. In RTK the pixels belong to the image; its centre is the detector's
/// point (0, 0).
pub(crate) fn write_rtk_geometry(path: &Path, views: &[View]) -> Result<bool> {
    let place = path.display().to_string();
    let mut text = format!("<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY>\n<{ROOT} version=\"3\">\n");
    let mut reversed = None;
    for (i, view) in views.iter().enumerate() {
        let field = format!("views[{i}]");
        let all = [view.source, view.detector, view.u, view.v];
        let finite = all.iter().flatten().all(|x| x.is_finite());
        ensure(finite, &place, &field, "a number that is not finite", "finite millimetres")?;
        let (mut p, r) = Projection::of(view)
            .ok_or_else(|| Error::invalid(&place, &field, "detector axes askew", "rows and columns at right angles"))?;
        if *reversed.get_or_insert(r) != r {
            let expected = "rows that run the same way in every view";
            return Err(Error::invalid(place, field, "rows against those of the first view", expected));
        }
        text.push_str("  <Projection>\n");
        for (name, x) in NAMES.iter().zip(p.numbers()) {
            text.push_str(&format!("    <{name}>{x}</{name}>\n"));
        }
        text.push_str("    <Matrix>\n");
        for row in p.matrix() {
            text.push_str(&format!("      {} {} {} {}\n", row[0], row[1], row[2], row[3]));
        }
        text.push_str("    </Matrix>\n  </Projection>\n");
    }
    text.push_str(&format!("</{ROOT}>\n"));
    write_text_atomic(path, &text)?;
    Ok(reversed.unwrap_or(false))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{are_views, is_view, says, scan};

    fn near(a: Vec3, b: Vec3) -> bool {
        (0..3).all(|k| (a[k] - b[k]).abs() < 1e-9)
    }

    #[test]
    fn angles_and_offsets_put_source_and_detector_where_geometry_says() {
        let base = Projection { sid: 1000.0, sdd: 1500.0, ..Projection::default() };
        // The gantry turns from +x to +y in our axes; rows run up.
        let v = base.view([2.0, 1.0], [0.0; 2]);
        is_view(&v, [[1000.0, 0.0, 0.0], [-500.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]);
        let v = Projection { gantry: 90.0, ..base }.view([2.0, 1.0], [0.0; 2]);
        is_view(&v, [[0.0, 1000.0, 0.0], [0.0, -500.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 2.0]]);
        // X is along the columns, Y up.
        let v = Projection { source: [3.0, 4.0], detector: [5.0, 6.0], ..base }.view([2.0, 1.0], [0.5, 0.25]);
        assert!(near(v.source, [1000.0, 3.0, 4.0]) && near(v.detector, [-500.0, 5.25, 6.5]));
        // A quarter turn in the plane: seen from the source (on +x, y to the right, z up) the receptor turns
        // counter-clockwise, columns from y towards z.
        let v = Projection { in_plane: 90.0, ..base }.view([2.0, 1.0], [0.0; 2]);
        assert!(near(v.u, [0.0, 0.0, 1.0]) && near(v.v, [0.0, -2.0, 0.0]));
        // About the columns: RTK's y (our z) turns towards its z (our x), the source from +x to −z.
        let v = Projection { out_of_plane: 90.0, ..base }.view([2.0, 1.0], [0.0; 2]);
        assert!(near(v.v, [2.0, 0.0, 0.0]) && near(v.source, [0.0, 0.0, -1000.0]));
    }

    /// RTK's own example of a geometry file, from its documentation.
    const EXAMPLE: &str = "<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY>\n\
        <RTKThreeDCircularGeometry version=\"3\">\n\
        <SourceToIsocenterDistance>1000</SourceToIsocenterDistance>\n\
        <SourceToDetectorDistance>1536</SourceToDetectorDistance>\n\
        <Projection>\n<GantryAngle>271.847274780273</GantryAngle>\n\
        <ProjectionOffsetX>-117.056503295898</ProjectionOffsetX>\n\
        <ProjectionOffsetY>-1.01195001602173</ProjectionOffsetY>\n\
        <Matrix>\n-166.5093078829 0 -1531.42837748039 -117056.503295898\n\
        -1.01142410874151 -1536 0.0326206557691505 -1011.95001602173\n\
        -0.999480303105996 0 0.0322354417240802 -1000\n</Matrix>\n</Projection>\n\
        <Projection>\n<GantryAngle>271.852905273438</GantryAngle>\n</Projection>\n</RTKThreeDCircularGeometry>\n";

    fn read(text: &str) -> Result<Vec<View>> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("geometry.xml");
        std::fs::write(&path, text).unwrap();
        read_rtk_geometry(&path, [1.0, 1.0], [0.0; 2])
    }

    fn tilted(i: usize) -> Projection {
        Projection {
            sid: 1000.0,
            sdd: 1500.0 + i as f64,
            gantry: 37.0 * i as f64,
            out_of_plane: 10.0 * i as f64 - 20.0,
            in_plane: 3.0 * i as f64,
            source: [1.0, -2.0 * i as f64],
            detector: [4.0, i as f64],
        }
    }

    #[test]
    fn the_documented_example_is_read_and_its_matrix_agrees() {
        let views = read(EXAMPLE).unwrap();
        assert_eq!(views.len(), 2);
        let a = 271.847274780273f64.to_radians();
        assert!(near(views[0].source, [1000.0 * a.cos(), 1000.0 * a.sin(), 0.0]));
        // The second projection inherits missing numbers from the first.
        assert!((views[1].detector[2] + 1.01195001602173).abs() < 1e-9);
        // The matrix maps every point of a ray to the pixel that the ray hits.
        let p = tilted(5);
        let (v, m) = (p.view([1.0, 1.0], [0.0; 2]), p.matrix());
        for (x, y) in [(0.0, 0.0), (13.0, -20.0), (-55.0, 40.0)] {
            let pixel: Vec3 = std::array::from_fn(|k| v.detector[k] + x * v.u[k] + y * v.v[k]);
            let q = theirs(std::array::from_fn(|k| 0.4 * v.source[k] + 0.6 * pixel[k]));
            let h = m.map(|r| r[0] * q[0] + r[1] * q[1] + r[2] * q[2] + r[3]);
            // RTK's detector coordinates are relative to the world's axis: the pixel's coordinates in the rotated frame
            // minus the offset, which the matrix subtracts.
            assert!((h[0] / h[2] - x).abs() < 1e-9 && (h[1] / h[2] - y).abs() < 1e-9, "{x} {y} {h:?}");
        }
    }

    #[test]
    fn views_come_back_through_a_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("geometry.xml");
        let views: Vec<View> = (0..12).map(|i| tilted(i).view([2.0, 1.5], [0.0; 2])).collect();
        assert!(!write_rtk_geometry(&path, &views).unwrap());
        are_views(&read_rtk_geometry(&path, [2.0, 1.5], [0.0; 2]).unwrap(), &views);
        // The rows of conefield's own circles run the other way.
        let views = scan().geometry.views;
        assert!(write_rtk_geometry(&path, &views).unwrap());
        let mut askew = views.clone();
        askew[3].u[2] = 0.5;
        says(write_rtk_geometry(&path, &askew), &["views[3]"]);
        let mut mixed = views;
        mixed[2].v = mixed[2].v.map(|x| -x);
        says(write_rtk_geometry(&path, &mixed), &["views[2]"]);
    }

    #[test]
    fn what_does_not_fit_is_refused_in_words() {
        for (from, to, words) in [
            ("RTKThreeDCircularGeometry", "Geometry", "root element"),
            (">1536<", ">0<", "parallel"),
            ("-1000\n", "\n", "line 10: Matrix"),
            (
                "<Projection>\n<GantryAngle>271.852",
                "<RadiusCylindricalDetector>9</RadiusCylindricalDetector><Projection>\n<GantryAngle>271.852",
                "only flat",
            ),
        ] {
            let text = EXAMPLE.replace(from, to);
            assert_ne!(text, EXAMPLE);
            says(read(&text), &["geometry.xml", words]);
        }
        says(read("<RTKThreeDCircularGeometry version=\"3\"/>"), &["one for each view"]);
    }
}
