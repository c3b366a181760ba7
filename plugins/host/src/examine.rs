//! Checks of a library file before the operating system maps it.
//!
//! The system maps as much as the header claims. If the file is shorter, e.g. after an interrupted copy, the first
//! access to the missing part kills the process.

use conefield_core::error::{Error, Result, ensure};
use object::read::ReadCache;
use object::{Object, ObjectSection, ObjectSegment};
use std::fs::File;
use std::path::Path;

/// Refuses a file that is not a library or is shorter than its header says.
pub(crate) fn whole(path: &Path, place: &str) -> Result<()> {
    let io = |e| Error::io(path, e);
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let cache = ReadCache::new(file);
    let bad = |e: object::Error| {
        let found = format!("a file of {length} bytes that cannot be read as one: {e}");
        Error::invalid(place, "plugin", found, "a shared library for this system, whole")
    };
    let library = object::File::parse(&cache).map_err(bad)?;
    let segments = library.segments().map(|s| s.file_range());
    let sections = library.sections().filter_map(|s| s.file_range());
    for (at, size) in segments.chain(sections) {
        let end = at.saturating_add(size);
        let found = format!("a part that ends at byte {end}, in a file of {length} bytes");
        ensure(end <= length, place, "plugin", found, "a whole library: copy it again")?;
    }
    Ok(())
}
