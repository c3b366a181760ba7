//! Solid cylinders with holes, whose line integrals are known in closed form.

use crate::kit::{Case, Heard, method, psnr};
use conefield_core::geometry::{Geometry, Millimetres, Radians, Ray, View, VoxelGrid};
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::support::Cylinder;
use conefield_projectors::simulate::DetectorNoise;
use conefield_solvers::solid::{Solid, fit};
use ndarray::Array3;

const MU: f64 = 0.04;
const DISC: Cylinder = Cylinder { center: [1.5, -2.25], radius: 34.0 };

/// Where the disc has air.
fn holes() -> [Cylinder; 3] {
    [([9.0, 5.0], 8.0), ([-14.0, -12.0], 6.0), ([2.0, -20.0], 5.0)].map(|(center, radius)| Cylinder { center, radius })
}

/// One slice of `n`² voxels, seen by one row of 280 pixels over `arc` degrees, or by 24 rows.
fn geometry(n: usize, arc: f64, rows: usize) -> Geometry {
    let angle = |i: f64| Radians((40.0 + i).to_radians());
    let pixel = [Millimetres(0.4); 2];
    let view = |i| View::circular(angle(i), Millimetres(410.0), Millimetres(554.0), pixel, [Millimetres(0.0); 2]);
    let views = (0..arc as usize).map(|i| view(i as f64)).collect();
    let volume = VoxelGrid { shape: [n, n, 1], spacing: [76.0 / n as f64; 3], center: [0.0; 3] };
    Geometry { views, detector: [rows, 280], volume }
}

/// The scan of `body` with attenuation MU less that of `holes`. `bend` is the share of a line integral of 2 that beam
/// hardening takes.
fn scan(body: &[Cylinder], holes: &[Cylinder], bend: f64, g: Geometry) -> Scan {
    let chords = |of: &[Cylinder], ray: &Ray| of.iter().filter_map(|c| c.clip(ray)).map(|[a, b]| b - a).sum::<f64>();
    let [rows, columns] = g.detector;
    let projections = Array3::from_shape_fn((g.views.len(), rows, columns), |(v, r, c)| {
        let ray = g.ray(v, r, c);
        let p = MU * (chords(body, &ray) - chords(holes, &ray));
        (p - bend / 2.0 * p * p) as f32
    });
    Scan { geometry: g, projections, unit: Unit::default(), provenance: serde_json::Value::Null }
}

fn noisy(mut scan: Scan, seed: u64) -> Scan {
    let noise: DetectorNoise = "poisson:1e5".parse().unwrap();
    noise.add(&mut scan.projections, seed);
    scan
}

fn truth(grid: VoxelGrid) -> Volume {
    let inside = |c: &Cylinder, p: [f64; 3]| (p[0] - c.center[0]).hypot(p[1] - c.center[1]) <= c.radius;
    let data = Array3::from_shape_fn(grid.shape, |(x, y, z)| {
        let p = grid.voxel([x, y, z]);
        if inside(&DISC, p) && !holes().iter().any(|h| inside(h, p)) { MU as f32 } else { 0.0 }
    });
    Volume { data, ..Volume::centered(Array3::zeros(grid.shape), grid.spacing) }
}

fn close(solid: Solid, bend: f64, what: &str) {
    let Solid { cylinder: Cylinder { center, radius }, attenuation, hardening } = solid;
    let off = [center[0] - DISC.center[0], center[1] - DISC.center[1], radius - DISC.radius];
    assert!(off.iter().all(|d| d.abs() < 0.1), "{what}: {solid:?}");
    assert!((attenuation / MU - 1.0).abs() < 0.015, "{what}: {solid:?}");
    // The curvature follows from p = μ·t − (bend/2)·(μ·t)².
    let bent = hardening / (MU * MU / 2.0);
    assert!((bent - bend).abs() < 0.012, "{what}: {bent} {solid:?}");
    for chord in [1.0, 20.0, 60.0] {
        let p = attenuation * chord - hardening * chord * chord;
        let linear = f64::from(solid.linear(p as f32));
        assert!((linear / (attenuation * chord) - 1.0).abs() < 1e-5, "{what}: {linear} for {chord}");
    }
    assert!(solid.linear(-0.01) == -0.01 && solid.linear(0.0) == 0.0 && solid.linear(1e9).is_finite());
}

#[test]
fn a_disc_with_holes_is_found_in_few_views() {
    for (arc, rows) in [(30.0, 1), (90.0, 1), (30.0, 24)] {
        for bend in [0.0, 0.1] {
            for seed in 0..3 {
                let scan = noisy(scan(&[DISC], &holes(), bend, geometry(64, arc, rows)), seed);
                let what = format!("{arc}°, {rows} rows, bend {bend}, seed {seed}");
                close(fit(&scan).unwrap_or_else(|e| panic!("{what}: {e}")), bend, &what);
            }
        }
    }
}

/// What is no solid cylinder is not taken for one.
#[test]
fn other_objects_are_no_solid() {
    let at = |x: f64, y: f64, radius| Cylinder { center: [x, y], radius };
    let g = || geometry(64, 90.0, 1);
    let half = at(0.0, 0.0, 33.0);
    let cases: [(&str, Scan); 5] = [
        ("air", scan(&[], &[], 0.0, g())),
        ("two rods", scan(&[at(-18.0, 0.0, 9.0), at(18.0, 4.0, 9.0)], &[], 0.0, g())),
        ("a tube", scan(&[half], &[at(0.0, 0.0, 31.0)], 0.0, g())),
        ("a dense core", scan(&[half, at(5.0, 0.0, 8.0), at(5.0, 0.0, 7.0)], &[], 0.0, g())),
        ("wider than the detector", scan(&[at(0.0, 0.0, 60.0)], &[], 0.0, g())),
    ];
    for (what, scan) in cases {
        let found = fit(&scan);
        println!("{what}: {found:?}");
        assert!(found.is_err(), "{what}: {found:?}");
        let run = |support: &str| {
            Case::of(&scan).run(&method("cgls", &format!("scene.support = \"{support}\"")), &mut Heard::default())
        };
        if what == "a tube" {
            let e = run("solid").err().expect(what).to_string();
            assert!(e.contains("spec: scene.support: found \"solid\", but") && e.contains("solid-or-carve"), "{e}");
            run("solid-or-carve").unwrap();
        }
    }
}

/// Over 40 degrees, outline, bound and linear data make the difference; each method stays inside the disc.
#[test]
fn a_limited_arc_gains_by_the_solid() {
    let scan = noisy(scan(&[DISC], &holes(), 0.1, geometry(64, 40.0, 1)), 1);
    let truth = truth(scan.geometry.volume);
    for kind in ["sart", "mlem", "cgls", "lsqr", "asd-pocs", "fista-tv"] {
        let of = |support: &str| {
            let text = method(kind, &format!("scene.support = {support}\nstop = {{ passes = 40 }}"));
            Case::of(&scan).volume(&text)
        };
        let (box_, _) = of("\"box\"");
        let (solid, heard) = of("\"solid\"");
        let (outline, _) = of("{ cylinder = { center = [1.5, -2.25], radius = 34.0 } }");
        let [a, b, c] = [&box_, &outline, &solid].map(|v| psnr(v, &truth));
        println!("{kind}: {a:.2} dB, with the outline {b:.2}, as a solid {c:.2}");
        assert!(heard.said("a solid cylinder with its axis at x = 1.5"), "{:?}", heard.notes);
        assert!(b > a + 1.0 && c > b + 1.0, "{kind}: {a} {b} {c}");
        let top = solid.data.iter().fold(0.0f32, |m, x| m.max(*x));
        assert!(f64::from(top) < 1.015 * MU, "{kind}: {top}");
    }
}
