//! Helpers shared by the tests of several modules.

use crate::{DataSet, I0, OpenBeam, Stored, is_volume, rays, read_volume, volume_voxels, write_volume};
use conefield_core::Result;
use conefield_core::geometry::{Geometry, Millimetres, Radians, View, VoxelGrid};
use conefield_core::orbit::CircularOrbit;
use conefield_core::scan::{Scan, Unit, Volume};
use ndarray::Array3;
use std::io::Write;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Fails unless `result` is an error that names all of `words`.
pub(crate) fn says<T>(result: Result<T>, words: &[&str]) {
    let Err(e) = result else { panic!("no error: {words:?}") };
    let e = e.to_string();
    assert!(words.iter().all(|w| e.contains(w)), "{words:?} are not all in: {e}");
}

/// Fails unless `result` is an error with just these words, in which names of files are relative to `dir`.
pub(crate) fn says_just<T>(result: Result<T>, dir: &Path, words: &str) {
    let Err(e) = result else { panic!("no error: {words}") };
    assert_eq!(e.to_string().replace(&format!("{}/", dir.display()), ""), words);
}

/// Fails unless the scan that `description` describes is refused with just `words` about the `file` beside or below it,
/// once `change` has damaged that. The file is as it was afterwards.
pub(crate) fn damage_is_refused(description: &Path, file: &str, change: &dyn Fn(&mut Vec<u8>), words: &str) {
    let dir = description.parent().unwrap();
    let whole = std::fs::read(dir.join(file)).unwrap();
    let mut bytes = whole.clone();
    change(&mut bytes);
    assert_ne!(bytes, whole, "{words}");
    std::fs::write(dir.join(file), bytes).unwrap();
    says_just(read_scanner(description, None), dir, &format!("{file}: {words}"));
    std::fs::write(dir.join(file), whole).unwrap();
}

/// A change that puts `to` in place of `from`.
pub(crate) fn replaced<'a>(from: &'a str, to: &'a str) -> impl Fn(&mut Vec<u8>) + 'a {
    move |bytes| *bytes = std::str::from_utf8(bytes).unwrap().replace(from, to).into_bytes()
}

/// Fails unless source, detector, u and v are `want`, to a billionth.
pub(crate) fn is_view(found: &View, want: [[f64; 3]; 4]) {
    for (found, want) in [found.source, found.detector, found.u, found.v].into_iter().zip(want) {
        assert!((0..3).all(|k| (found[k] - want[k]).abs() < 1e-9), "{found:?} is not {want:?}");
    }
}

/// Fails unless there are as many views, and each is that of `want`, to a billionth.
pub(crate) fn are_views(found: &[View], want: &[View]) {
    assert_eq!(found.len(), want.len());
    found.iter().zip(want).for_each(|(found, w)| is_view(found, [w.source, w.detector, w.u, w.v]));
}

/// Fails unless detector and grid are those of `want`, and the views are, to a billionth.
pub(crate) fn is_geometry(found: &Geometry, want: &Geometry) {
    assert_eq!((found.detector, found.volume.shape), (want.detector, want.volume.shape));
    are_views(&found.views, &want.views);
    let (a, b) = (&found.volume, &want.volume);
    let mut pairs = a.spacing.iter().chain(&a.center).zip(b.spacing.iter().chain(&b.center));
    assert!(pairs.all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} is not {b:?}");
}

/// Fails unless the line integral at view, row and column is `want`, to a millionth.
pub(crate) fn is_integral(scan: &Scan, at: [usize; 3], want: f64) {
    let found = f64::from(scan.projections[at]);
    assert!((found - want).abs() < 1e-6, "{at:?}: {found} is not {want}");
}

/// Writes a 16-bit TIFF with the pixels that `f` gives for row and column.
pub(crate) fn tiff16(path: &Path, [rows, columns]: [usize; 2], f: impl Fn(usize, usize) -> u16) {
    use tiff::encoder::{TiffEncoder, colortype::Gray16};
    let pixels: Vec<u16> = (0..rows * columns).map(|i| f(i / columns, i % columns)).collect();
    let file = std::fs::File::create(path).unwrap();
    TiffEncoder::new(file).unwrap().write_image::<Gray16>(columns as u32, rows as u32, &pixels).unwrap();
}

/// A file called `name` in a folder of its own.
pub(crate) fn file(name: &str, parts: &[&[u8]]) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, parts.concat()).unwrap();
    (dir, path)
}

/// `bytes` in gzip.
pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut w = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    w.write_all(bytes).and_then(|()| w.finish()).unwrap()
}

/// `bytes` in zlib.
pub(crate) fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut w = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    w.write_all(bytes).and_then(|()| w.finish()).unwrap()
}

/// A file of the shared data, or `None` with a note that the test is skipped.
pub(crate) fn data(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("CONEFIELD_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"));
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: {} is not there; CONEFIELD_DATA names the folder of the shared data", path.display());
    None
}

/// The scan `path`, whose size is known before; counts are converted by the bare formula.
pub(crate) fn read_scan(path: impl AsRef<Path>) -> Result<Scan> {
    let path = path.as_ref();
    crate::read_scan(path).and_then(|stored| line_integrals(path, stored))
}

/// The same for a scanner's description.
pub(crate) fn read_scanner(path: impl AsRef<Path>, i0: Option<I0>) -> Result<Scan> {
    let path = path.as_ref();
    crate::read_scanner(path, i0, None).and_then(|stored| line_integrals(path, stored))
}

fn line_integrals(path: &Path, stored: Stored) -> Result<Scan> {
    let pixels = crate::scan_size(path)?.pixels;
    let mut counts = match stored {
        Stored::Scan(scan) => {
            assert_eq!(scan.projections.len() as u64, pixels);
            return Ok(scan);
        }
        Stored::Counts(counts) => counts,
    };
    assert_eq!(counts.values.len() as u64, pixels);
    let mut a = std::mem::take(&mut counts.values);
    a.indexed_iter_mut().for_each(|((_, row, column), x)| {
        let dark = counts.conversion.dark.as_ref().map_or(0.0, |d| d[[row, column]]);
        let open = match &counts.conversion.open {
            OpenBeam::Flat(flat) => flat[[row, column]],
            OpenBeam::Number(n) => *n as f32,
            OpenBeam::Air => panic!("no test needs it"),
        };
        *x = ((open - dark) / (*x - dark).max(1.0)).ln();
    });
    counts.scan(a, serde_json::Value::Null)
}

/// Writes `data` to a file called `name` and reads it: values, grid and affine are the same bits, with the volume
/// centred and with an affine of its own that turns and mirrors.
pub(crate) fn comes_back_to_the_bit(name: &str, data: Array3<f32>, spacing: [f64; 3]) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    let count = data.len();
    let mut volume = Volume::centered(data, spacing);
    write_volume(&path, &volume).unwrap();
    let back = read_volume(&path).unwrap();
    assert_eq!((&back.data, back.grid), (&volume.data, volume.grid));
    assert!(is_volume(&path) && back.data.is_standard_layout());
    assert_eq!(volume_voxels(&path).unwrap(), count as u64);
    let centred = back.affine.unwrap();
    let corner = volume.grid.voxel([0; 3]);
    assert_eq!(centred.map(|r| r[3]), [corner[0], corner[1], corner[2], 1.0]);
    let [x, y, z] = spacing;
    let turned = [[0.0, y, 0.0, 5.25], [-x, 0.0, 0.0, 6.0], [0.0, 0.0, -z, -7.0], [0.0, 0.0, 0.0, 1.0]];
    for affine in [centred, turned] {
        volume.affine = Some(affine);
        write_volume(&path, &volume).unwrap();
        let back = read_volume(&path).unwrap();
        assert_eq!((&back.data, back.grid, back.affine), (&volume.data, volume.grid, Some(affine)));
    }
}

/// A `.npy` file with the given header entries.
pub(crate) fn npy_bytes(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    out.extend(data);
    out
}

/// A small scan on a circle, with an offset detector and non-cubic voxels.
pub(crate) fn scan() -> Scan {
    let mm = Millimetres;
    let views: Vec<View> = (0..7)
        .map(|i| {
            let angle = Radians(0.3 + i as f64 * std::f64::consts::TAU / 7.0);
            View::circular(angle, mm(500.0), mm(800.0), [mm(2.0), mm(1.5)], [mm(-1.0), mm(30.0)])
        })
        .collect();
    Scan {
        geometry: Geometry {
            detector: [4, 6],
            views,
            volume: VoxelGrid { shape: [5, 6, 7], spacing: [1.0, 1.25, 2.0], center: [0.5, 0.0, -3.0] },
        },
        projections: Array3::from_shape_fn((7, 4, 6), |(a, v, u)| a as f32 + 0.1 * v as f32 + 0.01 * u as f32),
        unit: Unit { name: "cm".into(), mm: 10.0 },
        provenance: serde_json::json!({"from": "a test", "noise": {"photons": 10000, "sigma": 0.5}}),
    }
}

/// A scan that matches its volume, with another offset than that of [`scan`].
pub(crate) fn consistent(unit: Unit) -> (Scan, Volume) {
    let mut s = Scan { unit, ..scan() };
    let mut orbit = CircularOrbit::fit(&s.geometry.views).unwrap();
    orbit.offset = [0.25, -1.5];
    s.geometry.views = orbit.views();
    let data = Array3::from_shape_fn((5, 6, 7), |(x, y, z)| 0.01 + 0.002 * (x + y * z) as f32);
    let (g, mm) = (&s.geometry, s.unit.mm);
    s.projections.indexed_iter_mut().for_each(|((view, row, column), p)| {
        *p = (rays::integral(&data, &g.volume, &g.ray(view, row, column)) / mm) as f32;
    });
    let grid = s.geometry.volume;
    (s, Volume { data, grid, affine: None })
}

/// Writes views, test views and a volume.
type WriteDataSet<'a> = &'a dyn Fn(&Path, &Scan, Option<&Scan>, Option<&Volume>) -> Result<()>;

/// Fails unless `read` gives back what `write` writes to `path`: views, test views and a volume, and then views alone in
/// their place. Neither a scan that is no circle nor a volume of another shape is written.
pub(crate) fn data_set_comes_back(path: &Path, write: WriteDataSet, read: &dyn Fn(&Path, bool) -> Result<DataSet>) {
    let train = scan();
    let (_, test) = train.split(&[1, 4]).unwrap();
    let volume = Volume { data: Array3::from_elem((5, 6, 7), 0.5), grid: train.geometry.volume, affine: None };
    write(path, &train, Some(&test), Some(&volume)).unwrap();
    let back = read(path, true).unwrap();
    for (found, want) in [(&back.train, &train), (back.test.as_ref().unwrap(), &test)] {
        is_geometry(&found.geometry, &want.geometry);
        assert_eq!((&found.unit, &found.projections), (&want.unit, &want.projections));
        assert_eq!(found.provenance["unit_from"], "the file");
    }
    assert_eq!(back.volume.unwrap().data, volume.data);
    assert!(read(path, false).unwrap().test.is_none());
    write(path, &train, None, None).unwrap();
    let back = read(path, true).unwrap();
    assert!(back.test.is_none() && back.volume.is_none() && crate::read_truth(path).unwrap().is_none());
    let mut odd = train.clone();
    odd.geometry.views[0].source[2] += 1.0;
    says(write(path, &odd, None, None), &["circle"]);
    let small = Volume::centered(Array3::ones((2, 2, 2)), [1.0; 3]);
    says(write(path, &train, None, Some(&small)), &["shape of the volume", "[2, 2, 2]", "[5, 6, 7]"]);
}
