//! A proximal gradient method whose volumes stay on a device.
//!
//! Only images are copied: line integrals to the host, which applies the data term, and its derivatives back.

use crate::error::Result;
use crate::geometry::Geometry;
use crate::regularizer::Dual;
use ndarray::{ArrayView3, ArrayViewMut3};

/// The volumes of a proximal gradient method on the host, all in the grid's standard order; see
/// [`crate::regularizer::Update`].
pub struct Volumes<'a> {
    /// Their shape.
    pub shape: [usize; 3],
    /// The coefficients.
    pub x: &'a [f32],
    /// Point of the next gradient.
    pub ahead: &'a [f32],
    /// The coefficients to pull towards.
    pub towards: Option<&'a [f32]>,
    /// Coefficients that may be non-zero, if not all.
    pub inside: Option<&'a [bool]>,
    /// The penalty; `None` if it has no WGSL.
    pub dual: Option<Dual<'a>>,
}

/// Factors of an update; see [`crate::regularizer::Update`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Factors {
    /// Step along the negative gradient of the data term.
    pub step: f32,
    /// Extrapolation beyond the new coefficients.
    pub momentum: f32,
    /// Share of the way towards the coefficients to pull towards.
    pub pull: f32,
    /// Weight of the penalty's proximal map.
    pub tau: f32,
}

/// The volumes on a device. Their gradient is 0 at first and after an update.
pub trait Resident: Send {
    /// Overwrites `projections` with line integrals of the point of the next gradient.
    fn forward(&mut self, geometry: &Geometry, views: &[usize], projections: ArrayViewMut3<'_, f32>) -> Result<()>;

    /// Adds the adjoint of the line integrals for `projections` to the negative gradient.
    fn adjoint(&mut self, geometry: &Geometry, views: &[usize], projections: ArrayView3<'_, f32>) -> Result<()>;

    /// Makes an update.
    fn update(&mut self, factors: Factors) -> Result<()>;

    /// Replaces the vectors that guide the penalty.
    fn guide(&mut self, guide: [&[f32]; 3]) -> Result<()>;

    /// Downloads the coefficients.
    fn coefficients(&mut self, x: &mut [f32]) -> Result<()>;

    /// Downloads the point of the next gradient and the dual variables.
    fn rest(&mut self, ahead: &mut [f32], dual: [&mut [f32]; 3]) -> Result<()>;
}
