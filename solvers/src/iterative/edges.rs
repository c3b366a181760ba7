//! Edges of a volume, and their normals.

use conefield_core::error::Result;
use conefield_core::parallel;
use conefield_core::place::{Array, Slab};
use conefield_core::regularizer::Guide;
use conefield_core::space::Space;
use ndarray::ArrayView3;

/// A vector `n` per voxel, normal to the edge there, with a length from 0 (no edge) to 1 (a clear edge).
///
/// `n = √γ·s/√(|s|² + η²)`, where the slope s is a central difference, smoothed by 1-2-1 along the other two axes
/// (Sobel), and η is a multiple of the root mean square of all |s|.
pub struct Edges {
    n: [Array; 3],
    /// γ, below 1.
    strength: f32,
    /// η relative to the root mean square of the slopes.
    scale: f64,
}

impl Edges {
    /// Edges that are 0 until [`Self::find`].
    pub fn new(shape: [usize; 3], strength: f32, scale: f64, space: &Space) -> Result<Self> {
        let n = || space.array(shape);
        Ok(Self { n: [n()?, n()?, n()?], strength, scale })
    }

    /// The components along x, y and z, on the host.
    pub fn vectors(&self) -> [&[f32]; 3] {
        self.n.each_ref().map(Array::slice)
    }

    /// The same edges for a place with kernels.
    pub fn guide(&mut self) -> Guide<'_> {
        Guide { vectors: self.n.each_mut(), strength: self.strength, scale: self.scale as f32 }
    }

    /// Finds the edges of `x` on the host, whose differences are weighted by `g` along x, y, z. `x` is `slab` if several
    /// processes share the volume. The result does not depend on the number of threads.
    pub fn find(&mut self, x: ArrayView3<'_, f32>, g: [f32; 3], slab: Option<&Slab>) {
        let (nx, ny, nz) = x.dim();
        let plane = ny * nz;
        if plane == 0 {
            return;
        }
        let x = x.as_standard_layout();
        let Some(all) = x.as_slice() else { return };
        let at = |i: usize| &all[i * plane..(i + 1) * plane];
        let [a, b, c] = self.n.each_mut().map(Array::slice_mut);
        let planes = a.chunks_mut(plane).zip(b.chunks_mut(plane)).zip(c.chunks_mut(plane));
        let squares: Vec<f64> = parallel::map(planes, |i, ((a, b), c)| {
            let around = [at(i.saturating_sub(1)), at(i), at((i + 1).min(nx - 1))];
            slopes(around, nz, g, [&mut *a, &mut *b, &mut *c]);
            // No difference across the far faces, hence no edge.
            if i + 1 == nx {
                a.fill(0.0);
            }
            b[plane - nz..].fill(0.0);
            c.iter_mut().skip(nz - 1).step_by(nz).for_each(|c| *c = 0.0);
            let square = |((a, b), c): ((&f32, &f32), &f32)| f64::from(a * a + b * b + c * c);
            a.iter().zip(&*b).zip(&*c).map(square).sum::<f64>()
        });
        let mean = match slab {
            None => squares.iter().sum::<f64>() / x.len() as f64,
            Some(slab) => slab.sum(squares[slab.inner()].iter().sum()) / (slab.whole * plane) as f64,
        };
        let eta2 = (mean * self.scale * self.scale) as f32;
        let strength = self.strength;
        let planes = a.chunks_mut(plane).zip(b.chunks_mut(plane)).zip(c.chunks_mut(plane));
        parallel::over(planes, |_, ((a, b), c)| {
            for ((a, b), c) in a.iter_mut().zip(b).zip(c) {
                let square = *a * *a + *b * *b + *c * *c;
                // A slope of 0 has no direction, whatever η is.
                let factor = if square > 0.0 { (strength / (square + eta2)).sqrt() } else { 0.0 };
                [*a, *b, *c] = [*a * factor, *b * factor, *c * factor];
            }
        });
    }
}

/// The slopes of the middle one of three planes; voxels outside the volume repeat the nearest one.
fn slopes(around: [&[f32]; 3], nz: usize, g: [f32; 3], out: [&mut [f32]; 3]) {
    let [before, here, after] = around;
    let ny = here.len() / nz;
    let mut across = vec![0.0; here.len()];
    let mut smooth = vec![0.0; here.len()];
    for (k, (across, smooth)) in across.iter_mut().zip(&mut smooth).enumerate() {
        *across = 0.5 * g[0] * (after[k] - before[k]);
        *smooth = 0.25 * (before[k] + after[k]) + 0.5 * here[k];
    }
    // Three neighbouring lines along z.
    let mut lines = [[0; 3]; 3].map(|line| line.map(|_| vec![0.0; nz]));
    let [a, b, c] = out;
    for j in 0..ny {
        for (lines, j) in lines.iter_mut().zip([j.saturating_sub(1), j, (j + 1).min(ny - 1)]) {
            let part = j * nz..(j + 1) * nz;
            let [x, y, z] = lines;
            smoothed(&across[part.clone()], x);
            smoothed(&smooth[part.clone()], y);
            differences(&smooth[part], z);
        }
        let [low, mid, high] = &lines;
        for k in 0..nz {
            let to = j * nz + k;
            a[to] = 0.25 * (low[0][k] + high[0][k]) + 0.5 * mid[0][k];
            b[to] = 0.5 * g[1] * (high[1][k] - low[1][k]);
            c[to] = g[2] * (0.25 * (low[2][k] + high[2][k]) + 0.5 * mid[2][k]);
        }
    }
}

/// Smooths a line by 1-2-1.
fn smoothed(line: &[f32], out: &mut [f32]) {
    let last = line.len() - 1;
    for (k, out) in out.iter_mut().enumerate() {
        *out = 0.25 * (line[k.saturating_sub(1)] + line[(k + 1).min(last)]) + 0.5 * line[k];
    }
}

/// Central differences of a line.
fn differences(line: &[f32], out: &mut [f32]) {
    let last = line.len() - 1;
    for (k, out) in out.iter_mut().enumerate() {
        *out = 0.5 * (line[(k + 1).min(last)] - line[k.saturating_sub(1)]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::place::Host;
    use conefield_core::scan::ScanHeader;
    use ndarray::Array3;
    use std::sync::Arc;

    fn edges(x: &Array3<f32>, g: [f32; 3], scale: f64) -> Edges {
        let shape = x.dim().into();
        let space = Space::new(ScanHeader { views: 0, detector: [0; 2], volume: shape }, Arc::new(Host));
        let mut edges = Edges::new(shape, 0.81, scale, &space).unwrap();
        edges.find(x.view(), g, None);
        edges
    }

    #[test]
    fn a_slanted_face_is_found_with_its_direction() {
        let ramp = Array3::from_shape_fn([7, 6, 9], |(x, y, z)| 2.0 * x as f32 - y as f32 + 0.5 * z as f32);
        let found = edges(&ramp, [1.0, 1.0, 2.0], 1e-4);
        // Along (2, -1, 0.5·2), of length 0.9.
        let want = [2.0f32, -1.0, 1.0].map(|x| 0.9 * x / 6f32.sqrt());
        for (n, want) in found.n.iter().map(|n| n.on_host().unwrap()).zip(want) {
            assert!((n[[3, 3, 4]] - want).abs() < 1e-4, "{} and {want}", n[[3, 3, 4]]);
        }
    }

    #[test]
    fn what_is_flat_has_no_edges_and_weak_slopes_count_little() {
        let flat = edges(&Array3::from_elem([3, 1, 4], 0.7), [1.0; 3], 1.0);
        assert!(flat.vectors().iter().all(|n| n.iter().all(|x| *x == 0.0)));
        let mut step = Array3::from_shape_fn([16, 8, 8], |(x, _, _)| f32::from(u8::from(x >= 8)));
        step.slice_mut(ndarray::s![3.., .., ..]).mapv_inplace(|x| x + 0.01);
        let found = edges(&step, [1.0; 3], 1.0);
        let n = found.n[0].on_host().unwrap();
        assert!(n[[8, 4, 4]] > 0.6 && n[[3, 4, 4]] < 0.03, "{n}");
        assert!(n.iter().all(|x| x.abs() <= 0.9));
    }

    #[test]
    fn threads_change_no_bit() {
        let x = Array3::from_shape_fn([23, 5, 7], |(x, y, z)| ((x * 31 + y * 17 + z * 7) % 11) as f32);
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| edges(&x, [1.0, 0.7, 1.3], 0.7).vectors().map(<[f32]>::to_vec))
        };
        assert!(on(1) == on(5));
    }
}
