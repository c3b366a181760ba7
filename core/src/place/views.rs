//! Work on measured views: data terms, and FDK's filtered back-projection.

use super::map::squares;
use super::{Array, Mask, Place};
use crate::data_term::Misfit;
use crate::error::Result;
use crate::parallel;
use crate::voxel::VoxelView;
use ndarray::{Array3, ArrayView3, ArrayViewMut3, Axis, CowArray, Ix3, Zip, s};

/// Measured line integrals, `[view, row, column]`.
pub struct MeasuredViews<'a> {
    /// As the scan holds them.
    pub measured: &'a Array3<f32>,
    /// A copy in the place, if it has one.
    pub here: Option<Array>,
}

/// How computed line integrals are compared with measured ones.
#[derive(Clone, Copy)]
pub struct Weighing<'a> {
    /// The measured line integrals p.
    pub views: &'a MeasuredViews<'a>,
    /// Pixels outside count as p = 0.
    pub shadow: Option<&'a Mask>,
    /// Factors of the residuals of all views.
    pub weights: Option<&'a Array>,
    /// The data term φ; `½r²` if there is none.
    pub term: Option<&'a dyn Misfit>,
}

impl Weighing<'_> {
    /// Returns an error of the data term in the calls so far.
    pub fn fault(&self) -> Result<()> {
        self.term.map_or(Ok(()), Misfit::fault)
    }

    /// [`Place::compare`] on the host.
    pub fn compare(
        &self,
        views: &[usize],
        images: &mut Array3<f32>,
        weights: Option<&CowArray<'_, f32, Ix3>>,
    ) -> [f64; 2] {
        let shadow = self.shadow.and_then(Mask::on_host);
        for (mut image, &v) in images.axis_iter_mut(Axis(0)).zip(views) {
            let rows = image.outer_iter_mut().zip(self.views.measured.index_axis(Axis(0), v).into_outer_iter());
            parallel::over(rows, |row, (mut image, measured)| match shadow {
                None => image.zip_mut_with(&measured, |a, p| *a = p - *a),
                Some(shadow) => Zip::from(&mut image)
                    .and(&measured)
                    .and(shadow.slice(s![v, row, ..]))
                    .for_each(|a, p, inside| *a = if *inside { p - *a } else { -*a }),
            });
        }
        let residual = images.slice(s![..views.len(), .., ..]);
        let residual = residual.as_slice().map_or_else(|| unreachable!("images follow each other"), squares);
        [residual, self.derivative(views, images, weights).unwrap_or(0.5 * residual)]
    }

    /// Replaces residuals r with weights·φ'(r), on the host. Returns `Σ φ(r)`, if there is a data term.
    pub fn derivative(
        &self,
        views: &[usize],
        images: &mut Array3<f32>,
        weights: Option<&CowArray<'_, f32, Ix3>>,
    ) -> Option<f64> {
        let misfits = self.term.map(|term| self.each_image(views, images, |view, p, r| term.differentiate(view, p, r)));
        if let Some(weights) = weights {
            parallel::over(images.axis_iter_mut(Axis(0)).zip(views), |_, (mut image, &v)| {
                image.zip_mut_with(&weights.index_axis(Axis(0), v), |r, w| *r *= w);
            });
        }
        misfits.map(|m| m.iter().sum())
    }

    /// [`Place::weigh`] on the host, wherever the images are.
    pub fn weigh<P: Place + ?Sized>(&self, place: &P, spread: bool, views: &[usize], images: &mut Array) -> Result<()> {
        let Some(term) = self.term else { return Ok(()) };
        place.change(images, &mut |images| {
            self.each_image(views, images, |view, measured, values| {
                if spread { term.spread(view, measured, values) } else { term.curve(view, measured, values) }
            });
        })?;
        self.fault()
    }

    /// Calls `work` with each of the first images, its view and its measurement. Returns the results in the order of
    /// the views.
    fn each_image<T: Send>(
        &self,
        views: &[usize],
        images: &mut Array3<f32>,
        work: impl Fn(usize, &[f32], &mut [f32]) -> T + Sync,
    ) -> Vec<T> {
        parallel::map(images.axis_iter_mut(Axis(0)).zip(views), |_, (image, &view)| {
            let measured = self.views.measured.index_axis(Axis(0), view);
            let measured = measured.as_standard_layout();
            match (measured.as_slice(), image.into_slice()) {
                (Some(measured), Some(image)) => work(view, measured, image),
                _ => unreachable!("images are contiguous"),
            }
        })
    }
}

/// FDK's work on views: weights, the ramp filter along rows, and distance-weighted back-projection.
pub trait FilteredViews: Sync {
    /// Weights and filters the image of a view, `[row, column]`.
    fn filter(&self, view: usize, image: &mut [f32]);

    /// Adds the filtered images of some views to `slab`, planes of the volume along x from plane `first` on.
    fn backproject(&self, views: &[usize], images: ArrayView3<'_, f32>, slab: ArrayViewMut3<'_, f32>, first: usize);

    /// The weights of a view in numbers, for a device.
    fn weights(&self, view: usize) -> RowWeights;

    /// The filter along rows, besides the factors in [`RowWeights::columns`]: a pixel's factor by its distance in
    /// columns, as many as a row has.
    fn taps(&self) -> Vec<f32>;

    /// A view for back-projection; voxel (0, 0, 0) is the first one of the volume.
    fn seen(&self, view: usize) -> VoxelView;
}

/// Weights and filters the first of `images`, those of some views.
pub(super) fn filter(work: &dyn FilteredViews, views: &[usize], images: &mut Array3<f32>) {
    parallel::over(images.axis_iter_mut(Axis(0)).zip(views), |_, (image, &view)| {
        work.filter(view, image.into_slice().unwrap_or_else(|| unreachable!("images are contiguous")));
    });
}

/// The weights of a view's pixels before the ramp filter: `columns[c]·(corner + c·u + r·v)·normal/|corner + c·u + r·v|`.
pub struct RowWeights {
    /// Factor of each column.
    pub columns: Vec<f32>,
    /// From the source to pixel (0, 0), mm.
    pub corner: [f64; 3],
    /// From pixel to pixel along a row, mm.
    pub u: [f64; 3],
    /// From row to row, mm.
    pub v: [f64; 3],
    /// Unit normal of the detector, away from the source.
    pub normal: [f64; 3],
}
