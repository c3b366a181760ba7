//! Pages compressed by Zstandard (compression 50000), which the `tiff` crate leaves to a C library.
//!
//! `ruzstd` decompresses the strips or tiles; this module undoes the predictor (TIFF 6.0, section 14; Adobe's Technical
//! Note 3 for floats).

use super::Sample;
use crate::number::{ByteOrder, Number};
use conefield_core::{Error, Result, allowance};
use ruzstd::decoding::FrameDecoder;
use std::io::{Read, Seek, SeekFrom};
use tiff::decoder::{ChunkType, Decoder};
use tiff::tags::Tag;

/// Value of the Compression tag.
const ZSTD: u32 = 50_000;

/// Largest window of Zstandard's own encoder.
const WINDOW: u64 = 8 << 20;

/// Whether Zstandard compresses the current page of `decoder`.
pub(super) fn is_packed(decoder: &mut Decoder<impl Read + Seek>) -> bool {
    decoder.find_tag_unsigned::<u32>(Tag::Compression).is_ok_and(|c| c == Some(ZSTD))
}

/// Appends the `rows` × `columns` values of the current page of `decoder` to `out`, row by row.
pub(super) fn read(
    place: &str,
    decoder: &mut Decoder<impl Read + Seek>,
    [rows, columns]: [usize; 2],
    sample: Sample,
    out: &mut Vec<f32>,
) -> Result<()> {
    let page = Page::of(place, decoder, [rows, columns], sample)?;
    let start = out.len();
    out.resize(start + rows * columns, 0.0);
    let across = columns.div_ceil(page.chunk[1]);
    let mut values = Vec::new();
    for (i, (&at, &size)) in page.offsets.iter().zip(&page.sizes).enumerate() {
        let (row, column) = (i / across * page.chunk[0], i % across * page.chunk[1]);
        if row >= rows {
            break;
        }
        // The last strip ends with the page; a tile extends beyond it.
        let height = if page.tiled { page.chunk[0] } else { page.chunk[0].min(rows - row) };
        let packed = page.bytes(decoder.inner(), at, size)?;
        let mut raw = page.unpack(&packed, height)?;
        page.sum(&mut raw);
        values.clear();
        // The float predictor stores the highest byte first.
        let order = if page.predictor == 3 { ByteOrder::Big } else { page.order };
        page.number.singles(order, &raw, &mut values);
        let width = page.chunk[1].min(columns - column);
        for (r, line) in values.chunks_exact(page.chunk[1]).take(rows - row).enumerate() {
            let to = start + (row + r) * columns + column;
            out[to..to + width].copy_from_slice(&line[..width]);
        }
    }
    Ok(())
}

struct Page<'a> {
    place: &'a str,
    number: Number,
    order: ByteOrder,
    predictor: u32,
    tiled: bool,
    /// Rows and columns of a strip or tile.
    chunk: [usize; 2],
    offsets: Vec<u64>,
    sizes: Vec<u64>,
}

impl<'a> Page<'a> {
    fn of(
        place: &'a str,
        decoder: &mut Decoder<impl Read + Seek>,
        [rows, columns]: [usize; 2],
        sample: Sample,
    ) -> Result<Self> {
        let tiled = decoder.get_chunk_type() == ChunkType::Tile;
        let (width, height) = decoder.chunk_dimensions();
        let chunk = [height as usize, width as usize];
        let order = match decoder.byte_order() {
            tiff::tags::ByteOrder::LittleEndian => ByteOrder::Little,
            tiff::tags::ByteOrder::BigEndian => ByteOrder::Big,
        };
        let broken = |e| super::broken(place, &e);
        let predictor = decoder.find_tag_unsigned::<u32>(Tag::Predictor).map_err(broken)?.unwrap_or(1);
        let mut list = |strips, tiles| {
            decoder
                .find_tag_unsigned_vec::<u64>(if tiled { tiles } else { strips })
                .map_err(broken)
                .map(Option::unwrap_or_default)
        };
        let offsets = list(Tag::StripOffsets, Tag::TileOffsets)?;
        let sizes = list(Tag::StripByteCounts, Tag::TileByteCounts)?;
        let number = sample.number().ok_or_else(|| {
            let expected = "integers of 8 to 64 bits or floats of 32 or 64, where Zstandard packs them";
            Error::invalid(place, "SampleFormat", sample, expected)
        })?;
        let float = matches!(number, Number::F32 | Number::F64);
        if !(predictor == 1 || (predictor == 2 && !float) || (predictor == 3 && float)) {
            let expected = "1 (none), 2 (differences of integers) or 3 (differences of floats)";
            return Err(Error::invalid(place, "Predictor", predictor, expected));
        }
        let pieces = chunk.iter().all(|n| *n > 0).then(|| rows.div_ceil(chunk[0]) * columns.div_ceil(chunk[1]));
        let fits = pieces == Some(offsets.len()) && offsets.len() == sizes.len();
        // A tile is at most about as large as its page.
        let within = !tiled || (chunk[0] <= rows.max(1 << 12) && chunk[1] <= columns.max(1 << 12));
        if !(fits && within) {
            let found = format!("{} strips or tiles of {} x {} pixels", offsets.len(), chunk[0], chunk[1]);
            return Err(Error::invalid(place, "StripOffsets", found, "those that make up the page"));
        }
        Ok(Self { place, number, order, predictor, tiled, chunk, offsets, sizes })
    }

    /// The compressed bytes of a strip or tile.
    fn bytes(&self, reader: &mut (impl Read + Seek), at: u64, size: u64) -> Result<Vec<u8>> {
        let mut packed = Vec::new();
        let read = reader.seek(SeekFrom::Start(at)).and_then(|_| reader.take(size).read_to_end(&mut packed));
        match read {
            Ok(n) if n as u64 == size => Ok(packed),
            Ok(n) => Err(self.damaged(format!("{n} bytes at byte {at}"), format!("{size}, as StripByteCounts says"))),
            Err(e) => Err(self.damaged(e, "a file that can be read")),
        }
    }

    /// The bytes of `height` rows of a strip or tile.
    fn unpack(&self, packed: &[u8], height: usize) -> Result<Vec<u8>> {
        let want = height * self.chunk[1] * self.number.bytes();
        // Includes the decoder's window.
        allowance::memory(self.place, "strip", (want as u64).saturating_mul(2).saturating_add(WINDOW))?;
        let mut decoder = FrameDecoder::new();
        decoder.set_max_window_size(WINDOW.max(want as u64));
        let mut raw = vec![0; want];
        match decoder.decode_all(packed, &mut raw) {
            Ok(n) if n == want => Ok(raw),
            Ok(n) => Err(self.damaged(format!("a strip of {n} bytes"), format!("{want}, as the directory says"))),
            Err(e) => Err(self.damaged(e, "a whole Zstandard stream")),
        }
    }

    /// Undoes the predictor, row by row.
    fn sum(&self, raw: &mut [u8]) {
        let bytes = self.number.bytes();
        for row in raw.chunks_exact_mut(self.chunk[1] * bytes) {
            match self.predictor {
                2 => self.sum_integers(row),
                3 => {
                    // Differences of bytes: all highest bytes first, then all second ones.
                    for i in 1..row.len() {
                        row[i] = row[i].wrapping_add(row[i - 1]);
                    }
                    let planes = row.to_vec();
                    let count = planes.len() / bytes;
                    for (i, value) in row.chunks_exact_mut(bytes).enumerate() {
                        for (k, byte) in value.iter_mut().enumerate() {
                            *byte = planes[k * count + i];
                        }
                    }
                }
                _ => {}
            }
        }
    }

    fn sum_integers(&self, row: &mut [u8]) {
        macro_rules! each {
            ($t:ty) => {{
                let mut sum: $t = 0;
                for b in row.as_chunks_mut::<{ size_of::<$t>() }>().0 {
                    let little = self.order == ByteOrder::Little;
                    sum = sum.wrapping_add(if little { <$t>::from_le_bytes(*b) } else { <$t>::from_be_bytes(*b) });
                    *b = if little { sum.to_le_bytes() } else { sum.to_be_bytes() };
                }
            }};
        }
        match self.number.bytes() {
            1 => each!(u8),
            2 => each!(u16),
            4 => each!(u32),
            _ => each!(u64),
        }
    }

    fn damaged(&self, found: impl ToString, expected: impl Into<String>) -> Error {
        Error::invalid(self.place, "TIFF", found, expected)
    }
}
