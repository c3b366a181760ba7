//! Which rays a step trains on.

use crate::shadow::{air_level, shadow};
use conefield_core::backend::TrainRay;
use conefield_core::error::{Error, Result};
use conefield_core::pipeline::Pipeline;
use conefield_core::random::stream;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::Scene;
use rand::seq::SliceRandom;
use rand::seq::index::sample;
use rand::{Rng, RngExt};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where a step takes its rays from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Views {
    /// One view a step, every view once an epoch in random order, and no pixel twice in a step where there are enough (published).
    One,
    /// All views at once.
    All,
}

/// Which pixels count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Pixels {
    /// Those whose own measured value is positive (published). Under noise it keeps the positive half of the empty
    /// background and so biases it.
    Positive,
    /// Those that the object's shadow covers, with a margin: decided from smoothed neighbourhoods, so that the
    /// noise of a pixel does not decide about itself.
    Support,
    /// Every pixel whose ray meets the scene.
    All,
}

/// The rays of a scan that may be trained on.
pub struct RaySource<'a> {
    scan: &'a Scan,
    scene: &'a Scene,
    /// Of each view, its usable pixels (row-major index).
    pixels: Vec<Vec<u32>>,
    views: Views,
    /// Views that have a usable pixel.
    usable: Vec<usize>,
}

impl<'a> RaySource<'a> {
    /// Bytes of the list of pixels: at most all of them.
    pub fn bytes(scan: &ScanHeader) -> u64 {
        size_of::<u32>() as u64 * scan.pixels()
    }

    /// Finds the usable pixels. `margin` widens the support by that many pixels.
    pub fn new(
        scan: &'a Scan,
        scene: &'a Scene,
        pipeline: &Pipeline,
        views: Views,
        which: Pixels,
        margin: usize,
    ) -> Result<Self> {
        let level = (which == Pixels::Support).then(|| air_level(scan));
        let pixels: Vec<Vec<u32>> = (0..scan.geometry.views.len())
            .into_par_iter()
            .map(|v| {
                let view = scan.view(v);
                let support = level.map(|level| shadow(view, level, margin));
                let columns = scan.geometry.detector[1];
                (0..view.len() as u32)
                    .filter(|&p| {
                        let (row, column) = (p as usize / columns, p as usize % columns);
                        let counts = match (which, &support) {
                            (Pixels::Positive, _) => view[[row, column]] > 0.0,
                            (_, Some(s)) => s[[row, column]],
                            _ => true,
                        };
                        counts && pipeline.sees(&scene.pixel_ray(&scan.geometry, v, row, column))
                    })
                    .collect()
            })
            .collect();
        let usable: Vec<usize> = (0..pixels.len()).filter(|&v| !pixels[v].is_empty()).collect();
        if usable.is_empty() {
            return Err(Error::invalid(
                "scan",
                "projections",
                "no ray that meets the volume and the object",
                "rays to train on (check the geometry and the unit of lengths)",
            ));
        }
        Ok(Self { scan, scene, pixels, views, usable })
    }

    /// Share of all pixels that may be trained on.
    pub fn share(&self) -> f64 {
        let all = self.scan.projections.len().max(1);
        self.pixels.iter().map(Vec::len).sum::<usize>() as f64 / all as f64
    }

    /// Steps that make an epoch.
    pub fn steps_an_epoch(&self) -> u64 {
        self.usable.len() as u64
    }

    /// The rays of step `step` (from 0): the same for the same seed.
    pub fn draw(&self, seed: u64, step: u64, count: usize, out: &mut Vec<TrainRay>) {
        out.clear();
        let steps = self.steps_an_epoch();
        let mut rng = stream(seed, 2 * step);
        let one = (self.views == Views::One).then(|| {
            let mut order = self.usable.clone();
            order.shuffle(&mut stream(seed, 2 * (step / steps) + 1));
            order[(step % steps) as usize]
        });
        let mut add = |view: usize, pixel: u32| {
            let columns = self.scan.geometry.detector[1];
            let (row, column) = (pixel as usize / columns, pixel as usize % columns);
            let ray = self.scene.pixel_ray(&self.scan.geometry, view, row, column);
            let target = self.scene.line_to_unit(self.scan.projections[[view, row, column]]);
            out.push(TrainRay { ray, target });
        };
        let Some(view) = one else {
            for _ in 0..count {
                let view = self.usable[rng.random_range(0..self.usable.len())];
                let pixels = &self.pixels[view];
                add(view, pixels[rng.random_range(0..pixels.len())]);
            }
            return;
        };
        let pixels = &self.pixels[view];
        apart(&mut rng, pixels.len(), count).for_each(|at| add(view, pixels[at]));
    }
}

/// `count` of the numbers below `n`, none of them twice before all were drawn.
fn apart(rng: &mut impl Rng, n: usize, count: usize) -> impl Iterator<Item = usize> {
    let rounds = (0..count).step_by(n).map(move |begin| sample(rng, n, n.min(count - begin)));
    rounds.flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_pixel_is_drawn_twice_before_all_were() {
        let mut rng = stream(1, 0);
        for (n, count) in [(50, 20), (50, 50), (7, 17), (1, 3)] {
            let drawn: Vec<usize> = apart(&mut rng, n, count).collect();
            assert_eq!(drawn.len(), count);
            for round in drawn.chunks(n) {
                let mut once = round.to_vec();
                once.sort_unstable();
                once.dedup();
                assert_eq!(once.len(), round.len(), "{drawn:?}");
                assert!(once.iter().all(|&i| i < n));
            }
        }
    }
}
