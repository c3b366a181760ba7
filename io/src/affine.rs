//! Affine maps from voxel indices to millimetres, converted between the conventions of the file formats.
//!
//! conefield uses NIfTI's axes, which point to the patient's right, front and head (RAS). The axes of DICOM and
//! MetaImage point to the left, back and head (LPS): the first two coordinates change sign.

use conefield_core::geometry::{VoxelGrid, cross, dot, norm};
use conefield_core::parts::Voxels;
pub(crate) use conefield_core::scan::Affine;

/// Converts RAS to LPS, or back.
pub(crate) fn flip(affine: Affine) -> Affine {
    // `0.0 - x` and not `-x`: negation would turn 0 into −0, which shows in files.
    let [x, y, z, w] = affine;
    [x.map(|v| 0.0 - v), y.map(|v| 0.0 - v), z, w]
}

/// The affine with the columns `axes`, the steps from one voxel to the next along x, y and z, and `first`, the centre
/// of the first voxel.
pub(crate) fn from_columns(axes: [[f64; 3]; 3], first: [f64; 3]) -> Affine {
    let [a, b, c] = axes;
    let row = |i: usize| [a[i], b[i], c[i], first[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// The step from one voxel to the next along axis `k`.
pub(crate) fn column(affine: &Affine, k: usize) -> [f64; 3] {
    [affine[0][k], affine[1][k], affine[2][k]]
}

/// The voxel sizes.
pub(crate) fn spacing(affine: &Affine) -> [f64; 3] {
    std::array::from_fn(|k| norm(column(affine, k)))
}

/// Whether every number is finite and the three axes span the space.
pub(crate) fn is_regular(affine: &Affine) -> bool {
    let volume = dot(cross(column(affine, 0), column(affine, 1)), column(affine, 2));
    affine.iter().flatten().all(|x| x.is_finite()) && volume.is_finite() && volume != 0.0
}

/// Axes whose cosine is larger are no longer at right angles; files round directions.
const SKEW: f64 = 1e-3;

/// What to say of axes that are not at right angles to each other: the voxels are taken for boxes. `None` if they are.
pub(crate) fn skew(affine: &Affine) -> Option<String> {
    let axes = [0, 1, 2].map(|k| column(affine, k));
    let cosine = |(a, b): (usize, usize)| dot(axes[a], axes[b]) / (norm(axes[a]) * norm(axes[b]));
    let (pair, most) =
        [(0, 1), (0, 2), (1, 2)].map(|p| (p, cosine(p))).into_iter().max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
    (most.abs() > SKEW).then(|| {
        let names = ['x', 'y', 'z'];
        format!(
            "the axes {} and {} of the voxels are at {:.2} degrees to each other, not at 90: the voxels are taken for \
             boxes whose sides are the steps along the axes (resample the volume to an upright grid)",
            names[pair.0],
            names[pair.1],
            most.clamp(-1.0, 1.0).acos().to_degrees()
        )
    })
}

/// What to say of the voxel sizes `said` by another entry, `name`, if they differ from `used`, which `source` gives.
pub(crate) fn contradiction(name: &str, said: [f64; 3], source: &str, used: [f64; 3]) -> Option<String> {
    let same = said.iter().zip(used).all(|(s, u)| (s - u).abs() <= 1e-3 * u);
    (!same).then(|| format!("{name} says voxels of {said:?} mm, {source} {used:?} mm: the latter are used"))
}

/// The affine to write for `voxels` into the file `place`, and whether it is the volume's own. An affine whose voxel
/// sizes differ from the grid's would make the file contradict itself; it is replaced by one that puts the grid's
/// centre at `grid.center`.
pub(crate) fn of(voxels: &dyn Voxels, place: &str) -> (Affine, bool) {
    let grid = voxels.grid();
    match voxels.affine() {
        Some(a) if fits(&a, grid.spacing) => return (a, true),
        Some(_) => tracing::warn!(
            "{place}: the affine's voxel sizes differ from the grid's {:?} mm; it is replaced by one from the grid",
            grid.spacing
        ),
        None => {}
    }
    (centred(&grid), false)
}

/// Whether the affine's columns have the lengths `wanted`, to the precision of files.
pub(crate) fn fits(affine: &Affine, wanted: [f64; 3]) -> bool {
    spacing(affine).iter().zip(wanted).all(|(n, s)| (n - s).abs() <= 1e-3 * s)
}

/// The affine of a grid whose place is not known: its centre lies at `grid.center`.
pub(crate) fn centred(grid: &VoxelGrid) -> Affine {
    let s = grid.spacing;
    from_columns([[s[0], 0.0, 0.0], [0.0, s[1], 0.0], [0.0, 0.0, s[2]]], grid.voxel([0; 3]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_skewed_axis_and_contradicting_sizes_are_said() {
        let turned = from_columns([[0.0, 2.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 0.0, 4.0]], [5.0; 3]);
        assert_eq!(skew(&turned), None);
        let sheared = from_columns([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]], [0.0; 3]);
        assert!(skew(&sheared).unwrap().contains("y and z of the voxels are at 45.00 degrees"));
        assert_eq!(contradiction("pixdim", [1.0, 1.0, 2.0005], "the sform", [1.0, 1.0, 2.0]), None);
        let said = contradiction("pixdim", [1.0, 1.0, 3.0], "the sform", [1.0, 1.0, 2.0]).unwrap();
        assert_eq!(said, "pixdim says voxels of [1.0, 1.0, 3.0] mm, the sform [1.0, 1.0, 2.0] mm: the latter are used");
    }
}
