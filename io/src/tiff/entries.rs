//! A walk along the directories of a TIFF that looks only at the lengths of their entries.
//!
//! The `tiff` crate takes memory for what an entry claims, at the first page up to 256 MiB whatever the file's size,
//! and tells a text that is too long for it on standard error. This keeps claims within the file.

use conefield_core::{Error, Result};
use std::collections::HashSet;
use std::io::{Read, Seek, SeekFrom};

struct EntryWalk<'a, R> {
    reader: &'a mut R,
    little: bool,
    big_tiff: bool,
}

/// Refuses an entry of more bytes than the `size` of the whole file. Other damage is left for the reader to tell.
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
    /// Where the first directory stands.
    fn first(&mut self) -> Option<u64> {
        if self.big_tiff {
            // The size of an offset, always eight, stands before it.
            self.number(4)?;
        }
        self.offset()
    }

    /// Where the directory behind the one at `at` stands; `None` at the end of the file as well.
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

    /// Tag, kind and number of values.
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

/// Bytes a value of a kind; those that are not known count as the longest.
fn bytes_of(kind: u64) -> u64 {
    match kind {
        1 | 2 | 6 | 7 => 1,
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        _ => 8,
    }
}
