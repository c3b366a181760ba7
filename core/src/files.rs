//! Opening of user-named files, which may be anything.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Opens a regular file and returns its size. Other file types could block or never end.
pub fn open(path: &Path) -> Result<(File, u64)> {
    let io = |e| Error::io(path, e);
    // Checked before opening: opening a pipe waits for its writer.
    if !path.metadata().map_err(io)?.is_file() {
        return Err(Error::invalid(path.display().to_string(), "file", "a folder, pipe or device", "a regular file"));
    }
    let file = File::open(path).map_err(io)?;
    let size = file.metadata().map_err(io)?.len();
    Ok((file, size))
}

/// Reads a text file of at most `most` bytes.
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    let invalid = |field: &str, found: String, expected: String| {
        Error::invalid(path.display().to_string(), field, found, expected)
    };
    let (file, size) = open(path)?;
    if size > most {
        return Err(invalid("file size", format!("{size} bytes"), format!("at most {most} bytes")));
    }
    crate::allowance::memory(&path.display().to_string(), "file size", size)?;
    let mut raw = Vec::new();
    file.take(most).read_to_end(&mut raw).map_err(|e| Error::io(path, e))?;
    String::from_utf8(raw)
        .map_err(|e| invalid("text", format!("a byte that is not UTF-8: {}", e.utf8_error()), "UTF-8 text".into()))
}

/// The line of `text` (from 1) of a TOML error, if known.
pub fn toml_line(text: &str, error: &toml::de::Error) -> Option<usize> {
    let before = &text.as_bytes()[..error.span()?.start.min(text.len())];
    Some(1 + before.iter().filter(|b| **b == b'\n').count())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_toml_error_has_its_line() {
        for (text, line) in [("a = = 1", 1), ("a = 1\n\nb = é", 3), ("a = 1\na = 2\n", 2), ("\n[b", 2)] {
            let error = toml::from_str::<toml::Table>(text).unwrap_err();
            assert_eq!(toml_line(text, &error), Some(line), "{text}");
        }
    }
}
