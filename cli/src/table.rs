//! The cells of scores.

use conefield_metrics::Scores;
pub use conefield_report::Table;

/// The headings of [`score_cells`].
pub const SCORES: [&str; 4] = ["PSNR dB", "ssim_2d", "ssim_3d", "ssim_skimage"];

/// PSNR and the SSIMs; one that is not defined is a dash.
pub fn score_cells(psnr: f64, ssims: [Option<f64>; 3]) -> [String; 4] {
    let [a, b, c] = ssims.map(|s| s.map_or("-".into(), |x| format!("{x:.4}")));
    [format!("{psnr:.2}"), a, b, c]
}

/// The cells of whole scores.
pub fn cells_of(s: &Scores) -> [String; 4] {
    score_cells(s.psnr, [s.ssim_2d, s.ssim_3d, s.ssim_skimage])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_that_is_not_defined_is_a_dash() {
        assert_eq!(score_cells(f64::INFINITY, [Some(1.0), None, None]), ["inf", "1.0000", "-", "-"]);
    }
}
