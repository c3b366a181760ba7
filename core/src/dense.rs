//! Dense layers on channel-major tiles: `y = W·x + b` and its two adjoints.
//!
//! `x` is `[k][n]` and `y` is `[m][n]` with the rows of the tile innermost, so that lanes run over rows; `W` is
//! `[m][ld]` row-major. Register blocks hold 8 channels × 2 vectors (forward, input gradient) and 4 × 4 channels
//! (weight gradient).
//!
//! The three products are compiled once for each set of instructions, and called: a copy of all their blocks in each
//! stage would be most of what a crate with dense layers compiles. They choose the instructions themselves, so that a
//! stage that only calls them is compiled once.

use crate::simd::{Op, Real, Select, Simd, SimdBase, SimdFloat, V, WIDEST, load, run, store};

/// The part of a weight matrix that a product uses.
#[derive(Clone, Copy)]
pub struct WeightMatrix<'a, R> {
    /// `[m][ld]`, row-major.
    pub data: &'a [R],
    /// Columns of the whole matrix.
    pub ld: usize,
    /// First column used.
    pub column: usize,
}

/// How a product treats existing output values.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Output {
    /// Replaces them.
    Set,
    /// Adds to them.
    Add,
    /// Multiplies them: chain rule through an activation whose derivative is stored there.
    Multiply,
}

/// A product with its arguments. The last one is the number of rows.
enum Product<'a, R> {
    Affine(WeightMatrix<'a, R>, Option<&'a [R]>, &'a [R], &'a mut [R], usize),
    Input(WeightMatrix<'a, R>, &'a [R], &'a mut [R], Output, usize),
    Weights([&'a [R]; 2], &'a mut [R], [usize; 2], Option<&'a mut [R]>, usize),
}

impl<R: Real> Op for Product<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        match self {
            Self::Affine(w, bias, x, y, n) => affine_blocks(s, w, bias, x, y, n),
            Self::Input(w, dy, dx, out, n) => input_blocks(s, w, dy, dx, out, n),
            Self::Weights([dy, x], dw, [ld, column], db, n) => weights_blocks(s, dy, x, dw, ld, column, db, n),
        }
    }
}

/// `y = W[:, column..column + k]·x + bias`, or `y += …` without a bias.
#[inline(never)]
pub fn affine<R: Real>(w: WeightMatrix<'_, R>, bias: Option<&[R]>, x: &[R], y: &mut [R], n: usize) {
    run(Product::Affine(w, bias, x, y, n));
}

#[inline(always)]
fn affine_blocks<S: Simd, R: Real>(s: S, w: WeightMatrix<'_, R>, bias: Option<&[R]>, x: &[R], y: &mut [R], n: usize) {
    let (k, m) = (x.len() / n, y.len() / n);
    let len = V::<S, R>::LEN;
    let mut o = 0;
    while o < m {
        let (high, rows) = (m - o, &w.data[o * w.ld..]);
        let w = WeightMatrix { data: rows, ..w };
        let (bias, y) = (bias.map(|b| &b[o..]), &mut y[o * n..]);
        let mut i = 0;
        o += height(high);
        while i < n {
            let wide = i + 2 * len <= n;
            let full = i + len <= n;
            match (high, wide, full) {
                (8.., true, _) => affine_block::<S, R, 8, 2, true>(s, w, bias, x, y, k, n, i),
                (8.., _, true) => affine_block::<S, R, 8, 1, true>(s, w, bias, x, y, k, n, i),
                (8.., ..) => affine_block::<S, R, 8, 1, false>(s, w, bias, x, y, k, n, i),
                (4.., true, _) => affine_block::<S, R, 4, 2, true>(s, w, bias, x, y, k, n, i),
                (4.., ..) => affine_block::<S, R, 4, 1, false>(s, w, bias, x, y, k, n, i),
                (_, true, _) => affine_block::<S, R, 1, 2, true>(s, w, bias, x, y, k, n, i),
                _ => affine_block::<S, R, 1, 1, false>(s, w, bias, x, y, k, n, i),
            }
            i += if wide { 2 * len } else { len };
        }
    }
}

/// Channels of a block where so many are left.
#[inline(always)]
fn height(left: usize) -> usize {
    match left {
        8.. => 8,
        4.. => 4,
        _ => 1,
    }
}

/// `M` output channels × `C` vectors of rows in registers. `FULL` blocks do not reach past the end of the tile.
#[inline(always)]
fn affine_block<S: Simd, R: Real, const M: usize, const C: usize, const FULL: bool>(
    s: S,
    w: WeightMatrix<'_, R>,
    bias: Option<&[R]>,
    x: &[R],
    y: &mut [R],
    k: usize,
    n: usize,
    i: usize,
) {
    // Plain loops instead of closures: a closure is compiled without the instructions of `s`.
    let zero = V::<S, R>::splat(s, R::ZERO);
    let mut acc = [[zero; C]; M];
    let mut rows: [&[R]; M] = [&[]; M];
    for j in 0..M {
        rows[j] = &w.data[j * w.ld + w.column..][..k];
        for c in 0..C {
            acc[j][c] = match bias {
                Some(b) => V::<S, R>::splat(s, b[j]),
                None => read::<S, R, FULL>(s, y, j * n + i, c),
            };
        }
    }
    for k in 0..k {
        let mut v = [zero; C];
        for c in 0..C {
            v[c] = read::<S, R, FULL>(s, x, k * n + i, c);
        }
        for j in 0..M {
            let w = V::<S, R>::splat(s, rows[j][k]);
            for c in 0..C {
                acc[j][c] = w.mul_add(v[c], acc[j][c]);
            }
        }
    }
    for j in 0..M {
        for c in 0..C {
            write::<S, R, FULL>(acc[j][c], &mut y[j * n..(j + 1) * n], i, c);
        }
    }
}

/// Vector `c` from `x[i]`. `x` is the whole tile, not one channel: if the rows left do not fill a vector, its last
/// lanes hold values of the next channel, which `write` drops. Only at the end of the tile is a vector read lane by
/// lane.
#[inline(always)]
fn read<S: Simd, R: Real, const FULL: bool>(s: S, x: &[R], i: usize, c: usize) -> V<S, R> {
    let (at, len) = (i + c * V::<S, R>::LEN, V::<S, R>::LEN);
    if FULL { V::<S, R>::from_slice(s, &x[at..at + len]) } else { load(s, x, at) }
}

#[inline(always)]
fn write<S: Simd, R: Real, const FULL: bool>(v: V<S, R>, y: &mut [R], i: usize, c: usize) {
    let (at, len) = (i + c * V::<S, R>::LEN, V::<S, R>::LEN);
    if FULL { v.store_slice(&mut y[at..at + len]) } else { store::<S, R>(v, y, at) }
}

/// `dx = W[:, column..column + k]ᵀ·dy`, set, added or multiplied into `dx`.
#[inline(never)]
pub fn affine_input<R: Real>(w: WeightMatrix<'_, R>, dy: &[R], dx: &mut [R], out: Output, n: usize) {
    run(Product::Input(w, dy, dx, out, n));
}

#[inline(always)]
fn input_blocks<S: Simd, R: Real>(s: S, w: WeightMatrix<'_, R>, dy: &[R], dx: &mut [R], out: Output, n: usize) {
    let (k, m) = (dx.len() / n, dy.len() / n);
    let len = V::<S, R>::LEN;
    let mut c = 0;
    while c < k {
        let broad = k - c;
        let w = WeightMatrix { column: w.column + c, ..w };
        let dx = &mut dx[c * n..];
        let mut i = 0;
        c += height(broad);
        while i < n {
            let wide = i + 2 * len <= n;
            let full = i + len <= n;
            match (broad, wide, full) {
                (8.., true, _) => input_block::<S, R, 8, 2, true>(s, w, dy, dx, out, m, n, i),
                (8.., _, true) => input_block::<S, R, 8, 1, true>(s, w, dy, dx, out, m, n, i),
                (8.., ..) => input_block::<S, R, 8, 1, false>(s, w, dy, dx, out, m, n, i),
                (4.., true, _) => input_block::<S, R, 4, 2, true>(s, w, dy, dx, out, m, n, i),
                (4.., ..) => input_block::<S, R, 4, 1, false>(s, w, dy, dx, out, m, n, i),
                (_, true, _) => input_block::<S, R, 1, 2, true>(s, w, dy, dx, out, m, n, i),
                _ => input_block::<S, R, 1, 1, false>(s, w, dy, dx, out, m, n, i),
            }
            i += if wide { 2 * len } else { len };
        }
    }
}

#[inline(always)]
fn input_block<S: Simd, R: Real, const K: usize, const C: usize, const FULL: bool>(
    s: S,
    w: WeightMatrix<'_, R>,
    dy: &[R],
    dx: &mut [R],
    out: Output,
    m: usize,
    n: usize,
    i: usize,
) {
    let zero = V::<S, R>::splat(s, R::ZERO);
    let mut acc = [[zero; C]; K];
    if out == Output::Add {
        for j in 0..K {
            for c in 0..C {
                acc[j][c] = read::<S, R, FULL>(s, dx, j * n + i, c);
            }
        }
    }
    for o in 0..m {
        let mut d = [zero; C];
        for c in 0..C {
            d[c] = read::<S, R, FULL>(s, dy, o * n + i, c);
        }
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
            let v =
                if out == Output::Multiply { acc[j][c] * read::<S, R, FULL>(s, dx, j * n + i, c) } else { acc[j][c] };
            write::<S, R, FULL>(v, &mut dx[j * n..(j + 1) * n], i, c);
        }
    }
}

/// `dW[:, column..column + k] += dy·xᵀ`, and `db += Σ dy` where `db` is given.
#[inline(never)]
pub fn affine_weights<R: Real>(
    dy: &[R],
    x: &[R],
    dw: &mut [R],
    ld: usize,
    column: usize,
    db: Option<&mut [R]>,
    n: usize,
) {
    run(Product::Weights([dy, x], dw, [ld, column], db, n));
}

#[inline(always)]
fn weights_blocks<S: Simd, R: Real>(
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
    let len = V::<S, R>::LEN;
    // 1 in the lanes that the rows of the last vector fill.
    let last = load(s, &[R::ONE; WIDEST][..n % len], 0);
    let mut o = 0;
    while o < m {
        let tall = if o + 4 <= m { 4 } else { 1 };
        let mut c = 0;
        while c < k {
            let broad = if c + 4 <= k { 4 } else { 1 };
            let (dy, x) = (&dy[o * n..], &x[c * n..]);
            let dw = &mut dw[o * ld + column + c..];
            match (tall, broad) {
                (4, 4) => weights_block::<S, R, 4, 4>(s, dy, x, dw, ld, n, last),
                (4, _) => weights_block::<S, R, 4, 1>(s, dy, x, dw, ld, n, last),
                (_, 4) => weights_block::<S, R, 1, 4>(s, dy, x, dw, ld, n, last),
                _ => weights_block::<S, R, 1, 1>(s, dy, x, dw, ld, n, last),
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
    last: V<S, R>,
) {
    let len = V::<S, R>::LEN;
    let zero = V::<S, R>::splat(s, R::ZERO);
    let mut acc = [zero; 16];
    let (mut rows, mut columns): ([&[R]; M], [&[R]; K]) = ([&[]; M], [&[]; K]);
    for j in 0..M {
        rows[j] = &dy[j * n..(j + 1) * n];
    }
    for k in 0..K {
        columns[k] = &x[k * n..(k + 1) * n];
    }
    let (tile_dy, tile_x, dy, x) = (dy, x, rows, columns);
    let whole = n / len * len;
    for i in (0..whole).step_by(len) {
        let mut v = [zero; K];
        for k in 0..K {
            v[k] = V::<S, R>::from_slice(s, &x[k][i..i + len]);
        }
        for j in 0..M {
            let d = V::<S, R>::from_slice(s, &dy[j][i..i + len]);
            for k in 0..K {
                acc[j * K + k] = d.mul_add(v[k], acc[j * K + k]);
            }
        }
    }
    if whole < n {
        // Lanes past the last row hold values of the next channel, infinities too: they are replaced, not multiplied by
        // 0.
        let fill = last.simd_ge(V::<S, R>::splat(s, R::ONE));
        let mut v = [zero; K];
        for k in 0..K {
            v[k] = fill.select(load(s, tile_x, k * n + whole), zero);
        }
        for j in 0..M {
            let d = fill.select(load(s, tile_dy, j * n + whole), zero);
            for k in 0..K {
                acc[j * K + k] = d.mul_add(v[k], acc[j * K + k]);
            }
        }
    }
    let sums = lane_sums::<S, R>(acc);
    for j in 0..M {
        for k in 0..K {
            dw[j * ld + k] += sums[j * K + k];
        }
    }
}

/// The sum over lanes of each of 16 vectors, by a tree of pairwise sums: after `log2(LEN)` rounds the sums are in
/// order, one vector of them for every `LEN` inputs.
#[inline(always)]
fn lane_sums<S: Simd, R: Real>(mut v: [V<S, R>; 16]) -> [R; 16] {
    let len = V::<S, R>::LEN;
    let mut out = [R::ZERO; 16];
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

/// The sum of a slice, first within lanes.
#[inline(always)]
pub fn total<S: Simd, R: Real>(s: S, x: &[R]) -> R {
    let mut acc = V::<S, R>::splat(s, R::ZERO);
    let mut i = 0;
    while i < x.len() {
        acc += load(s, x, i);
        i += V::<S, R>::LEN;
    }
    acc.as_slice().iter().copied().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_agree_with_plain_loops_for_every_size() {
        let f = |i: usize| ((i * 7919 + 13) % 101) as f64 / 50.0 - 1.0;
        for (m, k, n) in [(1, 1, 1), (1, 32, 256), (8, 3, 33), (13, 9, 100), (32, 20, 64), (33, 17, 31)] {
            let (ld, column) = (k + 3, 2);
            let w: Vec<f32> = (0..m * ld).map(|i| f(i) as f32).collect();
            let x: Vec<f32> = (0..k * n).map(|i| f(i + 5) as f32).collect();
            let dy: Vec<f32> = (0..m * n).map(|i| f(i + 11) as f32).collect();
            let bias: Vec<f32> = (0..m).map(|i| i as f32).collect();
            let (mut y, mut dx, mut dw, mut db) = (vec![0.0; m * n], vec![1.0; k * n], vec![1.0; m * ld], vec![0.0; m]);
            let weights = WeightMatrix { data: &w, ld, column };
            affine(weights, Some(&bias), &x, &mut y, n);
            affine_input(weights, &dy, &mut dx, Output::Add, n);
            affine_weights(&dy, &x, &mut dw, ld, column, Some(&mut db), n);
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
