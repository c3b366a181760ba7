//! Stages as written in a spec: a table with a `type`, or the name of a type with defaults for all its settings.
//! Boxes of settings read themselves ([`settings_of!`](crate::settings_of)).

use super::schema::NESTED;
use crate::registry::{Settings, read};
use schemars::{Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use serde::de::{Deserializer, Error};
use serde_json::Value;

/// For `#[serde(deserialize_with = …)]`: a list of stages.
pub fn list<'de, T: Settings + ?Sized + 'static, D: Deserializer<'de>>(from: D) -> Result<Vec<Box<T>>, D::Error> {
    let all = values(from)?.into_iter().enumerate();
    all.map(|(i, v)| read(v).map_err(|e| D::Error::custom(format!("{i}: {e}")))).collect()
}

/// Compiled once, whatever the kind of the stages.
#[inline(never)]
fn values<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Value>, D::Error> {
    Vec::deserialize(from)
}

/// For `#[schemars(schema_with = …)]`: the schema of a setting that is a stage.
pub fn schema<T: Settings + ?Sized>(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ NESTED: T::KIND.name() })
}

/// For `#[schemars(schema_with = …)]`: the schema of a setting that is a list of stages.
pub fn schema_of_list<T: Settings + ?Sized>(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { NESTED: T::KIND.name() } })
}
