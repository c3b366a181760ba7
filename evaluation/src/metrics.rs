//! Distance between a reconstructed volume and its reference: PSNR, RMSE and the three common SSIMs; and overlap of two
//! label maps: Dice; and agreement of two volumes about where material is: Matthews correlation.
//!
//! Three definitions of SSIM are published under one name and differ by several hundredths; [`evaluate`] reports all of
//! them by name. All use K1 = 0.01, K2 = 0.03 and the given peak as data range:
//!
//! | name | window | border | covariance | mean over |
//! |---|---|---|---|---|
//! | `ssim_2d` | Gaussian 11×11, σ 1.5, per slice | zero padding | biased | positive-reference slices, then axes |
//! | `ssim_3d` | Gaussian 11×11×11, σ 1.5 | valid positions only | biased | all window positions |
//! | `ssim_skimage` | uniform 7×7 per slice | valid positions only | sample (N − 1) | slices, then axes |
//!
//! All sums are in `f64`; results do not depend on the number of threads.
//!
//! Volumes are `[x, y, z]`. `peak` is the data range: 1 for volumes in `[0, 1]`, which all published figures use;
//! [`peak_of`] derives it from a reference.

mod check;
mod dice;
mod error;
mod material;
mod peak;
mod residual;
mod score;
mod ssim;
mod window;

pub use dice::{Dice, LabelDice, dice, label_map};
pub use error::{Axis, WorstSlice, psnr};
pub use material::{Agreement, Threshold, agreement, otsu};
pub use peak::{other_unit, peak_of};
pub use residual::{Residual, residual};
pub use score::{Scores, evaluate};
