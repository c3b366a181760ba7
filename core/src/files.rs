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

/// Reads a text file of at most `most` bytes in UTF-8; a byte-order mark at its start is not part of the text.
pub fn read_text(path: &Path, most: u64) -> Result<String> {
    String::from_utf8(read_text_bytes(path, most)?).map_err(|e| {
        let found = format!("a byte that is not UTF-8: {}", e.utf8_error());
        Error::invalid(path.display().to_string(), "text", found, "UTF-8 text")
    })
}

/// The bytes of a text file of at most `most` bytes, without UTF-8's byte-order mark; refuses UTF-16.
pub fn read_text_bytes(path: &Path, most: u64) -> Result<Vec<u8>> {
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
    // Without a mark, every second byte of a Latin text is 0.
    let unmarked = raw.len() > 3 && (raw[0] == 0) != (raw[1] == 0) && (raw[2] == 0) != (raw[3] == 0);
    if raw.starts_with(&[0xff, 0xfe]) || raw.starts_with(&[0xfe, 0xff]) || unmarked {
        return Err(invalid("text", "UTF-16".into(), "UTF-8 text: save the file again in that encoding".into()));
    }
    if raw.starts_with(BYTE_ORDER_MARK) {
        raw.drain(..BYTE_ORDER_MARK.len());
    }
    Ok(raw)
}

/// UTF-8's byte-order mark, which programs on Windows put at the start of a text.
pub const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_byte_order_mark_is_no_text_and_utf_16_is_named() {
        let path = std::env::temp_dir().join(format!("conefield-text-{}", std::process::id()));
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let read = read_text(&path, 100);
            std::fs::remove_file(&path).unwrap();
            read
        };
        assert_eq!(read(b"\xef\xbb\xbfangle\n1").unwrap(), "angle\n1");
        assert_eq!(read("µ".as_bytes()).unwrap(), "µ");
        for bytes in [&b"\xff\xfea\0b\0"[..], b"\xfe\xff\0a\0b", b"a\0b\0", b"\0a\0b"] {
            let e = read(bytes).unwrap_err().to_string();
            assert!(e.contains("UTF-16") && e.contains("UTF-8"), "{e}");
        }
        let e = read(b"\xa9 2004").unwrap_err().to_string();
        assert!(e.contains("not UTF-8"), "{e}");
    }
}
