//! Joseph's projector for views of any orientation, with neighbouring pixels in bundles.
//!
//! From plane to plane of voxels across its main direction a ray's position changes by a constant. The intersections of
//! a bundle's rays with a plane, their voxels and interpolation weights are computed together; only the voxels
//! themselves are read or written one by one. In the forward projection, a strip of columns traverses a few planes, row
//! by row, before the next planes. In the adjoint, some planes gather from all bundles. Both take their weights from
//! `Bundle::meet`, so they are adjoint by construction.

use super::layout::main_axis;
use super::walk::VoxelRay;
use conefield_core::geometry::{Geometry, Vec3, VoxelGrid};
use conefield_core::parallel;
use conefield_core::simd::{Op, Real, Simd, SimdBase, SimdFloat, V, load, run, store};
use ndarray::{ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
use std::ops::Range;

/// Pixels per bundle.
const BUNDLE: usize = 16;
/// Planes that a strip of columns traverses at once: their part near the strip stays in cache.
const PLANES: usize = 16;
/// Planes per task of [`adjoint`].
const TILE: usize = 8;
/// Bytes of bundles that [`adjoint`] holds at once.
const HELD: usize = 32 << 20;

/// Heading of a ray: its main axis, along which it meets most planes, and whether it runs upwards along it.
type Heading = (usize, bool);

const HEADINGS: [Heading; 6] = [(0, true), (0, false), (1, true), (1, false), (2, true), (2, false)];

fn heading_of(ray: &VoxelRay) -> Heading {
    let main = main_axis(ray.ahead);
    (main, ray.ahead[main] > 0.0)
}

/// The two axes other than `main`, in order.
fn across(main: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [0, 1]][main]
}

/// Neighbouring pixels of a row whose rays have one heading. Lanes of other pixels meet no voxel.
struct Bundle<R> {
    /// Index among the images projected at once.
    image: usize,
    row: usize,
    /// Column of the first lane.
    column: usize,
    main: usize,
    /// Planes in which a ray may meet voxels.
    planes: Range<usize>,
    /// Positions across the main axis in the volume's middle plane, in voxels, relative to one before the first.
    middle: [[R; BUNDLE]; 2],
    /// Their change from plane to plane.
    slope: [[R; BUNDLE]; 2],
    /// mm from plane to plane.
    step: [R; BUNDLE],
}

/// The two voxels along an axis between which each ray of a bundle passes, and their weights; voxels outside have
/// weight 0.
struct Beside<R> {
    voxels: [[u32; BUNDLE]; 2],
    shares: [[R; BUNDLE]; 2],
}

impl<R: Real> Beside<R> {
    fn new() -> [Self; 2] {
        std::array::from_fn(|_| Self { voxels: [[0; BUNDLE]; 2], shares: [[R::ZERO; BUNDLE]; 2] })
    }
}

impl<R: Real> Bundle<R> {
    /// Appends the bundles of the pixels from `column` on to `all`: one per heading among them.
    fn of(geometry: &Geometry, [view, row, column]: [usize; 3], image: usize, all: &mut Vec<Self>) {
        let grid = &geometry.volume;
        let rays: [VoxelRay; BUNDLE] = std::array::from_fn(|i| VoxelRay::of(geometry, view, row, column + i));
        let rays = &rays[..BUNDLE.min(geometry.detector[1] - column)];
        let source = rays[0].source;
        for heading in HEADINGS.into_iter().filter(|h| rays.iter().any(|r| heading_of(r) == *h)) {
            let (main, others) = (heading.0, across(heading.0));
            let half = 0.5 * (grid.shape[main] as f64 - 1.0);
            let (mut middle, mut slope) = ([[R::ZERO; BUNDLE]; 2], [[R::ZERO; BUNDLE]; 2]);
            let mut step = [R::ZERO; BUNDLE];
            let mut planes = grid.shape[main]..0;
            for (i, ray) in rays.iter().enumerate().filter(|(_, r)| heading_of(r) == heading) {
                let slopes = others.map(|k| ray.ahead[k] / ray.ahead[main]);
                let crossed = crossed(grid, source, heading, slopes);
                if crossed.is_empty() {
                    continue;
                }
                planes = planes.start.min(crossed.start)..planes.end.max(crossed.end);
                for d in 0..2 {
                    middle[d][i] = R::of(source[others[d]] + (half - source[main]) * slopes[d] + 1.0);
                    slope[d][i] = R::of(slopes[d]);
                }
                step[i] = R::of(ray.length / ray.ahead[main].abs());
            }
            if !planes.is_empty() {
                all.push(Self { image, row, column, main, planes, middle, slope, step });
            }
        }
    }

    /// Computes where its rays meet plane `plane`.
    #[inline(always)]
    fn meet<S: Simd>(&self, s: S, plane: usize, shape: [usize; 3], found: &mut [Beside<R>; 2]) {
        let number = |x: f64| V::<S, R>::splat(s, R::of(x));
        let (zero, one) = (number(0.0), number(1.0));
        let away = number(plane as f64 - 0.5 * (shape[self.main] as f64 - 1.0));
        for (d, (k, found)) in across(self.main).into_iter().zip(found).enumerate() {
            let (count, last) = (number(shape[k] as f64), number(shape[k] as f64 - 1.0));
            let [low, high] = &mut found.voxels;
            let [of_low, of_high] = &mut found.shares;
            for i in (0..BUNDLE).step_by(V::<S, R>::LEN) {
                let position = load(s, &self.slope[d], i).mul_add(away, load(s, &self.middle[d], i));
                // Clamped between one voxel before the first and one after the last, which are empty.
                let position = position.max(zero).min(count + one);
                let cell = position.floor();
                let share = position - cell;
                let is_low = cell.min(one) * (count + one - cell).min(one);
                let is_high = (count - cell).max(zero).min(one);
                store::<S, R>((one - share) * is_low, of_low, i);
                store::<S, R>(share * is_high, of_high, i);
                R::cells(s, (cell - one).max(zero).min(last), &mut low[i..]);
                R::cells(s, cell.min(last), &mut high[i..]);
            }
        }
    }
}

/// The planes in which a ray from `source` may meet voxels, and one more on either side.
fn crossed(grid: &VoxelGrid, source: Vec3, (main, up): Heading, slopes: [f64; 2]) -> Range<usize> {
    let last = grid.shape[main] as f64 - 1.0;
    // In front of the source.
    let (mut low, mut high) = (0.0f64, last);
    if up {
        low = low.max(source[main].floor() + 1.0);
    } else {
        high = high.min(source[main].ceil() - 1.0);
    }
    for (k, slope) in across(main).into_iter().zip(slopes) {
        let n = grid.shape[k] as f64;
        if slope == 0.0 {
            if source[k] <= -1.0 || source[k] >= n {
                return 0..0;
            }
            continue;
        }
        let plane = |at: f64| source[main] + (at - source[k]) / slope;
        let (a, b) = (plane(-1.0), plane(n));
        low = low.max(a.min(b).floor());
        high = high.min(a.max(b).ceil());
    }
    if low > high { 0..0 } else { low as usize..high as usize + 1 }
}

/// Line integrals of `volume` for `views`, one image each.
pub fn forward<R: Real>(
    geometry: &Geometry,
    views: &[usize],
    volume: ArrayView3<'_, R>,
    images: Vec<ArrayViewMut2<'_, R>>,
) {
    let volume = volume.as_standard_layout();
    let Some(voxels) = volume.as_slice() else { return };
    parallel::over(images.into_iter().zip(views), |_, (mut image, &view)| {
        parallel::over(image.axis_chunks_iter_mut(Axis(1), BUNDLE), |n, mut strip| {
            let mut bundles = vec![];
            (0..strip.nrows()).for_each(|row| Bundle::of(geometry, [view, row, n * BUNDLE], 0, &mut bundles));
            let mut sums = vec![[R::ZERO; BUNDLE]; strip.nrows()];
            run(BundlesForward { shape: geometry.volume.shape, voxels, bundles: &bundles, sums: &mut sums });
            for (mut row, sums) in strip.rows_mut().into_iter().zip(&sums) {
                row.iter_mut().zip(sums).for_each(|(out, sum)| *out = *sum);
            }
        });
    });
}

/// The line integrals of a strip of columns.
struct BundlesForward<'a, R> {
    shape: [usize; 3],
    voxels: &'a [R],
    bundles: &'a [Bundle<R>],
    /// One row each.
    sums: &'a mut [[R; BUNDLE]],
}

impl<R: Real> Op for BundlesForward<'_, R> {
    type Number = R;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let strides = [self.shape[1] * self.shape[2], self.shape[2], 1];
        let mut found = Beside::new();
        for main in 0..3 {
            let [a, b] = across(main).map(|k| strides[k]);
            for from in (0..self.shape[main]).step_by(PLANES) {
                for bundle in self.bundles.iter().filter(|b| b.main == main) {
                    // Partial sums over a few planes: two short sums have a smaller rounding error than one long sum.
                    let mut part = [R::ZERO; BUNDLE];
                    for plane in from.max(bundle.planes.start)..(from + PLANES).min(bundle.planes.end) {
                        bundle.meet(s, plane, self.shape, &mut found);
                        let [lines, places] = &found;
                        let voxels = &self.voxels[plane * strides[main]..];
                        for i in 0..BUNDLE {
                            let place = [0, 1].map(|h| places.voxels[h][i] as usize * b);
                            let line = |h: usize| {
                                let at = lines.voxels[h][i] as usize * a;
                                places.shares[0][i] * voxels[at + place[0]]
                                    + places.shares[1][i] * voxels[at + place[1]]
                            };
                            part[i] += lines.shares[0][i] * line(0) + lines.shares[1][i] * line(1);
                        }
                    }
                    let sums = &mut self.sums[bundle.row];
                    (0..BUNDLE).for_each(|i| sums[i] += part[i] * bundle.step[i]);
                }
            }
        }
    }
}

/// Adds the adjoint of [`forward`] to `volume`.
pub fn adjoint<R: Real>(
    geometry: &Geometry,
    views: &[usize],
    projections: ArrayView3<'_, R>,
    volume: &mut ArrayViewMut3<'_, R>,
) {
    let [rows, columns] = geometry.detector;
    let bytes = columns.div_ceil(BUNDLE) * size_of::<Bundle<R>>();
    let of_line = |line: usize| {
        let (image, row) = (line / rows, line % rows);
        let mut all = vec![];
        for column in (0..columns).step_by(BUNDLE) {
            Bundle::of(geometry, [views[image], row, column], image, &mut all);
        }
        all
    };
    let (lines, held) = (views.len() * rows, (HELD / bytes.max(1)).max(1));
    for from in (0..lines).step_by(held) {
        let some = from..(from + held).min(lines);
        let bundles: Vec<Vec<Bundle<R>>> = parallel::map(some, |_, line| of_line(line));
        for main in (0..3).filter(|&main| bundles.iter().flatten().any(|b| b.main == main)) {
            let [a, b] = across(main);
            let mut turned = volume.view_mut().permuted_axes([main, a, b]);
            parallel::over(turned.axis_chunks_iter_mut(Axis(0), TILE), |n, mut planes| {
                let of = n * TILE..n * TILE + planes.dim().0;
                let shape = geometry.volume.shape;
                let found = run(Adjoint { main, planes: of, shape, bundles: &bundles, projections });
                planes.iter_mut().zip(&found).for_each(|(voxel, x)| *voxel += *x);
            });
        }
    }
}

/// Planes of voxels that gather from all bundles crossing them, `[plane, a, b]` with the other two axes in order.
struct Adjoint<'a, R> {
    main: usize,
    planes: Range<usize>,
    shape: [usize; 3],
    /// Those of each line.
    bundles: &'a [Vec<Bundle<R>>],
    projections: ArrayView3<'a, R>,
}

impl<R: Real> Op for Adjoint<'_, R> {
    type Number = R;
    type Out = Vec<R>;
    #[inline(always)]
    fn call<S: Simd>(self, s: S) -> Vec<R> {
        let [lines, places] = across(self.main).map(|k| self.shape[k]);
        let mut voxels = vec![R::ZERO; self.planes.len() * lines * places];
        let mut found = Beside::new();
        for bundle in self.bundles.iter().flatten().filter(|b| b.main == self.main) {
            let planes = self.planes.start.max(bundle.planes.start)..self.planes.end.min(bundle.planes.end);
            if planes.is_empty() {
                continue;
            }
            let mut values = bundle.step;
            for (i, value) in values.iter_mut().enumerate() {
                let pixel = self.projections.get([bundle.image, bundle.row, bundle.column + i]);
                *value *= pixel.copied().unwrap_or(R::ZERO);
            }
            if values.iter().all(|v| *v == R::ZERO) {
                continue;
            }
            for plane in planes {
                bundle.meet(s, plane, self.shape, &mut found);
                let [across, along] = &found;
                let voxels = &mut voxels[(plane - self.planes.start) * lines * places..][..lines * places];
                for i in 0..BUNDLE {
                    for h in 0..2 {
                        let at = across.voxels[h][i] as usize * places;
                        let value = values[i] * across.shares[h][i];
                        voxels[at + along.voxels[0][i] as usize] += value * along.shares[0][i];
                        voxels[at + along.voxels[1][i] as usize] += value * along.shares[1][i];
                    }
                }
            }
        }
        voxels
    }
}
