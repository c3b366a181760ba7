//! Dense layers on channel-major tiles: `y = W·x + b` and its two adjoints.
//!
//! `x` is `[k][n]` and `y` is `[m][n]` with the rows of the tile innermost, so that lanes run over rows; `W` is
//! `[m][ld]` row-major. Register blocks hold 8 channels × 2 vectors (forward, input gradient) and 4 × 4 channels
//! (weight gradient).

use crate::simd::{Real, Simd, SimdBase, SimdFloat, V, load, store};

/// Which part of a weight matrix a product uses.
#[derive(Clone, Copy)]
pub struct Weights<'a, R> {
    /// `[m][ld]`, row-major.
    pub data: &'a [R],
    /// Columns of the whole matrix.
    pub ld: usize,
    /// First column used.
    pub column: usize,
}

/// What a product does with the numbers that stand in its output.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Output {
    /// Replaces them.
    Set,
    /// Adds to them.
    Add,
    /// Multiplies them: the chain rule through an activation whose derivative stands there.
    Multiply,
}

/// `y = W[:, column..column + k]·x + bias`, or `y += …` without a bias.
#[inline(always)]
pub fn affine<S: Simd, R: Real>(s: S, w: Weights<'_, R>, bias: Option<&[R]>, x: &[R], y: &mut [R], n: usize) {
    let (k, m) = (x.len() / n, y.len() / n);
    let len = V::<S, R>::LEN;
    let row = |o: usize| &w.data[o * w.ld + w.column..][..k];
    let mut i = 0;
    while i < n {
        let wide = i + 2 * len <= n;
        let mut o = 0;
        while o < m {
            if o + 8 <= m && wide {
                affine_block::<S, R, 8, 2>(
                    s,
                    std::array::from_fn(|j| row(o + j)),
                    bias.map(|b| &b[o..]),
                    x,
                    &mut y[o * n..],
                    n,
                    i,
                );
                o += 8;
            } else if o + 4 <= m {
                if wide {
                    affine_block::<S, R, 4, 2>(
                        s,
                        std::array::from_fn(|j| row(o + j)),
                        bias.map(|b| &b[o..]),
                        x,
                        &mut y[o * n..],
                        n,
                        i,
                    );
                } else {
                    affine_block::<S, R, 4, 1>(
                        s,
                        std::array::from_fn(|j| row(o + j)),
                        bias.map(|b| &b[o..]),
                        x,
                        &mut y[o * n..],
                        n,
                        i,
                    );
                }
                o += 4;
            } else {
                if wide {
                    affine_block::<S, R, 1, 2>(s, [row(o)], bias.map(|b| &b[o..]), x, &mut y[o * n..], n, i);
                } else {
                    affine_block::<S, R, 1, 1>(s, [row(o)], bias.map(|b| &b[o..]), x, &mut y[o * n..], n, i);
                }
                o += 1;
            }
        }
        i += if wide { 2 * len } else { len };
    }
}

#[inline(always)]
fn affine_block<S: Simd, R: Real, const M: usize, const C: usize>(
    s: S,
    w: [&[R]; M],
    bias: Option<&[R]>,
    x: &[R],
    y: &mut [R],
    n: usize,
    i: usize,
) {
    let len = V::<S, R>::LEN;
    let mut acc: [[V<S, R>; C]; M] = std::array::from_fn(|j| {
        std::array::from_fn(|c| match bias {
            Some(b) => V::<S, R>::splat(s, b[j]),
            None => load(s, &y[j * n..(j + 1) * n], i + c * len),
        })
    });
    for (k, x) in x.chunks_exact(n).enumerate() {
        let x: [V<S, R>; C] = std::array::from_fn(|c| load(s, x, i + c * len));
        for j in 0..M {
            let w = V::<S, R>::splat(s, w[j][k]);
            for c in 0..C {
                acc[j][c] = w.mul_add(x[c], acc[j][c]);
            }
        }
    }
    for j in 0..M {
        for c in 0..C {
            store::<S, R>(acc[j][c], &mut y[j * n..(j + 1) * n], i + c * len);
        }
    }
}

/// `dx = W[:, column..column + k]ᵀ·dy`, set, added or multiplied into `dx`.
#[inline(always)]
pub fn affine_input<S: Simd, R: Real>(s: S, w: Weights<'_, R>, dy: &[R], dx: &mut [R], out: Output, n: usize) {
    let k = dx.len() / n;
    let len = V::<S, R>::LEN;
    let mut i = 0;
    while i < n {
        let wide = i + 2 * len <= n;
        let mut c = 0;
        while c < k {
            let width = if c + 8 <= k && wide {
                8
            } else if c + 4 <= k {
                4
            } else {
                1
            };
            let (w, dx) = (Weights { column: w.column + c, ..w }, &mut dx[c * n..(c + width) * n]);
            match (width, wide) {
                (8, _) => input_block::<S, R, 8, 2>(s, w, dy, dx, out, n, i),
                (4, true) => input_block::<S, R, 4, 2>(s, w, dy, dx, out, n, i),
                (4, false) => input_block::<S, R, 4, 1>(s, w, dy, dx, out, n, i),
                (_, true) => input_block::<S, R, 1, 2>(s, w, dy, dx, out, n, i),
                (_, false) => input_block::<S, R, 1, 1>(s, w, dy, dx, out, n, i),
            }
            c += width;
        }
        i += if wide { 2 * len } else { len };
    }
}

#[inline(always)]
fn input_block<S: Simd, R: Real, const K: usize, const C: usize>(
    s: S,
    w: Weights<'_, R>,
    dy: &[R],
    dx: &mut [R],
    out: Output,
    n: usize,
    i: usize,
) {
    let len = V::<S, R>::LEN;
    let mut acc: [[V<S, R>; C]; K] = std::array::from_fn(|j| {
        std::array::from_fn(|c| {
            if out == Output::Add {
                load(s, &dx[j * n..(j + 1) * n], i + c * len)
            } else {
                V::<S, R>::splat(s, R::ZERO)
            }
        })
    });
    for (o, dy) in dy.chunks_exact(n).enumerate() {
        let d: [V<S, R>; C] = std::array::from_fn(|c| load(s, dy, i + c * len));
        let w = &w.data[o * w.ld + w.column..][..K];
        for j in 0..K {
            let w = V::<S, R>::splat(s, w[j]);
            for c in 0..C {
                acc[j][c] = w.mul_add(d[c], acc[j][c]);
            }
        }
    }
    for j in 0..K {
        for c in 0..C {
            let dx = &mut dx[j * n..(j + 1) * n];
            let v = if out == Output::Multiply { acc[j][c] * load(s, dx, i + c * len) } else { acc[j][c] };
            store::<S, R>(v, dx, i + c * len);
        }
    }
}

/// `dW[:, column..column + k] += dy·xᵀ`, and `db += Σ dy` where `db` is given.
#[inline(always)]
pub fn affine_weights<S: Simd, R: Real>(
    s: S,
    dy: &[R],
    x: &[R],
    dw: &mut [R],
    ld: usize,
    column: usize,
    db: Option<&mut [R]>,
    n: usize,
) {
    let (m, k) = (dy.len() / n, x.len() / n);
    let mut o = 0;
    while o < m {
        let tall = if o + 4 <= m { 4 } else { 1 };
        let mut c = 0;
        while c < k {
            let broad = if c + 4 <= k { 4 } else { 1 };
            let (dy, x) = (&dy[o * n..(o + tall) * n], &x[c * n..(c + broad) * n]);
            let dw = &mut dw[o * ld + column + c..];
            match (tall, broad) {
                (4, 4) => weights_block::<S, R, 4, 4>(s, dy, x, dw, ld, n),
                (4, _) => weights_block::<S, R, 4, 1>(s, dy, x, dw, ld, n),
                (_, 4) => weights_block::<S, R, 1, 4>(s, dy, x, dw, ld, n),
                _ => weights_block::<S, R, 1, 1>(s, dy, x, dw, ld, n),
            }
            c += broad;
        }
        o += tall;
    }
    if let Some(db) = db {
        for (db, dy) in db.iter_mut().zip(dy.chunks_exact(n)) {
            *db += total(s, dy);
        }
    }
}

/// `M·K` dot products over the rows of the tile.
#[inline(always)]
fn weights_block<S: Simd, R: Real, const M: usize, const K: usize>(
    s: S,
    dy: &[R],
    x: &[R],
    dw: &mut [R],
    ld: usize,
    n: usize,
) {
    let len = V::<S, R>::LEN;
    let zero = V::<S, R>::splat(s, R::ZERO);
    let mut acc = [zero; 16];
    let dy: [&[R]; M] = std::array::from_fn(|j| &dy[j * n..(j + 1) * n]);
    let x: [&[R]; K] = std::array::from_fn(|j| &x[j * n..(j + 1) * n]);
    let mut i = 0;
    while i < n {
        let x: [V<S, R>; K] = std::array::from_fn(|j| load(s, x[j], i));
        for j in 0..M {
            let d = load(s, dy[j], i);
            for k in 0..K {
                acc[j * K + k] = d.mul_add(x[k], acc[j * K + k]);
            }
        }
        i += len;
    }
    let sums = lane_sums::<S, R>(acc);
    for j in 0..M {
        for k in 0..K {
            dw[j * ld + k] += sums[j * K + k];
        }
    }
}

/// The sum over lanes of each of 16 vectors. A tree of pairwise sums: after `log2(LEN)` rounds the sums stand in
/// order, a vector of them for every `LEN` inputs.
#[inline(always)]
fn lane_sums<S: Simd, R: Real>(mut v: [V<S, R>; 16]) -> [R; 16] {
    let len = V::<S, R>::LEN;
    let mut out = [R::ZERO; 16];
    if len > 16 {
        for (o, v) in out.iter_mut().zip(v) {
            *o = v.as_slice().iter().copied().sum();
        }
        return out;
    }
    let mut live = 16;
    let mut width = len;
    while width > 1 {
        live /= 2;
        for j in 0..live {
            let (a, b) = (v[2 * j], v[2 * j + 1]);
            v[j] = a.unzip_low(b) + a.unzip_high(b);
        }
        width /= 2;
    }
    for j in 0..16 / len {
        v[j].store_slice(&mut out[j * len..(j + 1) * len]);
    }
    out
}

/// The sum of a slice, lane by lane first.
#[inline(always)]
pub fn total<S: Simd, R: Real>(s: S, x: &[R]) -> R {
    let mut acc = V::<S, R>::splat(s, R::ZERO);
    let mut i = 0;
    while i < x.len() {
        acc = acc + load(s, x, i);
        i += V::<S, R>::LEN;
    }
    acc.as_slice().iter().copied().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Op, run};

    struct All<'a, R> {
        w: &'a [R],
        x: &'a [R],
        dy: &'a [R],
        n: usize,
        ld: usize,
        column: usize,
    }

    impl<R: Real> Op for All<'_, R> {
        type Out = [Vec<R>; 4];
        #[inline(always)]
        fn call<S: Simd>(self, s: S) -> Self::Out {
            let Self { w, x, dy, n, ld, column } = self;
            let m = dy.len() / n;
            let bias: Vec<R> = (0..m).map(|i| R::of(i as f64)).collect();
            let (mut y, mut dx) = (vec![R::ZERO; dy.len()], vec![R::ONE; x.len()]);
            let (mut dw, mut db) = (vec![R::ONE; w.len()], vec![R::ZERO; m]);
            let weights = Weights { data: w, ld, column };
            affine(s, weights, Some(&bias), x, &mut y, n);
            affine_input(s, weights, dy, &mut dx, Output::Add, n);
            affine_weights(s, dy, x, &mut dw, ld, column, Some(&mut db), n);
            [y, dx, dw, db]
        }
    }

    #[test]
    fn products_agree_with_plain_loops_for_every_size() {
        let f = |i: usize| ((i * 7919 + 13) % 101) as f64 / 50.0 - 1.0;
        for (m, k, n) in [(1, 1, 1), (1, 32, 256), (8, 3, 33), (13, 9, 100), (32, 20, 64), (33, 17, 31)] {
            let (ld, column) = (k + 3, 2);
            let w: Vec<f32> = (0..m * ld).map(|i| f(i) as f32).collect();
            let x: Vec<f32> = (0..k * n).map(|i| f(i + 5) as f32).collect();
            let dy: Vec<f32> = (0..m * n).map(|i| f(i + 11) as f32).collect();
            let [y, dx, dw, db] = run(All { w: &w, x: &x, dy: &dy, n, ld, column });
            let close = |a: f32, b: f64| (f64::from(a) - b).abs() <= 2e-4 * (1.0 + b.abs());
            let at = |v: &[f32], i: usize| f64::from(v[i]);
            for o in 0..m {
                for i in 0..n {
                    let want = o as f64 + (0..k).map(|c| at(&w, o * ld + column + c) * at(&x, c * n + i)).sum::<f64>();
                    assert!(close(y[o * n + i], want), "y {m} {k} {n}");
                }
                assert!(close(db[o], (0..n).map(|i| at(&dy, o * n + i)).sum()), "db {m} {k} {n}");
                for c in 0..ld {
                    let inside = c >= column && c < column + k;
                    let sum = if inside {
                        (0..n).map(|i| at(&dy, o * n + i) * at(&x, (c - column) * n + i)).sum()
                    } else {
                        0.0
                    };
                    assert!(close(dw[o * ld + c], 1.0 + sum), "dw {m} {k} {n}");
                }
            }
            for c in 0..k {
                for i in 0..n {
                    let want = 1.0 + (0..m).map(|o| at(&w, o * ld + column + c) * at(&dy, o * n + i)).sum::<f64>();
                    assert!(close(dx[c * n + i], want), "dx {m} {k} {n}");
                }
            }
        }
    }
}
