//! `conefield evaluate`

use crate::boundary::{self, Inputs};
use crate::segmenter::Segmenter;
use crate::{out, signals};
use clap::Args;
use conefield::memory::Memory;
use conefield::score::{peak, same_shape, score};
use conefield::{files, parse};
use conefield_core::Result;
use conefield_core::scan::Volume;
use conefield_evaluation::metrics::{Agreement, Dice, Scores, Threshold, agreement, dice, label_map};
use conefield_evaluation::report::MiddleSlices;
use serde::Serialize;
use std::path::PathBuf;

/// Score a volume, its material or label maps against a reference.
///
/// A volume gets PSNR, RMSE and three SSIMs, material the Matthews correlation coefficient, label maps Dice.
///
/// ssim_2d: 11x11 Gaussian window on slices of three axes (R2-Gaussian). ssim_3d: 11x11x11 Gaussian window (NI-NeRF).
/// ssim_skimage: 7x7 uniform window on slices of three axes (scikit-image).
///
/// Dice is 2|A∩B|/(|A|+|B|) over the voxels of a label. Label 0 is background. A label in only one of the maps scores 0
/// and counts in the mean.
#[derive(Args)]
pub struct EvaluateArgs {
    /// The volume to score.
    volume: PathBuf,
    /// The reference.
    reference: PathBuf,
    /// The data range [default: 1 for a reference in [0, 1] that exceeds 0.5, else its range].
    #[arg(long, value_parser = parse::above_zero)]
    peak: Option<f64>,
    /// Also draw the middle slices of reference, volume and difference.
    #[arg(long, value_name = "FILE")]
    png: Option<PathBuf>,
    /// Both are label maps (whole numbers): compute Dice only.
    #[arg(long, conflicts_with_all = ["peak", "png", "segmenter"])]
    labels: bool,
    /// Also segment both with this command and compute Dice, such as 'TotalSegmentator -i {in} -o {out} --ml'. {in} and
    /// {out} stand for .nii.gz files. The command is split into words as in a shell, but no shell runs. Both volumes
    /// get the voxel size and position of the reference.
    #[arg(long, value_name = "CMD")]
    segmenter: Option<Segmenter>,
    /// Hounsfield units of the values 0 and 1, for the segmenter's input.
    #[arg(long, value_name = "LO,HI", value_parser = parse::hu, requires = "segmenter", allow_hyphen_values = true)]
    hu: Option<[f64; 2]>,
    /// Score only where material is: values above this threshold, or above Otsu's. Computes Matthews correlation (MCC;
    /// 0 for an empty volume) and Dice. A reference with two values, of which one is 0, is a mask; any other gets a
    /// threshold too.
    #[arg(long, value_name = "otsu|NUMBER", allow_hyphen_values = true)]
    #[arg(conflicts_with_all = ["peak", "png", "labels", "segmenter"])]
    threshold: Option<Threshold>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// All requested scores.
#[derive(Default, Serialize)]
struct Evaluation {
    #[serde(flatten)]
    scores: Option<Scores>,
    /// The data range of the scores.
    #[serde(skip_serializing_if = "Option::is_none")]
    peak: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dice: Option<Dice>,
    #[serde(skip_serializing_if = "Option::is_none")]
    material: Option<Agreement>,
}

impl EvaluateArgs {
    pub fn run(self) -> Result<()> {
        boundary::picture(self.png.as_deref(), &Inputs::of([&self.volume, &self.reference]))?;
        let voxels = [&self.volume, &self.reference].map(conefield_io::volume_voxels);
        let [volume, reference] = voxels;
        let (volume, reference) = (volume?, reference?);
        let maps = if self.segmenter.is_some() { &[volume, reference][..] } else { &[] };
        Memory::of_volumes(&[&[volume, reference], maps].concat()).check()?;
        let report = match self.threshold {
            Some(threshold) => self.material(threshold)?,
            None if self.labels => self.label_maps()?,
            None => self.volumes()?,
        };
        if self.json {
            return out::json(&report);
        }
        let range = |scores: &Scores| format!("{}\npeak          {}", lines(scores), report.peak.unwrap_or(1.0));
        let material = report.material.as_ref().map(ToString::to_string);
        let parts = [report.scores.as_ref().map(range), report.dice.as_ref().map(dice_lines), material];
        out::say(&parts.into_iter().flatten().collect::<Vec<_>>().join("\n\n"))
    }

    /// The agreement about material.
    fn material(&self, threshold: Threshold) -> Result<Evaluation> {
        let volume = conefield_io::read_volume(&self.volume)?.data;
        let reference = conefield_io::read_volume(&self.reference)?.data;
        same_shape(&self.volume.display().to_string(), volume.shape(), reference.shape())?;
        let material = Some(agreement(volume.view(), reference.view(), threshold)?);
        Ok(Evaluation { material, ..Evaluation::default() })
    }

    /// The Dice scores of two label maps.
    fn label_maps(&self) -> Result<Evaluation> {
        let read =
            |path: &PathBuf| label_map(&path.display().to_string(), conefield_io::read_volume(path)?.data.view());
        let (volume, reference) = (read(&self.volume)?, read(&self.reference)?);
        same_shape(&self.volume.display().to_string(), volume.shape(), reference.shape())?;
        Ok(Evaluation { dice: Some(dice(volume.view(), reference.view())?), ..Evaluation::default() })
    }

    /// The scores of a volume, with the Dice of the segmentations of volume and reference.
    fn volumes(&self) -> Result<Evaluation> {
        let volume = conefield_io::read_volume(&self.volume)?;
        let reference = conefield_io::read_volume(&self.reference)?;
        let place = self.volume.display().to_string();
        let peak = peak(self.peak, &reference);
        let scores = score(&place, &volume, &reference, peak)?;
        if let Some(png) = &self.png {
            files::picture(png, Some(&MiddleSlices::of(&reference)), &MiddleSlices::of(&volume))?;
        }
        let dice = match &self.segmenter {
            None => None,
            Some(segmenter) => {
                signals::listen();
                // A segmentation may depend on the voxel size: both volumes get the same.
                let volume = Volume { data: volume.data, grid: reference.grid, affine: reference.affine };
                let [volume, reference] = [volume, reference].map(|v| self.in_hu(v));
                let volume = segmenter.run(&place, &volume)?;
                let reference = segmenter.run(&self.reference.display().to_string(), &reference)?;
                Some(dice(volume.view(), reference.view())?)
            }
        };
        Ok(Evaluation { scores: Some(scores), peak: Some(peak), dice, material: None })
    }

    /// `volume` as input of the segmenter.
    fn in_hu(&self, volume: Volume) -> Volume {
        match self.hu {
            None => volume,
            Some([low, high]) => volume.mapped(|x| (low + f64::from(x) * (high - low)) as f32),
        }
    }
}

/// The scores as text.
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

/// Dice scores as text.
fn dice_lines(d: &Dice) -> String {
    let mut rows = vec![["label", "dice", "voxels", "reference"].map(str::to_owned).to_vec()];
    for l in &d.labels {
        rows.push(vec![
            l.label.to_string(),
            format!("{:.4}", l.dice),
            out::number(l.voxels),
            out::number(l.reference_voxels),
        ]);
    }
    let mean = d.mean.map_or("not defined: no label but background in either".into(), |m| format!("{m:.4}"));
    let mut all = match d.labels.len() {
        0 => format!("mean dice  {mean}"),
        n => {
            let labels = out::counted(n, "label");
            format!("{}\nmean dice of {labels}  {mean}", out::table(&rows, &[0, 1, 2, 3]))
        }
    };
    for (where_, labels) in [("volume", &d.only_in_result), ("reference", &d.only_in_reference)] {
        if !labels.is_empty() {
            let labels: Vec<String> = labels.iter().map(u32::to_string).collect();
            all += &format!("\nonly in the {where_}, counted as 0: {}", labels.join(", "));
        }
    }
    all
}
