//! The stored values of one slice.

use conefield_core::{Error, Result, allowance};
use dicom_core::PrimitiveValue;
use dicom_object::DefaultDicomObject;
use dicom_object::mem::InMemElement;
use jpeg_decoder::Decoder;

/// How values are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PixelFormat {
    pub rows: usize,
    pub columns: usize,
    /// Bytes per value: 1, 2 or 4.
    pub bytes: usize,
    /// Significant bits, of which `high` is the uppermost.
    pub stored: u32,
    pub high: u32,
    pub signed: bool,
}

impl PixelFormat {
    pub fn count(&self) -> usize {
        self.rows * self.columns
    }

    /// The number in the significant bits.
    fn number(&self, bits: u32) -> i64 {
        let value = i64::from(bits >> (self.high + 1 - self.stored)) & ((1i64 << self.stored) - 1);
        if self.signed && value >> (self.stored - 1) != 0 { value - (1i64 << self.stored) } else { value }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Packing {
    Plain,
    RunLength,
    Jpeg,
    JpegLs,
    Jpeg2000,
}

/// How the transfer syntax `uid` compresses images.
pub(super) fn packing(place: &str, uid: &str) -> Result<Packing> {
    match uid {
        "1.2.840.10008.1.2" | "1.2.840.10008.1.2.1" | "1.2.840.10008.1.2.2" => Ok(Packing::Plain),
        "1.2.840.10008.1.2.5" => Ok(Packing::RunLength),
        "1.2.840.10008.1.2.4.50" | "1.2.840.10008.1.2.4.57" | "1.2.840.10008.1.2.4.70" => Ok(Packing::Jpeg),
        "1.2.840.10008.1.2.4.80" | "1.2.840.10008.1.2.4.81" => Ok(Packing::JpegLs),
        "1.2.840.10008.1.2.4.90" | "1.2.840.10008.1.2.4.91" => Ok(Packing::Jpeg2000),
        other => Err(unsupported(place, other)),
    }
}

fn unsupported(place: &str, uid: &str) -> Error {
    let name = match uid {
        "1.2.840.10008.1.2.1.99" => " (deflated)",
        "1.2.840.10008.1.2.4.51" => " (JPEG with 12 bits)",
        "1.2.840.10008.1.2.4.201" | "1.2.840.10008.1.2.4.202" | "1.2.840.10008.1.2.4.203" => " (HTJ2K)",
        _ => "",
    };
    Error::unsupported(
        format!("{place}: TransferSyntaxUID {uid}{name}"),
        "uncompressed, RLE, 8-bit or lossless JPEG, JPEG-LS and JPEG 2000 files are read: decompress the series first \
         (gdcmconv --raw)",
    )
}

/// The pixel values of `object`, row by row.
pub(super) fn values(
    place: &str,
    object: &DefaultDicomObject,
    element: &InMemElement,
    format: &PixelFormat,
) -> Result<Vec<f64>> {
    let fail = |found: String, expected: String| Error::invalid(place, "PixelData", found, expected);
    // The joined fragments, the stored and returned values, and the intermediate output of a JPEG decoder.
    let held = element.fragments().map_or(0, |all| all.iter().map(|f| f.len() as u64).sum());
    allowance::memory(place, "PixelData", (format.count() as u64).saturating_mul(12).saturating_add(held))?;
    let bits = match packing(place, object.meta().transfer_syntax())? {
        Packing::Plain => plain(element, format),
        packed => {
            let pieces = element.fragments().ok_or("no compressed picture".to_owned());
            pieces.map(|p| p.concat()).and_then(|bytes| match packed {
                Packing::RunLength => run_length(&bytes, format),
                Packing::JpegLs => jpeg_ls(&bytes, format),
                Packing::Jpeg2000 => jpeg_2000(place, &bytes, format),
                _ => jpeg(&bytes, format),
            })
        }
    };
    let bits = bits.map_err(|found| fail(found, "a whole picture".into()))?;
    if bits.len() != format.count() {
        let expected = format!("{} ({} rows of {})", format.count(), format.rows, format.columns);
        return Err(fail(format!("{} values", bits.len()), expected));
    }
    Ok(bits.into_iter().map(|b| format.number(b) as f64).collect())
}

fn plain(element: &InMemElement, format: &PixelFormat) -> Result<Vec<u32>, String> {
    let count = format.count();
    let value = element.value().primitive().ok_or("a compressed picture in an uncompressed file")?;
    // Words are already in native byte order; byte arrays are little-endian.
    match (value, format.bytes) {
        (PrimitiveValue::U16(words), 2) => Ok(words.iter().take(count).map(|w| u32::from(*w)).collect()),
        (PrimitiveValue::U16(words), 1) => {
            Ok(words.iter().flat_map(|w| w.to_le_bytes()).take(count).map(u32::from).collect())
        }
        (PrimitiveValue::U16(words), _) => {
            let pairs = words.chunks_exact(2).take(count);
            Ok(pairs.map(|p| u32::from(p[0]) | u32::from(p[1]) << 16).collect())
        }
        (PrimitiveValue::U8(bytes), n) => {
            let word = |b: &[u8]| b.iter().rev().fold(0, |w, b| w << 8 | u32::from(*b));
            Ok(bytes.chunks_exact(n).take(count).map(word).collect())
        }
        _ => Err("neither bytes nor words".into()),
    }
}

/// DICOM's run-length coding: one PackBits run per byte of a value, the highest byte first.
fn run_length(bytes: &[u8], format: &PixelFormat) -> Result<Vec<u32>, String> {
    let word = |k: usize| bytes.get(4 * k..4 * k + 4).map(|b| b.iter().rev().fold(0, |w, b| w << 8 | usize::from(*b)));
    let header = || format!("{} bytes without a run-length header", bytes.len());
    let segments = word(0).ok_or_else(header)?;
    if segments != format.bytes {
        return Err(format!("{segments} run-length segments for values of {} bytes", format.bytes));
    }
    let mut out = vec![0u32; format.count()];
    for k in 1..=segments {
        let start = word(k).ok_or_else(header)?;
        let end = if k < segments { word(k + 1).ok_or_else(header)? } else { bytes.len() };
        let segment =
            bytes.get(start..end).ok_or(format!("a segment from byte {start} to {end} of {}", bytes.len()))?;
        let mut plane = Runs { rest: segment, repeat: 0, literal: 0 };
        for value in &mut out {
            let byte = plane.next().ok_or(format!("the end of segment {k} before the last value"))?;
            *value = *value << 8 | u32::from(byte);
        }
    }
    Ok(out)
}

/// Iterator over the bytes that PackBits encodes.
struct Runs<'a> {
    rest: &'a [u8],
    /// Remaining repetitions of the next byte.
    repeat: usize,
    /// Remaining literal bytes.
    literal: usize,
}

impl Iterator for Runs<'_> {
    type Item = u8;

    fn next(&mut self) -> Option<u8> {
        while self.repeat == 0 && self.literal == 0 {
            let (code, rest) = self.rest.split_first()?;
            self.rest = rest;
            match code {
                0..=127 => self.literal = usize::from(*code) + 1,
                128 => {}
                129..=255 => self.repeat = 257 - usize::from(*code),
            }
        }
        let (byte, rest) = self.rest.split_first()?;
        if self.literal > 0 {
            self.literal -= 1;
            self.rest = rest;
        } else {
            self.repeat -= 1;
            if self.repeat == 0 {
                self.rest = rest;
            }
        }
        Some(*byte)
    }
}

/// JPEG with one channel; checks the image's own size before it allocates memory.
fn jpeg(bytes: &[u8], format: &PixelFormat) -> Result<Vec<u32>, String> {
    let found = frame(bytes).ok_or("no JPEG picture")?;
    must_be(found, format, "JPEG")?;
    let mut decoder = Decoder::new(bytes);
    decoder.set_max_decoding_buffer_size(format.count() * 2);
    let raw = decoder.decode().map_err(|e| format!("a JPEG picture that cannot be decoded: {e}"))?;
    Ok(match found.0 {
        0..=8 => raw.into_iter().map(u32::from).collect(),
        _ => raw.as_chunks().0.iter().map(|b| u32::from(u16::from_ne_bytes(*b))).collect(),
    })
}

/// Refuses an image whose size differs from the file's.
fn must_be((bits, rows, columns, channels): Frame, format: &PixelFormat, name: &str) -> Result<(), String> {
    if (rows, columns, channels) != (format.rows, format.columns, 1) {
        return Err(format!("a {name} picture of {rows} rows, {columns} columns and {channels} channels"));
    }
    if bits == 0 || usize::from(bits).div_ceil(8) > format.bytes {
        return Err(format!("a {name} picture of {bits} bits in values of {} bytes", format.bytes));
    }
    Ok(())
}

/// JPEG-LS with one channel, lossless or near-lossless.
fn jpeg_ls(bytes: &[u8], format: &PixelFormat) -> Result<Vec<u32>, String> {
    must_be(frame(bytes).ok_or("no JPEG-LS picture")?, format, "JPEG-LS")?;
    let (values, ..) = jpegls::decode(bytes, format.columns as u32, format.rows as u32)
        .map_err(|e| format!("a JPEG-LS picture that cannot be decoded: {e}"))?;
    Ok(values.into_iter().map(u32::from).collect())
}

/// JPEG 2000 with one channel and at most 16 bits, as a code stream or in a JP2 file.
///
/// The decoder computes values in 32-bit floats and adds half of their range also to signed values, which need no shift
/// (ISO/IEC 15444-1, G.1). This function subtracts it again.
fn jpeg_2000(place: &str, bytes: &[u8], format: &PixelFormat) -> Result<Vec<u32>, String> {
    let (found, signed) = size_marker(bytes).ok_or("no JPEG 2000 picture")?;
    must_be(found, format, "JPEG 2000")?;
    let bits = u32::from(found.0);
    if bits > 16 {
        return Err(format!("a JPEG 2000 picture of {bits} bits, where at most 16 are read"));
    }
    let fail = |e: &dyn std::fmt::Display| format!("a JPEG 2000 picture that cannot be decoded: {e}");
    // Coefficients and values of 32 bits, and the decoder's passes.
    allowance::memory(place, "PixelData", (format.count() as u64).saturating_mul(16)).map_err(|e| e.to_string())?;
    let image = hayro_jpeg2000::Image::new(bytes, &hayro_jpeg2000::DecodeSettings::default()).map_err(|e| fail(&e))?;
    if (image.width() as usize, image.height() as usize) != (format.columns, format.rows) {
        return Err(fail(&"its headers contradict each other"));
    }
    let mut context = hayro_jpeg2000::DecoderContext::default();
    let decoded = image.decode(&mut context).map_err(|e| fail(&e))?;
    let component = decoded.components().first().ok_or("no channel")?;
    let half = if signed { (1i64 << (bits - 1)) as f32 } else { 0.0 };
    let [least, most] = if signed { [-half, half - 1.0] } else { [0.0, ((1i64 << bits) - 1) as f32] };
    Ok(component.samples().iter().map(|x| (x - half).round().clamp(least, most) as i32 as u32).collect())
}

/// The frame in the SIZ marker of a JPEG 2000 code stream, and whether its values are signed.
fn size_marker(bytes: &[u8]) -> Option<(Frame, bool)> {
    // SOC and SIZ; in a JP2 file boxes precede them.
    let at = bytes.windows(4).position(|w| w == [0xff, 0x4f, 0xff, 0x51])? + 4;
    let four = |k: usize| bytes.get(at + k..at + k + 4).map(|b| b.iter().fold(0, |n, b| n << 8 | usize::from(*b)));
    let [columns, rows, left, top] = [four(4)?, four(8)?, four(12)?, four(16)?];
    let channels = u8::try_from(usize::from(*bytes.get(at + 36)?) << 8 | usize::from(*bytes.get(at + 37)?)).ok()?;
    let depth = *bytes.get(at + 38)?;
    Some((((depth & 0x7f) + 1, rows.checked_sub(top)?, columns.checked_sub(left)?, channels), depth & 0x80 != 0))
}

/// Bits, rows, columns and channels of an image.
type Frame = (u8, usize, usize, u8);

/// The frame of a JPEG image.
fn frame(bytes: &[u8]) -> Option<Frame> {
    let two = |at: usize| bytes.get(at..at + 2).map(|b| usize::from(b[0]) << 8 | usize::from(b[1]));
    let mut at = 2;
    loop {
        match (bytes.get(at)?, bytes.get(at + 1)?) {
            (0xff, 0xff) => at += 1,
            // Start of frame of any coding (F7: JPEG-LS). C4, C8 and CC, which lie among them, are tables.
            (0xff, 0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf | 0xf7) => {
                return Some((*bytes.get(at + 4)?, two(at + 5)?, two(at + 7)?, *bytes.get(at + 9)?));
            }
            (0xff, 0xd8 | 0x01) => at += 2,
            (0xff, 0xd9 | 0xda) => return None,
            (0xff, _) => at += 2 + two(at + 2)?,
            _ => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: PixelFormat = PixelFormat { rows: 2, columns: 3, bytes: 2, stored: 12, high: 11, signed: true };

    fn segments(parts: &[&[u8]]) -> Vec<u8> {
        let mut out = (parts.len() as u32).to_le_bytes().to_vec();
        let mut at = 64u32;
        for k in 0..15 {
            out.extend(parts.get(k).map_or(0, |_| at).to_le_bytes());
            at += parts.get(k).map_or(0, |p| p.len() as u32);
        }
        out.extend(parts.concat());
        out
    }

    #[test]
    fn bits_that_count_become_numbers() {
        assert_eq!([0x7ff, 0x800, 0xffff, 0xf001].map(|b| TWO.number(b)), [2047, -2048, -1, 1]);
        let upper = PixelFormat { high: 15, signed: false, ..TWO };
        assert_eq!(upper.number(0xabcd), 0xabc);
        let all = PixelFormat { bytes: 4, stored: 32, high: 31, ..TWO };
        assert_eq!([all.number(u32::MAX), PixelFormat { signed: false, ..all }.number(u32::MAX)], [-1, 0xffff_ffff]);
        let bit = PixelFormat { bytes: 1, stored: 1, high: 0, signed: false, ..TWO };
        assert_eq!(bit.number(3), 1);
    }

    #[test]
    fn run_lengths_unpack_and_lies_are_refused() {
        // Six times 1 (257 − 251), then literal 2 3, a no-op, four times 9.
        let good = segments(&[&[251, 1], &[1, 2, 3, 128, 253, 9]]);
        assert_eq!(run_length(&good, &TWO).unwrap(), [0x102, 0x103, 0x109, 0x109, 0x109, 0x109]);
        for (bad, word) in [
            (segments(&[&[251, 1]]), "1 run-length segments"),
            (segments(&[&[251, 1], &[252, 1]]), "end of segment 2"),
            (segments(&[&[251], &[251, 1]]), "end of segment 1"),
            (good[..40].to_vec(), "segment from byte 64"),
            (vec![2, 0, 0], "without a run-length header"),
            (vec![], "without a run-length header"),
        ] {
            let e = run_length(&bad, &TWO).unwrap_err();
            assert!(e.contains(word), "{e}");
        }
        let mut wild = good.clone();
        wild[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(run_length(&wild, &TWO).unwrap_err().contains("4294967295"));
    }

    #[test]
    fn a_jpeg_of_another_size_is_refused_before_it_is_decoded() {
        let start = |rows: u16, columns: u16, channels: u8, bits: u8| {
            let [r, c] = [rows.to_be_bytes(), columns.to_be_bytes()];
            [&[0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xc3, 0, 11, bits], &r[..], &c[..], &[channels, 1, 0x11, 0]]
                .concat()
        };
        let refused = |bytes: &[u8]| jpeg(bytes, &TWO).unwrap_err();
        assert!(refused(&start(65535, 65535, 1, 16)).contains("65535 rows"));
        assert!(refused(&start(2, 3, 2, 16)).contains("2 channels"));
        assert!(refused(&start(2, 3, 1, 17)).contains("17 bits"));
        assert!(refused(&start(2, 3, 1, 16)).contains("cannot be decoded"));
        assert!(refused(&[0xff, 0xd8, 0xff, 0xe0, 0xff, 0xff]).contains("no JPEG"));
        assert!(refused(&[]).contains("no JPEG"));
    }

    /// Lossless, 2 rows of 3 columns, by ITK: 100 101 99 / −5 2047 −2048 as 16 bits.
    const JPEG: [u8; 61] = [
        0xff, 0xd8, 0xff, 0xc3, 0x00, 0x0b, 0x10, 0x00, 0x02, 0x00, 0x03, 0x01, 0x01, 0x11, 0x00, 0xff, 0xc4, 0x00,
        0x18, 0x00, 0x00, 0x02, 0x03, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
        0x01, 0x0c, 0x02, 0x07, 0x0f, 0xff, 0xda, 0x00, 0x08, 0x01, 0x01, 0x00, 0x01, 0x00, 0x00, 0xc0, 0x18, 0xcc,
        0x69, 0x66, 0x01, 0x10, 0x00, 0xff, 0xd9,
    ];

    #[test]
    fn lossless_jpeg_is_read() {
        let all = PixelFormat { stored: 16, high: 15, ..TWO };
        let found: Vec<i64> = jpeg(&JPEG, &all).unwrap().into_iter().map(|b| all.number(b)).collect();
        assert_eq!(found, [100, 101, 99, -5, 2047, -2048]);
    }

    /// The same values, by CharLS and, with a sign and without, by OpenJPEG (`tests/fixtures/make_formats.py`).
    const JPEG_LS: &[u8] = include_bytes!("../../tests/fixtures/picture.jls");
    const JPEG_2000: &[u8] = include_bytes!("../../tests/fixtures/picture.j2k");
    const UNSIGNED: &[u8] = include_bytes!("../../tests/fixtures/picture_unsigned.j2k");

    #[test]
    fn jpeg_ls_and_jpeg_2000_are_read_and_other_sizes_refused() {
        let all = PixelFormat { stored: 16, high: 15, ..TWO };
        let want = [100, 101, 99, -5, 2047, -2048];
        let decoded = [jpeg_ls(JPEG_LS, &all), jpeg_2000("a", JPEG_2000, &all), jpeg_2000("a", UNSIGNED, &all)];
        for bits in decoded {
            assert_eq!(bits.unwrap().into_iter().map(|b| all.number(b)).collect::<Vec<_>>(), want);
        }
        let other = PixelFormat { rows: 3, columns: 2, ..all };
        let byte = PixelFormat { bytes: 1, stored: 8, high: 7, ..all };
        for (e, word) in [
            (jpeg_ls(JPEG_LS, &other), "2 rows, 3 columns"),
            (jpeg_2000("a", JPEG_2000, &other), "2 rows, 3 columns"),
            (jpeg_ls(JPEG_LS, &byte), "16 bits in values of 1 bytes"),
            (jpeg_2000("a", JPEG_2000, &byte), "16 bits in values of 1 bytes"),
            (jpeg_ls(&JPEG_LS[..80], &all), "cannot be decoded"),
            (jpeg_2000("a", &JPEG_2000[..60], &all), "cannot be decoded"),
            (jpeg_ls(JPEG_2000, &all), "no JPEG-LS picture"),
            (jpeg_2000("a", JPEG_LS, &all), "no JPEG 2000 picture"),
        ] {
            let e = e.unwrap_err();
            assert!(e.contains(word), "{word} is not in: {e}");
        }
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_make_it_panic(changes in proptest::collection::vec((0usize..1000, 0u8..), 1..6), cut in 0usize..1000) {
            for picture in [&JPEG[..], JPEG_LS, JPEG_2000, UNSIGNED] {
                let mut bytes = picture.to_vec();
                for &(at, x) in &changes {
                    bytes[at % picture.len()] = x;
                }
                bytes.truncate((cut % (picture.len() + 1)).max(30));
                let _ = (jpeg(&bytes, &TWO), run_length(&bytes, &TWO));
                let _ = (jpeg_ls(&bytes, &TWO), jpeg_2000("a", &bytes, &TWO));
            }
        }
    }
}
