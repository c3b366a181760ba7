//! TOML and JSON with errors that name the line and, for an unknown key, the nearest valid one; texts of other
//! programs in their encodings.

use crate::input::LONGEST_TEXT;
use conefield_core::error::ensure;
use conefield_core::files::{BYTE_ORDER_MARK, read_text, read_text_bytes, toml_line};
use conefield_core::{Error, Result, allowance};
use roxmltree::{Document, ParsingOptions};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// The notation of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Notation {
    Toml,
    Json,
}

impl Notation {
    /// JSON for the extension `.json`, else TOML.
    fn of(path: &Path) -> Self {
        let json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
        if json { Self::Json } else { Self::Toml }
    }
}

/// The keys that identify a description.
#[derive(Default, Deserialize)]
struct Mark {
    format: Option<String>,
    version: Option<u32>,
}

/// The `format` that the file `path` states, if it is a description at all.
pub(crate) fn format_of(path: &Path) -> Option<String> {
    let mark: Mark = parse(path, &read_text(path, LONGEST_TEXT).ok()?, Notation::of(path)).ok()?;
    mark.format
}

/// Reads the description `path`, whose `format` and `version` must match.
pub(crate) fn described<T: DeserializeOwned>(path: &Path, format: &str, version: u32) -> Result<T> {
    let text = read_text(path, LONGEST_TEXT)?;
    let place = path.display().to_string();
    let notation = Notation::of(path);
    // Checked before the other keys, which may differ in a later version.
    let mark: Mark = parse(path, &text, notation)?;
    let found = mark.format.unwrap_or_else(|| "nothing".into());
    ensure(found == format, &place, "format", format!("\"{found}\""), format!("\"{format}\""))?;
    let found = mark.version.map_or("nothing".into(), |v| v.to_string());
    ensure(mark.version == Some(version), &place, "version", found, format!("{version}, which this build reads"))?;
    parse(path, &text, notation)
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

/// Parses `text`, the content of `path`.
fn parse<T: DeserializeOwned>(path: &Path, text: &str, notation: Notation) -> Result<T> {
    match notation {
        Notation::Toml => parse_toml(path, text),
        Notation::Json => parse_json(path, text),
    }
}

/// Parses `text`, the content of the JSON file `path`.
pub(crate) fn parse_json<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    serde_json::from_str(text).map_err(|e| {
        let full = e.to_string();
        let message = full.rsplit_once(" at line ").map_or(full.as_str(), |(m, _)| m);
        explain(path, text, (e.line() > 0).then(|| e.line()), message)
    })
}

/// Parses `text`, the content of the TOML file `path`. Errors name the line and, for an unknown key, the nearest valid
/// one.
pub fn parse_toml<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    toml::from_str(text).map_err(|e| explain(path, text, toml_line(text, &e), e.message()))
}

fn explain(path: &Path, text: &str, line: Option<usize>, message: &str) -> Error {
    let place = match line {
        Some(n) => format!("{}: line {n}", path.display()),
        None => path.display().to_string(),
    };
    let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    if message.starts_with("unknown field")
        && let Some((unknown, valid)) = names.split_first()
    {
        return Error::invalid(place, *unknown, "a key that is not known here", suggestion(unknown, valid));
    }
    if let (true, Some(name)) = (message.starts_with("missing field"), names.first()) {
        return Error::invalid(place, *name, "nothing", "a value");
    }
    let key = line
        .and_then(|n| text.lines().nth(n - 1))
        .and_then(|l| l.split_once(['=', ':']))
        .map(|(k, _)| k.trim().trim_matches('"'))
        .filter(|k| !k.is_empty() && !k.contains(['{', '[', '#']))
        .unwrap_or("content");
    match message.split_once(", expected ") {
        Some((found, expected)) => Error::invalid(place, key, found.trim(), expected.trim()),
        None => Error::invalid(place, key, message.trim(), "valid values"),
    }
}

/// What to say of `keys` that are not read; `None` if there are none.
pub(crate) fn unread(keys: &[String]) -> Option<String> {
    (!keys.is_empty()).then(|| format!("not read, though they may change the geometry: {}", keys.join(", ")))
}

/// Warns of the file `place`.
pub(crate) fn warn(place: &str, remarks: impl IntoIterator<Item = String>) {
    remarks.into_iter().for_each(|r| tracing::warn!("{place}: {r}"));
}

/// A value in quotes, cut to 80 characters for errors.
pub(crate) fn shortened(text: &str) -> String {
    match text.char_indices().nth(80) {
        Some((at, _)) => format!("\"{}…\"", &text[..at]),
        None => format!("\"{text}\""),
    }
}

/// "`spacing`, the nearest of: ...".
fn suggestion(unknown: &str, valid: &[&str]) -> String {
    let near = |name: &str| strsim::jaro_winkler(&unknown.to_lowercase(), name);
    let best = valid.iter().max_by(|a, b| near(a).total_cmp(&near(b)));
    match best {
        Some(b) if valid.len() > 1 => format!("`{b}` (the nearest of: {})", valid.join(", ")),
        Some(b) => format!("`{b}`"),
        None => "no key at all".into(),
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
