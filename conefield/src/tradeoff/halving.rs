//! Successive halving (Jamieson and Talwalkar, AISTATS 2016): many candidates get a small budget, the best share of
//! them a larger one. Fields and voxel methods are ranked separately.

use crate::tradeoff::front::Unknowns;

/// The result of a candidate under a budget.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrialOutcome {
    /// Accuracy; higher is better.
    Accuracy(f64),
    /// The budget was too short to do anything, which says nothing about the candidate.
    TooShort,
    /// It failed.
    Failed,
}

/// Number of candidates out of `n` to keep: the share `keep`, at least one.
pub fn kept(n: usize, keep: f64) -> usize {
    ((n as f64 * keep - 1e-9).ceil() as usize).clamp(n.min(1), n)
}

/// Indices of the candidates to keep for the next budget, in the given order: for each kind the best share of the
/// ranked ones, and all that could not be ranked.
pub fn go_on(tried: &[(Unknowns, TrialOutcome)], keep: f64) -> Vec<usize> {
    let mut all = vec![];
    for kind in [Unknowns::Field, Unknowns::Voxels] {
        let of_kind = tried.iter().enumerate().filter(|(_, (k, _))| *k == kind);
        let mut judged = 0;
        let mut ranked: Vec<(usize, f64)> = vec![];
        for (i, (_, outcome)) in of_kind {
            judged += usize::from(*outcome != TrialOutcome::TooShort);
            match outcome {
                TrialOutcome::Accuracy(a) if !a.is_nan() => ranked.push((i, *a)),
                TrialOutcome::TooShort => all.push(i),
                _ => {}
            }
        }
        // Stable: of equal candidates the first stays first.
        ranked.sort_by(|a, b| b.1.total_cmp(&a.1));
        all.extend(ranked.iter().take(kept(judged, keep)).map(|(i, _)| *i));
    }
    all.sort_unstable();
    all
}

/// Upper bounds for the remaining number of trials at each of `rungs` budgets, for these numbers of candidates.
pub fn to_come(fields: usize, voxels: usize, rungs: usize, keep: f64) -> Vec<usize> {
    let next = |n: &[usize; 2]| Some(n.map(|n| kept(n, keep)));
    std::iter::successors(Some([fields, voxels]), next).map(|n| n.iter().sum()).take(rungs).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn outcomes() -> impl Strategy<Value = Vec<(Unknowns, TrialOutcome)>> {
        let kind = prop_oneof![Just(Unknowns::Field), Just(Unknowns::Voxels)];
        // Few values, so that some are equal.
        let outcome = prop_oneof![
            4 => (0..6).prop_map(|a| TrialOutcome::Accuracy(f64::from(a))),
            1 => Just(TrialOutcome::TooShort),
            1 => Just(TrialOutcome::Failed),
        ];
        prop::collection::vec((kind, outcome), 0..40)
    }

    proptest! {
        #[test]
        fn the_best_share_of_each_kind_goes_on(tried in outcomes(), keep in 0.05f64..=1.0) {
            let on = go_on(&tried, keep);
            prop_assert!(on.windows(2).all(|w| w[0] < w[1]));
            for kind in [Unknowns::Field, Unknowns::Voxels] {
                let of = |i: &usize| tried[*i].0 == kind;
                let accuracy = |i: &usize| match tried[*i].1 { TrialOutcome::Accuracy(a) => Some(a), _ => None };
                let all: Vec<usize> = (0..tried.len()).filter(of).collect();
                let judged = all.iter().filter(|i| tried[**i].1 != TrialOutcome::TooShort).count();
                let good = all.iter().filter_map(accuracy).count();
                let here: Vec<usize> = on.iter().copied().filter(of).collect();
                let went: Vec<f64> = here.iter().filter_map(accuracy).collect();
                prop_assert_eq!(went.len(), kept(judged, keep).min(good));
                let stayed = all.iter().filter(|i| !here.contains(i)).filter_map(accuracy);
                let worst = went.iter().copied().fold(f64::INFINITY, f64::min);
                for a in stayed {
                    prop_assert!(a <= worst);
                }
                for i in all {
                    let unjudged = tried[i].1 == TrialOutcome::TooShort;
                    prop_assert!(!unjudged || here.contains(&i));
                    prop_assert!(tried[i].1 != TrialOutcome::Failed || !here.contains(&i));
                }
            }
        }

        #[test]
        fn a_share_is_never_none_and_never_more(n in 0usize..1000, keep in 0.001f64..=1.0) {
            let k = kept(n, keep);
            prop_assert!(k <= n && (n == 0 || k >= 1));
            prop_assert!((k as f64) < n as f64 * keep + 1.0 && k as f64 >= (n as f64 * keep - 1e-6).min(n as f64));
        }
    }

    #[test]
    fn halves_and_thirds_are_what_they_say() {
        assert_eq!(
            [kept(8, 0.5), kept(9, 1.0 / 3.0), kept(7, 0.5), kept(1, 0.1), kept(0, 0.5), kept(5, 1.0)],
            [4, 3, 4, 1, 0, 5]
        );
        assert_eq!(to_come(8, 4, 4, 0.5), [12, 6, 3, 2]);
    }
}
