//! A walk over the directories of a TIFF that checks only the lengths of their entries.
//!
//! The `tiff` crate allocates what an entry claims, on the first page up to 256 MiB whatever the file's size, and
//! prints an overlong text to standard error. This check keeps claims within the file's size.

use conefield_core::{Error, Result};
use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

struct EntryWalk<'a, R> {
    reader: &'a mut R,
    little: bool,
    big_tiff: bool,
}

/// Refuses an entry longer than the `size` of the whole file. The reader reports other damage.
pub(super) fn check(place: &str, reader: &mut (impl Read + Seek), size: u64) -> Result<()> {
    let mut mark = [0; 4];
    if reader.rewind().and_then(|()| reader.read_exact(&mut mark)).is_err() {
        return Ok(());
    }
    let little = mark[0] == b'I';
    let mut walk = EntryWalk { reader, little, big_tiff: mark[if little { 2 } else { 3 }] == 43 };
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
    Ok(())
}

impl<R: Read + Seek> EntryWalk<'_, R> {
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
        let (count_bytes, entry_bytes) = if self.big_tiff { (8, 20) } else { (2, 12) };
        if self.reader.seek(SeekFrom::Start(at)).is_err() {
            return Ok(None);
        }
        let Some(count) = self.number(count_bytes) else { return Ok(None) };
        if count.saturating_mul(entry_bytes) > size {
            return Err(format!("a directory of {count} entries"));
        }
        for _ in 0..count {
            let Some([tag, kind, length]) = self.entry() else { return Ok(None) };
            let bytes = length.saturating_mul(bytes_of(kind));
            if bytes > size {
                return Err(format!("{bytes} bytes in the entry {tag}"));
            }
        }
        Ok(self.offset())
    }

    /// Tag, type and number of values.
    fn entry(&mut self) -> Option<[u64; 3]> {
        let found = [self.number(2)?, self.number(2)?, self.offset()?];
        self.offset()?;
        Some(found)
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
