//! Stages as written in a spec: a table with a `type`, or the name of a type with defaults for all its settings.
//!
//! `typetag` reads linked types. It cannot see those of loaded libraries, as every library has its own statics;
//! [`needed`] and [`list`] look their names up at run time.

use super::schema::NESTED;
use crate::method::Method;
use crate::registry::{Kind, Origin, Settings, find};
use schemars::{Schema, SchemaGenerator, json_schema};
use serde::Deserialize;
use serde::de::{DeserializeOwned, Deserializer, Error};
use serde_json::{Value, json};

/// Libraries cannot provide methods.
impl Settings for dyn Method {
    const KIND: Kind = Kind::Method;
}

/// Reads the settings in `value`.
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

/// For `#[serde(deserialize_with = …)]`: one stage.
pub fn needed<'de, T: Settings + ?Sized, D: Deserializer<'de>>(from: D) -> Result<Box<T>, D::Error>
where
    Box<T>: DeserializeOwned,
{
    read(Value::deserialize(from)?).map_err(D::Error::custom)
}

/// For `#[serde(deserialize_with = …)]`: a list of stages.
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
