//! Headers of NRRD and MetaImage: lines with a name and a value, then the voxels or the name of their file.

use crate::folder;
use crate::folder::folder_of;
use crate::input::Input;
use crate::text::shortened;
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::path::Path;

/// The entries of a header.
pub(crate) struct Header {
    pub place: String,
    /// What errors expect in place of an entry that is not there.
    lacking: &'static str,
    entries: Vec<(String, Vec<u8>)>,
}

impl Header {
    /// A header of the file `input`, without entries so far.
    pub fn new(input: &Input, lacking: &'static str) -> Self {
        Self { place: input.place(), lacking, entries: Vec::new() }
    }

    pub fn push(&mut self, name: impl Into<String>, value: &[u8]) {
        self.entries.push((name.into(), value.to_owned()));
    }

    pub fn invalid(&self, field: &str, found: impl ToString, expected: &str) -> Error {
        Error::invalid(&self.place, field, found, expected)
    }

    /// The text of the entry `name`. Only the entries in use must be text and occur once.
    pub fn text(&self, name: &str) -> Result<Option<&str>> {
        let mut all = self.entries.iter().filter(|(n, _)| n == name);
        let Some((_, value)) = all.next() else { return Ok(None) };
        ensure(all.next().is_none(), &self.place, name, "two entries", "one")?;
        let text = std::str::from_utf8(value);
        text.map(Some).map_err(|e| self.invalid(name, format!("bytes that are no UTF-8 ({e})"), "a text"))
    }

    pub fn required(&self, name: &str) -> Result<&str> {
        self.text(name)?.ok_or_else(|| self.invalid(name, "no such entry", self.lacking))
    }

    /// The first of `names` that exists, with its name: some entries have several spellings.
    pub fn first<'a>(&self, names: &[&'a str]) -> Result<Option<(&'a str, &str)>> {
        for &name in names {
            if let Some(text) = self.text(name)? {
                return Ok(Some((name, text)));
            }
        }
        Ok(None)
    }

    /// The file `name` in the folder of the header `path`, as the entry `field` says; refuses lists of files.
    pub fn data_file(&self, path: &Path, field: &str, name: &str, expected: &str) -> Result<Input> {
        ensure(!name.starts_with("LIST") && !name.contains('%'), &self.place, field, shortened(name), expected)?;
        Input::open_plain(&folder::inside(folder_of(path), &self.place, field, name)?)
    }

    /// Skips as many bytes of `data` as the entry `field` says in `text`. Where `last` is known, −1 stands for all but
    /// the last so many.
    pub fn skip(&self, data: &mut Input, (field, text): (&str, &str), last: Option<u64>, expected: &str) -> Result<()> {
        let left = data.left();
        let count = match (text.parse::<i64>(), left.zip(last)) {
            (Ok(-1), Some((left, last))) => left.saturating_sub(last),
            (Ok(n), _) if n >= 0 && left.is_none_or(|left| n.unsigned_abs() <= left) => n.unsigned_abs(),
            _ => return Err(self.invalid(field, shortened(text), expected)),
        };
        data.skip(count, field)
    }
}

/// Finite numbers, if all of these are.
pub(crate) fn finite<'a>(texts: impl Iterator<Item = &'a str>) -> Option<Vec<f64>> {
    texts.map(|t| t.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect()
}
