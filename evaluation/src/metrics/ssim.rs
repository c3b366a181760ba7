//! The three common definitions of SSIM, of checked pairs.

use crate::metrics::check;
use crate::metrics::window::{FIELDS, SsimWindow, products};
use conefield_core::error::{Result, ensure};
use conefield_core::parallel;
use ndarray::{Array3, ArrayView2, ArrayView3, Axis, Slice, s};

/// SSIM as reported by R2-Gaussian: per slice, 11×11 Gaussian, zero padding; slices without a positive reference value
/// are skipped; mean over slices, then over the three axes. Refuses a reference without a positive value.
pub(crate) fn ssim_2d(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<f64> {
    check::reach("ssim_2d", result, reference, peak)?;
    let window = SsimWindow::gaussian();
    let mean = over_axes(result, reference, &|x, y| {
        y.iter().any(|&v| v > 0.0).then(|| slice_ssim(x, y, &window, window.len() / 2, peak))
    });
    ensure(mean.is_some(), "ssim_2d", "reference", "no positive value", "a slice that is not empty")?;
    Ok(mean.unwrap_or(0.0))
}

/// SSIM by scikit-image's default per slice (7×7 uniform, sample covariance, without the border of 3 pixels), mean over
/// slices, then over the three axes. NAF's published code passes whole volumes to the same function: a window of 7×7×7,
/// and a data range of 2. Refuses volumes smaller than the window.
pub(crate) fn ssim_skimage(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<f64> {
    check::reach("ssim_skimage", result, reference, peak)?;
    let window = SsimWindow::uniform();
    check::window("ssim_skimage", result.shape(), window.len())?;
    Ok(over_axes(result, reference, &|x, y| Some(slice_ssim(x, y, &window, 0, peak))).unwrap_or(0.0))
}

/// The score of two images, unless it is not defined.
type Score<'a> = dyn Fn(ArrayView2<f32>, ArrayView2<f32>) -> Option<f64> + Sync + 'a;

/// Mean over the slices with a score, then over the axes; `None` if an axis has none.
fn over_axes(result: ArrayView3<f32>, reference: ArrayView3<f32>, score: &Score) -> Option<f64> {
    // Slices across z touch every cache line of the volume: copying a few at once reads each line only once.
    const BLOCK: usize = 16;
    let mut means = 0.0;
    for axis in 0..3 {
        let n = result.shape()[axis];
        let scores: Vec<Vec<Option<f64>>> = parallel::map(0..n.div_ceil(BLOCK), |_, block| {
            let range = block * BLOCK..n.min((block + 1) * BLOCK);
            let (x, y) = (slices(result, axis, range.clone()), slices(reference, axis, range));
            x.outer_iter().zip(y.outer_iter()).map(|(x, y)| score(x, y)).collect()
        });
        let (mut sum, mut count) = (0.0, 0usize);
        for score in scores.into_iter().flatten().flatten() {
            sum += score;
            count += 1;
        }
        if count == 0 {
            return None;
        }
        means += sum / count as f64;
    }
    Some(means / 3.0)
}

/// Slices `range` perpendicular to `axis`, in order, each with contiguous rows.
fn slices(volume: ArrayView3<f32>, axis: usize, range: std::ops::Range<usize>) -> Array3<f32> {
    let mut part = volume.slice_axis(Axis(axis), Slice::from(range));
    match axis {
        0 => {}
        1 => part.swap_axes(0, 1),
        _ => {
            part.swap_axes(1, 2);
            part.swap_axes(0, 1);
        }
    }
    let mut copy = Array3::zeros(part.dim());
    copy.assign(&part);
    copy
}

/// Mean of the SSIM map of one slice, with `pad` zeros on every side.
fn slice_ssim(x: ArrayView2<f32>, y: ArrayView2<f32>, window: &SsimWindow, pad: usize, peak: f64) -> f64 {
    let (rows, columns) = x.dim();
    let (border, wide) = (window.len() - 1, columns + 2 * pad);
    let (high, out) = (rows + 2 * pad, wide - border);
    // First the window along every row; padding rows stay zero.
    let mut fields: [Vec<f64>; FIELDS] = std::array::from_fn(|_| vec![0.0; high * out]);
    let mut row: [Vec<f64>; FIELDS] = std::array::from_fn(|_| vec![0.0; wide]);
    for (r, (x, y)) in x.rows().into_iter().zip(y.rows()).enumerate() {
        products(x, y, pad, &mut row);
        let at = (r + pad) * out;
        for (field, row) in fields.iter_mut().zip(&row) {
            window.along_row(row, &mut field[at..at + out]);
        }
    }
    // Then across rows, one row of the map at a time.
    let mut mean: [Vec<f64>; FIELDS] = std::array::from_fn(|_| vec![0.0; out]);
    let mut sum = 0.0;
    for r in 0..high - border {
        for (mean, field) in mean.iter_mut().zip(&fields) {
            window.across(|t| &field[(r + t) * out..(r + t + 1) * out], mean);
        }
        sum += window.ssim(mean.each_ref().map(Vec::as_slice), peak);
    }
    sum / ((high - border) * out) as f64
}

/// SSIM as reported by NI-NeRF: one map over the volume, 11×11×11 Gaussian, valid positions only. Refuses volumes
/// smaller than the window.
pub(crate) fn ssim_3d(result: ArrayView3<f32>, reference: ArrayView3<f32>, peak: f64) -> Result<f64> {
    check::reach("ssim_3d", result, reference, peak)?;
    // A tile keeps a ring of 11 windowed planes of `TILE[1] × nz`: a few megabytes, however large the volume is.
    const TILE: [usize; 2] = [64, 64];
    let window = SsimWindow::gaussian();
    check::window("ssim_3d", result.shape(), window.len())?;
    let (nx, ny, nz) = result.dim();
    let border = window.len() - 1;
    let places = [nx - border, ny - border];
    let tiles: Vec<[usize; 2]> =
        (0..places[0]).step_by(TILE[0]).flat_map(|x| (0..places[1]).step_by(TILE[1]).map(move |y| [x, y])).collect();
    let sums: Vec<f64> = parallel::map(tiles, |_, [x0, y0]| {
        let (x1, y1) = ((x0 + TILE[0]).min(places[0]) + border, (y0 + TILE[1]).min(places[1]) + border);
        let part = s![x0..x1, y0..y1, ..];
        tile_sum(result.slice(part), reference.slice(part), &window, peak)
    });
    Ok(sums.iter().sum::<f64>() / (places[0] * places[1] * (nz - border)) as f64)
}

/// Sum of the SSIM map over the positions of a 3D window inside the tile.
fn tile_sum(result: ArrayView3<f32>, reference: ArrayView3<f32>, window: &SsimWindow, peak: f64) -> f64 {
    let (nx, ny, nz) = result.dim();
    let (size, border) = (window.len(), window.len() - 1);
    let (high, out) = (ny - border, nz - border);
    let plane = high * out;
    let new = |n: usize| -> [Vec<f64>; FIELDS] { std::array::from_fn(|_| vec![0.0; n]) };
    let (mut row, mut rows, mut ring, mut mean) = (new(nz), new(ny * out), new(size * plane), new(plane));
    let mut sum = 0.0;
    for i in 0..nx {
        // Along z, then y, replacing the oldest plane of the ring.
        let (x, y) = (result.index_axis(Axis(0), i), reference.index_axis(Axis(0), i));
        for (j, (x, y)) in x.rows().into_iter().zip(y.rows()).enumerate() {
            products(x, y, 0, &mut row);
            for (to, from) in rows.iter_mut().zip(&row) {
                window.along_row(from, &mut to[j * out..(j + 1) * out]);
            }
        }
        let slot = (i % size) * plane;
        for (to, from) in ring.iter_mut().zip(&rows) {
            for j in 0..high {
                let to = &mut to[slot + j * out..slot + (j + 1) * out];
                window.across(|t| &from[(j + t) * out..(j + t + 1) * out], to);
            }
        }
        // Along x, once the ring is full: the oldest plane is after the newest.
        if i >= border {
            for (to, from) in mean.iter_mut().zip(&ring) {
                let at = |t: usize| ((i - border + t) % size) * plane;
                for j in 0..high {
                    let to = &mut to[j * out..(j + 1) * out];
                    window.across(|t| &from[at(t) + j * out..at(t) + (j + 1) * out], to);
                }
            }
            sum += window.ssim(mean.each_ref().map(Vec::as_slice), peak);
        }
    }
    sum
}
