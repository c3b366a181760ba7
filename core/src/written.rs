//! TOML and JSON as written: values with their locations, and errors that name them.

use crate::allowance;
use crate::error::{Error, Result};
use serde::de::value::{MapAccessDeserializer, StrDeserializer};
use serde::de::{DeserializeOwned, DeserializeSeed, IntoDeserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserializer, de, forward_to_deserialize_any};
use serde_json::{Number, Value};
use serde_spanned::de::{SpannedDeserializer, is_spanned};
use std::collections::{BTreeSet, HashSet};
use std::fmt;
use std::path::Path;
use std::sync::Arc;
use toml::de::{DeTable, DeValue};

/// Most bytes of memory per byte of text: of a list of digits, each one is a [`Node`].
const NODE_BYTES: u64 = 48;

/// Reads `text`, the content of the file `place`. Errors name line and column, and for an unknown key the nearest valid
/// one.
pub fn read<T: DeserializeOwned>(place: &str, text: &str) -> Result<T> {
    value(&parse(place, text, 0)?)
}

/// Reads a value.
pub(crate) fn value<T: DeserializeOwned>(node: &Node) -> Result<T> {
    T::deserialize(node).map_err(|e| e.located(&node.at))
}

/// Parses `text`, the content of `place`, with `depth` layers above it: JSON if the extension says so or
/// the text begins with a brace, as no TOML does, else TOML.
pub(crate) fn parse(place: &str, text: &str, depth: usize) -> Result<Node> {
    allowance::memory(place, "text", (text.len() as u64).saturating_mul(NODE_BYTES))?;
    let json = Path::new(place).extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if json || text.trim_start().starts_with('{') {
        parse_json(place, text, depth)
    } else {
        parse_toml(place, text, depth)
    }
}

/// A location in a source: a file with line and column, or a `--set`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct At {
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
    pub(crate) fn whole(name: &str) -> Self {
        Self { source: Source::new(name, "", 0), offset: None }
    }

    /// The byte offset in its source, if any.
    pub(crate) fn offset(&self) -> Option<usize> {
        self.offset
    }

    /// The number of layers above its source.
    pub(crate) fn depth(&self) -> usize {
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
        match self.offset {
            Some(offset) => f.write_str(&location(name, text, offset)),
            None => f.write_str(name),
        }
    }
}

/// Line and column of byte `offset` in `text`, the content of the file `place`: `place:line:column`.
pub fn location(place: &str, text: &str, offset: usize) -> String {
    let before = &text.as_bytes()[..offset.min(text.len())];
    let line = before.iter().filter(|b| **b == b'\n').count() + 1;
    let rest = String::from_utf8_lossy(before.rsplit(|b| *b == b'\n').next().unwrap_or_default());
    format!("{place}:{line}:{}", rest.chars().count() + 1)
}

/// A value and its location.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Node {
    pub(crate) at: At,
    pub(crate) kind: Is,
}

impl Node {
    /// Adds the names of all sources used here.
    pub(crate) fn sources(&self, all: &mut BTreeSet<String>) {
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
pub(crate) enum Is {
    Null,
    Bool(bool),
    Number(Number),
    String(String),
    /// Only in TOML; a type reads it as a text.
    Date(String),
    Array(Vec<Node>),
    Table(Vec<Entry>),
}

/// A key of a table with its value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    pub(crate) key: String,
    /// Location of the key.
    pub(crate) at: At,
    pub(crate) value: Node,
}

impl Node {
    /// A table without entries.
    pub(crate) fn empty_table(at: At) -> Self {
        Self { at, kind: Is::Table(vec![]) }
    }

    /// The value of `key`, if this is a table that has it.
    pub(crate) fn get(&self, key: &str) -> Option<&Node> {
        self.entries().iter().find(|e| e.key == key).map(|e| &e.value)
    }

    /// The value of `key`, mutable.
    pub(crate) fn get_mut(&mut self, key: &str) -> Option<&mut Node> {
        match &mut self.kind {
            Is::Table(entries) => entries.iter_mut().find(|e| e.key == key).map(|e| &mut e.value),
            _ => None,
        }
    }

    /// The entries of a table; empty for anything else.
    pub(crate) fn entries(&self) -> &[Entry] {
        match &self.kind {
            Is::Table(entries) => entries,
            _ => &[],
        }
    }

    /// Removes `key` from a table.
    pub(crate) fn take(&mut self, key: &str) -> Option<Entry> {
        match &mut self.kind {
            Is::Table(entries) => entries.iter().position(|e| e.key == key).map(|i| entries.remove(i)),
            _ => None,
        }
    }

    /// The text, if this is a string.
    pub(crate) fn text(&self) -> Option<&str> {
        match &self.kind {
            Is::String(s) => Some(s),
            _ => None,
        }
    }

    /// The deepest node on `path` that exists.
    pub(crate) fn nearest(&self, path: &[&str]) -> &Node {
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
    pub(crate) fn spell_out(&mut self) {
        if let Is::String(_) = self.kind {
            let at = self.at.clone();
            let value = std::mem::replace(self, Self::empty_table(at.clone()));
            self.kind = Is::Table(vec![Entry { key: "type".into(), at, value }]);
        }
    }

    /// Appends the items of a list to the list at `path`, which is created if missing.
    pub(crate) fn push_all(&mut self, path: &[&str], items: Node) {
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
    pub(crate) fn merge(&mut self, over: Node) {
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
    pub(crate) fn to_json(&self) -> Value {
        match &self.kind {
            Is::Null => Value::Null,
            Is::Bool(b) => Value::Bool(*b),
            Is::Number(n) => Value::Number(n.clone()),
            Is::String(s) | Is::Date(s) => Value::String(s.clone()),
            Is::Array(items) => Value::Array(items.iter().map(Node::to_json).collect()),
            Is::Table(entries) => Value::Object(entries.iter().map(|e| (e.key.clone(), e.value.to_json())).collect()),
        }
    }

    /// For an error message: the value; of a list or a table only the size or the keys.
    pub(crate) fn shown(&self) -> String {
        match &self.kind {
            Is::Array(items) => format!("a list of {}", items.len()),
            Is::Table(entries) if entries.is_empty() => "an empty table".into(),
            Is::Table(entries) => {
                let keys: Vec<&str> = entries.iter().take(4).map(|e| &*e.key).collect();
                let more = if keys.len() < entries.len() { " and more" } else { "" };
                format!("a table of {}{more}", keys.join(", "))
            }
            Is::String(s) => format!("the text {s:?}"),
            Is::Date(s) => format!("the date {s}"),
            _ => self.to_json().to_string(),
        }
    }
}

/// Parses TOML with `depth` layers above it.
pub(crate) fn parse_toml(source: &str, text: &str, depth: usize) -> Result<Node> {
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
        let (key, at) = (key.get_ref().to_string(), At::byte(source, key.span().start));
        let value =
            toml_value(source, value.get_ref(), At::byte(source, value.span().start)).map_err(|e| below(&key, e))?;
        entries.push(Entry { key, at, value });
    }
    Ok(Node { at, kind: Is::Table(entries) })
}

/// The error of a value at `step` of a table or list.
fn below(step: &dyn fmt::Display, error: Error) -> Error {
    match error {
        Error::Invalid { place, field, found, expected } => {
            let field = if field.is_empty() { step.to_string() } else { format!("{step}.{field}") };
            Error::Invalid { place, field, found, expected }
        }
        other => other,
    }
}

fn toml_value(source: &Arc<Source>, value: &DeValue<'_>, at: At) -> Result<Node> {
    let refuse = |found: &dyn fmt::Display, expected: &str| Error::invalid(at.to_string(), "", found, expected);
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
        DeValue::Datetime(d) => Is::Date(d.to_string()),
        DeValue::Array(items) => Is::Array(
            items
                .iter()
                .enumerate()
                .map(|(i, v)| {
                    toml_value(source, v.get_ref(), At::byte(source, v.span().start)).map_err(|e| below(&i, e))
                })
                .collect::<Result<_>>()?,
        ),
        DeValue::Table(t) => return toml_table(source, t, at),
    };
    Ok(Node { at, kind })
}

/// Parses JSON with `depth` layers above it.
pub(crate) fn parse_json(source: &str, text: &str, depth: usize) -> Result<Node> {
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

/// An error of a value, which learns where the value stands.
#[derive(Debug)]
pub(crate) struct Misfit {
    at: Option<At>,
    /// Keys and numbers that lead to the value, innermost first.
    path: Vec<String>,
    message: String,
}

impl fmt::Display for Misfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Misfit {}

impl de::Error for Misfit {
    #[inline(never)]
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self { at: None, path: vec![], message: message.to_string() }
    }
}

impl Misfit {
    fn at(mut self, at: &At) -> Self {
        self.at.get_or_insert_with(|| at.clone());
        self
    }

    fn below(mut self, step: &dyn fmt::Display) -> Self {
        self.path.push(step.to_string());
        self
    }

    /// The error in the text whose value stands at `root`.
    fn located(self, root: &At) -> Error {
        let Self { at, path, message } = self;
        let place = at.as_ref().unwrap_or(root).to_string();
        let field = |key: &str| {
            let steps = path.iter().rev().map(String::as_str).chain((!key.is_empty()).then_some(key));
            steps.collect::<Vec<_>>().join(".")
        };
        let names: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
        match names.split_first() {
            Some((key, valid)) if message.starts_with("unknown field") => {
                Error::invalid(place, field(key), "a key that is not known here", suggest(key, valid))
            }
            Some((key, _)) if message.starts_with("missing field") => {
                Error::invalid(place, field(key), "nothing", "a value")
            }
            _ => {
                let (found, expected) = message.split_once(", expected ").unwrap_or((&message, "valid values"));
                let field = if path.is_empty() { "content".into() } else { field("") };
                Error::invalid(place, field, found.trim(), expected.trim())
            }
        }
    }
}

impl<'de> Deserializer<'de> for &'de Node {
    type Error = Misfit;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Misfit> {
        match &self.kind {
            Is::Null => visitor.visit_unit(),
            Is::Bool(b) => visitor.visit_bool(*b),
            Is::Number(n) => match (n.as_u64(), n.as_i64()) {
                (Some(n), _) => visitor.visit_u64(n),
                (_, Some(n)) => visitor.visit_i64(n),
                _ => visitor.visit_f64(n.as_f64().unwrap_or(f64::NAN)),
            },
            Is::String(s) | Is::Date(s) => visitor.visit_str(s),
            Is::Array(items) => {
                let mut rest = Items { all: items, next: 0 };
                visitor.visit_seq(&mut rest).and_then(|v| rest.end().map(|()| v))
            }
            Is::Table(entries) => visitor.visit_map(Entries { rest: entries, value: None }),
        }
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Misfit> {
        match self.kind {
            Is::Null => visitor.visit_none(),
            _ => visitor.visit_some(self),
        }
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _: &'static str, visitor: V) -> Result<V::Value, Misfit> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        _: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Misfit> {
        if is_spanned(name) {
            let offset = self.at.offset().unwrap_or(0);
            return visitor.visit_map(SpannedDeserializer::new(self, offset..offset));
        }
        self.deserialize_any(visitor)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _: &'static str,
        _: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Misfit> {
        match &self.kind {
            Is::String(name) => visitor.visit_enum(StrDeserializer::new(name)),
            Is::Table(entries) => {
                visitor.visit_enum(MapAccessDeserializer::new(Entries { rest: entries, value: None }))
            }
            _ => Err(de::Error::custom(format_args!("{}, expected a text or a table", self.shown()))),
        }
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit unit_struct seq tuple
        tuple_struct map identifier ignored_any
    }
}

impl<'de> IntoDeserializer<'de, Misfit> for &'de Node {
    type Deserializer = Self;
    fn into_deserializer(self) -> Self {
        self
    }
}

/// The items of a list.
struct Items<'a> {
    all: &'a [Node],
    next: usize,
}

impl Items<'_> {
    /// Refuses a list with items that nobody read.
    fn end(&self) -> Result<(), Misfit> {
        let Self { all, next } = *self;
        let long = || de::Error::custom(format_args!("a list of {}, expected {next}", all.len()));
        if next < all.len() { Err(long()) } else { Ok(()) }
    }
}

impl<'de> SeqAccess<'de> for Items<'de> {
    type Error = Misfit;
    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Misfit> {
        let Some(node) = self.all.get(self.next) else { return Ok(None) };
        self.next += 1;
        seed.deserialize(node).map(Some).map_err(|e: Misfit| e.at(&node.at).below(&(self.next - 1)))
    }
    fn size_hint(&self) -> Option<usize> {
        Some(self.all.len() - self.next)
    }
}

/// The entries of a table.
struct Entries<'a> {
    rest: &'a [Entry],
    /// The entry whose key was read.
    value: Option<&'a Entry>,
}

impl<'de> MapAccess<'de> for Entries<'de> {
    type Error = Misfit;
    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Misfit> {
        let Some((entry, rest)) = self.rest.split_first() else { return Ok(None) };
        (self.rest, self.value) = (rest, Some(entry));
        seed.deserialize(StrDeserializer::new(&entry.key)).map(Some).map_err(|e: Misfit| e.at(&entry.at))
    }
    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Misfit> {
        let Some(entry) = self.value.take() else { return Err(de::Error::custom("a value without a key")) };
        seed.deserialize(&entry.value).map_err(|e: Misfit| e.at(&entry.value.at).below(&entry.key))
    }
}

/// For an error message: the name of `known` that is nearest to `name`, or all.
pub(crate) fn suggest(name: &str, known: &[&str]) -> String {
    let distance = |k: &str| strsim::osa_distance(&name.to_lowercase(), k);
    let alike = |k: &str| distance(k) <= (k.len() / 3).max(2) || k.starts_with(name) || name.starts_with(k);
    let near = known.iter().filter(|k| alike(k)).min_by_key(|k| distance(k));
    match (near, known) {
        (_, []) => "none; this build has none".into(),
        (Some(near), [_]) => format!("{near:?}"),
        (Some(near), _) => format!("{near:?} (of {})", known.join(", ")),
        (None, _) => listed(known),
    }
}

/// For an error message: all names of `known`.
pub(crate) fn listed(known: &[&str]) -> String {
    match known {
        [] => "none is known here".into(),
        [one] => (*one).into(),
        _ => format!("one of {}", known.join(", ")),
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
    fn values_are_read_and_errors_name_place_and_path() {
        #[derive(Debug, PartialEq, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Part {
            size: [f64; 2],
            kind: Option<Kind>,
            at: Option<toml::Spanned<u8>>,
        }
        #[derive(Debug, PartialEq, serde::Deserialize)]
        #[serde(rename_all = "kebab-case")]
        enum Kind {
            Plain,
            Of { sides: i64 },
            Pair(u8, u8),
        }
        #[derive(Debug, PartialEq, serde::Deserialize)]
        struct Whole {
            parts: Vec<Part>,
        }
        let whole: Whole = read("a.toml", "[[parts]]\nsize = [1, 2.5]\nkind = 'plain'\n").unwrap();
        assert_eq!(whole.parts, [Part { size: [1.0, 2.5], kind: Some(Kind::Plain), at: None }]);
        let text = r#"{"parts": [{"size": [-1, 2], "kind": {"of": {"sides": -3}}}, {"size": [0, 0], "kind": {"pair": [1, 2]}, "at": 7}]}"#;
        let whole: Whole = read("no extension", text).unwrap();
        assert_eq!(whole.parts[0].kind, Some(Kind::Of { sides: -3 }));
        assert_eq!(whole.parts[1].kind, Some(Kind::Pair(1, 2)));
        let at = whole.parts[1].at.as_ref().unwrap();
        assert_eq!((*at.get_ref(), &text[at.span().start..][..2]), (7, "7}"));
        for (text, says) in [
            (
                "[[parts]]\nsize = [1, true]",
                "a.toml:2:12: parts.0.size.1: found invalid type: boolean `true`, expected f64",
            ),
            ("[[parts]]\nsize = [1, 2, 3]", "a.toml:2:8: parts.0.size: found a list of 3, expected 2"),
            (
                "[[parts]]\nsize = [1]",
                "a.toml:2:8: parts.0.size: found invalid length 1, expected an array of length 2",
            ),
            (
                "[[parts]]\nsize = [1, 2]\nkin = 1",
                "a.toml:3:1: parts.0.kin: found a key that is not known here, expected \"kind\"",
            ),
            ("[[parts]]\nkind = 'plain'", "a.toml:1:1: parts.0.size: found nothing, expected a value"),
            ("parts = 3", "a.toml:1:9: parts: found invalid type: integer `3`, expected a sequence"),
            ("[[parts]]\nsize = [1, 2]\nkind = 'plane'", "a.toml:3:8: parts.0.kind: found unknown variant `plane`"),
            (
                "[[parts]]\nsize = [1, 2]\nat = 300",
                "a.toml:3:6: parts.0.at: found invalid value: integer `300`, expected u8",
            ),
            ("parts = [", "a.toml:1:"),
        ] {
            let e = read::<Whole>("a.toml", text).unwrap_err().to_string();
            assert!(e.starts_with(says), "{e}\n{says}");
        }
    }

    #[test]
    fn a_changed_type_drops_the_keys_of_the_old_one() {
        let mut base = parse_toml("base", "[a]\ntype = 'one'\nk = 1\n[b]\ntype = 'one'\nk = 1\n", 1).unwrap();
        base.merge(parse_toml("over", "[a]\ntype = 'two'\n[b]\nl = 2\n", 1).unwrap());
        let want = serde_json::json!({"a": {"type": "two"}, "b": {"type": "one", "k": 1, "l": 2}});
        assert_eq!(base.to_json(), want);
    }
}
