//! Keys and values of vendors' texts: INI files and the leaves of XML elements.

use crate::input::LONGEST_TEXT;
use crate::text::{self, read_foreign, shortened};
use conefield_core::{Error, Result};
use roxmltree::Node;
use std::collections::HashMap;
use std::path::Path;

/// The keys of all sections or elements of a text, in small and capital letters alike, with the file's name.
pub(super) struct Keys {
    place: String,
    /// By the key in small letters: the key and its value.
    all: HashMap<String, (String, String)>,
}

impl Keys {
    /// The lines `key=value` of the file `path`. A second value of one of the `known` keys is an error; of the others,
    /// which later sections may use for other devices, the first one counts.
    pub fn ini(path: &Path, known: &[&str]) -> Result<Self> {
        let text = read_foreign(path, LONGEST_TEXT)?;
        let mut keys = Self { place: path.display().to_string(), all: HashMap::new() };
        for (i, line) in text.lines().enumerate() {
            let Some((key, value)) = line.split_once('=') else { continue };
            let (key, value) = (key.trim(), value.trim());
            let first = keys.add(key, value);
            if first != value && known.iter().any(|k| k.eq_ignore_ascii_case(key)) {
                let at = format!("{}: line {}", keys.place, i + 1);
                return Err(Error::invalid(at, key, format!("a second value, {value}"), "one value"));
            }
        }
        Ok(keys)
    }

    /// The elements of the XML in the file `path`, in which `expected` should be; see [`Self::below`].
    pub fn xml(path: &Path, expected: &str) -> Result<Self> {
        let text = read_foreign(path, LONGEST_TEXT)?;
        let place = path.display().to_string();
        let document = text::xml(&place, &text, expected)?;
        Ok(Self::below(place, document.root_element()))
    }

    /// The elements below `node` that hold text only; of elements with one name the first counts.
    pub fn below(place: String, node: Node) -> Self {
        let mut keys = Self { place, all: HashMap::new() };
        for leaf in node.descendants().filter(|n| n.is_element() && !n.children().any(|c| c.is_element())) {
            keys.add(leaf.tag_name().name(), leaf.text().unwrap_or_default().trim());
        }
        keys
    }

    /// Adds a value unless the key has one, and returns the one that it has.
    fn add(&mut self, key: &str, value: &str) -> &str {
        &self.all.entry(key.to_lowercase()).or_insert_with(|| (key.to_owned(), value.to_owned())).1
    }

    /// The file, for errors.
    pub fn place(&self) -> &str {
        &self.place
    }

    pub fn invalid(&self, key: &str, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(&self.place, key, found, expected)
    }

    pub fn has(&self, key: &str) -> bool {
        self.all.contains_key(&key.to_lowercase())
    }

    /// The text of a key; an empty one counts as absent.
    pub fn text(&self, key: &str) -> Option<&str> {
        self.all.get(&key.to_lowercase()).map(|(_, v)| v.as_str()).filter(|v| !v.is_empty())
    }

    pub fn number(&self, key: &str) -> Result<f64> {
        let Some((_, text)) = self.all.get(&key.to_lowercase()) else {
            return Err(self.invalid(key, "nothing", "a number"));
        };
        let found = text.parse::<f64>().ok().filter(|x| x.is_finite());
        found.ok_or_else(|| self.invalid(key, shortened(text), "a number"))
    }

    pub fn length(&self, key: &str) -> Result<f64> {
        let found = self.number(key)?;
        if found > 0.0 { Ok(found) } else { Err(self.invalid(key, found, "a number above 0")) }
    }

    /// A whole number from 1 to `most`.
    pub fn whole(&self, key: &str, most: usize) -> Result<usize> {
        let found = self.number(key)?;
        if found.fract() == 0.0 && (1.0..=most as f64).contains(&found) {
            Ok(found as usize)
        } else {
            Err(self.invalid(key, found, format!("a whole number from 1 to {most}")))
        }
    }

    pub fn or(&self, key: &str, otherwise: f64) -> Result<f64> {
        if self.text(key).is_some() { self.number(key) } else { Ok(otherwise) }
    }

    /// Keys with one of `parts` in their names that are not `known` and hold a number other than 0, with their values.
    pub fn others(&self, parts: &[&str], known: &[&str]) -> Vec<String> {
        let others = |key: &str| parts.iter().any(|m| key.contains(m)) && !known.contains(&key);
        let set = |value: &str| value.parse::<f64>().is_ok_and(|x| x != 0.0);
        let shown = |(k, v): &(String, String)| (others(k) && set(v)).then(|| format!("{k} = {v}"));
        let mut found: Vec<String> = self.all.values().filter_map(shown).collect();
        found.sort();
        found
    }
}
