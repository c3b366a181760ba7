//! Dice coefficient of two label maps, per label: `2·|A ∩ B| / (|A| + |B|)` (Dice 1945) over the voxels with that
//! label.

use conefield_core::error::{Error, Result, ensure};
use conefield_core::finite::first_not;
use ndarray::{Array3, ArrayView3};
use serde::Serialize;
use std::collections::BTreeMap;

/// Above this, not every integer is an `f32`.
const LARGEST: f32 = 16_777_216.0;

/// The overlap for one label.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LabelDice {
    /// The label, from 1.
    pub label: u32,
    /// From 0 to 1; 0 if only one of the maps has the label.
    pub dice: f64,
    /// Voxels of the result with this label.
    pub voxels: u64,
    /// Voxels of the reference with this label.
    pub reference_voxels: u64,
}

/// The overlap of two label maps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Dice {
    /// Mean over all labels of either map, equally weighted; `None` if there is only background.
    pub mean: Option<f64>,
    /// Per label, ascending.
    pub labels: Vec<LabelDice>,
    /// Labels missing in the reference.
    pub only_in_result: Vec<u32>,
    /// Labels missing in the result.
    pub only_in_reference: Vec<u32>,
}

/// The labels of an integer-valued volume. Other values are refused; `place` names the volume in errors.
pub fn label_map(place: &str, volume: ArrayView3<f32>) -> Result<Array3<u32>> {
    let whole = |x: f32| x.fract() == 0.0 && (0.0..LARGEST).contains(&x);
    if let Some(((x, y, z), value)) = first_not(&volume, whole) {
        let expected = "a label: a whole number from 0 (background) to 16777215";
        return Err(Error::invalid(place, format!("voxel [{x}, {y}, {z}]"), value, expected));
    }
    Ok(volume.mapv(|x| x as u32))
}

/// Compares two label maps of equal shape. Label 0 is background and is ignored.
pub fn dice(result: ArrayView3<u32>, reference: ArrayView3<u32>) -> Result<Dice> {
    let (found, expected) = (format!("{:?}", result.shape()), format!("{:?}", reference.shape()));
    let same = result.shape() == reference.shape();
    ensure(same, "dice", "shape of the result", found, format!("{expected}, the shape of the reference"))?;
    // Voxels in the result, in the reference, in both.
    let mut counts: BTreeMap<u32, [u64; 3]> = BTreeMap::new();
    let mut count = |(a, b): (u32, u32), voxels: u64| {
        for (label, which, there) in [(a, 0, true), (b, 1, true), (a, 2, a == b)] {
            if label > 0 && there {
                counts.entry(label).or_default()[which] += voxels;
            }
        }
    };
    // Neighbours mostly have the same labels: they are counted together.
    let (mut last, mut run) = ((0, 0), 0);
    for (&a, &b) in result.iter().zip(&reference) {
        if (a, b) != last {
            count(last, run);
            (last, run) = ((a, b), 0);
        }
        run += 1;
    }
    count(last, run);
    let label = |(&label, &[a, b, both]): (&u32, &[u64; 3])| LabelDice {
        label,
        dice: 2.0 * both as f64 / (a + b) as f64,
        voxels: a,
        reference_voxels: b,
    };
    let labels: Vec<LabelDice> = counts.iter().map(label).collect();
    let alone = |only: fn(&LabelDice) -> bool| labels.iter().filter(|l| only(l)).map(|l| l.label).collect();
    Ok(Dice {
        mean: (!labels.is_empty()).then(|| labels.iter().map(|l| l.dice).sum::<f64>() / labels.len() as f64),
        only_in_result: alone(|l| l.reference_voxels == 0),
        only_in_reference: alone(|l| l.voxels == 0),
        labels,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 1 within a box, 0 outside.
    fn block(label: u32, x: std::ops::Range<usize>) -> Array3<u32> {
        Array3::from_shape_fn((10, 6, 4), |(i, _, _)| if x.contains(&i) { label } else { 0 })
    }

    #[test]
    fn boxes_that_overlap_by_a_known_part() {
        // 4 and 6 planes, 3 in common: 2·3/(4 + 6).
        let found = dice(block(7, 1..5).view(), block(7, 2..8).view()).unwrap();
        assert_eq!(found.labels, [LabelDice { label: 7, dice: 0.6, voxels: 96, reference_voxels: 144 }]);
        assert_eq!(found.mean, Some(0.6));
        assert!(found.only_in_result.is_empty() && found.only_in_reference.is_empty());
    }

    #[test]
    fn every_label_counts_alike_and_absent_ones_count_as_0() {
        // Label 1: 2 planes, the same in both; 2: the result alone; 9: the reference alone.
        let mut a = block(1, 0..2);
        let mut b = a.clone();
        a += &block(2, 4..5);
        b += &block(9, 6..10);
        let found = dice(a.view(), b.view()).unwrap();
        assert_eq!(found.labels.iter().map(|l| (l.label, l.dice)).collect::<Vec<_>>(), [(1, 1.0), (2, 0.0), (9, 0.0)]);
        assert_eq!(found.mean, Some(1.0 / 3.0));
        assert_eq!((found.only_in_result, found.only_in_reference), (vec![2], vec![9]));
        // It is symmetric.
        assert_eq!(dice(b.view(), a.view()).unwrap().mean, Some(1.0 / 3.0));
        // Different labels at the same place do not count.
        assert_eq!(dice(block(3, 2..6).view(), block(4, 2..6).view()).unwrap().mean, Some(0.0));
    }

    #[test]
    fn only_background_has_no_score() {
        let empty = Array3::zeros((3, 3, 3));
        let found = dice(empty.view(), empty.view()).unwrap();
        assert_eq!((found.mean, found.labels.len()), (None, 0));
    }

    #[test]
    fn what_is_no_label_map_is_refused_in_words() {
        let mut v = Array3::<f32>::zeros((2, 3, 4));
        v[[1, 2, 3]] = 117.0;
        assert_eq!(label_map("a.nii", v.view()).unwrap()[[1, 2, 3]], 117);
        for (bad, word) in
            [(0.5, "0.5"), (-1.0, "-1"), (f32::NAN, "NaN"), (f32::INFINITY, "inf"), (LARGEST, "16777216")]
        {
            v[[0, 1, 2]] = bad;
            let e = label_map("a.nii", v.view()).unwrap_err().to_string();
            assert!(e.contains("a.nii: voxel [0, 1, 2]") && e.contains(word), "{e}");
        }
        let e = dice(Array3::zeros((2, 2, 2)).view(), Array3::zeros((2, 2, 3)).view()).unwrap_err().to_string();
        assert!(e.contains("[2, 2, 2]") && e.contains("[2, 2, 3]"), "{e}");
    }
}
