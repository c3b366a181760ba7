//! The files with which vendors describe a scan, and what they give in common: views, the names of the images, the open
//! beam and a volume, as a [`Description`].

use super::{Description, Files, I0, LayoutTable, ValueKind, ValuesTable, his, obi, skyscan, txrm, xim, xtekct};
use crate::folder::extension;
use crate::input::LONGEST_TEXT;
use crate::rtk::Projection;
use crate::stack::Names;
use crate::text::read_foreign;
use conefield_core::Result;
use conefield_core::geometry::{View, VoxelGrid};
use ndarray::{Array3, Axis};
use std::path::Path;

/// Most views of a description: a circle in steps of about one second of arc. A larger number is a typing error and
/// would only fill memory.
pub(crate) const MOST_VIEWS: usize = 1_000_000;

/// Most rows or columns of a detector.
pub(super) const MOST_PIXELS: usize = 1_000_000;

/// Most voxels along x and y of a volume that no file states: clinical scanners reconstruct as many, and a finer grid
/// may not fit in memory.
const MOST_VOXELS: f64 = 512.0;

/// What reads a vendor's description of a scan, in the terms of `scanner.toml`.
type Reader = fn(&Path) -> Result<Description>;

/// The vendors' descriptions by extension, with words that only such a file holds where others use the extension too.
const READERS: [(&str, &str, Reader); 6] = [
    ("xtekct", "", xtekct::scan),
    ("txrm", "", txrm::scan),
    ("log", skyscan::MARK, skyscan::scan),
    ("xml", xim::MARK, xim::scan),
    ("xml", obi::MARK, obi::scan),
    ("xml", his::MARK, his::scan),
];

/// The reader of the vendor that describes a scan in the file `path`.
pub(super) fn reader(path: &Path) -> Option<Reader> {
    let extension = extension(path);
    let mut readers = READERS.iter().filter(|(end, ..)| *end == extension).peekable();
    let text = match readers.peek()? {
        (_, "", _) => String::new(),
        _ => read_foreign(path, LONGEST_TEXT).ok()?,
    };
    readers.find(|(_, mark, _)| text.contains(mark)).map(|(.., reader)| *reader)
}

/// Whether the file `path` is a vendor's description of a scan.
pub(crate) fn is_vendors(path: &Path) -> bool {
    reader(path).is_some()
}

/// The open beam.
pub(super) enum Open {
    Flat(Names),
    Number(f64),
    /// Estimated from the border of each view.
    Air,
}

/// What makes counts of the numbers in the images.
#[derive(Debug, Default, PartialEq)]
pub(super) enum Response {
    /// Nothing: they are counts.
    #[default]
    Counts,
    /// A factor for each view.
    Factors(Vec<f32>),
    /// They are the open beam of Elekta's detector less the counts.
    Inverted,
}

impl Response {
    pub fn apply(&self, values: &mut Array3<f32>) {
        match self {
            Self::Counts => {}
            Self::Factors(all) => {
                values.axis_iter_mut(Axis(0)).zip(all).for_each(|(mut view, factor)| view *= *factor);
            }
            Self::Inverted => values.mapv_inplace(|x| his::I0 - if (1.0..=65534.0).contains(&x) { x } else { 1.0 }),
        }
    }
}

impl Description {
    /// A vendor's scan of the images `projections` with a view each, on a detector of so many rows and columns. `remarks`
    /// are warnings for the user.
    pub fn of_vendor(
        projections: Names,
        open: Open,
        views: Vec<View>,
        detector: [usize; 2],
        volume: VoxelGrid,
        remarks: Vec<String>,
    ) -> Self {
        let (flat, i0) = match open {
            Open::Flat(names) => (Some(names), None),
            Open::Number(n) => (None, Some(I0::Number(n))),
            Open::Air => (None, Some(I0::Air)),
        };
        Self {
            _format: String::new(),
            _version: 0,
            files: Files { projections, flat, dark: None },
            circle: None,
            vectors: None,
            rtk: None,
            cil: None,
            layout: LayoutTable::default(),
            values: ValuesTable { kind: ValueKind::Counts, i0, ..ValuesTable::default() },
            volume,
            views: Some(views),
            detector: Some(detector),
            response: Response::Counts,
            remarks,
        }
    }

    /// The same for `images` of an imager on a gantry, in RTK's terms: the distances from the source to the axis and the
    /// detector, the size of a pixel along v and u, and for each image the gantry's angle and the detector's shift along
    /// columns and rows. Lengths are mm, angles degrees. The files state no volume.
    pub fn on_gantry(
        place: &str,
        images: Vec<String>,
        open: Open,
        [sid, sdd]: [f64; 2],
        detector: [usize; 2],
        pixel: [f64; 2],
        stands: &[(f64, [f64; 2])],
        mut remarks: Vec<String>,
    ) -> Result<Self> {
        let view = |&(gantry, detector): &(f64, [f64; 2])| {
            Projection { sid, sdd, gantry, detector, ..Projection::default() }.view(pixel, [0.0; 2])
        };
        let aside = stands.iter().map(|(_, shift)| shift[0].abs()).fold(0.0, f64::max);
        let at_axis = pixel.map(|x| x * sid / sdd);
        let volume = field_of_view(place, detector, at_axis, aside * sid / sdd, &mut remarks)?;
        let views = stands.iter().map(view).collect();
        Ok(Self::of_vendor(Names::Many(images), open, views, detector, volume, remarks))
    }
}

/// A volume for a scan that states none: as wide as the views see, with voxels of the pixel's size at the axis (`across`
/// along u, `along` along v), or larger ones if there were more than [`MOST_VOXELS`]. `aside` is the distance, at the
/// axis, by which the detector is shifted along u: over a full turn its views see a disc wider by twice that.
pub(super) fn field_of_view(
    place: &str,
    [rows, columns]: [usize; 2],
    [along, across]: [f64; 2],
    aside: f64,
    remarks: &mut Vec<String>,
) -> Result<VoxelGrid> {
    let width = columns as f64 + 2.0 * aside.abs() / across;
    let coarser = (width / MOST_VOXELS).max(1.0);
    // Rounding errors do not add a voxel.
    let count = |pixels: f64| (pixels / coarser - 1e-6).ceil().max(1.0) as usize;
    let [x, y, z] = [across, across, along].map(|x| x * coarser);
    let grid =
        VoxelGrid { shape: [count(width), count(width), count(rows as f64)], spacing: [x, y, z], center: [0.0; 3] };
    grid.validate(place)?;
    if coarser > 1.0 {
        remarks.push(format!(
            "the files state no volume: {} x {} x {} voxels of {x:.4} mm are taken, and the pixels are {across:.4} mm at \
             the axis; volume in the imported scan.toml sets others",
            grid.shape[0], grid.shape[1], grid.shape[2]
        ));
    }
    Ok(grid)
}
