//! TIFF from detectors: one grey channel, integers or floats, one image per page; uncompressed, or compressed by LZW,
//! deflate, PackBits or Zstandard. [`write`] writes a volume with one slice per page; [`read_volume`] and
//! [`read_folder`] read slices.

mod entries;
mod volume;
mod write;
mod zstd;

pub(crate) use volume::{folder_voxels, is_stack, read_folder, read_volume};
pub(crate) use write::{check_shape, write};

use crate::input::must_unpack;
use crate::memory;
use conefield_core::finite::stray;
use conefield_core::{Error, Result, allowance, files};
use ndarray::Array3;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Seek};
use std::path::Path;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::{ColorType, TiffError};

/// Whether `head`, the first bytes of a file, starts a TIFF or BigTIFF.
pub(crate) fn is_tiff(head: &[u8]) -> bool {
    [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|m| head.starts_with(*m))
}

/// Number of values of all pages, from their directories.
pub(crate) fn values(path: &Path) -> Result<u64> {
    let mut sum = 0u64;
    pages(path, |_, page| {
        sum = sum.saturating_add(page.pixels);
        Ok(())
    })?;
    Ok(sum)
}

/// Reads all pages as `[page, row, column]`; they must have the same size.
///
/// Converts 8 to 64 bits per pixel, integers or floats, to `f32`. Refuses other colour types, sizes that the file
/// cannot hold, values that are not finite and damaged files.
pub(crate) fn read(path: &Path) -> Result<Array3<f32>> {
    stack(path, |_| Ok(()))
}

/// Like [`read`]; `first` gets the decoder at the first page.
fn stack(path: &Path, first: impl FnOnce(&mut Decoder<BufReader<File>>) -> Result<()>) -> Result<Array3<f32>> {
    let place = path.display().to_string();
    let mut values = Vec::<f32>::new();
    let mut first = Some(first);
    let (pages, [rows, columns]) = pages(path, |decoder, page| {
        if let Some(first) = first.take() {
            first(decoder)?;
        }
        let count = usize::try_from(page.pixels).unwrap_or(usize::MAX);
        memory::grow(&mut values, count, usize::MAX, &place, "pages")?;
        // The stored page and its decompressed strips or tiles.
        allowance::memory(&place, "page", page.bytes.saturating_mul(2))?;
        if zstd::is_packed(decoder) {
            return zstd::read(&place, decoder, page.size, page.bits, &mut values);
        }
        append(&mut values, decoder.read_image().map_err(|e| broken(&place, &e))?);
        Ok(())
    })?;
    let all = Array3::from_shape_vec((pages, rows, columns), values)
        .map_err(|e| Error::invalid(&place, "TIFF", e, format!("{rows} x {columns} values per page")))?;
    match stray(&all) {
        Some(((p, r, c), x)) => {
            Err(Error::invalid(place, format!("page {p}, row {r}, column {c}"), x, "a finite number"))
        }
        None => Ok(all),
    }
}

/// What a page's directory claims.
struct Page {
    pixels: u64,
    /// Bytes of the decompressed values.
    bytes: u64,
    bits: u8,
    /// Rows and columns.
    size: [usize; 2],
}

/// Walks over the pages without decompressing them; returns their number, rows and columns.
fn pages(
    path: &Path,
    mut each: impl FnMut(&mut Decoder<BufReader<File>>, Page) -> Result<()>,
) -> Result<(usize, [usize; 2])> {
    let place = path.display().to_string();
    let (file, packed) = files::open(path)?;
    let broken = |e: TiffError| broken(&place, &e);
    let mut reader = BufReader::new(file);
    entries::check(&place, &mut reader, packed)?;
    reader.rewind().map_err(|e| Error::io(path, e))?;
    let mut decoder = Decoder::new(reader).map_err(broken)?;
    let (mut size, mut pages, mut claimed) = (None, 0usize, [0u64; 2]);
    loop {
        let (width, height) = decoder.dimensions().map_err(broken)?;
        let bits = match decoder.colortype().map_err(broken)? {
            ColorType::Gray(bits @ (8 | 16 | 32 | 64)) => bits,
            other => {
                let expected = "one grey channel of 8, 16, 32 or 64 bits";
                return Err(Error::invalid(&place, format!("page {pages}"), format!("{other:?}"), expected));
            }
        };
        let pixels = u64::from(width) * u64::from(height);
        let bytes = pixels.saturating_mul(u64::from(bits) / 8);
        claimed = [claimed[0].saturating_add(bytes), claimed[1].saturating_add(pixels)];
        let fits = must_unpack(packed, claimed[0], claimed[1]);
        fits.and(if bytes == 0 { Err("at least one pixel".into()) } else { Ok(()) }).map_err(|expected| {
            let found = format!("{height} x {width} pixels of {bits} bits in a file of {packed} bytes");
            Error::invalid(&place, format!("page {pages}"), found, expected)
        })?;
        if *size.get_or_insert((height, width)) != (height, width) {
            let found = format!("{height} x {width} pixels");
            return Err(Error::invalid(&place, format!("page {pages}"), found, "the size of the first page"));
        }
        // Includes the next page's entries; a value takes 32 bytes at most.
        let most = bytes.max(packed.saturating_mul(32));
        let mut limits = Limits::default();
        limits.decoding_buffer_size = usize::try_from(most).unwrap_or(usize::MAX);
        (limits.ifd_value_size, limits.intermediate_buffer_size) = [limits.decoding_buffer_size; 2].into();
        decoder = decoder.with_limits(limits);
        each(&mut decoder, Page { pixels, bytes, bits, size: [height as usize, width as usize] })?;
        pages += 1;
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().map_err(broken)?;
    }
    let (height, width) = size.unwrap_or_default();
    Ok((pages, [height as usize, width as usize]))
}

fn broken(place: &str, e: &TiffError) -> Error {
    let found = match e {
        TiffError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => "the end of the file".to_owned(),
        other => other.to_string(),
    };
    Error::invalid(place, "TIFF", found, "a whole TIFF image")
}

fn append(out: &mut Vec<f32>, image: DecodingResult) {
    use DecodingResult::*;
    match image {
        U8(v) => out.extend(v.iter().map(|&x| f32::from(x))),
        I8(v) => out.extend(v.iter().map(|&x| f32::from(x))),
        U16(v) => out.extend(v.iter().map(|&x| f32::from(x))),
        I16(v) => out.extend(v.iter().map(|&x| f32::from(x))),
        U32(v) => out.extend(v.iter().map(|&x| x as f32)),
        I32(v) => out.extend(v.iter().map(|&x| x as f32)),
        U64(v) => out.extend(v.iter().map(|&x| x as f32)),
        I64(v) => out.extend(v.iter().map(|&x| x as f32)),
        F16(v) => out.extend(v.iter().map(|&x| f32::from(x))),
        F32(v) => out.extend(v),
        F64(v) => out.extend(v.iter().map(|&x| x as f32)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use tiff::encoder::{TiffEncoder, colortype as kind};

    #[test]
    fn integers_and_floats_come_in_and_pages_become_views() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        macro_rules! each {
            ($kind:ty, $t:ty) => {{
                let mut w = TiffEncoder::new(File::create(&path).unwrap()).unwrap();
                for page in 0..2u8 {
                    let data: Vec<$t> = (0..6u8).map(|i| (10 * page + i) as $t).collect();
                    w.write_image::<$kind>(3, 2, &data).unwrap();
                }
                drop(w);
                let a = read(&path).unwrap();
                assert_eq!(a.dim(), (2, 2, 3));
                assert_eq!((a[[0, 0, 2]], a[[0, 1, 0]], a[[1, 1, 2]]), (2.0, 3.0, 15.0));
            }};
        }
        each!(kind::Gray8, u8);
        each!(kind::Gray16, u16);
        each!(kind::Gray32, u32);
        each!(kind::GrayI16, i16);
        each!(kind::Gray32Float, f32);
    }

    /// Written by tifffile (`tests/fixtures/make_formats.py`): the i-th value is 9000 + 97 i, or a seventh of that.
    const ZSTD: &[(&str, &[u8])] = &[
        ("strips", include_bytes!("../tests/fixtures/zstd.tif")),
        ("floats", include_bytes!("../tests/fixtures/zstd_floats.tif")),
        ("tiles", include_bytes!("../tests/fixtures/zstd_tiles.tif")),
    ];

    #[test]
    fn zstandard_is_read_in_strips_and_tiles() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let count = |i: usize| 9000.0 + 97.0 * i as f32;
        for (name, bytes) in ZSTD {
            std::fs::write(&path, bytes).unwrap();
            let a = read(&path).unwrap();
            let want = |p: usize, r: usize, c: usize| match *name {
                "strips" => count(20 * p + 5 * r + c),
                "floats" => ((f64::from(count(20 * p + 5 * r + c))) / 7.0) as f32,
                _ => count(5 * (r % 4) + c % 5),
            };
            assert_eq!(a.dim(), if *name == "tiles" { (1, 24, 25) } else { (3, 4, 5) });
            assert!(a.indexed_iter().all(|((p, r, c), x)| *x == want(p, r, c)), "{name}: {a}");
        }
        let (_, whole) = ZSTD[0];
        let mut bytes = whole.to_vec();
        let at = bytes.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).unwrap();
        bytes[at] = 0;
        refused(&bytes, &["TIFF", "Zstandard"]);
        for at in 0..whole.len() {
            let mut bytes = whole.to_vec();
            bytes[at] ^= 0x83;
            std::fs::write(&path, &bytes).unwrap();
            let _ = read(&path);
        }
    }

    fn refused(bytes: &[u8], words: &[&str]) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        std::fs::write(&path, bytes).unwrap();
        let e = read(&path).unwrap_err().to_string();
        assert!(e.contains("a.tif") && words.iter().all(|w| e.contains(w)), "{words:?} are not all in: {e}");
    }

    #[test]
    fn damaged_and_foreign_images_are_refused() {
        let mut file = std::io::Cursor::new(Vec::new());
        let data: Vec<u16> = (0..400).collect();
        TiffEncoder::new(&mut file).unwrap().write_image::<kind::Gray16>(20, 20, &data).unwrap();
        let whole = file.into_inner();
        for cut in [0, 3, 9, whole.len() / 2, whole.len() - 20] {
            refused(&whole[..cut], &["TIFF"]);
        }
        // No changed byte causes a panic or a large allocation.
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("b.tif");
        for at in (0..8).chain(800..whole.len()) {
            for x in [0x01, 0x80, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] ^= x;
                std::fs::write(&path, &bytes).unwrap();
                let _ = read(&path);
            }
        }
        let mut file = std::io::Cursor::new(Vec::new());
        TiffEncoder::new(&mut file).unwrap().write_image::<kind::RGB8>(2, 1, &[1u8; 6]).unwrap();
        refused(&file.into_inner(), &["page 0", "RGB", "grey"]);
        let mut file = std::io::Cursor::new(Vec::new());
        TiffEncoder::new(&mut file).unwrap().write_image::<kind::Gray32Float>(2, 1, &[1.0, f32::NAN]).unwrap();
        refused(&file.into_inner(), &["page 0, row 0, column 1", "NaN"]);
    }
}
