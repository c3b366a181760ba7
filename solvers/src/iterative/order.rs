//! Ordered subsets of the views.

use conefield_core::error::{Result, ensure};
use conefield_core::random::stream;
use conefield_core::words::{counted, plural};
use rand::seq::SliceRandom;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Number of subsets of the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Subsets {
    /// This many; 1 uses all views at once.
    Count(usize),
    /// One subset per view.
    Each(Each),
}

/// One subset per element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Each {
    /// One view at a time.
    Views,
}

impl Subsets {
    /// One view at a time.
    pub const VIEWS: Self = Self::Each(Each::Views);

    /// Refuses 0; the error names the key `subsets`.
    pub fn validate(self) -> Result<()> {
        ensure(self != Self::Count(0), "spec", "subsets", 0, "at least 1, or \"views\"")
    }

    /// The number of subsets for `views` views.
    pub fn count(self, views: usize) -> usize {
        match self {
            Self::Count(n) => n.clamp(1, views.max(1)),
            Self::Each(Each::Views) => views.max(1),
        }
    }

    /// The subsets of `views` views.
    pub fn of(self, views: usize) -> Vec<Vec<usize>> {
        split(views, self.count(views))
    }
}

impl std::fmt::Display for Subsets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Count(1) => f.write_str("all views at once"),
            Self::Count(n) => write!(f, "{n} subsets"),
            Self::Each(Each::Views) => f.write_str("one view at a time"),
        }
    }
}

/// The order of subsets within a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// One after another.
    Sequential,
    /// Shuffled in every pass, by the run's seed.
    Random,
    /// In golden-section steps around the orbit: each subset is far from all earlier ones.
    Golden,
}

/// Splits `views` views into `n` interleaved groups (every `n`th view) of nearly equal size.
pub fn split(views: usize, n: usize) -> Vec<Vec<usize>> {
    (0..n).map(|s| (s..views).step_by(n).collect()).collect()
}

/// Text for the log: number of subsets and views.
pub fn summary(subsets: &[Vec<usize>]) -> String {
    let sizes = || subsets.iter().map(Vec::len);
    let (least, most) = (sizes().min().unwrap_or(0), sizes().max().unwrap_or(0));
    let views = if least == most { format!("{most}") } else { format!("{least} or {most}") };
    format!("{} of {views} {}", counted(subsets.len(), "subset"), plural(most, "view"))
}

impl Order {
    /// The order of `count` subsets in pass `pass`.
    pub fn of(self, count: usize, seed: u64, pass: u64) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        match self {
            Order::Sequential => {}
            Order::Random => order.shuffle(&mut stream(seed ^ 0x0bde_5ed0, pass)),
            Order::Golden => {
                // Step k lands at the fraction k·0.618…; it takes the nearest free subset.
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
        let s = Subsets::Count(3).of(11);
        assert_eq!(s, [vec![0, 3, 6, 9], vec![1, 4, 7, 10], vec![2, 5, 8]]);
        assert_eq!(Subsets::Count(9).of(4).len(), 4);
        assert_eq!(Subsets::VIEWS.of(4), Subsets::Count(4).of(4));
        assert_eq!(summary(&s), "3 subsets of 3 or 4 views");
        assert_eq!(summary(&Subsets::VIEWS.of(4)), "4 subsets of 1 view");
        assert_eq!(summary(&Subsets::Count(1).of(4)), "1 subset of 4 views");
    }

    #[test]
    fn a_number_or_views_can_be_written() {
        for (text, subsets) in [("7", Subsets::Count(7)), ("\"views\"", Subsets::VIEWS)] {
            assert_eq!(serde_json::from_str::<Subsets>(text).unwrap(), subsets);
            assert_eq!(serde_json::to_string(&subsets).unwrap(), text);
        }
        assert!(serde_json::from_str::<Subsets>("\"view\"").is_err());
        assert!(Subsets::Count(0).validate().is_err() && Subsets::VIEWS.validate().is_ok());
    }
}
