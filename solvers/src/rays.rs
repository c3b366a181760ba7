//! Selection of the rays of a training step.

use crate::field_plan::Training;
use crate::shadow::{air_level, shadow};
use conefield_core::backend::TrainRay;
use conefield_core::error::{Result, ensure};
use conefield_core::parallel;
use conefield_core::pipeline::Pipeline;
use conefield_core::random::stream;
use conefield_core::scan::{Scan, ScanHeader};
use conefield_core::scene::Scene;
use rand::seq::index::sample;
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{Rng, RngExt};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Views from which a step takes its rays.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Views {
    /// One view per step: every view once per epoch, in random order. No pixel occurs twice in a step if there are
    /// enough (published).
    One,
    /// All views.
    All,
}

/// Pixels used for training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Pixels {
    /// Pixels with a positive measured value (published). With noise, this keeps the positive half of the empty
    /// background and so biases it.
    Positive,
    /// Pixels in the object's shadow, and a margin around it. The shadow is found in smoothed views, so that a pixel's
    /// own noise does not select it.
    Support,
    /// Every pixel whose ray meets the scene.
    All,
}

/// Some rays of a step form square windows of neighbouring pixels (Cai et al., CVPR 2024: masked local-global ray
/// sampling). Windows tile the detector from its first pixel; a window is used only if all its pixels are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Windows {
    /// Windows per step. The other rays of the step are single pixels outside them.
    pub count: usize,
    /// Rows and columns of a window.
    pub side: usize,
}

impl Windows {
    /// Refuses more windows than a step of `rays` rays can hold.
    pub fn validate(&self, rays: usize) -> Result<()> {
        ensure((2..=256).contains(&self.side), "spec", "side", self.side, "2 to 256 pixels")?;
        let most = rays / (self.side * self.side);
        let room =
            format!("windows of at most {rays} pixels, the rays of a step, or at least {} rays", self.side * self.side);
        ensure(most > 0, "spec", "side", self.side, room)?;
        ensure((1..=most).contains(&self.count), "spec", "count", self.count, format!("1 to {most} for {rays} rays"))
    }

    /// Number of windows in a step of `rays` rays.
    fn fitting(&self, rays: usize) -> usize {
        self.count.min(rays / (self.side * self.side))
    }

    /// Number of windows along a detector of `columns` columns; the remaining columns at the end are in no window.
    fn across(&self, columns: usize) -> usize {
        columns / self.side
    }

    /// The window of a pixel.
    fn of(&self, pixel: u32, columns: usize) -> Option<u32> {
        let (row, column) = (pixel as usize / columns / self.side, pixel as usize % columns / self.side);
        (column < self.across(columns)).then(|| (row * self.across(columns) + column) as u32)
    }

    /// The windows whose pixels are all in `pixels`.
    fn whole(&self, pixels: &[u32], columns: usize) -> Vec<u32> {
        let mut inside: Vec<u32> = pixels.iter().filter_map(|&p| self.of(p, columns)).collect();
        inside.sort_unstable();
        let all = self.side * self.side;
        inside.chunk_by(|a, b| a == b).filter(|same| same.len() == all).map(|same| same[0]).collect()
    }

    /// The pixels of a window.
    fn pixels(&self, window: u32, columns: usize) -> impl Iterator<Item = u32> {
        let (row, column) = (window as usize / self.across(columns), window as usize % self.across(columns));
        let (row, column, side) = (row * self.side, column * self.side, self.side);
        (0..side * side).map(move |i| ((row + i / side) * columns + column + i % side) as u32)
    }
}

/// The training rays of a scan.
pub struct RaySource<'a> {
    scan: &'a Scan,
    scene: &'a Scene,
    /// Usable pixels of each view (row-major index).
    pixels: Vec<Vec<u32>>,
    /// Windows of each view whose pixels are all usable.
    windows: Option<(Windows, Vec<Vec<u32>>)>,
    views: Views,
    /// Views with at least one usable pixel.
    usable: Vec<usize>,
}

impl<'a> RaySource<'a> {
    /// Upper bound in bytes of the lists of pixels and windows.
    pub fn bytes(scan: &ScanHeader, windows: Option<Windows>) -> u64 {
        let listed = windows.map_or(0, |w| scan.pixels() / (w.side * w.side) as u64);
        size_of::<u32>() as u64 * (scan.pixels() + listed)
    }

    /// Finds the usable pixels.
    pub fn new(scan: &'a Scan, scene: &'a Scene, pipeline: &Pipeline, training: &Training) -> Result<Self> {
        let Training { views, pixels: which, margin, windows, .. } = *training;
        let level = (which == Pixels::Support).then(|| air_level(scan));
        let pixels: Vec<Vec<u32>> = parallel::map(0..scan.geometry.views.len(), |_, v| {
            let view = scan.view(v);
            let support = level.map(|level| shadow(view, level, margin));
            let columns = scan.geometry.detector[1];
            let usable = |&p: &u32| {
                let (row, column) = (p as usize / columns, p as usize % columns);
                let counts = match (which, &support) {
                    (Pixels::Positive, _) => view[[row, column]] > 0.0,
                    (_, Some(s)) => s[[row, column]],
                    _ => true,
                };
                counts && pipeline.sees(&scene.pixel_ray(&scan.geometry, v, row, column))
            };
            let mut pixels: Vec<u32> = (0..view.len() as u32).filter(usable).collect();
            // The list has grown by doubling, but the memory estimate assumes its exact length.
            pixels.shrink_to_fit();
            pixels
        });
        let usable: Vec<usize> = (0..pixels.len()).filter(|&v| !pixels[v].is_empty()).collect();
        let found = "no ray that meets the volume and the object";
        let expected = "rays to train on (check the geometry and the unit of lengths)";
        ensure(!usable.is_empty(), "scan", "projections", found, expected)?;
        let columns = scan.geometry.detector[1];
        let windows: Option<(Windows, Vec<Vec<u32>>)> =
            windows.map(|w| (w, parallel::map(&pixels, |_, p| w.whole(p, columns))));
        Ok(Self { scan, scene, pixels, windows, views, usable })
    }

    /// Share of all pixels that are used for training.
    pub fn share(&self) -> f64 {
        let all = self.scan.projections.len().max(1);
        self.pixels.iter().map(Vec::len).sum::<usize>() as f64 / all as f64
    }

    /// Steps per epoch.
    pub fn steps_an_epoch(&self) -> u64 {
        self.usable.len() as u64
    }

    /// Number of windows to draw from; `None` without windows.
    pub fn whole_windows(&self) -> Option<usize> {
        self.windows.as_ref().map(|(_, whole)| whole.iter().map(Vec::len).sum())
    }

    /// Draws the rays of step `step` (from 0), reproducible by `seed`.
    pub fn draw(&self, seed: u64, step: u64, count: usize, out: &mut Vec<TrainRay>) {
        let mut rng = stream(seed, 2 * step);
        let mut drawn = Vec::with_capacity(count);
        match self.views {
            Views::One => self.draw_from(self.view_of(seed, step), count, &mut rng, &mut drawn),
            Views::All => self.draw_from_all(count, &mut rng, &mut drawn),
        }
        // A GPU waits meanwhile.
        let rays = parallel::map(drawn.chunks(512), |_, drawn| {
            drawn.iter().map(|&(view, pixel)| self.ray(view, pixel)).collect::<Vec<_>>()
        });
        out.clear();
        out.extend(rays.into_iter().flatten());
    }

    /// The view of step `step`: every view once per epoch.
    fn view_of(&self, seed: u64, step: u64) -> usize {
        let steps = self.steps_an_epoch();
        let mut order = self.usable.clone();
        order.shuffle(&mut stream(seed, 2 * (step / steps) + 1));
        order[(step % steps) as usize]
    }

    fn ray(&self, view: usize, pixel: u32) -> TrainRay {
        let columns = self.columns();
        let (row, column) = (pixel as usize / columns, pixel as usize % columns);
        let ray = self.scene.pixel_ray(&self.scan.geometry, view, row, column);
        TrainRay { ray, target: self.scene.line_to_unit(self.scan.projections[[view, row, column]]) }
    }

    fn columns(&self) -> usize {
        self.scan.geometry.detector[1]
    }

    /// Draws pixels of one view. No pixel is drawn twice if there are enough.
    fn draw_from(&self, view: usize, count: usize, rng: &mut impl Rng, drawn: &mut Vec<(usize, u32)>) {
        let columns = self.columns();
        let mut pixels = Cow::from(&self.pixels[view]);
        if let Some((windows, whole)) = &self.windows {
            let whole = &whole[view];
            let most = windows.fitting(count).min(whole.len());
            let mut chosen: Vec<u32> = sample(rng, whole.len(), most).iter().map(|at| whole[at]).collect();
            let inside = chosen.iter().flat_map(|&w| windows.pixels(w, columns));
            drawn.extend(inside.map(|pixel| (view, pixel)));
            chosen.sort_unstable();
            let is_inside = |p: &u32| windows.of(*p, columns).is_some_and(|w| chosen.binary_search(&w).is_ok());
            let outside: Vec<u32> = pixels.iter().copied().filter(|p| !is_inside(p)).collect();
            // If the windows cover all pixels, the other rays are drawn from all pixels again.
            if !outside.is_empty() {
                pixels = Cow::from(outside);
            }
        }
        let single = apart(rng, pixels.len(), count - drawn.len());
        drawn.extend(single.map(|at| (view, pixels[at])));
    }

    /// Draws pixels of all views.
    fn draw_from_all(&self, count: usize, rng: &mut impl Rng, drawn: &mut Vec<(usize, u32)>) {
        let columns = self.columns();
        if let Some((windows, whole)) = &self.windows {
            for _ in 0..windows.fitting(count) {
                let view = self.usable[rng.random_range(0..self.usable.len())];
                if let Some(&window) = whole[view].choose(rng) {
                    drawn.extend(windows.pixels(window, columns).map(|pixel| (view, pixel)));
                }
            }
        }
        while drawn.len() < count {
            let view = self.usable[rng.random_range(0..self.usable.len())];
            let pixels = &self.pixels[view];
            drawn.push((view, pixels[rng.random_range(0..pixels.len())]));
        }
    }
}

/// Draws `count` numbers below `n`; none is repeated before all have been drawn.
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

    #[test]
    fn windows_are_whole_and_stand_side_by_side() {
        let (columns, rows, windows) = (7, 5, Windows { count: 1, side: 2 });
        // All pixels but one, so its window is incomplete. The last column and row belong to no window.
        let pixels: Vec<u32> = (0..(columns * rows) as u32).filter(|&p| p != 9).collect();
        let whole = windows.whole(&pixels, columns);
        assert_eq!(whole, [0, 2, 3, 4, 5]);
        let mut all: Vec<u32> = whole.iter().flat_map(|&w| windows.pixels(w, columns)).collect();
        assert_eq!(all[..8], [0, 1, 7, 8, 4, 5, 11, 12]);
        assert!(all.iter().all(|p| pixels.contains(p)));
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), 4 * whole.len());
        for w in whole {
            assert!(windows.pixels(w, columns).all(|p| windows.of(p, columns) == Some(w)));
        }
        assert_eq!(windows.of(6, columns), None);
    }

    #[test]
    fn windows_that_do_not_fit_are_refused() {
        assert!(Windows { count: 16, side: 8 }.validate(2048).is_ok());
        // If there are fewer rays, as many windows as fit.
        let error = Windows { count: 16, side: 8 }.validate(32).unwrap_err().to_string();
        assert!(error.contains("side: found 8") && error.contains("at least 64 rays"), "{error}");
        assert_eq!(Windows { count: 16, side: 8 }.fitting(1000), 15);
        for (windows, named) in [((33, 8), "count"), ((0, 8), "count"), ((1, 1), "side"), ((1, 257), "side")] {
            let error = Windows { count: windows.0, side: windows.1 }.validate(2048).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }
}
