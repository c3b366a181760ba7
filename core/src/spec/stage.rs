//! Stages as a spec writes them: a table with a `type`, or the name of a type whose settings all have their default.
//!
//! `typetag` reads the types that are linked in. Those of loaded libraries it cannot see, as every library has statics
//! of its own; [`needed`] and [`list`] look their names up at run time.

use super::schema::NESTED;
use crate::method::Method;
use crate::registry::{Kind, Origin, Settings, find};
use schemars::{Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use serde::de::{DeserializeOwned, Deserializer, Error};
use serde_json::{Value, json};

/// Libraries bring stages, no methods.
impl Settings for dyn Method {
    const KIND: Kind = Kind::Method;
}

/// The settings that `value` says.
pub fn read<T: Settings + ?Sized>(mut value: Value) -> Result<Box<T>, String>
where
    Box<T>: DeserializeOwned,
{
    if value.is_string() {
        value = json!({ "type": value });
    }
    let found = value["type"].as_str().and_then(|name| find(T::KIND, name));
    if let Some(Origin::Loaded { make, .. }) = found.map(|t| &t.origin)
        && let Some(make) = T::made_by(make)
    {
        value.as_object_mut().and_then(|v| v.remove("type"));
        return make(value).map_err(|e| e.to_string());
    }
    serde_path_to_error::deserialize(value).map_err(|e| match e.path().to_string().as_str() {
        "." => e.inner().to_string(),
        path => format!("{path}: {}", e.inner()),
    })
}

/// For `#[serde(deserialize_with = …)]`: a stage.
pub fn needed<'de, T: Settings + ?Sized, D: Deserializer<'de>>(from: D) -> Result<Box<T>, D::Error>
where
    Box<T>: DeserializeOwned,
{
    read(Value::deserialize(from)?).map_err(D::Error::custom)
}

/// For `#[serde(deserialize_with = …)]`: several stages.
pub fn list<'de, T: Settings + ?Sized, D: Deserializer<'de>>(from: D) -> Result<Vec<Box<T>>, D::Error>
where
    Box<T>: DeserializeOwned,
{
    let all = Vec::<Value>::deserialize(from)?.into_iter().enumerate();
    all.map(|(i, v)| read(v).map_err(|e| D::Error::custom(format!("{i}: {e}")))).collect()
}

/// For `#[schemars(schema_with = …)]`: the schema of a setting that is a stage.
pub fn schema<T: Settings + ?Sized>(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ NESTED: T::KIND.name() })
}

/// For `#[schemars(schema_with = …)]`: the schema of a setting that is a list of stages.
pub fn schema_of_list<T: Settings + ?Sized>(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "array", "items": { NESTED: T::KIND.name() } })
}
