//! Principal components of features.

use conefield_core::parallel;

/// Maximum sweeps of Jacobi's method; about ten suffice for hundreds of channels.
const SWEEPS: usize = 50;

/// The directions of largest variance of features.
#[derive(Debug, Clone, PartialEq)]
pub struct Pca {
    mean: Vec<f64>,
    /// One unit vector over channels per direction, by decreasing variance.
    axes: Vec<Vec<f64>>,
    /// Variance along each direction.
    pub variance: Vec<f64>,
}

impl Pca {
    /// Analyses features `[F][rows]`. The largest entry of each direction is positive.
    pub fn of(features: &[f32], rows: usize) -> Self {
        let channels: Vec<&[f32]> = features.chunks_exact(rows).collect();
        let n = rows as f64;
        let mean: Vec<f64> = channels.iter().map(|c| c.iter().map(|&x| f64::from(x)).sum::<f64>() / n).collect();
        let lower: Vec<Vec<f64>> = parallel::map(0..channels.len(), |_, i| {
            let with = |j: usize| {
                let (a, b) = (channels[i], channels[j]);
                a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - mean[i]) * (f64::from(b) - mean[j])).sum::<f64>() / n
            };
            (0..=i).map(with).collect()
        });
        let whole = |i: usize| (0..lower.len()).map(|j| lower[i.max(j)][i.min(j)]).collect();
        let (variance, axes) = eigen((0..lower.len()).map(whole).collect());
        // Rounding may make a variance of 0 slightly negative.
        Self { mean, axes, variance: variance.into_iter().map(|v| v.max(0.0)).collect() }
    }

    /// The share of the total variance along each direction; `None` if it is zero.
    pub fn explained(&self) -> Option<Vec<f64>> {
        let total: f64 = self.variance.iter().sum();
        (total > 0.0 && total.is_finite()).then(|| self.variance.iter().map(|v| v / total).collect())
    }

    /// The projection of every row onto direction `k`.
    pub fn component(&self, k: usize, features: &[f32], rows: usize) -> Vec<f32> {
        let mut out = vec![0.0f64; rows];
        for ((channel, mean), weight) in features.chunks_exact(rows).zip(&self.mean).zip(&self.axes[k]) {
            out.iter_mut().zip(channel).for_each(|(o, &x)| *o += weight * (f64::from(x) - mean));
        }
        out.into_iter().map(|x| x as f32).collect()
    }
}

/// Eigenvalues of a symmetric matrix in decreasing order, with unit eigenvectors, by cyclic Jacobi rotations (Golub &
/// Van Loan, Matrix Computations, 8.5).
fn eigen(mut a: Vec<Vec<f64>>) -> (Vec<f64>, Vec<Vec<f64>>) {
    let n = a.len();
    let mut v: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect();
    let size = a.iter().flatten().map(|x| x * x).sum::<f64>();
    for _ in 0..SWEEPS {
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i][j] * a[i][j]).sum();
        // Below this, eigenvalues are exact up to rounding.
        if off <= 1e-32 * size {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                if a[p][q] == 0.0 {
                    continue;
                }
                // The rotation that zeroes a[p][q], by the smaller of its two angles.
                let tau = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = 1f64.copysign(tau) / (tau.abs() + tau.hypot(1.0));
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for k in 0..n {
                    let (kp, kq) = (a[k][p], a[k][q]);
                    (a[k][p], a[k][q]) = (c * kp - s * kq, s * kp + c * kq);
                }
                for m in [&mut a, &mut v] {
                    let (head, tail) = m.split_at_mut(q);
                    for (x, y) in head[p].iter_mut().zip(&mut tail[0]) {
                        (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
                    }
                }
            }
        }
    }
    let mut pairs: Vec<(f64, Vec<f64>)> = v.into_iter().enumerate().map(|(i, v)| (a[i][i], v)).collect();
    pairs.sort_by(|x, y| y.0.total_cmp(&x.0));
    for (_, v) in &mut pairs {
        let largest = v.iter().copied().fold(0.0, |m: f64, x| if x.abs() > m.abs() { x } else { m });
        if largest < 0.0 {
            v.iter_mut().for_each(|x| *x = -*x);
        }
    }
    pairs.into_iter().unzip()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{a} {b}");
    }

    #[test]
    fn eigenvalues_that_are_known() {
        let (values, vectors) = eigen(vec![vec![2.0, 1.0], vec![1.0, 2.0]]);
        close(values[0], 3.0);
        close(values[1], 1.0);
        close(vectors[0][0], 0.5f64.sqrt());
        close(vectors[0][1], 0.5f64.sqrt());
        // The second difference on n points has the eigenvalues 2 − 2·cos(kπ/(n + 1)).
        let n = 40;
        let entry = |i: usize, j: usize| match i.abs_diff(j) {
            0 => 2.0,
            1 => -1.0,
            _ => 0.0,
        };
        let a: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| entry(i, j)).collect()).collect();
        let (values, vectors) = eigen(a.clone());
        for (k, value) in values.iter().enumerate() {
            close(*value, 2.0 - 2.0 * ((n - k) as f64 * std::f64::consts::PI / (n + 1) as f64).cos());
        }
        for (value, v) in values.iter().zip(&vectors) {
            for (row, x) in a.iter().zip(v) {
                let product: f64 = row.iter().zip(v).map(|(a, v)| a * v).sum();
                assert!((product - value * x).abs() < 1e-11);
            }
            close(v.iter().map(|x| x * x).sum(), 1.0);
        }
        // Nothing to rotate, and a single number.
        assert_eq!(eigen(vec![vec![0.0; 3]; 3]).0, [0.0; 3]);
        assert_eq!(eigen(vec![vec![5.0]]), (vec![5.0], vec![vec![1.0]]));
    }

    #[test]
    fn points_along_known_directions() {
        // x = 1 + 3a + b, y = 2 + 3a − b, z = 7: a and b are on a grid, so they are uncorrelated.
        let (mut x, mut y) = (vec![], vec![]);
        for a in -4..=4 {
            for b in -4..=4 {
                let (a, b) = (a as f32, b as f32);
                x.push(1.0 + 3.0 * a + b);
                y.push(2.0 + 3.0 * a - b);
            }
        }
        let rows = x.len();
        let features = [x, y, vec![7.0; rows]].concat();
        let pca = Pca::of(&features, rows);
        // The mean square of −4..4 is 20/3; (1, 1)·3a has the square 18a², (1, −1)·b has 2b².
        close(pca.variance[0], 18.0 * 20.0 / 3.0);
        close(pca.variance[1], 2.0 * 20.0 / 3.0);
        assert!(pca.variance[2].abs() < 1e-12);
        let explained = pca.explained().unwrap();
        close(explained[0], 0.9);
        close(explained[1], 0.1);
        let first = pca.component(0, &features, rows);
        assert!((first[0] + 4.0 * 18f32.sqrt()).abs() < 1e-4, "{}", first[0]);
        assert!(pca.component(2, &features, rows).iter().all(|c| c.abs() < 1e-5));
        assert_eq!(Pca::of(&[3.0; 12], 4).explained(), None);
    }
}
