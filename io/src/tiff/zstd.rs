//! Pages compressed by Zstandard (compression 50000), which the `tiff` crate leaves to a C library.
//!
//! `ruzstd` decompresses the strips or tiles. The `tiff` crate reads them from a file in memory that holds nothing but
//! the page, uncompressed.

use super::{Page, Pages, Source, append, broken, pieces, tags};
use crate::input::read_up_to;
use conefield_core::error::ensure;
use conefield_core::{Error, Result, allowance};
use ruzstd::decoding::FrameDecoder;
use std::io::{Cursor, SeekFrom};
use tiff::TiffError;
use tiff::decoder::{ChunkType, Decoder, Limits};
use tiff::encoder::TiffEncoder;
use tiff::tags::{ByteOrder, Tag};

/// Value of the Compression tag.
pub(super) const ZSTD: u32 = 50_000;

/// Largest window of Zstandard's own encoder.
const WINDOW: u64 = 8 << 20;

/// Most bytes of all tiles of a small page: one tile of 4096² numbers in double precision.
const TILES: u64 = 128 << 20;

/// Value of the Predictor tag: differences of floats, whose highest byte comes first in either byte order.
const OF_FLOATS: u32 = 3;

/// Appends the values of `page`, the current one of `decoder`, to `out`, row by row.
pub(super) fn read(place: &str, decoder: &mut Pages, page: &Page, out: &mut Vec<f32>) -> Result<()> {
    let broken = |e: TiffError| broken(place, &e);
    let [rows, columns] = page.size.map(|n| n as u32);
    let tiled = decoder.get_chunk_type() == ChunkType::Tile;
    let (width, height) = decoder.chunk_dimensions();
    let [offsets, sizes] = pieces(place, decoder)?;
    let bytes = usize::from(page.sample.bits / 8);
    let all = offsets.len() as u64 * bytes as u64;
    let all = all.saturating_mul(u64::from(width)).saturating_mul(u64::from(height));
    // Tiles no larger than the page cover at most four times its pixels.
    let found = format!("{} strips or tiles of {height} x {width} pixels", offsets.len());
    let expected = "those that make up the page";
    ensure(!tiled || all <= page.bytes.saturating_mul(4).max(TILES), place, "StripOffsets", found, expected)?;
    // The file in memory, with header and directory, and the page that is read from it.
    let held = (if tiled { all } else { page.bytes }).saturating_add(4096 + 16 * offsets.len() as u64);
    allowance::memory(place, "page", held.saturating_add(page.bytes))?;
    let predictor = decoder.find_tag_unsigned::<u32>(Tag::Predictor).map_err(broken)?.unwrap_or(1);
    // The file in memory has the byte order of the machine.
    let turned = predictor != OF_FLOATS && decoder.byte_order() != ByteOrder::native();
    let mut plain = Cursor::new(Vec::with_capacity(usize::try_from(held).unwrap_or(0)));
    let mut encoder = TiffEncoder::new_big(&mut plain).map_err(broken)?;
    let mut directory = encoder.image_directory().map_err(broken)?;
    let (mut starts, mut lengths) = (vec![], vec![]);
    for (i, (&at, &size)) in offsets.iter().zip(&sizes).enumerate() {
        // The last strip ends with the page; a tile extends beyond it.
        let left = rows.saturating_sub((i as u32).saturating_mul(height));
        let height = if tiled { height } else { height.min(left) };
        let packed = stored(place, decoder.inner(), at, size)?;
        let mut raw = unpacked(place, &packed, height as usize * width as usize * bytes)?;
        if turned {
            raw.chunks_exact_mut(bytes).for_each(<[u8]>::reverse);
        }
        starts.push(directory.write_data(&raw[..]).map_err(broken)?);
        lengths.push(raw.len() as u64);
    }
    // Entries of tiles do not matter to strips.
    for (tag, value) in [
        (Tag::ImageWidth, columns),
        (Tag::ImageLength, rows),
        (Tag::BitsPerSample, page.sample.bits.into()),
        (Tag::PhotometricInterpretation, 1),
        (Tag::SampleFormat, page.sample.format.into()),
        (Tag::Predictor, predictor),
        (Tag::RowsPerStrip, height),
        (Tag::TileWidth, width),
        (Tag::TileLength, height),
    ] {
        directory.write_tag(tag, value).map_err(broken)?;
    }
    let [offsets, sizes] = tags(decoder);
    directory.write_tag(offsets, &starts[..]).map_err(broken)?;
    directory.write_tag(sizes, &lengths[..]).map_err(broken)?;
    directory.finish().map_err(broken)?;
    plain.set_position(0);
    let mut page: Pages = Decoder::new(Box::new(plain) as Box<dyn Source>).map_err(broken)?;
    page = page.with_limits(Limits::unlimited());
    append(out, page.read_image().map_err(broken)?);
    Ok(())
}

/// The `size` bytes at byte `at` of the file.
fn stored(place: &str, reader: &mut dyn Source, at: u64, size: u64) -> Result<Vec<u8>> {
    let packed = reader.seek(SeekFrom::Start(at)).and_then(|_| read_up_to(reader, size));
    let packed = packed.map_err(|e| Error::invalid(place, "TIFF", e, "a file that can be read"))?;
    let (found, expected) = (packed.len(), format!("{size}, as StripByteCounts says"));
    ensure(found as u64 == size, place, "TIFF", format!("{found} bytes at byte {at}"), expected)?;
    Ok(packed)
}

/// The `want` bytes of a strip or tile.
fn unpacked(place: &str, packed: &[u8], want: usize) -> Result<Vec<u8>> {
    // Includes the decoder's window.
    allowance::memory(place, "strip", (want as u64).saturating_mul(2).saturating_add(WINDOW))?;
    let mut decoder = FrameDecoder::new();
    decoder.set_max_window_size(WINDOW.max(want as u64));
    let mut raw = vec![0; want];
    match decoder.decode_all(packed, &mut raw) {
        Ok(n) if n == want => Ok(raw),
        Ok(n) => {
            let found = format!("a strip of {n} bytes");
            Err(Error::invalid(place, "TIFF", found, format!("{want}, as the directory says")))
        }
        Err(e) => Err(Error::invalid(place, "TIFF", e, "a whole Zstandard stream")),
    }
}
