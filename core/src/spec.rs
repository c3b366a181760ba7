//! Specs, in TOML or JSON. A spec names a method by its `type`; the other keys are the method's settings.
//!
//! Every stage is a table with a `type` and the settings of that type. A stage with default settings may be written as
//! its type name. [`crate::registry`] lists the types; [`load`] reads files and locates mistakes.

pub mod check;
pub mod load;
pub mod marks;
mod one_of;
pub mod schema;
pub mod stage;

use crate::method::Method;
use schemars::JsonSchema;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value};

/// A method with its name and description.
pub struct Spec {
    /// Short name, shown in tables.
    pub name: String,
    /// Its purpose, in a sentence.
    pub description: String,
    /// Libraries of stages used by the spec.
    pub plugins: PluginPaths,
    /// The method.
    pub method: Box<dyn Method>,
}

/// The keys of a spec besides its method.
#[derive(Default, Serialize, Deserialize)]
#[serde(default)]
struct Label {
    name: String,
    description: String,
    #[serde(skip_serializing_if = "PluginPaths::is_empty")]
    plugins: PluginPaths,
}

/// Keys of a spec that do not belong to its method.
const LABEL: [&str; 3] = ["name", "description", "plugins"];

impl Serialize for Spec {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        use serde::ser::Error;
        let Self { name, description, plugins, method } = self;
        let label = Label { name: name.clone(), description: description.clone(), plugins: plugins.clone() };
        let mut all = Map::new();
        for part in [serde_json::to_value(label), serde_json::to_value(method)] {
            if let Value::Object(map) = part.map_err(Error::custom)? {
                all.extend(map);
            }
        }
        all.serialize(to)
    }
}

impl<'de> Deserialize<'de> for Spec {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let mut method = Map::<String, Value>::deserialize(from)?;
        let mut label = Map::new();
        label.extend(LABEL.iter().filter_map(|key| method.remove_entry(*key)));
        let Label { name, description, plugins } =
            crate::registry::from_table(label.into()).map_err(D::Error::custom)?;
        let method = crate::registry::read(Value::Object(method)).map_err(D::Error::custom)?;
        Ok(Self { name, description, plugins, method })
    }
}

/// Libraries of stages named by a spec. A spec alone never loads a library: the user must allow it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PluginPaths {
    /// Library files, relative to the spec file. Loaded only if the user allows it with `--allow-plugins-from-spec`, or
    /// names the same file with `--plugin`.
    pub paths: Vec<String>,
}

impl PluginPaths {
    /// Whether no library is named.
    pub fn is_empty(&self) -> bool {
        self.paths.is_empty()
    }
}
