//! Back-projection of views whose detector columns run along z, as on every circular orbit that is not tilted.
//!
//! A line of voxels along z then lies at one depth, between the same two columns of pixels, and its voxels meet evenly
//! spaced rows. The two columns are blended once for a line, with its weight, over the rows that it meets; a vector of
//! voxels reads a window of two to four vectors of the blend, up to about four rows per voxel.

use super::backproject::Image;
use super::readers::PAD;
use conefield_core::simd::{Real, Simd, SimdBase, SimdFloat, V, load, store};
use conefield_core::voxel::VoxelView;

/// Largest change in columns, and in depth relative to the depth, over a line of voxels that counts as none: far below
/// the rounding of positions.
const STILL: f64 = 1e-12;
/// Vectors in the largest window.
const WIDEST_WINDOW: usize = 4;

/// A view whose detector columns run along z.
pub(super) struct Upright<'a, R> {
    image: &'a Image<'a, R>,
    /// The image's, with rows counted from below.
    view: VoxelView,
}

impl<'a, R: Real> Upright<'a, R> {
    /// The view of `image`, seen from a volume of the shape `shape`. `None` unless its columns run along z, and all
    /// voxels are in front of the source and near enough to each other for windows of vectors of `len` numbers.
    pub fn of(image: &'a Image<'a, R>, [nx, ny, nz]: [usize; 3], len: usize) -> Option<Self> {
        let mut view = *image.view;
        if image.pixels.downwards(image.index) {
            let top = image.detector[0] as f64 - 1.0;
            view.row = std::array::from_fn(|k| top * view.depth[k] - view.row[k]);
        }
        let corners = [[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1]];
        let nearest = corners.map(|corner| at(&view.depth, corner)).into_iter().fold(f64::INFINITY, f64::min);
        let still = |n: &[f64; 4]| n[3].abs() * nz as f64 <= STILL * nearest;
        let step = view.row[3] / nearest;
        let fits = nearest > 0.0 && step > 0.0 && vectors(step, len) <= WIDEST_WINDOW;
        (fits && still(&view.depth) && still(&view.column)).then_some(Self { image, view })
    }

    /// Adds to `voxels`, the line at `x` and `y`, what they read; `blend` is a buffer.
    #[inline(always)]
    pub fn add<S: Simd>(&self, s: S, line: [usize; 2], voxels: &mut [R], blend: &mut Blend<R>) {
        let [rows, columns] = self.image.detector.map(|n| n as f64);
        let reach = 1.0 / at(&self.view.depth, line);
        let [first, column] = [&self.view.row, &self.view.column].map(|n| at(n, line) * reach);
        let step = self.view.row[3] * reach;
        let last = first + step * (voxels.len() - 1) as f64;
        if last <= -1.0 || first >= rows || column <= -1.0 || column >= columns {
            return;
        }
        let (row, left) = (first.floor(), column.floor());
        let (weight, share) = (self.view.scale * reach * reach, column - left);
        let columns = [1, 2].map(|k| self.image.column((left as isize + k) as usize));
        let weights = [weight * (1.0 - share), weight * share].map(R::of);
        // One more than two, because positions are rounded.
        let used = (last.floor() - row) as usize + 3;
        blend.fill(s, columns, weights, row as isize, used);
        blend.place(s, [first - row, step], voxels.len());
        match vectors(step, V::<S, R>::LEN) {
            0..=2 => blend.read::<S, 2>(s, step, voxels),
            3 => blend.read::<S, 3>(s, step, voxels),
            _ => blend.read::<S, WIDEST_WINDOW>(s, step, voxels),
        }
    }
}

/// A linear function of the voxel, at the lower end of a line.
fn at(n: &[f64; 4], [x, y]: [usize; 2]) -> f64 {
    n[0] + n[1] * x as f64 + n[2] * y as f64
}

/// Vectors in the window of `len` voxels `step` rows apart: the first is before number 1 of it, and each reads two.
fn vectors(step: f64, len: usize) -> usize {
    ((len as f64 - 1.0) * step + 2.01).div_euclid(len as f64) as usize + 1
}

/// Two columns of pixels blended for a line of voxels.
#[derive(Default)]
pub(super) struct Blend<R> {
    column: Vec<R>,
    /// For each vector of voxels, the start of its window and the position of its first voxel in it.
    from: Vec<u32>,
    along: Vec<R>,
}

impl<R: Real> Blend<R> {
    /// Blends `used` rows from `row` on of the columns `a` and `b`.
    #[inline(always)]
    fn fill<S: Simd>(&mut self, s: S, [a, b]: [&[R]; 2], weights: [R; 2], row: isize, used: usize) {
        let len = V::<S, R>::LEN;
        let used = used.next_multiple_of(len);
        // Windows reach beyond the rows used.
        let all = used + WIDEST_WINDOW * len;
        if self.column.len() < all {
            self.column.resize(all, R::ZERO);
        }
        let start = row + PAD as isize;
        let [from, to] = [start, start + used as isize].map(|r| r.clamp(0, a.len() as isize) as usize);
        let before = (-start).clamp(0, used as isize) as usize;
        let (below, rest) = self.column[..used].split_at_mut(before);
        let (inside, above) = rest.split_at_mut(to - from);
        below.fill(R::ZERO);
        above.fill(R::ZERO);
        let [left, right] = weights.map(|w| V::<S, R>::splat(s, w));
        let (a, b) = (&a[from..to], &b[from..to]);
        for ((a, b), out) in a.chunks_exact(len).zip(b.chunks_exact(len)).zip(inside.chunks_exact_mut(len)) {
            let [a, b] = [a, b].map(|x| V::<S, R>::from_slice(s, x));
            b.mul_add(right, a * left).store_slice(out);
        }
        let whole = inside.len() - inside.len() % len;
        if whole < inside.len() {
            let [a, b] = [a, b].map(|x| load::<S, R>(s, x, whole));
            store::<S, R>(b.mul_add(right, a * left), inside, whole);
        }
    }

    /// Finds the windows of `count` voxels `step` rows apart, the first of which is at `first`, in [0, 1).
    #[inline(always)]
    fn place<S: Simd>(&mut self, s: S, [first, step]: [f64; 2], count: usize) {
        let len = V::<S, R>::LEN;
        let vectors = count.div_ceil(len).next_multiple_of(len);
        self.from.resize(vectors, 0);
        self.along.resize(vectors, R::ZERO);
        let number = |x: f64| V::<S, R>::splat(s, R::of(x));
        let apart = step * len as f64;
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64)) * number(apart);
        let (from, along) = (self.from.chunks_exact_mut(len), self.along.chunks_exact_mut(len));
        for (i, (from, along)) in from.zip(along).enumerate() {
            // Relative to a row nearby, which keeps the digits of the fraction.
            let start = first + apart * (i * len) as f64;
            let at = lanes + number(start - start.floor());
            let cell = at.floor();
            (at - cell).store_slice(along);
            R::cells::<S>(s, cell + number(start.floor()), from);
        }
    }

    /// Adds to `voxels`, `step` rows apart, what they read from windows of `W` vectors.
    #[inline(always)]
    fn read<S: Simd, const W: usize>(&self, s: S, step: f64, voxels: &mut [R]) {
        let len = V::<S, R>::LEN;
        let lanes = V::<S, R>::from_fn(s, |i| R::of(i as f64)) * V::<S, R>::splat(s, R::of(step));
        for ((voxels, &from), &along) in voxels.chunks_mut(len).zip(&self.from).zip(&self.along) {
            let at = lanes + V::<S, R>::splat(s, along);
            let cell = at.floor();
            let window = &self.column[from as usize..from as usize + W * len];
            let [a, b] = R::window::<S, 2, W>(s, window, cell);
            let sum = a + load::<S, R>(s, voxels, 0);
            store::<S, R>((at - cell).mul_add(b - a, sum), voxels, 0);
        }
    }
}
