//! Types from values, by `serde`.

use super::node::{At, Entry, Is, Node};
use super::suggest;
use crate::error::Error;
use serde::de::value::{BorrowedStrDeserializer, MapAccessDeserializer, StrDeserializer};
use serde::de::{DeserializeSeed, Expected, MapAccess, SeqAccess, Unexpected, Visitor};
use serde::{Deserializer, de, forward_to_deserialize_any};
use serde_spanned::de::is_spanned;
use std::fmt;

/// The names of the fields of `serde_spanned`'s type. That type takes borrowed names only.
const SPANNED: [&str; 3] =
    ["$__serde_spanned_private_start", "$__serde_spanned_private_end", "$__serde_spanned_private_value"];

/// The field of `serde_spanned`'s type that `key` is, if it is one.
fn spanned_field(key: &str) -> Option<&'static str> {
    SPANNED.into_iter().find(|field| *field == key)
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

    fn invalid_type(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        let found = match found {
            Unexpected::Bool(b) => b.to_string(),
            Unexpected::Unsigned(n) => n.to_string(),
            Unexpected::Signed(n) => n.to_string(),
            Unexpected::Float(n) => n.to_string(),
            Unexpected::Str(s) => format!("the text {s:?}"),
            Unexpected::Seq => "a list".into(),
            Unexpected::Map => "a table".into(),
            Unexpected::Unit => "null".into(),
            other => other.to_string(),
        };
        Self::custom(format_args!("{found}, expected {}", in_words(&expected.to_string())))
    }

    fn invalid_value(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        Self::invalid_type(found, expected)
    }

    fn invalid_length(found: usize, expected: &dyn Expected) -> Self {
        Self::custom(format_args!("a list of {found}, expected {}", in_words(&expected.to_string())))
    }
}

/// What `serde` expects, without names of Rust's types.
fn in_words(expected: &str) -> String {
    let length = ["an array of length ", "a tuple of size "].iter().find_map(|start| expected.strip_prefix(start));
    match (expected, length) {
        (_, Some(length)) => return format!("a list of {length}"),
        ("f32" | "f64", _) => "a number",
        ("u8", _) => "a whole number from 0 to 255",
        ("u16", _) => "a whole number from 0 to 65535",
        ("u32", _) => "a whole number from 0 to 4294967295",
        ("u64" | "usize", _) => "a whole number from 0 to 18446744073709551615",
        ("i8" | "i16" | "i32" | "i64", _) => "a whole number",
        ("a boolean", _) => "true or false",
        ("a string", _) => "a text",
        ("a sequence", _) => "a list",
        ("a map", _) => "a table",
        (other, _) if other.starts_with("struct ") => "a table",
        (other, _) if other.starts_with("a nonzero u") => "a whole number of at least 1",
        (other, _) => other,
    }
    .into()
}

impl Misfit {
    fn at(mut self, at: &At) -> Self {
        self.at.get_or_insert_with(|| at.clone());
        self
    }

    /// The error of the value at `at`, which is `step` of a table or list.
    #[inline(never)]
    fn below(self, at: &At, step: &dyn fmt::Display) -> Self {
        let mut new = self.at(at);
        let step = step.to_string();
        // The text has no such key.
        if spanned_field(&step).is_none() {
            new.path.push(step);
        }
        new
    }

    /// The error in the text whose value stands at `root`.
    pub(super) fn located(self, root: &At) -> Error {
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

impl Node {
    /// The table from which `serde_spanned` reads the value and its place.
    fn spanned(&self) -> Self {
        let offset = || Is::Number(self.at.offset().unwrap_or(0).into());
        let [start, end, value] = SPANNED;
        let table = [(start, offset()), (end, offset()), (value, self.kind.clone())].map(|(name, kind)| {
            let value = Self { at: self.at.clone(), kind };
            Entry { key: name.into(), at: self.at.clone(), value }
        });
        Self { at: self.at.clone(), kind: Is::Table(table.into()) }
    }
}

/// Visitors are generic: every type that is read has its own copy of each function here that calls one. A type with fields
/// is read from a table only.
impl<'de> Deserializer<'de> for &Node {
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
        let spanned;
        let node = if is_spanned(name) {
            spanned = self.spanned();
            &spanned
        } else {
            self
        };
        match &node.kind {
            Is::Table(entries) => visitor.visit_map(Entries { rest: entries, value: None }),
            _ => Err(de::Error::custom(format_args!("{}, expected a table", node.shown()))),
        }
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

impl<'de> SeqAccess<'de> for Items<'_> {
    type Error = Misfit;
    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>, Misfit> {
        let Some(node) = self.all.get(self.next) else { return Ok(None) };
        self.next += 1;
        seed.deserialize(node).map(Some).map_err(|e: Misfit| e.below(&node.at, &(self.next - 1)))
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

impl<'de> MapAccess<'de> for Entries<'_> {
    type Error = Misfit;
    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Misfit> {
        let Some((entry, rest)) = self.rest.split_first() else { return Ok(None) };
        (self.rest, self.value) = (rest, Some(entry));
        let key = match spanned_field(&entry.key) {
            Some(field) => seed.deserialize(BorrowedStrDeserializer::new(field)),
            None => seed.deserialize(StrDeserializer::new(&entry.key)),
        };
        key.map(Some).map_err(|e: Misfit| e.at(&entry.at))
    }
    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Misfit> {
        let Some(entry) = self.value.take() else { return Err(de::Error::custom("a value without a key")) };
        seed.deserialize(&entry.value).map_err(|e: Misfit| e.below(&entry.value.at, &entry.key))
    }
}
