//! Pareto optimality in time, memory and accuracy.

/// Cost and accuracy of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Performance {
    /// Time; lower is better.
    pub seconds: f64,
    /// Memory; lower is better.
    pub bytes: f64,
    /// Accuracy; higher is better.
    pub accuracy: f64,
}

/// Times and sizes within about this share of each other count as equal: repeated runs differ by as much.
const GRAIN: f64 = 0.1;

impl Performance {
    /// Time and memory in units of the grain.
    fn coarse(&self) -> [f64; 2] {
        [self.seconds, self.bytes].map(|x| (x.max(1e-9).ln() / (1.0 + GRAIN).ln()).round())
    }

    /// Whether it is at least as good in everything and better in something. If time and memory count as equal,
    /// accuracy decides, then the exact figures.
    pub fn beats(&self, other: &Self) -> bool {
        let (a, b) = (self.coarse(), other.coarse());
        let fine = |s: &Self| [s.seconds, s.bytes];
        let no_worse = |x: [f64; 2], y: [f64; 2]| x.iter().zip(y).all(|(x, y)| *x <= y);
        if self.accuracy < other.accuracy || !no_worse(a, b) {
            return false;
        }
        self.accuracy > other.accuracy || a != b || (no_worse(fine(self), fine(other)) && fine(self) != fine(other))
    }
}

/// The indices of those that no other beats, by ascending time.
pub fn front(all: &[Performance]) -> Vec<usize> {
    let good = |s: &Performance| s.seconds.is_finite() && s.bytes.is_finite() && !s.accuracy.is_nan();
    let free = |i: &usize| good(&all[*i]) && !all.iter().any(|o| good(o) && o.beats(&all[*i]));
    let mut found: Vec<usize> = (0..all.len()).filter(free).collect();
    found.sort_by(|a, b| all[*a].seconds.total_cmp(&all[*b].seconds));
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn some() -> impl Strategy<Value = Vec<Performance>> {
        let one = (1.0f64..100.0, 1e6f64..1e9, 0u32..40).prop_map(|(seconds, bytes, a)| Performance {
            seconds,
            bytes,
            accuracy: f64::from(a),
        });
        prop::collection::vec(one, 0..60)
    }

    /// Plain dominance, without grains.
    fn dominates(a: &Performance, b: &Performance) -> bool {
        let no_worse = a.seconds <= b.seconds && a.bytes <= b.bytes && a.accuracy >= b.accuracy;
        no_worse && a != b
    }

    proptest! {
        #[test]
        fn none_of_the_front_is_dominated_and_all_else_is_beaten(all in some()) {
            let found = front(&all);
            for &i in &found {
                prop_assert!(!all.iter().any(|o| dominates(o, &all[i])));
            }
            for i in (0..all.len()).filter(|i| !found.contains(i)) {
                prop_assert!(found.iter().any(|f| all[*f].beats(&all[i])), "beaten by one of the front itself");
            }
            prop_assert!(found.windows(2).all(|w| all[w[0]].seconds <= all[w[1]].seconds));
        }

        #[test]
        fn beating_is_an_order(all in some()) {
            for a in &all {
                prop_assert!(!a.beats(a));
                for b in &all {
                    prop_assert!(!(a.beats(b) && b.beats(a)));
                    for c in all.iter().filter(|c| b.beats(c)) {
                        prop_assert!(!a.beats(b) || a.beats(c));
                    }
                }
            }
        }
    }

    #[test]
    fn equal_times_within_measurement_error_are_decided_by_accuracy() {
        let s = |seconds, bytes, accuracy| Performance { seconds, bytes, accuracy };
        let all =
            [s(60.0, 1e8, 30.0), s(59.0, 1e8, 29.0), s(10.0, 1e8, 20.0), s(70.0, 5e7, 25.0), s(9.0, 2e8, f64::NAN)];
        assert_eq!(front(&all), [2, 0, 3]);
        assert!(front(&[]).is_empty());
        assert_eq!(front(&[all[0], all[0]]), [0, 1], "equals stay");
    }
}
