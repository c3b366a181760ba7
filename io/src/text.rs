//! Descriptions in TOML and JSON; texts of other programs in their encodings.

use crate::input::LONGEST_TEXT;
use conefield_core::error::ensure;
use conefield_core::files::{BYTE_ORDER_MARK, read_text, read_text_bytes};
use conefield_core::{Error, Result, allowance, written};
use roxmltree::{Document, ParsingOptions};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::path::Path;

/// The keys that identify a description.
#[derive(Default, Deserialize)]
struct Mark {
    format: Option<String>,
    version: Option<u32>,
}

/// The `format` that the file `path` states, if it is a description at all.
pub(crate) fn format_of(path: &Path) -> Option<String> {
    read::<Mark>(path).ok()?.format
}

/// Reads the JSON or TOML file `path`.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<T> {
    written::read(&path.display().to_string(), &read_text(path, LONGEST_TEXT)?)
}

/// Reads the description `path`, whose `format` and `version` must match.
pub(crate) fn described<T: DeserializeOwned>(path: &Path, format: &str, version: u32) -> Result<T> {
    let text = read_text(path, LONGEST_TEXT)?;
    let place = path.display().to_string();
    // Checked before the other keys, which may differ in a later version.
    let mark: Mark = written::read(&place, &text)?;
    let found = mark.format.unwrap_or_else(|| "nothing".into());
    ensure(found == format, &place, "format", format!("\"{found}\""), format!("\"{format}\""))?;
    let found = mark.version.map_or("nothing".into(), |v| v.to_string());
    ensure(mark.version == Some(version), &place, "version", found, format!("{version}, which this build reads"))?;
    written::read(&place, &text)
}

/// The start of a text file without its byte-order mark.
pub(crate) fn without_mark(head: &[u8]) -> &[u8] {
    head.strip_prefix(BYTE_ORDER_MARK).unwrap_or(head)
}

/// Reads a text that another program wrote: in UTF-8, else in Windows-1252, the usual encoding of programs on Windows.
/// At most `most` bytes.
pub(crate) fn read_foreign(path: &Path, most: u64) -> Result<String> {
    String::from_utf8(read_text_bytes(path, most)?).or_else(|e| {
        tracing::debug!("{}: the text is not UTF-8 and is read as Windows-1252", path.display());
        Ok(windows_1252(e.as_bytes()))
    })
}

/// Decodes Windows-1252: Latin-1 but for the bytes from 0x80 to 0x9f.
fn windows_1252(bytes: &[u8]) -> String {
    const HIGH: [char; 32] = [
        '€', '\u{81}', '‚', 'ƒ', '„', '…', '†', '‡', 'ˆ', '‰', 'Š', '‹', 'Œ', '\u{8d}', 'Ž', '\u{8f}', '\u{90}', '‘',
        '’', '“', '”', '•', '–', '—', '˜', '™', 'š', '›', 'œ', '\u{9d}', 'ž', 'Ÿ',
    ];
    let decoded = |b: &u8| HIGH.get(usize::from(b.wrapping_sub(0x80))).copied().unwrap_or(char::from(*b));
    bytes.iter().map(decoded).collect()
}

/// Most nodes of an XML text: fifty thousand views of RTK's.
const MOST_NODES: u32 = 4_000_000;
/// Most bytes that a byte of XML expands to: a node takes about a hundred, and four bytes of text can make one.
const NODE_BYTES: u64 = 24;

/// Parses the XML `text` of the file `place`, in which `expected` should be. The parser limits entities.
pub(crate) fn xml<'t>(place: &str, text: &'t str, expected: &str) -> Result<Document<'t>> {
    allowance::memory(place, "XML", (text.len() as u64).saturating_mul(NODE_BYTES))?;
    // Document types may stand there, without content.
    let options = ParsingOptions { allow_dtd: true, nodes_limit: MOST_NODES, ..ParsingOptions::default() };
    Document::parse_with_options(text, options).map_err(|e| Error::invalid(place, "XML", e, expected))
}

/// What to say of `keys` that are not read; `None` if there are none.
pub(crate) fn unread(keys: &[String]) -> Option<String> {
    (!keys.is_empty()).then(|| format!("not read, though they may change the geometry: {}", keys.join(", ")))
}

/// Warns of the file `place`.
pub(crate) fn warn(place: &str, remarks: impl IntoIterator<Item = String>) {
    remarks.into_iter().for_each(|r| tracing::warn!("{place}: {r}"));
}

/// The message of an unusable `value` in the form of serde's errors: what was found, then what is expected.
pub(crate) fn misfit(value: &Value, expected: &str) -> String {
    let mut shown = value.to_string();
    if let Some((at, _)) = shown.char_indices().nth(80) {
        shown.truncate(at);
        shown.push('…');
    }
    format!("{shown}, expected {expected}")
}

/// A value in quotes, cut to 80 characters for errors.
pub(crate) fn shortened(text: &str) -> String {
    match text.char_indices().nth(80) {
        Some((at, _)) => format!("\"{}…\"", &text[..at]),
        None => format!("\"{text}\""),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_1252_is_read_where_a_text_is_not_utf_8() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        for (bytes, want) in [
            (&b"\xa9 2004 \x96 K\xfcndig \x80 \x9f\x7f"[..], "© 2004 – Kündig € Ÿ\u{7f}"),
            ("© Kündig".as_bytes(), "© Kündig"),
            (b"\xef\xbb\xbfangle", "angle"),
        ] {
            std::fs::write(&path, bytes).unwrap();
            assert_eq!(read_foreign(&path, 100).unwrap(), want);
        }
    }
}
