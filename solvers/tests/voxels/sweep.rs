//! Geometries that real scans have: the mean in the middle of a body is right within 2 %, or there is a warning or a
//! refusal, never silence.

use crate::kit::{Case, Heard, mean, method, view, volume};
use conefield_core::Result;
use conefield_core::geometry::{Geometry, Radians, Vec3, View, VoxelGrid};
use conefield_core::method::Solution;
use conefield_core::scan::Scan;
use conefield_projectors::simulate::{Ellipsoid, scan_ellipsoids};
use conefield_scans::diagnosis::{WarningKind, survey};

const RADIUS: f64 = 100.0;
const MAGNIFICATION: f64 = 1.5;
/// Column pitch and half width of the field of view at the axis, mm.
const PITCH: f64 = 0.8;
const REACH: f64 = 26.4;
/// Largest error of a mean that needs no warning.
const RIGHT: f64 = 0.02;

const WIDE: Ellipsoid = Ellipsoid { center: [1.0, -1.5, 0.0], axes: [20.0, 16.0, 20.0], value: 0.02 };
const NARROW: Ellipsoid = Ellipsoid { center: [2.0, -1.0, 0.0], axes: [8.0, 7.0, 20.0], value: 0.02 };
const ASIDE: Ellipsoid = Ellipsoid { center: [13.0, 6.0, 0.0], axes: [8.0, 7.0, 20.0], value: 0.02 };

/// A scan with a name.
struct Named {
    name: String,
    scan: Scan,
    body: Ellipsoid,
}

/// Views at `degrees`, each with a detector of `columns` shifted by `shift` mm at the axis.
fn views(degrees: &[f64], shift: impl Fn(usize) -> f64) -> Vec<View> {
    let pixel = [1.0, PITCH].map(|p| p * MAGNIFICATION);
    let at = |(i, a): (usize, &f64)| {
        view(a.to_radians(), [RADIUS, MAGNIFICATION * RADIUS], pixel, [0.0, shift(i) * MAGNIFICATION])
    };
    degrees.iter().enumerate().map(at).collect()
}

/// A detector from −`short` to `REACH` mm at the axis: columns, shift of its middle.
fn reaching(short: f64) -> (usize, f64) {
    (((REACH + short) / PITCH).round() as usize, 0.5 * (REACH - short))
}

fn slab() -> VoxelGrid {
    VoxelGrid { shape: [52, 52, 8], spacing: [1.0; 3], center: [0.0; 3] }
}

fn named(name: impl Into<String>, views: Vec<View>, columns: usize, volume: VoxelGrid, body: Ellipsoid) -> Named {
    // Bodies are no longer than what the rows see.
    let scan = scan_ellipsoids(&[body], Geometry { detector: [40, columns], views, volume });
    Named { name: name.into(), scan, body }
}

fn arc(degrees: f64, views: usize) -> Vec<f64> {
    (0..views).map(|i| 11.0 + degrees * i as f64 / views as f64).collect()
}

/// From −1 to 1, different for each view and `salt`.
fn chance(view: usize, salt: u64) -> f64 {
    let mixed =
        (view as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(salt.wrapping_mul(0xd1b5_4a32_d192_ed03));
    let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    (mixed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn moved(mut v: View, by: Vec3) -> View {
    v.source = std::array::from_fn(|k| v.source[k] + by[k]);
    v.detector = std::array::from_fn(|k| v.detector[k] + by[k]);
    v
}

/// Turned about the x axis by `degrees`: the whole circle, its axis with it.
fn turned(v: View, degrees: f64) -> View {
    let (s, c) = degrees.to_radians().sin_cos();
    let turn = |a: Vec3| [a[0], c * a[1] - s * a[2], s * a[1] + c * a[2]];
    View { source: turn(v.source), detector: turn(v.detector), u: turn(v.u), v: turn(v.v) }
}

/// A circle of sources `degrees` above the volume, the detector opposite of the source.
fn lifted(v: View, degrees: f64) -> View {
    let (s, c) = degrees.to_radians().sin_cos();
    let flat = |a: Vec3| a[0].hypot(a[1]);
    let along = [v.source[0] / flat(v.source), v.source[1] / flat(v.source)];
    let turn = |a: Vec3| {
        let (r, z) = (a[0] * along[0] + a[1] * along[1], a[2]);
        let across = [a[0] - r * along[0], a[1] - r * along[1]];
        let (r, z) = (c * r - s * z, s * r + c * z);
        [across[0] + r * along[0], across[1] + r * along[1], z]
    };
    View { source: turn(v.source), detector: turn(v.detector), u: turn(v.u), v: turn(v.v) }
}

fn all() -> Vec<Named> {
    let mut all = vec![];
    let (full, _) = reaching(REACH);
    let bodies = [("wide", WIDE), ("narrow", NARROW), ("aside", ASIDE)];
    for degrees in [180.0, 190.0, 200.0, 210.0, 225.0, 240.0, 270.0, 300.0, 330.0, 345.0, 360.0] {
        for (what, body) in bodies {
            for (side, short) in [("centred", REACH), ("offset", 6.0)] {
                let (columns, shift) = reaching(short);
                let angles = arc(degrees, (degrees / 2.0) as usize);
                all.push(named(
                    format!("arc {degrees}, {side}, {what}"),
                    views(&angles, |_| shift),
                    columns,
                    slab(),
                    body,
                ));
            }
        }
    }
    let mut add = |name: &str, views: Vec<View>, columns: usize| all.push(named(name, views, columns, slab(), WIDE));
    let turn = arc(360.0, 180);
    let centred = |angles: &[f64]| views(angles, |_| 0.0);
    let mapped = |f: &dyn Fn(usize, View) -> View| -> Vec<View> {
        centred(&turn).into_iter().enumerate().map(|(i, v)| f(i, v)).collect()
    };
    // Angles.
    let arcs = |degrees: f64, views: usize, from: &[f64]| -> Vec<f64> {
        from.iter().flat_map(|from| arc(degrees, views).into_iter().map(move |a| a + from)).collect()
    };
    let back = |angles: Vec<f64>| -> Vec<f64> { angles.into_iter().rev().collect() };
    for (name, angles) in [
        ("backwards", arc(-360.0, 180)),
        ("backwards, short", arc(-225.0, 112)),
        ("four exact turns", arc(1440.0, 360)),
        ("one and a half turns", arc(540.0, 270)),
        ("380 degrees", arc(380.0, 190)),
        ("both ends of a turn", arc(362.0, 181)),
        ("every view twice", [turn.clone(), turn.clone()].concat()),
        ("there and back", [arc(225.0, 112), back(arc(225.0, 112))].concat()),
        ("a gap of 20 degrees", arc(340.0, 170)),
        ("a gap of 60 degrees inside a turn", arcs(100.0, 50, &[0.0, 160.0, 260.0])),
        ("two arcs of 110, opposite", arcs(110.0, 55, &[0.0, 180.0])),
        ("two arcs of 120, 150 apart", arcs(120.0, 60, &[0.0, 150.0])),
        ("three arcs of 60", arcs(60.0, 30, &[0.0, 120.0, 240.0])),
        ("half of it denser", [arc(180.0, 180), arcs(180.0, 60, &[180.0])].concat()),
        ("random angles", (0..240).map(|i| 180.0 * chance(i, 3)).collect()),
        ("golden angles", (0..200).map(|i| 137.507_764 * f64::from(i)).collect()),
    ] {
        add(name, centred(&angles), full);
    }
    // Detectors.
    for (name, short) in [("edge on the axis", 0.0), ("beside the axis", -6.0), ("a little offset", 24.0)] {
        let (columns, shift) = reaching(short);
        add(name, views(&turn, |_| shift), columns);
    }
    let (columns, shift) = reaching(6.0);
    add(
        "two turns, the detector moves across",
        views(&[turn.clone(), turn.clone()].concat(), |i| if i < 180 { shift } else { -shift }),
        columns,
    );
    add("the detector moves across after half a turn", views(&turn, |i| if i < 90 { shift } else { -shift }), columns);
    add(
        "the detector moves across, two short arcs",
        views(&[arc(225.0, 112), arc(225.0, 112)].concat(), |i| if i < 112 { shift } else { -shift }),
        columns,
    );
    add("the detector jumps between views", views(&turn, |i| if i % 2 == 0 { shift } else { -shift }), columns);
    add("the detector wobbles", views(&turn, |i| 1.5 * chance(i, 1)), full);
    add("the detector drifts", views(&turn, |i| 6.0 * (i as f64 / 180.0 - 0.5)), full);
    for degrees in [2.0f64, 8.0, 15.0, 25.0] {
        let tilt = |at: usize| {
            let mut angles = [Radians(0.0), Radians(0.0), Radians(0.0)];
            angles[at] = Radians(degrees.to_radians());
            mapped(&|_, v| v.tilted(angles))
        };
        add(&format!("inclined by {degrees}"), tilt(0), full);
        add(&format!("slanted by {degrees}"), tilt(1), full);
        add(&format!("rolled by {degrees}"), tilt(2), full);
    }
    add("rolls by chance", mapped(&|i, v| v.tilted([0.02, 0.02, 0.02].map(|a| Radians(a * chance(i, 7))))), full);
    add("rows upwards", mapped(&|_, v| View { v: v.v.map(|x| -x), ..v }), full);
    add("columns backwards", mapped(&|_, v| View { u: v.u.map(|x| -x), ..v }), full);
    // Sources.
    add("the source wobbles along z", mapped(&|i, v| moved(v, [0.0, 0.0, 2.0 * chance(i, 5)])), full);
    add("the source wobbles", mapped(&|i, v| moved(v, [2.0 * chance(i, 8), 2.0 * chance(i, 9), 0.0])), full);
    add("the axis lies aside", mapped(&|_, v| moved(v, [4.0, -3.0, 0.0])), full);
    add("an ellipse", mapped(&|_, v| View { source: [1.1 * v.source[0], v.source[1], 0.0], ..v }), full);
    add("a helix", mapped(&|i, v| moved(v, [0.0, 0.0, 30.0 * (i as f64 / 180.0 - 0.5)])), full);
    for degrees in [3.0, 10.0, 30.0] {
        add(&format!("the circle is tilted by {degrees}"), mapped(&|_, v| turned(v, degrees)), full);
        add(&format!("laminography at {degrees}"), mapped(&|_, v| lifted(v, degrees)), full);
    }
    // Volumes and objects.
    let mut place = |name: &str, volume: VoxelGrid, body: Ellipsoid, short: f64| {
        let (columns, shift) = reaching(short);
        all.push(named(name, views(&turn, |_| shift), columns, volume, body));
    };
    let ball = |z: f64| Ellipsoid { center: [1.0, -1.5, z], axes: [14.0, 14.0, 14.0], value: 0.02 };
    for z in [5.0, 12.0, 20.0, 30.0] {
        place(
            &format!("a ball {z} mm above the circle"),
            VoxelGrid { center: [0.0, 0.0, z], ..slab() },
            ball(z),
            REACH,
        );
    }
    place("one slice", VoxelGrid { shape: [52, 52, 1], ..slab() }, WIDE, REACH);
    place("a larger volume", VoxelGrid { shape: [80, 80, 30], ..slab() }, WIDE, REACH);
    place("a volume inside the body", VoxelGrid { shape: [20, 20, 8], ..slab() }, WIDE, REACH);
    place("a volume off-centre", VoxelGrid { center: [9.0, -4.0, 0.0], ..slab() }, WIDE, REACH);
    let body = |axes: Vec3, center: Vec3| Ellipsoid { center, axes, value: 0.02 };
    place("a body wider than the detector", slab(), body([34.0, 30.0, 20.0], [0.0; 3]), REACH);
    place("a body that leaves one side", slab(), body([18.0, 16.0, 20.0], [14.0, 0.0, 0.0]), REACH);
    place("a body that leaves an offset detector", slab(), body([34.0, 30.0, 20.0], [0.0; 3]), 6.0);
    all
}

/// Relative error of the mean in the middle of the body, within the volume's middle slices.
fn error(named: &Named, solution: Solution) -> f64 {
    let volume = volume(solution);
    let Ellipsoid { center, axes, value } = named.body;
    let half = volume.grid.size()[2] / 2.0;
    let inside = |p: Vec3| {
        let [x, y] = [0, 1].map(|k| (p[k] - center[k]) / (0.6 * axes[k]).min(7.0));
        x.hypot(y) < 1.0 && (p[2] - volume.grid.center[2]).abs() < half.min(2.0)
    };
    mean(&volume, inside) / value - 1.0
}

/// The survey's warnings about the geometry. An object beyond the volume is no matter for fdk.
fn surveyed(scan: &Scan) -> Vec<WarningKind> {
    use WarningKind::{Arc, Gap, Offset, Truncated};
    let kinds = survey(scan).warnings.into_iter().map(|w| w.kind);
    kinds.filter(|k| [Arc, Gap, Offset, Truncated].contains(k)).collect()
}

fn fdk(named: &Named) -> (Result<Solution>, Heard) {
    let mut heard = Heard::default();
    let found = Case::of(&named.scan).run("type = \"fdk\"", &mut heard);
    (found, heard)
}

/// Geometries that people have.
const USUAL: [&str; 21] = [
    "arc 210, centred, narrow", "arc 225, centred, wide", "arc 240, centred, aside", "arc 300, centred, wide",
    "arc 360, centred, wide", "arc 360, offset, wide", "arc 360, offset, aside", "backwards", "backwards, short",
    "four exact turns", "one and a half turns", "380 degrees", "every view twice", "there and back",
    "half of it denser", "golden angles", "the detector wobbles", "rows upwards", "columns backwards", "one slice",
    "a ball 5 mm above the circle",
];

/// The usual ones are right, and there is nothing to warn of.
#[test]
fn no_geometry_gives_wrong_numbers_without_a_word() {
    let (mut silent, mut right, mut told, mut usual) = (vec![], 0, 0, USUAL.to_vec());
    for named in all() {
        let (found, heard) = fdk(&named);
        let is_usual = USUAL.contains(&&named.name[..]);
        usual.retain(|name| *name != named.name);
        let solution = match found {
            Ok(solution) => solution,
            Err(e) => {
                assert!(!is_usual, "{}: {e}", named.name);
                told += 1;
                continue;
            }
        };
        let error = error(&named, solution);
        let warnings = (&heard.warnings, surveyed(&named.scan));
        let warned = !warnings.0.is_empty() || !warnings.1.is_empty();
        assert!(!is_usual || (error.abs() < RIGHT && !warned), "{}: {error}, {warnings:?}", named.name);
        match error.abs() <= RIGHT {
            true => right += 1,
            false if warned => told += 1,
            false => silent.push(format!("{}: {:.1} %, {:?}", named.name, 100.0 * error, heard.notes)),
        }
    }
    println!("{right} right, {told} told");
    assert!(silent.is_empty() && usual.is_empty(), "{silent:#?}, not in the sweep: {usual:?}");
    // The sweep has both kinds, and most geometries that fdk can do are right.
    assert!(right > 60 && told > 20, "{right} right, {told} told");
}

/// The whole table, beside an iterative method: `cargo test --release -p conefield-solvers --test voxels table_of_geometries
/// -- --ignored --nocapture`.
#[test]
#[ignore = "minutes"]
fn table_of_geometries() {
    println!("| geometry | fdk | os-sart | warnings |\n| --- | --- | --- | --- |");
    for named in all() {
        let (found, heard) = fdk(&named);
        let percent = |found: Result<Solution>| match found {
            Ok(solution) => format!("{:+.1} %", 100.0 * error(&named, solution)),
            Err(_) => "refused".into(),
        };
        let fdk = percent(found);
        let sart = percent(Case::of(&named.scan).run(&method("os-sart", ""), &mut Heard::default()));
        let mut words: Vec<String> = surveyed(&named.scan).iter().map(|k| format!("{k:?}").to_lowercase()).collect();
        if heard.warnings.iter().any(|w| w.contains("no view measures")) {
            words.push("missing rays".into());
        }
        if heard.warnings.iter().any(|w| w.contains("plane of the sources")) {
            words.push("cone".into());
        }
        println!("| {} | {fdk} | {sart} | {} |", named.name, words.join(", "));
    }
}
