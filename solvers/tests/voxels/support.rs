//! Carving the volume by the air in the views: how much it removes, and that nothing real disappears.

use conefield_core::scan::{Scan, Volume};
use conefield_core::support::Support;
use conefield_projectors::simulate::{DetectorExtent, DetectorNoise, Protocol, simulate};
use conefield_solvers::support::carve;
use ndarray::Array3;

const N: usize = 48;

/// A body of attenuation 1 (per half cube side), off centre, plus `more`.
fn volume(more: impl Fn([usize; 3]) -> Option<f32>) -> Volume {
    let data = Array3::from_shape_fn((N, N, N), |(x, y, z)| {
        let d = [x as f64 - 20.0, y as f64 - 26.0, (z as f64 - 24.0) * 0.7];
        let body = f32::from(u8::from(d.iter().map(|v| v * v).sum::<f64>() < 110.0));
        more([x, y, z]).unwrap_or(body)
    });
    Volume::centered(data, [2.0 / N as f64; 3])
}

fn scan(volume: &Volume, views: usize, noise: DetectorNoise) -> Scan {
    let protocol = Protocol::r2(&volume.grid).with_detector([128, 128]).with_views(views).with_noise(noise, 3);
    simulate(volume, &protocol).unwrap()
}

fn noisy() -> DetectorNoise {
    "tigre:1e4,10".parse().unwrap()
}

/// Nonzero voxels outside the support.
fn lost(volume: &Volume, support: &Support) -> usize {
    let there =
        |((x, y, z), v): ((usize, usize, usize), &f32)| *v > 0.0 && !support.holds(volume.grid.voxel([x, y, z]));
    volume.data.indexed_iter().filter(|v| there(*v)).count()
}

/// Carves a scan of `volume` and checks that the support contains everything real. Returns the remaining share.
fn keeps(name: &str, volume: &Volume, views: usize, noise: DetectorNoise) -> f64 {
    let found = carve(&scan(volume, views, noise));
    println!("{name}: {}", found.said);
    let Some(support) = found.support else { return 1.0 };
    assert_eq!(lost(volume, &support), 0, "{name}: {}", found.said);
    support.share(&volume.grid)
}

#[test]
fn air_is_left_out_and_the_object_is_not() {
    let body = volume(|_| None);
    let share = keeps("body", &body, 50, DetectorNoise::None);
    assert!(share < 0.35, "{share}");
    let share = keeps("body, noise", &body, 50, noisy());
    assert!(share < 0.4, "{share}");
    // The box is that of the body, not of the volume.
    let support = carve(&scan(&body, 50, DetectorNoise::None)).support.unwrap();
    let [low, high] = support.bounds();
    assert!((0..3).all(|k| high[k] - low[k] < 1.7), "{low:?} {high:?}");
}

#[test]
fn thin_and_faint_things_stay() {
    let wire = volume(|[x, y, _]| (x == 43 && y == 6).then_some(0.6));
    keeps("wire beside the body", &wire, 50, DetectorNoise::None);
    keeps("wire beside the body, noise", &wire, 50, noisy());
    let slanted = volume(|[x, y, z]| (x == 40 && y + z == 50).then_some(0.8));
    keeps("slanted wire, noise", &slanted, 50, noisy());
    let voxel = volume(|at| (at == [47, 24, 40]).then_some(8.0));
    keeps("bright voxel at the rim", &voxel, 50, DetectorNoise::None);
    keeps("bright voxel at the rim, noise", &voxel, 50, noisy());
    // Four voxels per side with a tenth of the body's attenuation, in the air beside it.
    let faint =
        volume(|[x, y, z]| ((40..44).contains(&x) && (8..12).contains(&y) && (30..34).contains(&z)).then_some(0.1));
    keeps("faint block", &faint, 50, DetectorNoise::None);
    // About 30 photons through the body, 300 beside it.
    keeps("body, 10 views, heavy noise", &volume(|_| None), 10, "poisson:300".parse().unwrap());
}

#[test]
fn few_views_and_cut_off_objects_carve_little_or_nothing() {
    for views in [1, 2, 3, 4] {
        keeps(&format!("{views} views"), &volume(|_| None), views, noisy());
    }
    assert!(carve(&scan(&volume(|_| None), 1, DetectorNoise::None)).support.is_none());
    // The detector is too narrow: values beside the object are not reliable air.
    let body = volume(|_| None);
    let narrow =
        |grid, side| Protocol { extent: DetectorExtent::Side(side), ..Protocol::r2(grid).with_detector([64, 64]) };
    let protocol = narrow(&body.grid, [4.0, 0.9]);
    let found = carve(&simulate(&body, &protocol).unwrap());
    assert!(found.support.is_none() && found.said.contains("sides of the views"), "{}", found.said);
    // Every view shows only the object.
    let full = Volume::centered(Array3::from_elem((N, N, N), 0.5), [2.0 / N as f64; 3]);
    let protocol = narrow(&full.grid, [1.0, 1.0]);
    let found = carve(&simulate(&full, &protocol).unwrap());
    assert!(found.support.is_none(), "{}", found.said);
    // A scan of air.
    let nothing = Volume::centered(Array3::zeros((N, N, N)), [2.0 / N as f64; 3]);
    assert!(carve(&scan(&nothing, 20, DetectorNoise::None)).support.is_none());
}

/// Negative control: a threshold reached by chance would lose a wire. Here the wire is hidden on purpose.
#[test]
fn a_wire_that_no_view_shows_is_lost() {
    let wire = volume(|[x, y, _]| (x == 43 && y == 6).then_some(0.6));
    let blind = scan(&volume(|_| None), 50, DetectorNoise::None);
    let support = carve(&blind).support.unwrap();
    assert!(lost(&wire, &support) > 0);
}
