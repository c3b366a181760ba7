//! A spec as written: values with their locations.

use crate::error::{Error, Result};
use serde_json::{Number, Value};
use std::collections::{BTreeSet, HashSet};
use std::fmt;
use std::sync::Arc;
use toml::de::{DeTable, DeValue};

/// A location in a source: a file with line and column, or a `--set`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct At {
    source: Arc<Source>,
    /// Byte offset in the source's text. Line and column are counted only for display: counting them for every value of
    /// a long text would take quadratic time.
    offset: Option<usize>,
}

/// A source name with its text.
#[derive(Debug, PartialEq)]
struct Source {
    name: String,
    text: String,
    /// Number of layers above it.
    depth: usize,
}

impl Source {
    fn new(name: &str, text: &str, depth: usize) -> Arc<Self> {
        Arc::new(Self { name: name.into(), text: text.into(), depth })
    }
}

impl At {
    /// A source without lines, above all layers.
    pub(super) fn whole(name: &str) -> Self {
        Self { source: Source::new(name, "", 0), offset: None }
    }

    /// The byte offset in its source, if any.
    pub(super) fn offset(&self) -> Option<usize> {
        self.offset
    }

    /// The number of layers above its source.
    pub(super) fn depth(&self) -> usize {
        self.source.depth
    }

    /// The location of byte `offset` in the source's text.
    fn byte(source: &Arc<Source>, offset: usize) -> Self {
        Self { source: source.clone(), offset: Some(offset) }
    }
}

impl fmt::Display for At {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Source { name, text, .. } = &*self.source;
        f.write_str(name)?;
        if let Some(offset) = self.offset {
            let before = &text.as_bytes()[..offset.min(text.len())];
            let line = before.iter().filter(|b| **b == b'\n').count() + 1;
            let rest = String::from_utf8_lossy(before.rsplit(|b| *b == b'\n').next().unwrap_or_default());
            write!(f, ":{line}:{}", rest.chars().count() + 1)?;
        }
        Ok(())
    }
}

/// A value and its location.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Node {
    pub(super) at: At,
    pub(super) kind: Is,
}

impl Node {
    /// Adds the names of all sources used here.
    pub(super) fn sources(&self, all: &mut BTreeSet<String>) {
        all.insert(self.at.source.name.clone());
        match &self.kind {
            Is::Array(items) => items.iter().for_each(|i| i.sources(all)),
            Is::Table(entries) => entries.iter().for_each(|e| e.value.sources(all)),
            _ => {}
        }
    }
}

/// The content of a value.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Is {
    Null,
    Bool(bool),
    Number(Number),
    String(String),
    Array(Vec<Node>),
    Table(Vec<Entry>),
}

/// A key of a table with its value.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Entry {
    pub(super) key: String,
    /// Location of the key.
    pub(super) at: At,
    pub(super) value: Node,
}

impl Node {
    /// A table without entries.
    pub(super) fn empty_table(at: At) -> Self {
        Self { at, kind: Is::Table(vec![]) }
    }

    /// The value of `key`, if this is a table that has it.
    pub(super) fn get(&self, key: &str) -> Option<&Node> {
        self.entries().iter().find(|e| e.key == key).map(|e| &e.value)
    }

    /// The value of `key`, mutable.
    pub(super) fn get_mut(&mut self, key: &str) -> Option<&mut Node> {
        match &mut self.kind {
            Is::Table(entries) => entries.iter_mut().find(|e| e.key == key).map(|e| &mut e.value),
            _ => None,
        }
    }

    /// The entries of a table; empty for anything else.
    pub(super) fn entries(&self) -> &[Entry] {
        match &self.kind {
            Is::Table(entries) => entries,
            _ => &[],
        }
    }

    /// Removes `key` from a table.
    pub(super) fn take(&mut self, key: &str) -> Option<Entry> {
        match &mut self.kind {
            Is::Table(entries) => entries.iter().position(|e| e.key == key).map(|i| entries.remove(i)),
            _ => None,
        }
    }

    /// The text, if this is a string.
    pub(super) fn text(&self) -> Option<&str> {
        match &self.kind {
            Is::String(s) => Some(s),
            _ => None,
        }
    }

    /// The deepest node on `path` that exists.
    pub(super) fn nearest(&self, path: &[&str]) -> &Node {
        let mut node = self;
        for step in path {
            let next = match &node.kind {
                Is::Array(items) => step.parse::<usize>().ok().and_then(|i| items.get(i)),
                _ => node.get(step),
            };
            match next {
                Some(n) => node = n,
                None => break,
            }
        }
        node
    }

    /// Expands a stage given by name only to a table with that type.
    pub(super) fn spell_out(&mut self) {
        if let Is::String(_) = self.kind {
            let at = self.at.clone();
            let value = std::mem::replace(self, Self::empty_table(at.clone()));
            self.kind = Is::Table(vec![Entry { key: "type".into(), at, value }]);
        }
    }

    /// Appends the items of a list to the list at `path`, which is created if missing.
    pub(super) fn push_all(&mut self, path: &[&str], items: Node) {
        let at = items.at.clone();
        match (path, &mut self.kind, items.kind) {
            ([key, rest @ ..], Is::Table(entries), kind) => {
                let found = entries.iter().position(|e| e.key == *key);
                let i = found.unwrap_or_else(|| {
                    let fresh = if rest.is_empty() { Is::Array(vec![]) } else { Is::Table(vec![]) };
                    let value = Node { at: at.clone(), kind: fresh };
                    entries.push(Entry { key: (*key).into(), at: at.clone(), value });
                    entries.len() - 1
                });
                entries[i].value.push_all(rest, Node { at, kind });
            }
            ([], Is::Array(all), Is::Array(items)) => all.extend(items),
            _ => {}
        }
    }

    /// Merges `over` on top: tables merge, everything else is replaced. A table with another `type` replaces too, as
    /// the keys of one type mean nothing to another. A table without a `type` over a stage given by name only changes
    /// settings of that stage.
    pub(super) fn merge(&mut self, over: Node) {
        if matches!(over.kind, Is::Table(_)) && over.get("type").is_none() {
            self.spell_out();
        }
        let retyped = match (self.get("type"), over.get("type")) {
            (Some(a), Some(b)) => a.text() != b.text(),
            _ => false,
        };
        match (&mut self.kind, over.kind) {
            (Is::Table(base), Is::Table(over_entries)) if !retyped => {
                for e in over_entries {
                    match base.iter_mut().find(|b| b.key == e.key) {
                        Some(b) => {
                            b.value.merge(e.value);
                            b.at = e.at;
                        }
                        None => base.push(e),
                    }
                }
                self.at = over.at;
            }
            (_, kind) => *self = Node { at: over.at, kind },
        }
    }

    /// As a JSON value.
    pub(super) fn to_json(&self) -> Value {
        match &self.kind {
            Is::Null => Value::Null,
            Is::Bool(b) => Value::Bool(*b),
            Is::Number(n) => Value::Number(n.clone()),
            Is::String(s) => Value::String(s.clone()),
            Is::Array(items) => Value::Array(items.iter().map(Node::to_json).collect()),
            Is::Table(entries) => Value::Object(entries.iter().map(|e| (e.key.clone(), e.value.to_json())).collect()),
        }
    }

    /// For an error message: the value; of a list or a table only the size or the keys.
    pub(super) fn shown(&self) -> String {
        match &self.kind {
            Is::Array(items) => format!("a list of {}", items.len()),
            Is::Table(entries) if entries.is_empty() => "an empty table".into(),
            Is::Table(entries) => {
                let keys: Vec<&str> = entries.iter().take(4).map(|e| &*e.key).collect();
                let more = if keys.len() < entries.len() { " and more" } else { "" };
                format!("a table of {}{more}", keys.join(", "))
            }
            Is::String(s) => format!("the text {s:?}"),
            _ => self.to_json().to_string(),
        }
    }
}

/// Parses TOML with `depth` layers above it.
pub(super) fn parse_toml(source: &str, text: &str, depth: usize) -> Result<Node> {
    let source = Source::new(source, text, depth);
    let root = DeTable::parse(text).map_err(|e| {
        let at = At::byte(&source, e.span().map_or(0, |s| s.start));
        Error::invalid(at.to_string(), "syntax", e.message().replace('\n', ", "), "TOML")
    })?;
    toml_table(&source, root.get_ref(), At::byte(&source, 0))
}

fn toml_table(source: &Arc<Source>, table: &DeTable<'_>, at: At) -> Result<Node> {
    let mut entries = Vec::with_capacity(table.len());
    for (key, value) in table {
        entries.push(Entry {
            key: key.get_ref().to_string(),
            at: At::byte(source, key.span().start),
            value: toml_value(source, value.get_ref(), At::byte(source, value.span().start))?,
        });
    }
    Ok(Node { at, kind: Is::Table(entries) })
}

fn toml_value(source: &Arc<Source>, value: &DeValue<'_>, at: At) -> Result<Node> {
    let refuse = |found: &dyn fmt::Display, expected: &str| Error::invalid(at.to_string(), "value", found, expected);
    let kind = match value {
        DeValue::String(s) => Is::String(s.to_string()),
        DeValue::Boolean(b) => Is::Bool(*b),
        DeValue::Integer(i) => {
            let n = i64::from_str_radix(i.as_str(), i.radix()).map(Number::from);
            let n = n.or_else(|_| u64::from_str_radix(i.as_str(), i.radix()).map(Number::from));
            Is::Number(n.map_err(|_| refuse(i, "a whole number of at most 64 bits"))?)
        }
        DeValue::Float(f) => {
            let n = f.as_str().parse().ok().and_then(Number::from_f64);
            Is::Number(n.ok_or_else(|| refuse(f, "a finite number"))?)
        }
        DeValue::Datetime(d) => return Err(refuse(d, "a number, a text, a list or a table; no setting is a date")),
        DeValue::Array(items) => Is::Array(
            items
                .iter()
                .map(|v| toml_value(source, v.get_ref(), At::byte(source, v.span().start)))
                .collect::<Result<_>>()?,
        ),
        DeValue::Table(t) => return toml_table(source, t, at),
    };
    Ok(Node { at, kind })
}

/// Parses JSON with `depth` layers above it.
pub(super) fn parse_json(source: &str, text: &str, depth: usize) -> Result<Node> {
    let source = Source::new(source, text, depth);
    // serde_json checks syntax and depth; the reader below relies on valid text.
    serde_json::from_str::<Value>(text).map_err(|e| {
        let why = e.to_string();
        let why = why.split(" at line ").next().unwrap_or_default();
        Error::invalid(format!("{}:{}:{}", source.name, e.line(), e.column()), "syntax", why, "JSON")
    })?;
    let mut reader = Json { source, text, at: 0 };
    reader.value()
}

/// Reader of valid JSON.
struct Json<'a> {
    source: Arc<Source>,
    text: &'a str,
    at: usize,
}

impl Json<'_> {
    fn place(&self) -> At {
        At::byte(&self.source, self.at)
    }

    fn peek(&mut self) -> u8 {
        let rest = &self.text.as_bytes()[self.at..];
        self.at += rest.iter().take_while(|b| b.is_ascii_whitespace()).count();
        self.text.as_bytes().get(self.at).copied().unwrap_or(0)
    }

    /// Consumes `byte` if it is next.
    fn eat(&mut self, byte: u8) -> bool {
        let found = self.peek() == byte;
        self.at += usize::from(found);
        found
    }

    fn scalar<T: serde::de::DeserializeOwned>(&mut self, len: usize) -> Result<T> {
        let at = self.place();
        let piece = self.text.get(self.at..self.at + len).unwrap_or_default();
        self.at += len;
        serde_json::from_str(piece).map_err(|_| Error::invalid(at.to_string(), "value", piece, "a JSON value"))
    }

    fn string(&mut self) -> Result<String> {
        self.peek();
        let mut escaped = false;
        let end = self.text.as_bytes()[self.at..].iter().skip(1).position(|&b| {
            let ends = b == b'"' && !escaped;
            escaped = b == b'\\' && !escaped;
            ends
        });
        self.scalar(end.map_or(0, |n| n + 2))
    }

    fn value(&mut self) -> Result<Node> {
        let next = self.peek();
        let at = self.place();
        let kind = match next {
            b'{' => {
                self.at += 1;
                let mut entries: Vec<Entry> = vec![];
                let mut keys = HashSet::new();
                while !self.eat(b'}') {
                    self.eat(b',');
                    self.peek();
                    let at = self.place();
                    let key = self.string()?;
                    if !keys.insert(key.clone()) {
                        return Err(Error::invalid(at.to_string(), key, "the key a second time", "each key once"));
                    }
                    self.eat(b':');
                    entries.push(Entry { key, at, value: self.value()? });
                }
                Is::Table(entries)
            }
            b'[' => {
                self.at += 1;
                let mut items = vec![];
                while !self.eat(b']') {
                    self.eat(b',');
                    items.push(self.value()?);
                }
                Is::Array(items)
            }
            b'"' => Is::String(self.string()?),
            _ => {
                let rest = &self.text.as_bytes()[self.at..];
                let len = rest.iter().take_while(|b| !b",]}".contains(b) && !b.is_ascii_whitespace()).count();
                match self.scalar(len)? {
                    Value::Bool(b) => Is::Bool(b),
                    Value::Number(n) => Is::Number(n),
                    _ => Is::Null,
                }
            }
        };
        Ok(Node { at, kind })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn toml_and_json_read_alike_and_know_their_lines() {
        let t = parse_toml("a.toml", "x = 1\n[b]\n  y = [2.5, \"é\"]\n", 1).unwrap();
        let j = parse_json("a.json", "{ \"x\": 1,\n \"b\": {\n\n \"y\": [2.5, \"\\u00e9\"] } }", 1).unwrap();
        assert_eq!(t.to_json(), j.to_json());
        assert_eq!(t.nearest(&["b", "y", "1"]).at.to_string(), "a.toml:3:13");
        assert_eq!(j.nearest(&["b", "y", "1"]).at.to_string(), "a.json:4:13");
        assert_eq!(j.nearest(&["b", "z"]).at.to_string(), "a.json:2:7");
    }

    #[test]
    fn syntax_errors_name_the_line() {
        let e = parse_toml("a.toml", "x = 1\ny = = 2\n", 1).unwrap_err().to_string();
        assert!(e.starts_with("a.toml:2:"), "{e}");
        let e = parse_json("a.json", "{\n \"x\": }", 1).unwrap_err().to_string();
        assert!(e.starts_with("a.json:2:"), "{e}");
        let e = parse_json("a.json", "{ \"x\": 1,\n \"x\": 2}", 1).unwrap_err().to_string();
        assert!(e.starts_with("a.json:2:2: x: found the key a second time"), "{e}");
        let e = parse_toml("a.toml", "x = nan", 1).unwrap_err().to_string();
        assert!(e.contains("a finite number"), "{e}");
    }

    #[test]
    fn a_changed_type_drops_the_keys_of_the_old_one() {
        let mut base = parse_toml("base", "[a]\ntype = 'one'\nk = 1\n[b]\ntype = 'one'\nk = 1\n", 1).unwrap();
        base.merge(parse_toml("over", "[a]\ntype = 'two'\n[b]\nl = 2\n", 1).unwrap());
        let want = serde_json::json!({"a": {"type": "two"}, "b": {"type": "one", "k": 1, "l": 2}});
        assert_eq!(base.to_json(), want);
    }
}
