//! Values with their locations.

use super::location;
use serde_json::{Map, Number, Value};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

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
pub(super) struct Source {
    pub(super) name: String,
    text: String,
    /// Number of layers above it.
    depth: usize,
}

impl Source {
    pub(super) fn new(name: &str, text: &str, depth: usize) -> Arc<Self> {
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
    pub(super) fn byte(source: &Arc<Source>, offset: usize) -> Self {
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

/// A value and its location.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Node {
    pub(crate) at: At,
    pub(crate) kind: Is,
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

impl Entry {
    /// The entry of a key; a missing one is added at `at`, as an empty list or an empty table.
    pub(crate) fn of<'a>(entries: &'a mut Vec<Entry>, key: &str, at: &At, list: bool) -> &'a mut Entry {
        let found = entries.iter().position(|e| e.key == key);
        let i = found.unwrap_or_else(|| {
            let kind = if list { Is::Array(vec![]) } else { Is::Table(vec![]) };
            entries.push(Entry { key: key.into(), at: at.clone(), value: Node { at: at.clone(), kind } });
            entries.len() - 1
        });
        &mut entries[i]
    }
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
                Entry::of(entries, key, &at, rest.is_empty()).value.push_all(rest, Node { at, kind });
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
            Is::Table(entries) => {
                // Collecting sorts first, by code that is compiled for each iterator.
                let mut table = Map::new();
                table.extend(entries.iter().map(|e| (e.key.clone(), e.value.to_json())));
                table.into()
            }
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
