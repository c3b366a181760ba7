//! Mean and standard deviation.

use serde::Serialize;

/// Mean and spread of a figure's values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The sample standard deviation (n − 1); `None` for a single value.
    pub sd: Option<f64>,
    /// The number of values.
    pub n: usize,
}

impl Spread {
    /// The spread of `values`; `None` if there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len();
        if n == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n as f64;
        let squares = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
        let sd = (n > 1).then(|| (squares / (n as f64 - 1.0)).sqrt()).filter(|sd| sd.is_finite());
        Some(Self { mean, sd, n })
    }

    /// Mean ± standard deviation, each formatted by `number`.
    pub fn shown(&self, number: impl Fn(f64) -> String) -> String {
        let mean = number(self.mean);
        self.sd.map_or(mean.clone(), |sd| format!("{mean} ± {}", number(sd)))
    }

    /// The same for differences, with their sign.
    pub fn signed(&self, number: impl Fn(f64) -> String) -> String {
        let sign = if self.mean >= 0.0 { "+" } else { "" };
        format!("{sign}{}", self.shown(number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_deviation_are_known() {
        let two = |x: f64| format!("{x:.2}");
        // 2, 4, 4, 4, 5, 5, 7, 9: mean 5, squares 32, over 7.
        let all = Spread::of(&[2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]).unwrap();
        assert_eq!((all.mean, all.n), (5.0, 8));
        assert!((all.sd.unwrap() - (32.0f64 / 7.0).sqrt()).abs() < 1e-15);
        assert_eq!(all.signed(two), "+5.00 ± 2.14");
        let one = Spread::of(&[-3.0]).unwrap();
        assert_eq!((one.sd, one.shown(two), one.signed(two)), (None, "-3.00".into(), "-3.00".into()));
        assert_eq!(Spread::of(&[]), None);
        let without_end = Spread::of(&[f64::INFINITY, 1.0]).unwrap();
        assert_eq!((without_end.sd, without_end.shown(two)), (None, "inf".into()));
    }
}
