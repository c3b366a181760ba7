//! Computed phantoms: none of their voxels is measured.

use super::abdomen::abdomen;
use super::head::head;
use super::paint::{Paint, ball, block, cone, ellipsoid, paint};
use conefield_core::error::{Error, Result};
use conefield_core::geometry::Vec3;
use conefield_core::scan::Volume;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::fmt;
use std::str::FromStr;

/// Kind of phantom. Written `head`, `abdomen` or `random:SEED`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PhantomKind {
    /// A head: skull with diploe and sinuses, brain with ventricles, eyes, teeth, vessels, fine inserts.
    Head,
    /// An abdomen: organs, spine, ribs, bowel with gas, vessels.
    Abdomen,
    /// Random ellipsoids, boxes and tubes, different for every seed.
    Random(u64),
}

impl PhantomKind {
    /// Side of the cube in mm.
    fn side_mm(self) -> f64 {
        match self {
            Self::Head => 256.0,
            Self::Abdomen => 400.0,
            Self::Random(_) => 200.0,
        }
    }
}

/// The head phantom; see [`phantom_of`].
pub fn phantom(shape: usize) -> Volume {
    phantom_of(PhantomKind::Head, shape)
}

/// A phantom of `shape³` voxels with values from 0 (air) to 1 (enamel), x from right to left, y from front to back, z
/// upwards. The voxels depend only on kind and shape, not on the number of threads.
pub fn phantom_of(kind: PhantomKind, shape: usize) -> Volume {
    let paints = match kind {
        PhantomKind::Head => head(),
        PhantomKind::Abdomen => abdomen(),
        PhantomKind::Random(seed) => random(seed),
    };
    Volume::centered(paint(shape, &paints), [kind.side_mm() / shape.max(1) as f64; 3])
}

/// A body with 40 to 80 solids in it, from large to small.
fn random(seed: u64) -> Vec<Paint> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut within = |low: f64, high: f64| random.random_range(low..high);
    let body: Vec3 = std::array::from_fn(|_| within(0.55, 0.9));
    let mut paints = vec![
        ellipsoid([0.0; 3], body, within(0.2, 0.45))
            .turned([within(0.0, 90.0), within(0.0, 90.0), within(0.0, 90.0)])
            .wavy(within(0.0, 0.08), within(2.0, 5.0), seed)
            .textured(within(0.0, 0.03), within(4.0, 12.0), seed.wrapping_add(1)),
    ];
    let count = within(40.0, 80.0) as usize;
    for i in 0..count {
        // Sizes decrease to a few hundredths.
        let size = 0.45 * (0.07f64).powf(i as f64 / count as f64);
        let room = 0.75 - 0.5 * size;
        let at: Vec3 = std::array::from_fn(|k| body[k] * room * within(-1.0, 1.0));
        let half: Vec3 = std::array::from_fn(|_| size * within(0.3, 1.0));
        // A fifth are holes; few are as dense as metal or enamel.
        let value = if within(0.0, 1.0) < 0.2 { 0.0 } else { within(0.05, 1.0).powf(1.5) };
        let angles: Vec3 = std::array::from_fn(|_| within(0.0, 180.0));
        let solid = match within(0.0, 4.0) as usize {
            0 => block(at, half.map(|h| 0.8 * h), value),
            1 => {
                let to: Vec3 = std::array::from_fn(|k| at[k] + 2.0 * size * within(-1.0, 1.0));
                cone(at, to, [half[0] * 0.25, half[1] * 0.25], value)
            }
            2 => ball(at, half[0], value),
            _ => ellipsoid(at, half, value),
        };
        let (waves, texture) = (within(-0.03, 0.03).max(0.0), within(-0.03, 0.03).max(0.0));
        paints.push(
            solid.turned(angles).wavy(waves.min(0.3 * size), within(3.0, 12.0), seed.wrapping_add(i as u64)).textured(
                texture,
                within(5.0, 20.0),
                seed.wrapping_add(i as u64),
            ),
        );
    }
    paints
}

impl fmt::Display for PhantomKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Head => write!(f, "head"),
            Self::Abdomen => write!(f, "abdomen"),
            Self::Random(seed) => write!(f, "random:{seed}"),
        }
    }
}

impl FromStr for PhantomKind {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wrong = || Error::invalid("phantom", "kind", format!("`{text}`"), "`head`, `abdomen` or `random:SEED`");
        match text.trim().split_once(':') {
            None if text.trim() == "head" => Ok(Self::Head),
            None if text.trim() == "abdomen" => Ok(Self::Abdomen),
            Some(("random", seed)) => Ok(Self::Random(seed.trim().parse().map_err(|_| wrong())?)),
            _ => Err(wrong()),
        }
    }
}
