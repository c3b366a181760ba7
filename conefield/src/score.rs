//! Compares a volume with its reference.

use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::scan::Volume;
use conefield_evaluation::metrics::Scores;

/// The headings of [`cells_of`].
pub const SCORES: [&str; 4] = ["PSNR dB", "ssim_2d", "ssim_3d", "ssim_skimage"];

/// PSNR and the SSIMs as table cells; undefined values are dashes.
pub fn cells_of(s: &Scores) -> [String; 4] {
    let [a, b, c] = [s.ssim_2d, s.ssim_3d, s.ssim_skimage].map(|s| s.map_or("-".into(), |x| format!("{x:.4}")));
    [format!("{:.2}", s.psnr), a, b, c]
}

/// Refuses a volume whose shape differs from the reference's.
pub fn same_shape(place: &str, found: &[usize], expected: &[usize]) -> Result<()> {
    ensure(found == expected, place, "shape", format!("{found:?}"), format!("{expected:?}, the reference's shape"))
}

/// The data range of scores against `reference`: `given`, or derived from the reference.
pub fn peak(given: Option<f64>, reference: &Volume) -> f64 {
    given.unwrap_or_else(|| {
        let found = conefield_evaluation::metrics::peak_of(reference.data.view());
        if found != 1.0 {
            tracing::info!("peak {found}, the range of the reference's values; --peak sets another");
        }
        found
    })
}

/// Scores `volume`; errors name `place`.
pub fn score(place: &str, volume: &Volume, reference: &Volume, peak: f64) -> Result<Scores> {
    same_shape(place, volume.data.shape(), reference.data.shape())?;
    if let Some(factor) = conefield_evaluation::metrics::other_unit(volume.data.view(), reference.data.view()) {
        tracing::warn!(
            "{place}: multiplied by {factor:.4} it matches the reference: are both in the same unit? The scores use \
             both without scaling"
        );
    }
    conefield_evaluation::metrics::evaluate(volume.data.view(), reference.data.view(), peak)
}
