//! A CT series: a folder of DICOM files, one slice each.
//!
//! `dicom-object` reads the elements. This crate adds the rest: [`lengths`] refuses files whose elements claim more
//! than the file holds before they are read, [`slice`](mod@slice) extracts what a volume needs, [`pixels`] decodes the
//! values (the decoders of `dicom-pixeldata` index past the end of damaged data and panic), and this module sorts the
//! slices. [`write`](mod@write) writes a series,
//! [`enhanced`] reads and writes one file with all slices.

pub(crate) mod enhanced;
mod lengths;
mod pixels;
mod slice;
#[cfg(test)]
mod tests;
mod write;
#[cfg(test)]
mod written;

pub use write::DicomTemplate;
pub(crate) use write::{check_shape, write};

use crate::input::start_of;
use crate::{affine, folder, foreign};
use conefield_core::error::ensure;
use conefield_core::geometry::{VoxelGrid, cross, dot, norm, sub};
use conefield_core::scan::Volume;
use conefield_core::words::counted;
use conefield_core::{Error, Result, allowance};
use ndarray::{Array3, s};
use slice::Slice;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Whether `head`, the start of a file, contains DICOM's magic bytes.
pub(crate) fn is_header(head: &[u8]) -> bool {
    head.get(128..132) == Some(b"DICM".as_slice())
}

/// Whether there is a DICOM file in `folder`.
pub(crate) fn is_series(folder: &Path) -> bool {
    files(folder).is_ok_and(|all| all.iter().any(|p| is_dicom(p).unwrap_or(false)))
}

/// Reads the one series in `folder`; subfolders are ignored.
///
/// x runs along the rows of a slice, y down its columns, z along the normal of both. Values are rescaled (Hounsfield
/// units in a CT), padding as well. The affine is RAS, in mm; `grid.center` is `[0, 0, 0]`.
pub(crate) fn read(folder: &Path) -> Result<Volume> {
    let place = folder.display().to_string();
    assemble(&place, slices(folder)?, &Slice::values)
}

/// Number of voxels that [`read`] returns, from the headers of the slices.
pub(crate) fn voxels(folder: &Path) -> Result<u64> {
    Ok(slices(folder)?.iter().map(|s| s.format.count() as u64).sum())
}

/// The slices of the one series of `folder`, without their values.
fn slices(folder: &Path) -> Result<Vec<Slice>> {
    let mut series: BTreeMap<String, Vec<Slice>> = BTreeMap::new();
    let mut others = 0;
    for path in files(folder)? {
        if !is_dicom(&path)? {
            others += 1;
        } else if let Some(slice) = Slice::read(&path)? {
            series.entry(slice.series.clone()).or_default().push(slice);
        }
    }
    let place = folder.display().to_string();
    if series.len() > 1 {
        let list: Vec<String> =
            series.iter().map(|(uid, s)| format!("{uid} ({}, {})", s[0].about, counted(s.len(), "file"))).collect();
        let expected = "one series: move the others to folders of their own";
        return Err(Error::invalid(place, "SeriesInstanceUID", list.join("; "), expected));
    }
    let Some(slices) = series.into_values().next() else {
        foreign::refuse_folder(folder)?;
        let found = format!("none among {} (subfolders are not searched)", counted(others, "file"));
        return Err(Error::invalid(place, "DICOM slices", found, "the files of one series"));
    };
    Ok(slices)
}

/// The regular files of `folder`, sorted by name.
pub(crate) fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    Ok(folder::entries(folder)?.into_iter().filter(|path| path.is_file()).collect())
}

fn is_dicom(path: &Path) -> Result<bool> {
    Ok(is_header(&start_of(path, 132)?))
}

fn assemble(place: &str, mut slices: Vec<Slice>, values: &dyn Fn(&Slice) -> Result<Vec<f32>>) -> Result<Volume> {
    for other in &slices[1..] {
        other.must_fit(&slices[0])?;
    }
    let [row, column] = slices[0].axes;
    let normal = cross(row, column);
    slices.sort_by(|a, b| dot(a.position, normal).total_cmp(&dot(b.position, normal)));
    let (first, last) = (&slices[0], &slices[slices.len() - 1]);
    if first.modality != "CT" {
        tracing::warn!("{place}: the modality is {:?}, not CT: its values are not attenuation", first.modality);
    }
    let step = match slices.len() {
        1 => first.thickness()?,
        n => {
            even(place, &slices, normal)?;
            upright(place, first, last, normal)?;
            dot(sub(last.position, first.position), normal) / (n - 1) as f64
        }
    };
    let spacing = [first.spacing[1], first.spacing[0], step];
    let steps = [row.map(|x| x * spacing[0]), column.map(|x| x * spacing[1]), normal.map(|x| x * spacing[2])];
    let lps = affine::from_columns(steps, first.position);
    let grid = VoxelGrid { shape: [first.format.columns, first.format.rows, slices.len()], spacing, center: [0.0; 3] };
    grid.validate(place)?;
    let expected = "three independent voxel axes";
    ensure(affine::is_regular(&lps), place, "ImagePositionPatient", format!("{lps:?}"), expected)?;
    allowance::numbers(place, "voxels", grid.len().unwrap_or(usize::MAX))?;
    let mut data = Array3::zeros(grid.shape);
    for (z, slice) in slices.iter().enumerate() {
        let values = values(slice)?;
        let mut plane = data.slice_mut(s![.., .., z]);
        for (y, row) in values.chunks_exact(slice.format.columns).enumerate() {
            for (x, value) in row.iter().enumerate() {
                plane[[x, y]] = *value;
            }
        }
    }
    Ok(Volume { data, grid, affine: Some(affine::flip(lps)) })
}

/// Refuses coincident slices, gaps and steps that differ by a tenth; warns if steps differ by a hundredth.
fn even(place: &str, slices: &[Slice], normal: [f64; 3]) -> Result<()> {
    let steps: Vec<f64> = slices.windows(2).map(|p| dot(sub(p[1].position, p[0].position), normal)).collect();
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted[sorted.len() / 2];
    let mut missing = Vec::new();
    for (pair, &step) in slices.windows(2).zip(&steps) {
        let names = format!("{} and {}", pair[0].name(), pair[1].name());
        // Files give positions to about a thousandth of a pixel.
        if step < 1e-3 * slices[0].spacing[0].min(slices[0].spacing[1]) {
            let found = format!("{:?} in {names}", pair[0].position);
            return Err(Error::invalid(place, "ImagePositionPatient", found, "another position for every slice"));
        }
        let times = (step / usual).round();
        if (step - usual).abs() <= 0.1 * usual {
            continue;
        } else if times >= 2.0 && (step - times * usual).abs() <= 0.1 * usual {
            missing.push(format!("{} between {names}", times - 1.0));
        } else {
            let expected = format!("{usual:.4} mm, as between most slices");
            return Err(Error::invalid(place, "distance of slices", format!("{step:.4} mm between {names}"), expected));
        }
    }
    if !missing.is_empty() {
        let found = format!("slices missing: {}", missing.join("; "));
        let expected = format!("a slice every {usual:.4} mm");
        return Err(Error::invalid(place, "ImagePositionPatient", found, expected));
    }
    if sorted[sorted.len() - 1] - sorted[0] > 0.01 * usual {
        tracing::warn!(
            "{place}: slices lie {:.4} to {:.4} mm apart: even spacing is assumed",
            sorted[0],
            sorted[sorted.len() - 1]
        );
    }
    Ok(())
}

/// Refuses a stack that is sheared by more than half a pixel (a tilted gantry): its voxels would not be boxes.
fn upright(place: &str, first: &Slice, last: &Slice, normal: [f64; 3]) -> Result<()> {
    let way = sub(last.position, first.position);
    let along = dot(way, normal);
    let aside = norm(sub(way, normal.map(|x| x * along)));
    let found = format!("a last slice {aside:.3} mm aside of the first one's normal (a tilted gantry)");
    let expected = "slices above each other (resample the series to an upright volume first)";
    ensure(aside <= 0.5 * first.spacing[0].min(first.spacing[1]), place, "ImagePositionPatient", found, expected)?;
    Ok(())
}
