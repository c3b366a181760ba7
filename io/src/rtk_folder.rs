//! A scan for RTK: `projections.mha` and `geometry.xml` for its programs, and `scanner.toml` for conefield's own
//! reader, because neither of the two says which volume to reconstruct.

use crate::affine::{flip, from_columns};
use crate::scan::SCANNER;
use crate::{folder, metaimage, rtk, scanner, write_atomic, write_folder_atomic, write_text_atomic};
use conefield_core::Result;
use conefield_core::error::ensure;
use conefield_core::geometry::{VoxelGrid, norm};
use conefield_core::parts::{Part, Voxels};
use conefield_core::scan::Scan;
use ndarray::{ArrayView3, ArrayViewMut3, Axis, s};
use serde_json::json;
use std::path::Path;

const PROJECTIONS: &str = "projections.mha";
const GEOMETRY: &str = "geometry.xml";

/// Writes the folder `folder` for RTK: line integrals in `projections.mha`, one slice per view, columns along its x and
/// rows along its y, in mm relative to the detector's centre; the views in `geometry.xml`. Rows run up there, against
/// those of conefield's circles. An additional `scanner.toml` describes the same to [`read_scan`](crate::read_scan),
/// with the grid to reconstruct.
///
/// RTK's files cannot hold test views, the volume from which a scan was simulated, or a unit other than mm. Refuses
/// detectors whose rows and columns are not orthogonal and pixels that differ between views, which the files cannot
/// express. Replaces an earlier folder only if it is empty or such a folder with nothing else in it.
pub fn write_rtk(folder: impl AsRef<Path>, scan: &Scan) -> Result<()> {
    let folder = folder.as_ref();
    let place = folder.display().to_string();
    scan.validate(&place)?;
    let views = &scan.geometry.views;
    let pixel = [norm(views[0].v), norm(views[0].u)];
    for (i, view) in views.iter().enumerate() {
        let found = [norm(view.v), norm(view.u)];
        let same = (0..2).all(|k| (found[k] - pixel[k]).abs() <= 1e-6 * pixel[k]);
        let expected = format!("{pixel:?} mm, as in the first view");
        ensure(same, &place, &format!("views[{i}]: pixel"), format!("{found:?} mm"), expected)?;
    }
    folder::may_replace(folder, "folder for RTK", &|n| [PROJECTIONS, GEOMETRY, SCANNER].contains(&n), &[GEOMETRY])?;
    let description = json!({
        "format": scanner::FORMAT,
        "version": scanner::VERSION,
        "files": { "projections": PROJECTIONS },
        "rtk": { "file": GEOMETRY, "pixel": { "u": pixel[1], "v": pixel[0] } },
        "values": { "kind": "line-integrals" },
        "volume": scan.geometry.volume,
    });
    let text = toml::to_string(&description)
        .map_err(|e| conefield_core::Error::invalid(&place, SCANNER, e, "a description that TOML can hold"))?;
    write_folder_atomic(folder, &mut |new| {
        let reversed = rtk::write_rtk_geometry(&new.join(GEOMETRY), views)?;
        let mut data = scan.projections.view();
        if reversed {
            data.invert_axis(Axis(1));
        }
        let (path, mut image) = (new.join(PROJECTIONS), Image { data: data.reversed_axes(), pixel });
        write_atomic(&path, &mut |w| metaimage::write(w, &path, &mut image))?;
        write_text_atomic(new.join(SCANNER), &text)
    })
}

/// The projections as RTK's image: x along the columns, y along its rows, z the views.
struct Image<'s> {
    /// `[x, y, z]`.
    data: ArrayView3<'s, f32>,
    pixel: [f64; 2],
}

impl Voxels for Image<'_> {
    fn grid(&self) -> VoxelGrid {
        let (columns, rows, views) = self.data.dim();
        VoxelGrid { shape: [columns, rows, views], spacing: [self.pixel[1], self.pixel[0], 1.0], center: [0.0; 3] }
    }

    /// The image is axis-aligned in ITK's coordinates, its centre at (0, 0).
    fn affine(&self) -> Option<[[f64; 4]; 4]> {
        let VoxelGrid { shape, spacing: s, .. } = self.grid();
        let first = |k: usize| -(shape[k] as f64 - 1.0) / 2.0 * s[k];
        let axes = [[s[0], 0.0, 0.0], [0.0, s[1], 0.0], [0.0, 0.0, s[2]]];
        Some(flip(from_columns(axes, [first(0), first(1), 0.0])))
    }

    fn fill(&mut self, part: &Part, mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let [x, y, z] = part.clone();
        out.assign(&self.data.slice(s![x, y, z]));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::read_volume;
    use crate::testing::{is_geometry, read_scan, says, scan};

    #[test]
    fn a_scan_comes_back_and_rtk_finds_its_image_straight() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("rtk");
        let want = scan();
        write_rtk(&path, &want).unwrap();
        for name in ["", SCANNER] {
            let back = read_scan(path.join(name)).unwrap();
            assert_eq!(back.projections, want.projections);
            assert_eq!(back.geometry.volume, want.geometry.volume);
            is_geometry(&back.geometry, &want.geometry);
        }
        let header = std::fs::read(path.join(PROJECTIONS)).unwrap();
        let header = String::from_utf8_lossy(&header[..400]);
        for line in
            ["TransformMatrix = 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0", "Offset = -3.75 -3.0 0.0", "DimSize = 6 4 7"]
        {
            assert!(header.contains(line), "{line}: {header}");
        }
        // Our last row is RTK's first, the lowest.
        let image = read_volume(path.join(PROJECTIONS)).unwrap();
        assert_eq!(image.data[[2, 0, 5]], want.projections[[5, 3, 2]]);
        // Overwrites itself, but nothing else.
        write_rtk(&path, &want).unwrap();
        std::fs::write(path.join("notes.txt"), "").unwrap();
        assert!(write_rtk(&path, &want).unwrap_err().to_string().contains("notes.txt"));
    }

    #[test]
    fn pixels_that_differ_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut s = scan();
        s.geometry.views[2].u = s.geometry.views[2].u.map(|x| 1.01 * x);
        says(write_rtk(dir.path().join("rtk"), &s), &["views[2]: pixel"]);
    }
}
