//! Agreement of two volumes about where material is: Matthews correlation coefficient (Matthews, Biochim. Biophys.
//! Acta 405(2), 1975) and Dice coefficient, after a threshold.

use super::check;
use conefield_core::error::{Error, Result};
use ndarray::ArrayView3;
use serde::Serialize;
use std::fmt::{Display, Formatter};
use std::str::FromStr;

/// The value above which a voxel counts as material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Threshold {
    /// The one that separates two classes best; see [`otsu`].
    Otsu,
    /// A value in the volume's unit; material is above it.
    Value(f64),
}

impl FromStr for Threshold {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match (text, text.parse::<f64>()) {
            ("otsu", _) => Ok(Self::Otsu),
            (_, Ok(x)) if x.is_finite() => Ok(Self::Value(x)),
            _ => Err("expected otsu or a finite number".into()),
        }
    }
}

impl Threshold {
    /// Its value for `volume`; material is above it. `None` if all values are equal, and there are no two classes.
    pub fn of(self, volume: ArrayView3<f32>) -> Option<f64> {
        match self {
            Self::Otsu => otsu(volume),
            Self::Value(x) => Some(x),
        }
    }
}

/// Bins of the histogram in [`otsu`].
const BINS: usize = 256;

/// The threshold that maximizes the variance between two classes, in a histogram of 256 equal bins from the smallest to
/// the largest value (Otsu, IEEE Trans. Syst. Man Cybern. 9(1), 1979). `None` if all values are equal or there are none.
pub fn otsu(volume: ArrayView3<f32>) -> Option<f64> {
    let (low, high) = volume.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &x| (a.min(x), b.max(x)));
    let (low, high) = (f64::from(low), f64::from(high));
    let width = (high - low) / BINS as f64;
    if width.is_nan() || width <= 0.0 || !width.is_finite() {
        return None;
    }
    let mut counts = [0u64; BINS];
    volume.iter().for_each(|&x| counts[(((f64::from(x) - low) / width) as usize).min(BINS - 1)] += 1);
    let moment = |bin: usize| counts[bin] as f64 * bin as f64;
    let (all, sum) = (volume.len() as f64, (0..BINS).map(moment).sum::<f64>());
    let (mut below, mut sum_below) = (0.0, 0.0);
    // Bins between the classes are empty and equally good: the threshold is in their middle.
    let mut best = (0.0, 0, 0);
    for (bin, &count) in counts.iter().enumerate().take(BINS - 1) {
        below += count as f64;
        sum_below += moment(bin);
        let above = all - below;
        // The variance between the classes, times the square of the number of values.
        let between = below * above * (sum_below / below - (sum - sum_below) / above).powi(2);
        if between > best.0 {
            best = (between, bin, bin);
        } else if between == best.0 && count == 0 && best.2 + 1 == bin {
            best.2 = bin;
        }
    }
    Some(low + (0.5 * (best.1 + best.2) as f64 + 1.0) * width)
}

/// Where two volumes have material.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Agreement {
    /// The threshold of the result; `None` if all its values are equal: it then has no material.
    pub threshold: Option<f64>,
    /// The threshold of the reference; that of a mask is 0.
    pub reference_threshold: f64,
    /// Matthews correlation coefficient: `(TP·TN − FP·FN)/√((TP+FP)(TP+FN)(TN+FP)(TN+FN))`, from −1 to 1. It is 0 for a
    /// result without material or without anything else.
    pub mcc: f64,
    /// Dice coefficient `2TP/(2TP + FP + FN)`.
    pub dice: f64,
    /// Voxels of material in the result.
    pub voxels: u64,
    /// Voxels of material in the reference.
    pub reference_voxels: u64,
}

impl Display for Agreement {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let threshold = self.threshold.map_or("none: all values are equal".into(), |x| format!("{x:.6}"));
        writeln!(f, "mcc        {:.4}", self.mcc)?;
        writeln!(f, "dice       {:.4}", self.dice)?;
        writeln!(f, "threshold  {threshold}; reference {:.6}", self.reference_threshold)?;
        write!(f, "material   {} voxels; reference {}", self.voxels, self.reference_voxels)
    }
}

/// Compares where `result` and `reference` have material. A reference with two values, of which one is 0, is a mask:
/// the other value is material. Any other reference gets a threshold like the result.
///
/// # Errors
/// Different shapes, values that are not finite, and a reference without material or without anything else.
pub fn agreement(result: ArrayView3<f32>, reference: ArrayView3<f32>, threshold: Threshold) -> Result<Agreement> {
    check::pair(result, reference, 1.0)?;
    let of_result = threshold.of(result);
    let of_reference = if is_mask(reference) { Some(0.0) } else { threshold.of(reference) };
    let [at, reference_at] = [of_result, of_reference].map(|x| x.unwrap_or(f64::INFINITY));
    // Material in both, in the result only, in the reference only, in neither.
    let mut counts = [0u64; 4];
    for (&a, &b) in result.iter().zip(reference) {
        let (a, b) = (f64::from(a) > at, f64::from(b) > reference_at);
        counts[2 * usize::from(!a) + usize::from(!b)] += 1;
    }
    let [both, extra, missed, neither] = counts;
    if both + missed == 0 || extra + neither == 0 {
        let found = if both + missed == 0 { "no material" } else { "nothing but material" };
        return Err(Error::invalid("metrics", "reference", found, "values below and above the threshold"));
    }
    let [tp, fp, missing, tn] = counts.map(|n| n as f64);
    let product = ((tp + fp) * (tp + missing) * (tn + fp) * (tn + missing)).sqrt();
    Ok(Agreement {
        threshold: of_result,
        reference_threshold: reference_at,
        mcc: if product > 0.0 { (tp * tn - fp * missing) / product } else { 0.0 },
        dice: 2.0 * tp / (2.0 * tp + fp + missing),
        voxels: both + extra,
        reference_voxels: both + missed,
    })
}

/// Whether `volume` has two values, 0 and a positive one.
fn is_mask(volume: ArrayView3<f32>) -> bool {
    let top = volume.iter().fold(0.0f32, |m, &x| m.max(x));
    volume.iter().all(|&x| x == 0.0 || x == top)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    fn volume(values: &[f32]) -> Array3<f32> {
        Array3::from_shape_vec((values.len(), 1, 1), values.to_vec()).unwrap()
    }

    #[test]
    fn counts_give_the_scores_of_the_formulas() {
        let mask = volume(&[255.0, 255.0, 255.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        // TP = 2, FP = 1, FN = 1, TN = 4.
        let found = agreement(volume(&[0.9, 0.8, 0.1, 0.7, 0.0, 0.1, 0.2, 0.0]).view(), mask.view(), Threshold::Otsu);
        let found = found.unwrap();
        assert!((found.mcc - 7.0 / 15.0).abs() < 1e-12 && (found.dice - 4.0 / 6.0).abs() < 1e-12, "{found:?}");
        assert_eq!((found.voxels, found.reference_voxels, found.reference_threshold), (3, 3, 0.0));
        let given = agreement(mask.view(), mask.view(), Threshold::Value(100.0)).unwrap();
        assert_eq!((given.mcc, given.dice, given.threshold), (1.0, 1.0, Some(100.0)));
        let other = mask.mapv(|x| 255.0 - x);
        let turned = agreement(other.view(), mask.view(), Threshold::Otsu).unwrap();
        assert_eq!((turned.mcc, turned.dice), (-1.0, 0.0));
    }

    #[test]
    fn an_empty_or_full_volume_scores_no_correlation() {
        let mask = volume(&[1.0, 0.0, 0.0, 1.0, 0.0]);
        let empty = agreement(volume(&[0.0; 5]).view(), mask.view(), Threshold::Otsu).unwrap();
        assert_eq!((empty.mcc, empty.dice, empty.voxels, empty.threshold), (0.0, 0.0, 0, None));
        let full = agreement(volume(&[2.0; 5]).view(), mask.view(), Threshold::Value(1.0)).unwrap();
        assert_eq!((full.mcc, full.voxels), (0.0, 5));
        assert!(full.dice > 0.5, "Dice alone does not see it: {full:?}");
    }

    #[test]
    fn a_reference_of_attenuation_gets_a_threshold_of_its_own() {
        let reference = volume(&[0.01, 0.0, 0.02, 0.5, 0.52, 0.49]);
        let found = agreement(reference.mapv(|x| 3.0 * x).view(), reference.view(), Threshold::Otsu).unwrap();
        assert!(found.mcc == 1.0 && found.reference_voxels == 3, "{found:?}");
        assert!((found.threshold.unwrap() - 3.0 * found.reference_threshold).abs() < 1e-6);
    }

    #[test]
    fn two_classes_are_separated_where_their_variance_is_largest() {
        // Three clusters: the cut is between the two that are further apart.
        let found = otsu(volume(&[0.0, 0.0, 0.1, 0.1, 1.0, 1.0]).view()).unwrap();
        assert!(found > 0.1 && found < 1.0, "{found}");
        assert_eq!(otsu(volume(&[0.0, 1.0]).view()), Some(0.5));
        // Two thresholds as good as each other: the first, not the middle of both, which separates nothing.
        let tied = otsu(volume(&[0.0, 0.498, 0.502, 1.0]).view()).unwrap();
        assert!(tied > 0.0 && tied < 0.498, "{tied}");
        assert_eq!(otsu(volume(&[3.0, 3.0]).view()), None);
        assert_eq!("otsu".parse(), Ok(Threshold::Otsu));
        assert_eq!("-0.5".parse(), Ok(Threshold::Value(-0.5)));
        assert!(["", "nan", "inf", "half"].iter().all(|text| text.parse::<Threshold>().is_err()));
    }

    #[test]
    fn what_cannot_be_compared_is_refused() {
        for (reference, what) in [([0.0, f32::NAN], "finite"), ([0.0, 0.0], "reference: found no material")] {
            let (a, b) = (volume(&[0.0, 1.0]), volume(&reference));
            let e = agreement(a.view(), b.view(), Threshold::Otsu).unwrap_err().to_string();
            assert!(e.contains(what), "{e}");
        }
        let [two, three] = [volume(&[0.0, 1.0]), volume(&[0.0, 1.0, 1.0])];
        assert!(agreement(two.view(), three.view(), Threshold::Otsu).is_err());
    }
}
