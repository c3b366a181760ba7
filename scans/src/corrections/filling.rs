//! Replaces bad pixels by means of their neighbours.

use super::smooth::Sums;
use ndarray::{Array2, ArrayViewMut2};

/// The weights that fill in a detector's bad pixels.
pub struct Filling {
    pixels: Vec<Patch>,
}

/// One bad pixel and the good pixels that replace it, with their weights.
struct Patch {
    at: [usize; 2],
    from: Vec<([u32; 2], f32)>,
}

impl Filling {
    /// Each bad pixel gets the mean of the good ones in the smallest square around it with at least two, weighted by
    /// one over their squared distance. `None` if there is no good pixel at all.
    pub fn new(bad: &Array2<bool>) -> Option<Self> {
        let sums = Sums::of(bad.mapv(|bad| f32::from(!bad)).view());
        let good = bad.iter().filter(|b| !**b).count();
        if good == 0 {
            return None;
        }
        let mut pixels = Vec::new();
        for ((i, j), _) in bad.indexed_iter().filter(|(_, b)| **b) {
            // The reach of the square with the first good pixel, and of that with two: good pixels lie on their edges.
            let reach = |count| least(bad.dim(), |reach| sums.around([i, j], reach).0 >= count as f64);
            let reaches = [reach(1), reach(good.min(2))];
            let mut from = edge(bad, [i, j], reaches[0]);
            if reaches[1] > reaches[0] {
                from.extend(edge(bad, [i, j], reaches[1]));
                from.sort_unstable_by_key(|f| f.0);
            }
            let sum: f32 = from.iter().map(|f| f.1).sum();
            from.iter_mut().for_each(|f| f.1 /= sum);
            pixels.push(Patch { at: [i, j], from });
        }
        Some(Self { pixels })
    }

    /// Fills in one view.
    pub fn fill(&self, mut view: ArrayViewMut2<f32>) {
        for Patch { at, from } in &self.pixels {
            view[*at] = from.iter().map(|([r, c], w)| w * view[[*r as usize, *c as usize]]).sum();
        }
    }
}

/// The smallest reach on a detector of this size that is `enough`; every larger one is.
fn least((rows, columns): (usize, usize), enough: impl Fn(usize) -> bool) -> usize {
    let (mut low, mut high) = (1, rows.max(columns));
    while low < high {
        let middle = (low + high) / 2;
        if enough(middle) { high = middle } else { low = middle + 1 }
    }
    low
}

/// The good pixels on the edge of the square of this reach around a pixel, row by row, each with one over its squared
/// distance.
fn edge(bad: &Array2<bool>, [i, j]: [usize; 2], reach: usize) -> Vec<([u32; 2], f32)> {
    let (rows, columns) = bad.dim();
    let mut found = Vec::new();
    let mut look = |r: usize, c: usize| {
        if !bad[[r, c]] {
            let squared = r.abs_diff(i).pow(2) + c.abs_diff(j).pow(2);
            found.push(([r as u32, c as u32], 1.0 / squared as f32));
        }
    };
    let right = j + reach;
    for r in i.saturating_sub(reach)..(i + reach + 1).min(rows) {
        if r.abs_diff(i) == reach {
            (j.saturating_sub(reach)..(right + 1).min(columns)).for_each(|c| look(r, c));
        } else {
            j.checked_sub(reach).into_iter().chain((right < columns).then_some(right)).for_each(|c| look(r, c));
        }
    }
    found
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

    /// The pixels that a search of whole squares finds, on a detector with dead bands, lines and points.
    #[test]
    fn the_smallest_square_with_two_good_pixels_is_found() {
        let (rows, columns) = (23, 31);
        let bad = Array2::from_shape_fn((rows, columns), |(i, j)| i < 7 || j == 11 || (i * 7 + j * 5) % 3 == 0);
        let pixels = Filling::new(&bad).unwrap().pixels;
        assert_eq!(pixels.len(), bad.iter().filter(|b| **b).count());
        for Patch { at: [i, j], from } in pixels {
            let within = |reach: usize| {
                let near = |((r, c), b): &((usize, usize), &bool)| !**b && r.abs_diff(i).max(c.abs_diff(j)) <= reach;
                bad.indexed_iter().filter(near).map(|((r, c), _)| [r as u32, c as u32]).collect::<Vec<_>>()
            };
            let expected = (1..31).map(within).find(|found| found.len() >= 2).unwrap();
            assert_eq!(from.iter().map(|f| f.0).collect::<Vec<_>>(), expected, "{i}, {j}");
        }
        // One good pixel fills all others.
        let mut one = Array2::from_elem((5, 4), true);
        one[[1, 2]] = false;
        assert!(Filling::new(&one).unwrap().pixels.iter().all(|p| p.from == [([1, 2], 1.0)]));
    }

    /// A search of whole squares would take minutes.
    #[test]
    fn a_dead_band_is_filled_soon() {
        let bad = Array2::from_shape_fn((600, 600), |(i, _)| i < 120);
        let filling = Filling::new(&bad).unwrap();
        let mut view = Array2::from_shape_fn((600, 600), |(i, _)| if i < 120 { f32::NAN } else { 2.0 });
        filling.fill(view.view_mut());
        assert!(view.iter().all(|v| (v - 2.0).abs() < 1e-4));
    }
}
