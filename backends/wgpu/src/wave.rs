//! A step's work cut into waves of bounded size, so that no launch holds a device for long.

use crate::compose::GROUP;
use conefield_core::backend::{TrainRay, Work};
use conefield_core::random::mix;
use conefield_core::stage::{Projector, UnitRay};
use std::ops::Range;

/// Maximum number of groups of a launch along one side, on every device.
pub const MOST_GROUPS: usize = 65_535;

/// A ray in kernels: `Ray` in [`conefield_core::wgsl::RAY`].
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

/// The work of one pass through the kernels. Its rows are samples of rays, then points, then blocks.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wave {
    /// The rays.
    pub rays: Vec<GpuRay>,
    /// Number of their samples.
    pub ray_rows: u32,
    /// Range of the points.
    pub points: Range<usize>,
    /// Index of the prior of the blocks.
    pub prior: usize,
    /// Range of the prior's blocks.
    pub blocks: Range<usize>,
    /// Number of rows.
    pub rows: u32,
}

impl Wave {
    /// Number of partial losses from its kernels: one per ray, per 64 points and per block.
    pub fn losses(&self) -> usize {
        self.rays.len() + self.points.len().div_ceil(GROUP as usize) + self.blocks.len()
    }
}

/// Puts rays into waves of at most `most` rows. A longer ray gets a wave of its own.
fn cast<'a>(projector: &dyn Projector, rays: impl Iterator<Item = (&'a UnitRay, f32, u64)>, most: u32) -> Vec<Wave> {
    let mut waves = vec![Wave::default()];
    for (ray, measured, seed) in rays {
        // More rows than 32 bits count have no room on any device.
        let count = u32::try_from(projector.max_samples(ray)).unwrap_or(u32::MAX);
        if let Some(wave) = waves.last()
            && !wave.rays.is_empty()
            && (wave.rows.saturating_add(count) > most || wave.rays.len() == MOST_GROUPS)
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

/// The waves of a step, each of at most `most` rows. A longer ray or block gets a wave of its own.
pub fn of_step(projector: &dyn Projector, work: &Work<'_>, most: u32) -> Vec<Wave> {
    let seed = mix(work.seed, work.step);
    let rays = work.rays.iter().enumerate();
    let mut waves =
        cast(projector, rays.map(|(i, TrainRay { ray, target })| (ray, *target, mix(seed, i as u64))), most);
    place(&mut waves, work.points.len(), [1, most], usize::MAX, |wave, points| wave.points = points);
    for (prior, blocks) in work.priors.iter().enumerate() {
        // All blocks of a wave belong to one prior.
        if waves.last().is_some_and(|w| !w.blocks.is_empty()) && !blocks.corners.is_empty() {
            waves.push(Wave::default());
        }
        let each = blocks.prior.blocks().points() as u32;
        let put = |wave: &mut Wave, blocks| (wave.prior, wave.blocks) = (prior, blocks);
        place(&mut waves, blocks.corners.len(), [each, most], MOST_GROUPS, put);
    }
    waves
}

/// Puts `count` things of `each` rows into the last wave and new ones of at most `most` rows and `limit` things: `put` gets a
/// wave and its range of them.
fn place(
    waves: &mut Vec<Wave>,
    count: usize,
    [each, most]: [u32; 2],
    limit: usize,
    put: impl Fn(&mut Wave, Range<usize>),
) {
    let mut at = 0;
    while at < count {
        let Some(wave) = waves.last_mut() else { return };
        let room = (most.saturating_sub(wave.rows) / each) as usize;
        let room = if wave.rows == 0 { room.max(1) } else { room };
        let end = (at + room.min(limit)).min(count);
        if at < end {
            put(wave, at..end);
            wave.rows += (end - at) as u32 * each;
            at = end;
        }
        if at < count {
            waves.push(Wave::default());
        }
    }
}

/// The waves for rendering rays.
pub fn of_rays(projector: &dyn Projector, rays: &[UnitRay], most: u32) -> Vec<Wave> {
    cast(projector, rays.iter().map(|r| (r, 0.0, 0)), most)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::backend::BlockWork;
    use conefield_core::loss::Loss;
    use conefield_core::prior::{Blocks, Prior};
    use conefield_core::stage::Samples;

    /// A loss without values, and a prior without values whose blocks have this edge.
    struct Named(usize);
    impl Loss for Named {
        fn at(&self, _: f64, _: f64) -> (f64, f64) {
            (0.0, 0.0)
        }
        fn describe(&self) -> String {
            "named".into()
        }
    }
    impl Prior for Named {
        fn blocks(&self) -> Blocks {
            Blocks { edge: self.0, count: 1, spacing: 1.0, weight: 1.0 }
        }
        fn block(&self, _: &[f64], _: f64, _: &mut [f64]) -> f64 {
            0.0
        }
        fn describe(&self) -> String {
            "named".into()
        }
    }

    fn work<'a>(rays: &'a [TrainRay], points: &'a [([f32; 3], f32)], priors: &'a [BlockWork<'a>]) -> Work<'a> {
        Work { step: 1, seed: 2, loss: &Named(0), rays, points, priors }
    }

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
        let corners = [[0.0; 3]; 11];
        let of = |edge: &'static Named| BlockWork { prior: edge, corners: &corners, spacing: [0.1; 3] };
        let two = [of(&Named(4)), of(&Named(3))];
        for most in [64, 100, 333, 100_000] {
            for priors in [&two[..0], &two[..1], &two] {
                let waves = of_step(&Fixed(10), &work(&rays, &points, priors), most);
                assert!(waves.iter().all(|w| w.rows <= most && w.rows > 0), "{most}");
                assert_eq!(waves.iter().map(|w| w.rays.len()).sum::<usize>(), 37);
                assert_eq!(waves.iter().map(|w| w.points.len()).sum::<usize>(), 500);
                for prior in 0..priors.len() {
                    let own = waves.iter().filter(|w| w.prior == prior);
                    assert_eq!(own.map(|w| w.blocks.len()).sum::<usize>(), 11);
                }
                let rows: u32 = waves.iter().map(|w| w.rows).sum();
                assert_eq!(rows, 370 + 500 + 11 * [0, 64, 64 + 27][priors.len()]);
                for w in &waves {
                    assert!(w.rays.iter().enumerate().all(|(i, r)| r.first == 10 * i as u32));
                }
            }
        }
    }

    #[test]
    fn what_is_larger_than_a_wave_gets_one_of_its_own() {
        let rays = vec![TrainRay { ray: ray(), target: 0.5 }; 3];
        let corners = [[0.0; 3]; 2];
        let priors = [BlockWork { prior: &Named(8), corners: &corners, spacing: [0.1; 3] }];
        let rows: Vec<_> = of_step(&Fixed(100), &work(&rays, &[], &priors), 64).iter().map(|w| w.rows).collect();
        assert_eq!(rows, [100, 100, 100, 512, 512]);
        let waves = of_rays(&Fixed(1 << 32), &[ray(); 2], 64);
        assert_eq!(waves.iter().map(|w| w.rows).collect::<Vec<_>>(), [u32::MAX; 2]);
    }
}
