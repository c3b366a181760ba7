//! TIFF from detectors: one grey channel, integers or floats, one image per page; uncompressed, or compressed by LZW,
//! deflate, PackBits or Zstandard. [`write`] writes a volume with one slice per page; [`read_volume`] and
//! [`read_folder`] read slices.
//!
//! The numbers are those that the file stores. The entry PhotometricInterpretation, which can say that white is zero,
//! is a hint for screens.

mod entries;
mod images;
mod volume;
mod write;
mod zstd;

pub(crate) use volume::{folder_voxels, is_stack, read_folder, read_volume};
pub(crate) use write::{check_shape, write};

use crate::input::must_unpack;
use crate::number::{ByteOrder, Number};
use crate::{memory, text};
use conefield_core::error::ensure;
use conefield_core::{Error, Result, allowance, files, parallel};
use entries::AsStored;
use images::{Calibration, Claim};
use ndarray::Array3;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;
use tiff::decoder::{ChunkType, Decoder, DecodingResult, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

/// Bytes that are read from any place: a file, or a page in memory.
trait Source: Read + Seek {}

impl<R: Read + Seek> Source for R {}

/// The decoder of an open file. It is compiled once for all sources.
type Pages = Decoder<Box<dyn Source>>;

/// Whether `head`, the first bytes of a file, starts a TIFF or BigTIFF.
pub(crate) fn is_tiff(head: &[u8]) -> bool {
    [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|m| head.starts_with(*m))
}

/// Number of values of all images, from the directories.
pub(crate) fn values(path: &Path) -> Result<u64> {
    let found = images(path, &mut |_, _| Ok(()))?;
    Ok(found.size.iter().fold(found.count as u64, |n, side| n.saturating_mul(*side as u64)))
}

/// The images of a file.
pub(crate) struct Stack {
    /// `[page, row, column]`.
    pub values: Array3<f32>,
    /// How the file stores a number, such as "16-bit unsigned integers".
    pub numbers: String,
}

/// Reads all images as `[page, row, column]`; they must have the same size and the same numbers.
///
/// Converts 8 to 64 bits per pixel, integers or floats, to `f32`. Refuses other colour types, sizes that the file
/// cannot hold, values that are not finite and damaged files, and a file that holds more images than are found.
pub(crate) fn read(path: &Path) -> Result<Stack> {
    let (values, images) = stack(path, &mut |_| ())?;
    Ok(Stack { values, numbers: images.sample.to_string() })
}

/// The values as in [`read`]; `first` gets the decoder at the first page.
fn stack(path: &Path, first: &mut dyn FnMut(&mut Pages)) -> Result<(Array3<f32>, Images)> {
    let place = path.display().to_string();
    let mut values = Vec::<f32>::new();
    let images = images(path, &mut |decoder, page| {
        if values.is_empty() {
            first(decoder);
        }
        let count = usize::try_from(page.pixels).unwrap_or(usize::MAX);
        memory::grow(&mut values, count, usize::MAX, &place, "pages")?;
        // The stored page and its decompressed strips or tiles.
        allowance::memory(&place, "page", page.bytes.saturating_mul(2))?;
        if compression(&place, decoder)? == zstd::ZSTD {
            return zstd::read(&place, decoder, &page, &mut values);
        }
        append(&mut values, decoder.read_image().map_err(|e| broken(&place, &e))?);
        Ok(())
    })?;
    if let Some(rest) = &images.rest {
        rest.read(path, &mut values)?;
    }
    match images.calibration {
        Some(Calibration::Line([at, times])) => {
            tracing::info!("{place}: ImageJ's calibration is applied: {at} + {times} times the stored integer");
            let shown = |v: f32| (at + times * f64::from(v)) as f32;
            parallel::change(&mut values, [], |part, []| part.iter_mut().for_each(|v| *v = shown(*v)));
        }
        Some(Calibration::Other(function)) => {
            let what = format!("ImageJ's calibration function {function} is not applied: numbers are as stored");
            text::warn(&place, Some(what));
        }
        None => {}
    }
    text::warn(&place, images.remarks.iter().cloned());
    if images.white > 0 {
        tracing::info!("{place}: {} pages say that white is zero; the numbers are taken as stored", images.white);
    }
    let [rows, columns] = images.size;
    let all = Array3::from_shape_vec((images.count, rows, columns), values)
        .map_err(|e| Error::invalid(&place, "TIFF", e, format!("{rows} x {columns} values per page")))?;
    let all = memory::all_finite(&place, all, &|(p, r, c)| format!("page {p}, row {r}, column {c}"))?;
    Ok((all, images))
}

/// How a page stores a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Sample {
    /// The entry SampleFormat: 1 unsigned, 2 signed, 3 floats.
    format: u16,
    bits: u8,
}

impl Sample {
    /// Whether ImageJ calibrates such numbers.
    fn is_calibrated(self) -> bool {
        self.format != 3 && self.bits <= 16
    }

    fn of(place: &str, decoder: &mut Pages, bits: u8) -> Result<Self> {
        let format = decoder.find_tag_unsigned_vec::<u16>(Tag::SampleFormat).map_err(|e| broken(place, &e))?;
        Ok(Self { format: format.and_then(|f| f.first().copied()).unwrap_or(1), bits })
    }

    /// The number; `None` for floats of 16 bits, which only the `tiff` crate decodes, and unknown formats.
    fn number(self) -> Option<Number> {
        let kind = *['u', 'i', 'f'].get(usize::from(self.format).checked_sub(1)?)?;
        Number::of(kind, usize::from(self.bits / 8))
    }
}

impl std::fmt::Display for Sample {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.number() {
            Some(number) => number.fmt(f),
            None if self.format == 3 => write!(f, "{}-bit floats", self.bits),
            None => write!(f, "{}-bit numbers of an unknown format", self.bits),
        }
    }
}

/// What a page's directory claims.
#[derive(Clone, Copy)]
struct Page {
    pixels: u64,
    /// Bytes of the decompressed values.
    bytes: u64,
    sample: Sample,
    /// Rows and columns.
    size: [usize; 2],
}

/// The images of a file, with and without a directory.
struct Images {
    count: usize,
    /// Rows and columns.
    size: [usize; 2],
    sample: Sample,
    /// The images after the one page.
    rest: Option<Rest>,
    /// The text's claim.
    claim: Option<Claim>,
    /// ImageJ's calibration of the first page.
    calibration: Option<Calibration>,
    /// Number of pages in which white is zero.
    white: usize,
    /// Warnings for the user.
    remarks: Vec<String>,
}

/// Walks over the pages without decompressing them, and counts the images that have no directory.
fn images(path: &Path, each: &mut dyn FnMut(&mut Pages, Page) -> Result<()>) -> Result<Images> {
    let place = path.display().to_string();
    let (file, packed) = files::open(path)?;
    let broken = |e: TiffError| broken(&place, &e);
    let mut reader = BufReader::new(file);
    let directories = entries::check(&place, &mut reader, packed)?;
    let mut file = reader.into_inner();
    file.rewind().map_err(|e| Error::io(path, e))?;
    let white = directories.white.len();
    let source = BufReader::new(AsStored { reader: file, white: directories.white, at: 0 });
    let mut decoder: Pages = Decoder::new(Box::new(source) as Box<dyn Source>).map_err(broken)?;
    let mut first: Option<(Page, Option<Claim>, Option<Calibration>)> = None;
    let (mut pages, mut claimed, mut stored, mut end) = (0usize, [0u64; 2], 0u64, directories.end);
    loop {
        let page;
        (decoder, page) = next(&place, decoder, pages, packed, &mut claimed)?;
        let (like, ..) = first.get_or_insert_with(|| {
            let text = decoder.find_tag(Tag::ImageDescription).ok().flatten().and_then(|v| v.into_string().ok());
            let text = text.unwrap_or_default();
            let calibration = Calibration::of(&text).filter(|_| page.sample.is_calibrated());
            (page, images::claimed(&text, page.size.map(|n| n as u64)), calibration)
        });
        let (at, found) = (format!("page {pages}"), format!("{} x {} pixels", page.size[0], page.size[1]));
        ensure(like.size == page.size, &place, &at, found, "the size of the first page")?;
        let expected = format!("{}, as on the first page", like.sample);
        ensure(like.sample == page.sample, &place, &at, page.sample, expected)?;
        let [offsets, sizes] = pieces(&place, &mut decoder)?;
        for (at, bytes) in offsets.into_iter().zip(sizes) {
            stored = stored.saturating_add(bytes);
            end = end.max(at.saturating_add(bytes));
        }
        each(&mut decoder, page)?;
        pages += 1;
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().map_err(broken)?;
    }
    let Some((page, claim, calibration)) = first else {
        return Err(Error::invalid(&place, "TIFF", "no page", "at least one"));
    };
    let (size, sample) = (page.size, page.sample);
    let mut images = Images { count: pages, size, sample, rest: None, claim, calibration, white, remarks: vec![] };
    match claim {
        Some(claim) if claim.images > pages as u64 => {
            let rest = Rest::of(&place, &mut decoder, &page, pages, claim.images, packed)?;
            images.count += rest.images;
            images.rest = Some(rest);
        }
        _ => {
            if !directories.others {
                let parts = Parts {
                    pages: pages as u64,
                    stored,
                    after: packed.saturating_sub(end),
                    undescribed: packed.saturating_sub(directories.bytes.saturating_add(stored)),
                };
                images.remarks.extend(parts.remark(&place, &mut decoder, &page)?);
            }
            let fewer = claim.filter(|c| c.whole && c.images < pages as u64);
            images.remarks.extend(fewer.map(|c| {
                format!("the ImageDescription counts {} images, the file has {pages} pages: all are read", c.images)
            }));
        }
    }
    Ok(images)
}

/// The page of number `number` that `decoder` has come to, in a file of `packed` bytes. Adds its bytes and pixels to
/// `claimed`, which the file must be able to hold, and limits what the decoder may take in memory.
fn next(place: &str, mut decoder: Pages, number: usize, packed: u64, claimed: &mut [u64; 2]) -> Result<(Pages, Page)> {
    let broken = |e: TiffError| broken(place, &e);
    let (width, height) = decoder.dimensions().map_err(broken)?;
    let bits = match decoder.colortype().map_err(broken)? {
        ColorType::Gray(bits @ (8 | 16 | 32 | 64)) => bits,
        other => {
            let expected = "one grey channel of 8, 16, 32 or 64 bits";
            return Err(Error::invalid(place, format!("page {number}"), format!("{other:?}"), expected));
        }
    };
    let pixels = u64::from(width) * u64::from(height);
    let bytes = pixels.saturating_mul(u64::from(bits) / 8);
    *claimed = [claimed[0].saturating_add(bytes), claimed[1].saturating_add(pixels)];
    let fits = must_unpack(packed, claimed[0], claimed[1]);
    fits.and(if bytes == 0 { Err("at least one pixel".into()) } else { Ok(()) }).map_err(|expected| {
        let found = format!("{height} x {width} pixels of {bits} bits in a file of {packed} bytes");
        Error::invalid(place, format!("page {number}"), found, expected)
    })?;
    // Includes the next page's entries; a value takes 32 bytes at most.
    let most = bytes.max(packed.saturating_mul(32));
    let mut limits = Limits::default();
    limits.decoding_buffer_size = usize::try_from(most).unwrap_or(usize::MAX);
    (limits.ifd_value_size, limits.intermediate_buffer_size) = [limits.decoding_buffer_size; 2].into();
    decoder = decoder.with_limits(limits);
    let sample = Sample::of(place, &mut decoder, bits)?;
    Ok((decoder, Page { pixels, bytes, sample, size: [height as usize, width as usize] }))
}

/// Fewer bytes than this that nothing describes are gaps between the parts of a file.
const GAPS: u64 = 4096;

/// The bytes of a file's parts.
struct Parts {
    pages: u64,
    /// Of the pages' strips or tiles.
    stored: u64,
    /// Of what follows the last part.
    after: u64,
    /// Of what is no part.
    undescribed: u64,
}

impl Parts {
    /// Refuses a file of one page with room for more images after it; else a remark if an image has room in the bytes
    /// that are no part.
    fn remark(&self, place: &str, decoder: &mut Pages, page: &Page) -> Result<Option<String>> {
        let Self { pages, stored, after, undescribed } = *self;
        let plain = compression(place, decoder)? == 1;
        if plain && pages == 1 && after >= page.bytes {
            let found = format!("{after} bytes after the one page, room for {} more images", after / page.bytes);
            return Err(Error::invalid(place, "file size", found, "one page per image (save the stack so)"));
        }
        let image = if plain { page.bytes } else { stored / pages };
        Ok((undescribed >= image.max(GAPS)).then(|| {
            format!(
                "{undescribed} bytes of the file belong to none of its {pages} pages, each of about {image} bytes: \
                 images may be missing"
            )
        }))
    }
}

fn compression(place: &str, decoder: &mut Pages) -> Result<u32> {
    decoder.find_tag_unsigned::<u32>(Tag::Compression).map(|c| c.unwrap_or(1)).map_err(|e| broken(place, &e))
}

/// The entries with offsets and sizes of the strips or tiles of the current page.
fn tags(decoder: &Pages) -> [Tag; 2] {
    match decoder.get_chunk_type() {
        ChunkType::Strip => [Tag::StripOffsets, Tag::StripByteCounts],
        ChunkType::Tile => [Tag::TileOffsets, Tag::TileByteCounts],
    }
}

/// Offsets and sizes of the strips or tiles of the current page.
fn pieces(place: &str, decoder: &mut Pages) -> Result<[Vec<u64>; 2]> {
    let [offsets, sizes] = tags(decoder).map(|tag| decoder.find_tag_unsigned_vec(tag).map_err(|e| broken(place, &e)));
    Ok([offsets?.unwrap_or_default(), sizes?.unwrap_or_default()])
}

/// Images without a directory, in one piece after the one page.
struct Rest {
    /// The byte at which they start.
    at: u64,
    images: usize,
    pixels: usize,
    number: Number,
    order: ByteOrder,
}

impl Rest {
    /// The images after the first of `claimed`. Refuses a file that does not hold them in one piece.
    fn of(place: &str, decoder: &mut Pages, page: &Page, pages: usize, claimed: u64, packed: u64) -> Result<Self> {
        let [offsets, _] = pieces(place, decoder)?;
        let start = offsets.first().copied().unwrap_or(packed);
        let room = packed.saturating_sub(start);
        let strip = u64::from(decoder.chunk_dimensions().1).saturating_mul(page.bytes / page.size[0].max(1) as u64);
        let one_piece = compression(place, decoder)? == 1
            && decoder.get_chunk_type() == ChunkType::Strip
            && offsets.iter().enumerate().all(|(i, at)| *at == start.saturating_add(strip.saturating_mul(i as u64)));
        let images = usize::try_from(claimed - 1).ok().filter(|_| claimed.saturating_mul(page.bytes) <= room);
        match (page.sample.number(), images) {
            (Some(number), Some(images)) if pages == 1 && one_piece => Ok(Self {
                at: start + page.bytes,
                images,
                pixels: page.size[0] * page.size[1],
                number,
                order: match decoder.byte_order() {
                    tiff::tags::ByteOrder::LittleEndian => ByteOrder::Little,
                    tiff::tags::ByteOrder::BigEndian => ByteOrder::Big,
                },
            }),
            _ => {
                let found = format!("{claimed} in the ImageDescription, but {pages} pages and {room} bytes of pixels");
                let expected = format!(
                    "{pages}, the pages of the file (save the stack with one page per image), or all images of {} \
                     bytes in one piece after one page",
                    page.bytes
                );
                Err(Error::invalid(place, "images", found, expected))
            }
        }
    }

    fn read(&self, path: &Path, values: &mut Vec<f32>) -> Result<()> {
        let place = path.display().to_string();
        let io = |e| Error::io(path, e);
        memory::grow(values, self.images.saturating_mul(self.pixels), usize::MAX, &place, "pages")?;
        let bytes = self.pixels * self.number.bytes();
        allowance::memory(&place, "page", bytes as u64)?;
        let mut raw = vec![0; bytes];
        let mut file = files::open(path)?.0;
        file.seek(SeekFrom::Start(self.at)).map_err(io)?;
        for _ in 0..self.images {
            file.read_exact(&mut raw).map_err(io)?;
            self.number.singles(self.order, &raw, values);
        }
        Ok(())
    }
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
    use crate::testing::{file, says};
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};
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
                let a = read(&path).unwrap().values;
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
            let a = read(&path).unwrap().values;
            let want = |p: usize, r: usize, c: usize| match *name {
                "strips" => count(20 * p + 5 * r + c),
                "floats" => ((f64::from(count(20 * p + 5 * r + c))) / 7.0) as f32,
                _ => count(5 * (r % 4) + c % 5),
            };
            assert_eq!(a.dim(), if *name == "tiles" { (1, 24, 25) } else { (3, 4, 5) });
            assert!(a.indexed_iter().all(|((p, r, c), x)| *x == want(p, r, c)), "{name}: {a}");
        }
        // Integers in the other byte order.
        let data: Vec<u8> = [258u16, 65_000].iter().flat_map(|x| x.to_be_bytes()).collect();
        let packed = compress_to_vec(&data[..], CompressionLevel::Fastest);
        let mut bytes = one_page(true, [2, 1], [1, 16], 1, "", &packed);
        let mut put = |tag: u16, value: &[u8]| {
            let at = bytes.windows(2).position(|w| w == tag.to_be_bytes()).unwrap() + 8;
            bytes[at..at + value.len()].copy_from_slice(value);
        };
        put(259, &50_000u16.to_be_bytes());
        put(279, &(packed.len() as u32).to_be_bytes());
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(read(&path).unwrap().values.as_slice().unwrap(), [258.0, 65_000.0]);
        let (_, whole) = ZSTD[0];
        let mut bytes = whole.to_vec();
        let at = bytes.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).unwrap();
        bytes[at] = 0;
        refused(&bytes, &["TIFF", "Zstandard"]);
    }

    /// A file of one directory for the image of `columns` and `rows` at the start of `data`, whose numbers have this `format`
    /// and `bits`.
    fn one_page(
        big_endian: bool,
        [columns, rows]: [u32; 2],
        [format, bits]: [u32; 2],
        photometric: u32,
        text: &str,
        data: &[u8],
    ) -> Vec<u8> {
        let half = |x: u16| if big_endian { x.to_be_bytes() } else { x.to_le_bytes() };
        let whole = |x: u32| if big_endian { x.to_be_bytes() } else { x.to_le_bytes() };
        let mut entries: Vec<(u16, u16, u32, u32)> = vec![
            (256, 4, 1, columns),
            (257, 4, 1, rows),
            (258, 3, 1, bits),
            (259, 3, 1, 1),
            (262, 3, 1, photometric),
            (270, 2, text.len() as u32, 512),
            (273, 4, 1, 1024),
            (277, 3, 1, 1),
            (278, 4, 1, rows),
            (279, 4, 1, columns * rows * bits / 8),
            (339, 3, 1, format),
        ];
        // What other programs leave out.
        entries.retain(|e| !(e.0 == 270 && text.is_empty() || e.0 == 339 && format == 1));
        let mut out = if big_endian { b"MM".to_vec() } else { b"II".to_vec() };
        out.extend([half(42).to_vec(), whole(8).to_vec(), half(entries.len() as u16).to_vec()].concat());
        for (tag, kind, count, value) in entries {
            out.extend([half(tag).to_vec(), half(kind).to_vec(), whole(count).to_vec()].concat());
            // A short fills the first half of its field.
            out.extend(if kind == 3 { [half(value as u16), [0; 2]].concat() } else { whole(value).to_vec() });
        }
        out.extend([0; 4]);
        out.resize(512, 0);
        out.extend(text.as_bytes());
        out.resize(1024, 0);
        out.extend(data);
        out
    }

    /// Three images of 2 x 3 pixels of 16 bits: 0 to 17.
    fn three(big_endian: bool, photometric: u32, text: &str) -> Vec<u8> {
        let data: Vec<u8> =
            (0..18u16).flat_map(|x| if big_endian { x.to_be_bytes() } else { x.to_le_bytes() }).collect();
        one_page(big_endian, [3, 2], [1, 16], photometric, text, &data)
    }

    #[test]
    fn images_without_a_directory_are_read_where_the_text_counts_them() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let ome = "<OME><Image><Pixels SizeX=\"3\" SizeY=\"2\" SizeZ=\"3\" SizeC=\"1\"/></Image></OME>";
        for text in ["ImageJ=1.54f\nimages=3\nslices=3\n", "{\"shape\": [3, 2, 3], \"truncated\": true}", ome] {
            for (big_endian, photometric) in [(false, 1), (true, 1), (false, 0), (true, 0)] {
                std::fs::write(&path, three(big_endian, photometric, text)).unwrap();
                let a = read(&path).unwrap().values;
                assert_eq!(a.dim(), (3, 2, 3), "{text}");
                assert_eq!(a.iter().copied().collect::<Vec<_>>(), (0..18u8).map(f32::from).collect::<Vec<_>>());
                assert_eq!(values(&path).unwrap(), 18);
            }
            let whole = three(true, 1, text);
            refused(&whole[..whole.len() - 1], &["images: found 3", "1 pages and 35 bytes", "12 bytes"]);
        }
        // No changed byte causes a panic or a large allocation.
        let whole = three(true, 0, "ImageJ=1.54f\nimages=3\nslices=3\n");
        for at in (0..160).chain(512..560) {
            for x in [0x01, 0x80, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] ^= x;
                std::fs::write(&path, &bytes).unwrap();
                let _ = read(&path);
            }
        }
        // Nothing counts them: bytes for a part of one more image.
        std::fs::write(&path, &three(false, 1, "a detector")[..1024 + 20]).unwrap();
        assert_eq!(read(&path).unwrap().values.dim(), (1, 2, 3));
        refused(&three(false, 1, "{\"shape\": [1000000000000, 2, 3]}"), &["images", "1000000000000"]);
    }

    #[test]
    fn numbers_are_as_stored_whether_white_or_black_is_zero() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let floats: Vec<u8> = [0.25f32, -3.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        for (bits, format, data, want) in [
            (8, 1, vec![3, 250], [3.0, 250.0]),
            (16, 1, [3118u16, 1].iter().flat_map(|x| x.to_le_bytes()).collect(), [3118.0, 1.0]),
            (16, 2, [-5i16, 1].iter().flat_map(|x| x.to_le_bytes()).collect(), [-5.0, 1.0]),
            (32, 3, floats, [0.25, -3.0]),
        ] {
            std::fs::write(&path, one_page(false, [2, 1], [format, bits], 0, "", &data)).unwrap();
            let found = read(&path).unwrap();
            assert_eq!(found.values.as_slice().unwrap(), want, "{}", found.numbers);
        }
    }

    /// ImageJ writes a signed integer unsigned, 32768 larger, and shows it by a calibration.
    #[test]
    fn a_calibration_of_imagej_is_applied_to_integers() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        let line = "ImageJ=1.54f\nimages=3\nslices=3\ncf=0\nc0=-32768.0\nc1=2.0\nvunit=Gray Value\n";
        for (text, at, times) in [
            (line.to_owned(), -32768.0, 2.0),
            (line.replace("cf=0", "cf=3"), 0.0, 1.0),
            (line.replace("c0=-32768.0", "c0=NaN"), 0.0, 1.0),
        ] {
            std::fs::write(&path, three(false, 1, &text)).unwrap();
            let found = read(&path).unwrap();
            let want: Vec<f32> = (0..18).map(|i| at + times * i as f32).collect();
            assert_eq!(found.values.iter().copied().collect::<Vec<_>>(), want, "{text}");
        }
        let floats: Vec<u8> = [0.25f32, -3.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        let text = line.replace('3', "1");
        std::fs::write(&path, one_page(false, [2, 1], [3, 32], 1, &text, &floats)).unwrap();
        assert_eq!(read(&path).unwrap().values.as_slice().unwrap(), [0.25, -3.0]);
    }

    /// A set of one image per file, each of which describes the whole set; and a file alone, which names itself.
    #[test]
    fn a_file_of_an_ome_set_has_its_own_pages() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a_Z000.ome.tif");
        let named = |count: u32, channels: u32, names: [&str; 2]| {
            let [a, b] = names.map(|name| format!("<TiffData><UUID FileName=\"{name}\"/></TiffData>"));
            let sizes = format!("SizeX=\"3\" SizeY=\"2\" SizeZ=\"{count}\" SizeC=\"{channels}\"");
            format!("<OME><Image><Pixels {sizes}>{a}{b}</Pixels></Image></OME>")
        };
        let set = named(100, 1, ["a_Z000.ome.tif", "a_Z001.ome.tif"]);
        std::fs::write(&path, &three(false, 1, &set)[..1024 + 12]).unwrap();
        assert_eq!(read(&path).unwrap().values.dim(), (1, 2, 3));
        let alone = named(3, 1, ["a_Z000.ome.tif"; 2]);
        std::fs::write(&path, three(false, 1, &alone)).unwrap();
        assert_eq!(read(&path).unwrap().values.dim(), (3, 2, 3));
        // Two channels are no volume.
        std::fs::write(&path, three(false, 1, &alone.replace("SizeZ=\"3\" SizeC=\"1\"", "SizeZ=\"1\" SizeC=\"3\"")))
            .unwrap();
        assert!(volume::read_volume(&path).unwrap_err().to_string().contains("3 channels"));
    }

    fn refused(bytes: &[u8], words: &[&str]) {
        says(read(&file("a.tif", &[bytes]).1), &[&["a.tif"], words].concat());
    }
}
