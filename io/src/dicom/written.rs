//! Tests of written series: read back by this crate's reader and, element by element, by `dicom-object`.

use super::write::text;
use super::{DicomTemplate, files, tests};
use crate::affine;
use crate::testing::says;
use crate::{read_volume, write_volume, write_voxels_of};
use conefield_core::Result;
use conefield_core::geometry::VoxelGrid;
use conefield_core::parts::{Part, Voxels};
use conefield_core::scan::{Affine, Volume};
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_object::{InMemDicomObject, open_file};
use ndarray::{Array3, ArrayViewMut3};
use std::collections::BTreeSet;
use std::path::Path;

/// 4 × 3 × 5 voxels from -1000 on, with a value of 3 digits.
fn volume() -> Volume {
    let value = |(x, y, z)| -1000.0 + 41.3 * (x + 4 * y + 12 * z) as f32;
    Volume::centered(Array3::from_shape_fn((4, 3, 5), value), [0.75, 0.5, 1.0 / 3.0])
}

/// A volume whose values are Hounsfield units.
struct Hu(Volume);

impl Voxels for Hu {
    fn grid(&self) -> VoxelGrid {
        self.0.grid
    }
    fn affine(&self) -> Option<Affine> {
        self.0.affine
    }
    fn hounsfield(&self) -> Option<&str> {
        Some("HU: water 0.02, air 0 per mm")
    }
    fn fill(&mut self, part: &Part, out: ArrayViewMut3<'_, f32>) -> Result<()> {
        (&self.0).fill(part, out)
    }
}

fn said(file: &Path, tag: Tag) -> String {
    let object = open_file(file).unwrap();
    object.get(tag).map_or("nothing".into(), |e| e.to_str().unwrap().trim_end_matches(['\0', ' ']).to_owned())
}

fn whole(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let name = |p: &Path| p.file_name().unwrap().to_string_lossy().into_owned();
    files(folder).unwrap().iter().map(|p| (name(p), std::fs::read(p).unwrap())).collect()
}

#[test]
fn a_series_comes_back_within_half_a_slope_and_in_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let (path, mut v) = (dir.path().join("a.dicom"), volume());
    let (c, s) = (0.3f64.cos(), 0.3f64.sin());
    let turned = affine::from_columns(
        [[0.75 * c, 0.75 * s, 0.0], [-0.5 * s, 0.5 * c, 0.0], [0.0, 0.0, 1.0 / 3.0]],
        [-123.456789, 1e-7, 40.0],
    );
    for affine in [None, Some(turned)] {
        v.affine = affine;
        write_volume(&path, &v).unwrap();
        let back = read_volume(&path).unwrap();
        assert_eq!(back.grid.shape, v.grid.shape);
        let want = affine.unwrap_or_else(|| affine::centred(&v.grid));
        let near = |a: &f64, b: &f64| (a - b).abs() < 1e-9;
        assert!(back.affine.unwrap().iter().flatten().zip(want.iter().flatten()).all(|(a, b)| near(a, b)), "{back:?}");
        assert!(back.grid.spacing.iter().zip(&v.grid.spacing).all(|(a, b)| near(a, b)));
        let slope: f64 = said(&path.join("0001.dcm"), Tag(0x0028, 0x1053)).parse().unwrap();
        assert!(slope * 32767.0 >= 1436.7 && slope < 1436.8 / 32766.0, "{slope}");
        assert!(back.data.iter().zip(&v.data).all(|(a, b)| f64::from((a - b).abs()) <= 0.5001 * slope));
        for (z, file) in files(&path).unwrap().iter().enumerate() {
            let object = open_file(file).unwrap();
            let stored: Vec<u16> = object.get(Tag(0x7fe0, 0x0010)).unwrap().to_multi_int().unwrap();
            let want = (0..12).map(|i| (f64::from(v.data[[i % 4, i / 4, z]]) / slope).round() as i16);
            assert!(stored.into_iter().map(|x| x as i16).eq(want), "slice {z}");
        }
    }
}

/// A left-handed volume has its slices in the other order: the reader follows the normal.
#[test]
fn a_mirrored_volume_keeps_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let (path, mut v) = (dir.path().join("a.dicom"), volume());
    v.affine = Some(affine::from_columns([[0.75, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, -1.0 / 3.0]], [1.0, 2.0, 3.0]));
    write_volume(&path, &v).unwrap();
    let back = read_volume(&path).unwrap();
    assert!((back.affine.unwrap()[2][3] - (3.0 - 4.0 / 3.0)).abs() < 1e-9, "{back:?}");
    assert!((back.data[[1, 2, 0]] - v.data[[1, 2, 4]]).abs() < 0.03);
}

#[test]
fn identifiers_are_shared_unique_and_the_same_for_the_same_content() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b, c] = ["a.dicom", "b.dicom", "c.dicom"].map(|n| dir.path().join(n));
    let mut other = volume();
    other.data[[0, 0, 0]] = -999.0;
    for path in [&a, &b] {
        write_volume(path, &volume()).unwrap();
    }
    write_volume(&c, &other).unwrap();
    assert!(whole(&a) == whole(&b));
    let uids = |folder: &Path, tag| files(folder).unwrap().iter().map(|f| said(f, tag)).collect::<BTreeSet<_>>();
    for (tag, count) in [(Tag(8, 0x18), 5), (Tag(0x20, 0xd), 1), (Tag(0x20, 0xe), 1), (Tag(0x20, 0x52), 1)] {
        let (first, second) = (uids(&a, tag), uids(&c, tag));
        assert_eq!(first.len(), count);
        assert!(first.is_disjoint(&second));
        for uid in first {
            let number: u128 = uid.strip_prefix("2.25.").unwrap().parse().unwrap();
            assert!(number >> 76 & 0xf == 8 && number >> 62 & 3 == 2, "{uid}");
        }
    }
    let first = open_file(a.join("0001.dcm")).unwrap();
    assert_eq!(first.meta().media_storage_sop_instance_uid(), said(&a.join("0001.dcm"), Tag(8, 0x18)));
}

#[test]
fn hounsfield_units_and_other_values_say_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let [hu, other] = ["hu.dicom", "other.dicom"].map(|n| dir.path().join(n));
    write_voxels_of(&hu, &mut Hu(volume()), None).unwrap();
    write_volume(&other, &volume().mapped(|x| 1e-6 * (x + 1000.0))).unwrap();
    let [hu, other] = [hu, other].map(|f| f.join("0003.dcm"));
    let all = |file: &Path| [0x1050, 0x1051, 0x1052, 0x1054, 0x1056].map(|e| said(file, Tag(0x0028, e)));
    assert_eq!(all(&hu), ["40", "400", "0", "HU", "LINEAR"]);
    assert_eq!(all(&other)[2..], ["0", "US", "LINEAR_EXACT"]);
    let note = said(&hu, Tag(0x0008, 0x2111));
    assert!(note.starts_with("HU: water 0.02, air 0 per mm. Rounded to 16 bits: at most 0.02"), "{note}");
    // Zeros have no range.
    write_volume(dir.path().join("0.dicom"), &volume().mapped(|_| 0.0)).unwrap();
    assert_eq!(read_volume(dir.path().join("0.dicom")).unwrap().data, Array3::<f32>::zeros((4, 3, 5)));
}

#[test]
fn a_template_gives_patient_and_study_and_a_wrong_one_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (template, path) = (dir.path().join("t.dcm"), dir.path().join("a.dicom"));
    let write = |study: &str| {
        let mut o = InMemDicomObject::new_empty();
        for (tag, vr, value) in [
            (Tag(0x0008, 0x0005), VR::CS, "ISO_IR 100"),
            (Tag(0x0010, 0x0010), VR::PN, "M\u{fc}ller^Eva"),
            (Tag(0x0010, 0x0020), VR::LO, "4711"),
            (Tag(0x0008, 0x0020), VR::DA, "20200102"),
            (Tag(0x0020, 0x000d), VR::UI, study),
            (Tag(0x0020, 0x000e), VR::UI, "1.2.9"),
        ] {
            text(&mut o, tag, vr, value);
        }
        tests::write(&template, o, tests::EXPLICIT);
    };
    write("1.2.3");
    let read = DicomTemplate::read(&template).unwrap();
    write_voxels_of(&path, &mut &volume(), Some(&read)).unwrap();
    let file = path.join("0002.dcm");
    let tags = [Tag(8, 5), Tag(0x10, 0x10), Tag(0x10, 0x20), Tag(8, 0x20), Tag(0x20, 0xd), Tag(0x10, 0x40)];
    assert_eq!(tags.map(|t| said(&file, t)), ["ISO_IR 192", "M\u{fc}ller^Eva", "4711", "20200102", "1.2.3", ""]);
    assert!(said(&file, Tag(0x20, 0xe)).starts_with("2.25."));
    let other = dir.path().join("a.mha");
    says(write_voxels_of(other, &mut &volume(), Some(&read)), &["a.mha", "template", ".dicom"]);
    write("");
    says(DicomTemplate::read(&template), &["t.dcm: StudyInstanceUID", "\"\"", "digits"]);
    std::fs::write(&template, "no DICOM").unwrap();
    says(DicomTemplate::read(&template), &["t.dcm: template", "a DICOM file"]);
    says(DicomTemplate::read(dir.path().join("none")), &["none"]);
}

#[test]
fn what_is_there_stays_unless_it_is_such_a_series() {
    let dir = tempfile::tempdir().unwrap();
    let (path, mut v) = (dir.path().join("a.dicom"), volume());
    write_volume(&path, &v).unwrap();
    let before = whole(&path);
    v.data[[3, 2, 1]] = f32::NAN;
    says(write_volume(&path, &v), &["a.dicom: voxel [3, 2, 1]", "NaN"]);
    v.data[[3, 2, 1]] = 0.0;
    v.affine =
        Some(affine::from_columns([[0.75, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.2, 0.2666666666666666]], [0.0; 3]));
    says(write_volume(&path, &v), &["a.dicom: axes", "right angles"]);
    assert!(whole(&path) == before);
    std::fs::write(path.join("notes.txt"), "mine").unwrap();
    says(write_volume(&path, &volume()), &["notes.txt"]);
    says(crate::check_shape(&path, [70_000, 1, 1]), &["a.dicom: shape", "65535"]);
    says(crate::check_shape(&path, [60_000, 60_000, 1]), &["a.dicom: shape", "4 GiB"]);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn one_file_holds_what_a_series_holds() {
    let dir = tempfile::tempdir().unwrap();
    let [series, one] = ["a.dicom", "a.dcm"].map(|n| dir.path().join(n));
    let mut v = volume();
    v.affine = Some(affine::from_columns([[0.0, 0.75, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.0, 1.0 / 3.0]], [1.0, 2.0, 3.0]));
    for path in [&series, &one] {
        write_voxels_of(path, &mut Hu(v.clone()), None).unwrap();
        assert!(crate::is_volume(path));
        assert_eq!(crate::volume_voxels(path).unwrap(), 60);
    }
    let [a, b] = [&series, &one].map(|path| read_volume(path).unwrap());
    assert_eq!((a.data, a.grid, a.affine), (b.data, b.grid, b.affine));
    let bytes = std::fs::read(&one).unwrap();
    write_voxels_of(&one, &mut Hu(v.clone()), None).unwrap();
    assert!(bytes == std::fs::read(&one).unwrap());
    assert_eq!(said(&one, Tag(0x28, 8)), "5");
    v.data[[0, 1, 2]] = f32::INFINITY;
    says(write_volume(&one, &v), &["a.dcm: voxel [0, 1, 2]"]);
    assert!(bytes == std::fs::read(&one).unwrap());
    says(crate::check_shape(&one, [2000; 3]), &["a.dcm: shape", "4 GiB", ".dicom"]);
    // A frame less than the header says, and one without a position.
    let mut object = open_file(&one).unwrap();
    object.put(DataElement::new(Tag(0x28, 8), VR::IS, PrimitiveValue::from("4")));
    object.write_to_file(&one).unwrap();
    says(read_volume(&one), &["a.dcm: PerFrameFunctionalGroupsSequence", "5 items", "4"]);
    std::fs::write(&one, &bytes).unwrap();
    let mut object = open_file(&one).unwrap();
    object.remove_element(Tag(0x5200, 0x9229));
    object.write_to_file(&one).unwrap();
    says(read_volume(&one), &["a.dcm: PixelSpacing", "no such element"]);
}
