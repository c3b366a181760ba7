//! A walk over the directories of a TIFF that checks the lengths of their entries and counts their bytes.
//!
//! The `tiff` crate allocates what an entry claims, on the first page up to 256 MiB whatever the file's size, and
//! prints an overlong text to standard error. This check keeps claims within the file's size.

use super::Source;
use conefield_core::{Error, Result};
use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

/// What the walk over the directories has found.
pub(super) struct Directories {
    /// Bytes of the header, the directories and the values of their entries.
    pub bytes: u64,
    /// The byte after the last of them.
    pub end: u64,
    /// Bytes that say that white is zero (the entry PhotometricInterpretation), in ascending order.
    pub white: Vec<u64>,
    /// Whether an entry points to directories outside the chain of pages: reduced images, camera settings.
    pub others: bool,
}

impl Directories {
    fn add(&mut self, at: u64, bytes: u64) {
        self.bytes = self.bytes.saturating_add(bytes);
        self.end = self.end.max(at.saturating_add(bytes));
    }
}

/// The entry PhotometricInterpretation.
const PHOTOMETRIC: u64 = 262;

/// Entries that point to other directories: SubIFDs, Exif, GPS, interoperability.
const POINTERS: [u64; 4] = [330, 34_665, 34_853, 40_965];

struct EntryWalk<'a> {
    reader: &'a mut dyn Source,
    little: bool,
    big_tiff: bool,
    found: Directories,
}

/// Walks over the directories; refuses an entry longer than the `size` of the whole file. The reader reports other
/// damage.
pub(super) fn check(place: &str, reader: &mut dyn Source, size: u64) -> Result<Directories> {
    let mut mark = [0; 4];
    let found = Directories { bytes: 0, end: 0, white: Vec::new(), others: false };
    if reader.rewind().and_then(|()| reader.read_exact(&mut mark)).is_err() {
        return Ok(found);
    }
    let little = mark[0] == b'I';
    let mut walk = EntryWalk { reader, little, big_tiff: mark[if little { 2 } else { 3 }] == 43, found };
    let header = if walk.big_tiff { 16 } else { 8 };
    walk.found.add(0, header);
    let mut page = 0;
    let mut seen = HashSet::new();
    let mut next = walk.first();
    while let Some(at) = next.filter(|at| *at != 0 && seen.insert(*at)) {
        next = walk.directory(at, size).map_err(|found| {
            let expected = format!("at most {size} bytes, the size of the file");
            Error::invalid(place, format!("page {page}"), found, expected)
        })?;
        page += 1;
    }
    walk.found.white.sort_unstable();
    Ok(walk.found)
}

impl EntryWalk<'_> {
    /// Offset of the first directory.
    fn first(&mut self) -> Option<u64> {
        if self.big_tiff {
            // The size of an offset, always eight, precedes it.
            self.number(4)?;
        }
        self.offset()
    }

    /// Offset of the directory after the one at `at`; `None` also at the end of the file.
    fn directory(&mut self, at: u64, size: u64) -> Result<Option<u64>, String> {
        let (count_bytes, entry_bytes, value_bytes) = if self.big_tiff { (8, 20, 8) } else { (2, 12, 4) };
        if self.reader.seek(SeekFrom::Start(at)).is_err() {
            return Ok(None);
        }
        let Some(count) = self.number(count_bytes) else { return Ok(None) };
        if count.saturating_mul(entry_bytes) > size {
            return Err(format!("a directory of {count} entries"));
        }
        let directory = count_bytes as u64 + count * entry_bytes + value_bytes;
        self.found.add(at, directory);
        for i in 0..count {
            let Some([tag, kind, length, value]) = self.entry() else { return Ok(None) };
            let bytes = length.saturating_mul(bytes_of(kind));
            if bytes > size {
                return Err(format!("{bytes} bytes in the entry {tag}"));
            }
            if bytes > value_bytes {
                self.found.add(value, bytes);
            }
            self.found.others |= POINTERS.contains(&tag);
            // The value fills the first bytes of its field, in the file's byte order.
            let unused = 8 * (value_bytes - bytes.min(value_bytes));
            let small =
                if self.little { value & (u64::MAX >> (64 - 8 * value_bytes) >> unused) } else { value >> unused };
            if tag == PHOTOMETRIC && length == 1 && bytes <= 4 && small == 0 {
                let field = at.saturating_add(count_bytes as u64 + (i + 1) * entry_bytes - value_bytes);
                self.found.white.push(field + if self.little { 0 } else { bytes - 1 });
            }
        }
        Ok(self.offset())
    }

    /// Tag, type, number of values, and the value or its offset.
    fn entry(&mut self) -> Option<[u64; 4]> {
        Some([self.number(2)?, self.number(2)?, self.offset()?, self.offset()?])
    }

    fn offset(&mut self) -> Option<u64> {
        self.number(if self.big_tiff { 8 } else { 4 })
    }

    fn number(&mut self, bytes: usize) -> Option<u64> {
        let mut raw = [0; 8];
        let raw = &mut raw[..bytes];
        self.reader.read_exact(raw).ok()?;
        if self.little {
            raw.reverse();
        }
        Some(raw.iter().fold(0, |n, b| n << 8 | u64::from(*b)))
    }
}

/// Bytes per value of a type; unknown types count as the longest.
fn bytes_of(kind: u64) -> u64 {
    match kind {
        1 | 2 | 6 | 7 => 1,
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        _ => 8,
    }
}

/// A file in which black is zero on every page: the `tiff` crate inverts the numbers of the other pages, which are a
/// hint for screens. A detector's counts are as stored.
pub(super) struct AsStored<R> {
    pub reader: R,
    /// [`Directories::white`].
    pub white: Vec<u64>,
    pub at: u64,
}

impl<R: Read> Read for AsStored<R> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        let n = self.reader.read(out)?;
        let end = self.at + n as u64;
        let first = self.white.partition_point(|w| *w < self.at);
        for white in self.white[first..].iter().take_while(|w| **w < end) {
            out[(white - self.at) as usize] = 1;
        }
        self.at = end;
        Ok(n)
    }
}

impl<R: Seek> Seek for AsStored<R> {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.at = self.reader.seek(to)?;
        Ok(self.at)
    }
}
