//! Subsets of the views and the order in which they are taken.

use conefield_core::random::stream;
use rand::seq::SliceRandom;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The order of subsets within a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// One after another.
    Sequential,
    /// Shuffled anew for every pass, by the run's seed.
    Random,
    /// By steps of the golden section of the orbit: what follows lies far from all that came before.
    Golden,
}

/// Splits `views` views into `subsets` groups of every `subsets`th view, as equal in size as can be.
pub fn subsets(views: usize, subsets: usize) -> Vec<Vec<usize>> {
    let n = subsets.clamp(1, views.max(1));
    (0..n).map(|s| (s..views).step_by(n).collect()).collect()
}

/// In words: how many subsets of how many views.
pub fn told(subsets: &[Vec<usize>]) -> String {
    let sizes = || subsets.iter().map(Vec::len);
    let (least, most) = (sizes().min().unwrap_or(0), sizes().max().unwrap_or(0));
    let views = if least == most { format!("{most}") } else { format!("{least} or {most}") };
    format!("{} {} of {views} {}", subsets.len(), plural(subsets.len(), "subset"), plural(most, "view"))
}

fn plural(n: usize, word: &str) -> String {
    if n == 1 { word.into() } else { format!("{word}s") }
}

impl Order {
    /// The order of `count` subsets in pass `pass`.
    pub fn of(self, count: usize, seed: u64, pass: u64) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        match self {
            Order::Sequential => {}
            Order::Random => order.shuffle(&mut stream(seed ^ 0x0bde_5ed0, pass)),
            Order::Golden => {
                // Step k lands at the fraction k·0.618…; the nearest subset that is still free is taken.
                let mut free = order.clone();
                for (k, slot) in order.iter_mut().enumerate() {
                    let at = (k as f64 * 0.618_033_988_749_895).fract() * count as f64;
                    let far = |s: usize| {
                        let d = (s as f64 - at).abs();
                        d.min(count as f64 - d)
                    };
                    let best = (0..free.len()).min_by(|&a, &b| far(free[a]).total_cmp(&far(free[b]))).unwrap_or(0);
                    *slot = free.remove(best);
                }
            }
        }
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_order_takes_every_subset_once() {
        for order in [Order::Sequential, Order::Random, Order::Golden] {
            for count in [1, 2, 7, 50] {
                let mut all = order.of(count, 3, 1);
                all.sort_unstable();
                assert_eq!(all, (0..count).collect::<Vec<_>>(), "{order:?}");
            }
        }
        assert_ne!(Order::Random.of(50, 3, 1), Order::Random.of(50, 3, 2));
        assert_eq!(Order::Random.of(50, 3, 1), Order::Random.of(50, 3, 1));
        // Neighbours in a golden order are far apart.
        let golden = Order::Golden.of(50, 0, 0);
        assert!(golden.windows(2).all(|w| w[0].abs_diff(w[1]).min(50 - w[0].abs_diff(w[1])) >= 9), "{golden:?}");
    }

    #[test]
    fn subsets_cover_all_views() {
        let s = subsets(11, 3);
        assert_eq!(s, [vec![0, 3, 6, 9], vec![1, 4, 7, 10], vec![2, 5, 8]]);
        assert_eq!(subsets(4, 9).len(), 4);
        assert_eq!(told(&s), "3 subsets of 3 or 4 views");
        assert_eq!(told(&subsets(4, 9)), "4 subsets of 1 view");
        assert_eq!(told(&subsets(4, 1)), "1 subset of 4 views");
    }
}
