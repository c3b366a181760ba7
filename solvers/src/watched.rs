//! What is looked at during a reconstruction: the voxels for PSNR, and the middle slices.

use conefield_core::parts::Part;
use conefield_core::random::mix;

/// Edge of a block with one such voxel.
const EDGE: usize = 4;

/// The middle slices perpendicular to x, y and z.
pub fn middle(shape: [usize; 3]) -> [Part; 3] {
    [0, 1, 2].map(|axis| std::array::from_fn(|k| if k == axis { shape[k] / 2..shape[k] / 2 + 1 } else { 0..shape[k] }))
}

/// One random voxel of each block of 4³: every voxel is equally likely, whereas every 4th one along an axis would give
/// some slices four times their weight and others none. The same voxels are used in every run and by every method, so
/// that records are comparable.
pub fn voxels(shape: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    let edge = shape.map(|n| n.clamp(1, EDGE));
    let blocks: [usize; 3] = std::array::from_fn(|k| shape[k].div_ceil(edge[k]));
    (0..blocks.iter().product()).filter_map(move |block| {
        let at = [block / (blocks[1] * blocks[2]), block / blocks[2] % blocks[1], block % blocks[2]];
        let drawn = mix(block as u64, 0);
        let voxel: [usize; 3] = std::array::from_fn(|k| at[k] * edge[k] + (drawn >> (16 * k)) as usize % edge[k]);
        // A block clipped by the volume's rim has a voxel with a probability equal to its remaining share.
        (0..3).all(|k| voxel[k] < shape[k]).then_some(voxel)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_slice_has_more_than_its_share() {
        for shape in [[64; 3], [61, 62, 63]] {
            let found: Vec<_> = voxels(shape).collect();
            let share = shape.iter().product::<usize>() as f64 / 64.0;
            assert!((found.len() as f64 / share - 1.0).abs() < 0.05, "{shape:?}: {} of {share}", found.len());
            for axis in 0..3 {
                for slice in 0..shape[axis] {
                    let n = found.iter().filter(|v| v[axis] == slice).count() as f64;
                    let share = share / shape[axis] as f64;
                    // Five standard deviations.
                    assert!((n - share).abs() < 5.0 * share.sqrt(), "{shape:?}, {axis}, {slice}: {n} of {share}");
                }
            }
        }
    }

    #[test]
    fn small_and_flat_volumes_have_some() {
        assert_eq!(voxels([1, 1, 1]).collect::<Vec<_>>(), [[0, 0, 0]]);
        assert_eq!(voxels([512, 512, 1]).count(), 128 * 128);
        assert!(voxels([5, 1, 2]).count() >= 1);
        assert_eq!(voxels([0, 3, 3]).count(), 0);
    }
}
