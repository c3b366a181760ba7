//! A step's work cut into waves of bounded size, so that no launch holds a device for long.

use crate::compose::GROUP;
use conefield_core::backend::{TrainRay, Work};
use conefield_core::random::mix;
use conefield_core::stage::{Projector, UnitRay};
use std::ops::Range;

/// Groups that one launch may have along one side, on every device.
pub const MOST_GROUPS: usize = 65_535;

/// A ray as kernels see it: `Ray` in [`conefield_core::wgsl::RAY`].
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct GpuRay {
    origin: [f32; 3],
    per_mm: f32,
    direction: [f32; 3],
    measured: f32,
    inside: [f32; 2],
    published: [f32; 2],
    seed: [u32; 2],
    first: u32,
    count: u32,
}

impl GpuRay {
    pub(crate) fn new(ray: &UnitRay, measured: f32, seed: u64, first: u32, count: u32) -> Self {
        let UnitRay { origin, direction, inside, published, per_mm } = *ray;
        let seed = [seed as u32, (seed >> 32) as u32];
        Self { origin, per_mm, direction, measured, inside, published, seed, first, count }
    }
}

/// What one pass through the kernels takes on. Rows: samples of the rays, then points, then blocks.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wave {
    /// The rays.
    pub rays: Vec<GpuRay>,
    /// Rows of their samples.
    pub ray_rows: u32,
    /// Which of the points.
    pub points: Range<usize>,
    /// Which of the blocks.
    pub blocks: Range<usize>,
    /// All rows.
    pub rows: u32,
}

impl Wave {
    /// Partial losses that its kernels leave: one a ray, one for 64 points, one a block.
    pub fn losses(&self) -> usize {
        self.rays.len() + self.points.len().div_ceil(GROUP as usize) + self.blocks.len()
    }
}

/// Puts rays into waves of at most `most` rows, or one ray that has more.
fn cast<'a>(projector: &dyn Projector, rays: impl Iterator<Item = (&'a UnitRay, f32, u64)>, most: u32) -> Vec<Wave> {
    let mut waves = vec![Wave::default()];
    for (ray, measured, seed) in rays {
        let count = projector.max_samples(ray) as u32;
        if let Some(wave) = waves.last()
            && !wave.rays.is_empty()
            && (wave.rows + count > most || wave.rays.len() == MOST_GROUPS)
        {
            waves.push(Wave::default());
        }
        if let Some(wave) = waves.last_mut() {
            wave.rays.push(GpuRay::new(ray, measured, seed, wave.ray_rows, count));
            wave.ray_rows += count;
            wave.rows = wave.ray_rows;
        }
    }
    waves
}

/// The waves of a step, each of at most `most` rows where one ray or block has no more.
pub fn of_step(projector: &dyn Projector, work: &Work<'_>, most: u32) -> Vec<Wave> {
    let seed = mix(work.seed, work.step);
    let rays = work.rays.iter().enumerate();
    let mut waves =
        cast(projector, rays.map(|(i, TrainRay { ray, target })| (ray, *target, mix(seed, i as u64))), most);
    let mut at = 0;
    while at < work.points.len() {
        let room = waves.last().map_or(0, |w| most.saturating_sub(w.rows) as usize);
        if room == 0 {
            waves.push(Wave::default());
            continue;
        }
        let end = (at + room).min(work.points.len());
        if let Some(wave) = waves.last_mut() {
            wave.points = at..end;
            wave.rows += (end - at) as u32;
        }
        at = end;
    }
    let Some(tv) = work.tv else { return waves };
    let each = tv.edge.pow(3) as u32;
    let mut at = 0;
    while at < tv.corners.len() {
        let empty = waves.last().is_none_or(|w| w.rows == 0);
        let room = waves.last().map_or(0, |w| most.saturating_sub(w.rows) / each) as usize;
        let room = if empty { room.max(1) } else { room }.min(MOST_GROUPS);
        if room == 0 {
            waves.push(Wave::default());
            continue;
        }
        let end = (at + room).min(tv.corners.len());
        if let Some(wave) = waves.last_mut() {
            wave.blocks = at..end;
            wave.rows += (end - at) as u32 * each;
        }
        at = end;
        if at < tv.corners.len() {
            waves.push(Wave::default());
        }
    }
    waves
}

/// The waves in which rays are rendered.
pub fn of_rays(projector: &dyn Projector, rays: &[UnitRay], most: u32) -> Vec<Wave> {
    cast(projector, rays.iter().map(|r| (r, 0.0, 0)), most)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::backend::{Loss, TvBlocks};
    use conefield_core::stage::Samples;

    struct Fixed(usize);
    impl Projector for Fixed {
        fn max_samples(&self, _: &UnitRay) -> usize {
            self.0
        }
        fn sample(&self, _: &UnitRay, _: Option<u64>, _: &mut Samples) {}
        fn describe(&self) -> String {
            "fixed".into()
        }
    }

    fn ray() -> UnitRay {
        UnitRay { origin: [0.0; 3], direction: [1.0, 0.0, 0.0], inside: [0.0, 1.0], published: [0.0, 1.0], per_mm: 1.0 }
    }

    #[test]
    fn every_row_is_in_one_wave_and_none_is_too_large() {
        let rays = vec![TrainRay { ray: ray(), target: 0.5 }; 37];
        let points = vec![([0.5; 3], 0.5); 500];
        let tv = TvBlocks { corners: vec![[0.0; 3]; 11], edge: 4, ..TvBlocks::default() };
        for most in [64, 100, 333, 100_000] {
            for tv in [None, Some(&tv)] {
                let work = Work { step: 1, seed: 2, loss: Loss::L1, rays: &rays, points: &points, tv };
                let waves = of_step(&Fixed(10), &work, most);
                assert!(waves.iter().all(|w| w.rows <= most && w.rows > 0), "{most}");
                assert_eq!(waves.iter().map(|w| w.rays.len()).sum::<usize>(), 37);
                assert_eq!(waves.iter().map(|w| w.points.len()).sum::<usize>(), 500);
                assert_eq!(waves.iter().map(|w| w.blocks.len()).sum::<usize>(), tv.map_or(0, |t| t.corners.len()));
                let rows: u32 = waves.iter().map(|w| w.rows).sum();
                assert_eq!(rows, 370 + 500 + 64 * tv.map_or(0, |t| t.corners.len() as u32));
                for w in &waves {
                    assert!(w.rays.iter().enumerate().all(|(i, r)| r.first == 10 * i as u32));
                }
            }
        }
    }

    #[test]
    fn what_is_larger_than_a_wave_gets_one_of_its_own() {
        let rays = vec![TrainRay { ray: ray(), target: 0.5 }; 3];
        let tv = TvBlocks { corners: vec![[0.0; 3]; 2], edge: 8, ..TvBlocks::default() };
        let work = Work { step: 1, seed: 2, loss: Loss::L1, rays: &rays, points: &[], tv: Some(&tv) };
        let rows: Vec<_> = of_step(&Fixed(100), &work, 64).iter().map(|w| w.rows).collect();
        assert_eq!(rows, [100, 100, 100, 512, 512]);
    }
}
