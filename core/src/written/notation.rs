//! Parsers of TOML and JSON that keep locations.

use super::node::{At, Entry, Is, Node, Source};
use crate::error::{Error, Result};
use serde_json::{Number, Value};
use std::collections::HashSet;
use std::fmt;
use std::sync::Arc;
use toml::de::{DeTable, DeValue};

/// Parses TOML with `depth` layers above it.
pub(super) fn parse_toml(source: &str, text: &str, depth: usize) -> Result<Node> {
    let source = Source::new(source, text, depth);
    let root = DeTable::parse(text).map_err(|e| {
        let at = At::byte(&source, e.span().map_or(0, |s| s.start));
        Error::invalid(at, "syntax", e.message().replace('\n', ", "), "TOML")
    })?;
    toml_table(&source, root.get_ref(), At::byte(&source, 0))
}

fn toml_table(source: &Arc<Source>, table: &DeTable<'_>, at: At) -> Result<Node> {
    let mut entries = Vec::with_capacity(table.len());
    for (key, value) in table {
        let (key, at) = (key.get_ref().to_string(), At::byte(source, key.span().start));
        let value =
            toml_value(source, value.get_ref(), At::byte(source, value.span().start)).map_err(|e| e.below(&key))?;
        entries.push(Entry { key, at, value });
    }
    Ok(Node { at, kind: Is::Table(entries) })
}

fn toml_value(source: &Arc<Source>, value: &DeValue<'_>, at: At) -> Result<Node> {
    let refuse = |found: &dyn fmt::Display, expected: &str| Error::invalid(&at, "", found, expected);
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
                    toml_value(source, v.get_ref(), At::byte(source, v.span().start))
                        .map_err(|e| e.below(&i.to_string()))
                })
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
        serde_json::from_str(piece).map_err(|_| Error::invalid(at, "value", piece, "a JSON value"))
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
                        return Err(Error::invalid(at, key, "the key a second time", "each key once"));
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
