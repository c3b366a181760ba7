//! `conefield evaluate`

use crate::memory::Memory;
use crate::{files, out, parse};
use clap::Args;
use conefield_core::scan::Volume;
use conefield_core::{Error, Result};
use conefield_io::MiddleSlices;
use conefield_metrics::Scores;
use std::path::PathBuf;

/// Score a volume against a reference: PSNR, RMSE and three SSIMs.
///
/// ssim_2d: 11x11 Gaussian window on slices of three axes (R2-Gaussian). ssim_3d: 11x11x11 Gaussian window (NI-NeRF).
/// ssim_skimage: 7x7 uniform window on slices of three axes (scikit-image, NAF).
#[derive(Args)]
pub struct Evaluate {
    /// The volume to score.
    volume: PathBuf,
    /// What it should be.
    reference: PathBuf,
    /// The data range.
    #[arg(long, default_value = "1", value_parser = parse::above_zero)]
    peak: f64,
    /// Also draw the middle slices of reference, volume and difference.
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl Evaluate {
    pub fn run(self) -> Result<()> {
        let voxels = [&self.volume, &self.reference].map(conefield_io::volume_voxels);
        let [volume, reference] = voxels;
        Memory::of_volumes(&[volume?, reference?]).check(|_| vec![])?;
        let volume = conefield_io::read_volume(&self.volume)?;
        let reference = conefield_io::read_volume(&self.reference)?;
        let place = self.volume.display().to_string();
        let scores = score(&place, &volume, &reference, self.peak)?;
        if let Some(png) = &self.png {
            files::picture(png, Some(&MiddleSlices::of(&reference)), &MiddleSlices::of(&volume))?;
        }
        if self.json { out::json(&scores) } else { out::say(&lines(&scores)) }
    }
}

/// Scores `volume`, called `place` in errors.
pub fn score(place: &str, volume: &Volume, reference: &Volume, peak: f64) -> Result<Scores> {
    let (found, expected) = (volume.data.shape(), reference.data.shape());
    if found != expected {
        return Err(Error::invalid(
            place,
            "shape",
            format!("{found:?}"),
            format!("{expected:?}, the reference's shape"),
        ));
    }
    conefield_metrics::evaluate(volume.data.view(), reference.data.view(), peak)
}

/// The scores for people.
pub fn lines(s: &Scores) -> String {
    let mut rows = vec![vec!["psnr".to_owned(), format!("{:.3} dB", s.psnr)]];
    for (name, x) in [("ssim_2d", s.ssim_2d), ("ssim_3d", s.ssim_3d), ("ssim_skimage", s.ssim_skimage)] {
        let why = || s.missing.get(name).cloned().unwrap_or_else(|| "not defined".into());
        rows.push(vec![name.to_owned(), x.map_or_else(why, |x| format!("{x:.4}"))]);
    }
    rows.push(vec!["rmse".into(), format!("{:.6}", s.rmse)]);
    for w in &s.worst_slices {
        let axis = format!("{:?}", w.axis).to_lowercase();
        rows.push(vec![format!("worst {axis}"), format!("slice {}, {:.3} dB", w.index, w.psnr)]);
    }
    out::table(&rows, &[])
}
