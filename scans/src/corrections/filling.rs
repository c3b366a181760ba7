//! Replaces bad pixels by means of their neighbours.

use ndarray::{Array2, ArrayViewMut2};

/// The weights that fill in a detector's bad pixels.
pub struct Filling {
    pixels: Vec<Patch>,
}

/// One bad pixel and the good pixels that replace it, with their weights.
struct Patch {
    at: [usize; 2],
    from: Vec<([usize; 2], f32)>,
}

impl Filling {
    /// Each bad pixel gets the mean of the good ones in the smallest square around it with at least two, weighted by
    /// one over their squared distance. `None` if there is no good pixel at all.
    pub fn new(bad: &Array2<bool>) -> Option<Self> {
        let (rows, columns) = bad.dim();
        let good = bad.iter().filter(|b| !**b).count();
        let mut pixels = Vec::new();
        for ((i, j), _) in bad.indexed_iter().filter(|(_, b)| **b) {
            let mut from = Vec::new();
            for reach in 1..rows.max(columns) {
                from.clear();
                for r in i.saturating_sub(reach)..(i + reach + 1).min(rows) {
                    for c in j.saturating_sub(reach)..(j + reach + 1).min(columns) {
                        if !bad[[r, c]] {
                            let squared = (r.abs_diff(i)).pow(2) + (c.abs_diff(j)).pow(2);
                            from.push(([r, c], 1.0 / squared as f32));
                        }
                    }
                }
                if from.len() >= good.min(2) {
                    break;
                }
            }
            let sum: f32 = from.iter().map(|f| f.1).sum();
            if from.is_empty() {
                return None;
            }
            from.iter_mut().for_each(|f| f.1 /= sum);
            pixels.push(Patch { at: [i, j], from });
        }
        Some(Self { pixels })
    }

    /// Fills in one view.
    pub fn fill(&self, mut view: ArrayViewMut2<f32>) {
        for Patch { at, from } in &self.pixels {
            view[*at] = from.iter().map(|(p, w)| w * view[*p]).sum();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_fill_a_linear_ramp_exactly() {
        let ramp = Array2::from_shape_fn((9, 9), |(i, j)| 3.0 * i as f32 - 2.0 * j as f32);
        let mut bad = Array2::from_elem((9, 9), false);
        (bad[[4, 4]], bad[[0, 0]]) = (true, true);
        let mut view = ramp.clone();
        (view[[4, 4]], view[[0, 0]]) = (1e9, f32::NAN);
        Filling::new(&bad).unwrap().fill(view.view_mut());
        assert!((view[[4, 4]] - ramp[[4, 4]]).abs() < 1e-5 && (view[[0, 0]] - ramp[[0, 0]]).abs() <= 3.0);
        bad.fill(true);
        assert!(Filling::new(&bad).is_none());
    }
}
