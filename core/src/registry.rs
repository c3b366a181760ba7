//! The stage types that a spec may name.
//!
//! Linked types register with [`stage_type!`](crate::stage_type), those of libraries loaded at run time with [`add`].
//! The registry reads and writes the stages of a spec. Editor schemas and the lists in error messages use it too.

use crate::error::{Error, Result};
use schemars::Schema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Value, json};
use std::any::Any;
use std::fmt;
use std::sync::{PoisonError, RwLock};

/// Defines the kinds: name in a spec and description.
macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident $name:literal,)*) => {
        /// Kinds of types in a spec: methods, and the stages that they consist of.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum Kind {
            $($(#[$doc])* $kind,)*
        }

        impl Kind {
            /// Every kind: methods, then their stages in order.
            pub const ALL: &'static [Self] = &[$(Self::$kind,)*];

            /// Its name in a spec.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)*
                }
            }
        }
    };
}

/// Makes a trait of settings that of a kind of stage: boxes of it are read from and written to specs.
#[macro_export]
macro_rules! settings_of {
    ($kind:ident, $spec:ident) => {
        impl $crate::registry::Settings for dyn $spec {
            const KIND: $crate::registry::Kind = $crate::registry::Kind::$kind;
        }

        impl $crate::registry::serde::Serialize for dyn $spec {
            fn serialize<S: $crate::registry::serde::Serializer>(
                &self,
                to: S,
            ) -> ::std::result::Result<S::Ok, S::Error> {
                $crate::registry::write(self, to)
            }
        }

        impl<'de> $crate::registry::serde::Deserialize<'de> for Box<dyn $spec> {
            fn deserialize<D: $crate::registry::serde::Deserializer<'de>>(
                from: D,
            ) -> ::std::result::Result<Self, D::Error> {
                $crate::registry::deserialize(from)
            }
        }
    };
}

kinds! {
    /// Scan to volume.
    Method "method",
    /// Observes training and acts on it.
    Callback "callback",
    /// Points to features.
    Encoder "encoder",
    /// Features to features.
    Normalizer "normalizer",
    /// Features to attenuation.
    Field "field",
    /// Rays to samples of a field.
    Projector "projector",
    /// Source of weights.
    Initializer "initializer",
    /// Predicted against measured values.
    Loss "loss",
    /// A penalty on a field, independent of the measurements.
    Prior "prior",
    /// Line integrals of voxels, for iterative methods.
    VoxelProjector "voxel-projector",
    /// Coefficients to voxels, for iterative methods.
    Basis "basis",
    /// Distance between computed and measured line integrals, for iterative methods.
    DataTerm "data-term",
    /// Penalty of coefficients with its proximal map, for iterative methods.
    Regularizer "regularizer",
}

/// A settings type that is registered by [`stage_type!`](crate::stage_type).
pub trait Registered {
    /// The value of `type` in specs.
    fn type_name(&self) -> &'static str;

    /// The other keys of its table.
    fn keys(&self) -> serde_json::Result<Value>;
}

/// The settings of one kind of stage.
pub trait Settings: Registered {
    /// The kind.
    const KIND: Kind;
}

/// Writes the table of a stage.
pub fn write<S: Serializer>(settings: &dyn Registered, to: S) -> Result<S::Ok, S::Error> {
    let mut table = settings.keys().map_err(serde::ser::Error::custom)?;
    if let Some(table) = table.as_object_mut() {
        table.insert("type".into(), settings.type_name().into());
    }
    table.serialize(to)
}

/// Reads settings from a table with a `type`, or from the name of a type.
pub fn read<T: Settings + ?Sized + 'static>(value: Value) -> Result<Box<T>, String> {
    let (found, keys) = resolved(T::KIND, value)?;
    let settings = match &found.origin {
        Origin::Linked { make, .. } => make().call(keys),
        Origin::Loaded { make, .. } => make.call(keys),
    };
    settings.unwrap_or_else(|| unreachable!("a type makes settings of its own kind"))
}

/// The type that a value names, and the other keys of its table.
fn resolved(kind: Kind, mut value: Value) -> Result<(&'static StageType, Value), String> {
    if value.is_string() {
        value = json!({ "type": value });
    }
    if !value.is_object() {
        return Err(format!("found {value}, expected a table or the name of a type ({kind})"));
    }
    let name = value.as_object_mut().and_then(|table| table.remove("type")).ok_or("missing field `type`")?;
    let found = name.as_str().and_then(|name| find(kind, name));
    let found = found.ok_or_else(|| format!("found type {name}, expected {}", names(kind).join(", ")))?;
    Ok((found, value))
}

/// Reads the settings of a type from the keys of its table. It reads tables only: what `serde` derives for settings in a
/// list is not compiled. A struct without names needs `#[serde(transparent)]`.
pub fn from_table<T: DeserializeOwned>(keys: Value) -> Result<T, String> {
    let Value::Object(keys) = keys else { return Err(format!("found {keys}, expected a table")) };
    T::deserialize(keys).map_err(|e| e.to_string())
}

/// Reads settings for `serde`.
pub fn deserialize<'de, T: Settings + ?Sized + 'static, D: Deserializer<'de>>(from: D) -> Result<Box<T>, D::Error> {
    read(Value::deserialize(from)?).map_err(serde::de::Error::custom)
}

impl Kind {
    /// Whether plugins can bring types of this kind.
    pub fn is_of_plugins(self) -> bool {
        !matches!(self, Self::Method | Self::Callback | Self::VoxelProjector)
    }

    /// The kind named `name`.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|k| k.name() == name)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// A type that a spec may name.
pub struct StageType {
    /// Its kind.
    pub kind: Kind,
    /// The value of `type`.
    pub name: &'static str,
    /// A one-line description.
    pub doc: &'static str,
    /// Its origin.
    pub origin: Origin,
}

/// Origin of a stage type.
pub enum Origin {
    /// Linked into the program.
    Linked {
        /// The package that defines it.
        package: &'static str,
        /// JSON Schema of its settings, without `type`.
        schema: fn() -> Schema,
        /// Example settings in JSON, without `type`, for tests.
        example: &'static str,
        /// Builds its settings.
        make: fn() -> Make,
    },
    /// From a library loaded at run time.
    Loaded {
        /// The library in readable form: name, version, file.
        owner: String,
        /// JSON Schema of its settings, without `type`.
        schema: Value,
        /// Builds its settings.
        make: Make,
    },
}

/// Builds a stage's settings from the keys of its table except `type`, or says what is wrong with them.
pub type MakeFn<T> = Box<dyn Fn(Value) -> Result<Box<T>, String> + Send + Sync>;

/// The [`MakeFn`] of one kind.
pub struct Make {
    kind: Kind,
    make: Box<dyn Any + Send + Sync>,
}

impl Make {
    /// That of the kind whose settings are `T`.
    pub fn new<T: Settings + ?Sized + 'static>(make: MakeFn<T>) -> Self {
        Self { kind: T::KIND, make: Box::new(make) }
    }

    /// Builds settings; `None` for those of another kind.
    pub fn call<T: Settings + ?Sized + 'static>(&self, keys: Value) -> Option<Result<Box<T>, String>> {
        self.make.downcast_ref::<MakeFn<T>>().map(|make| make(keys))
    }
}

impl StageType {
    /// A type of a loaded library `owner`, in readable form. Its texts live as long as the library: it is never unloaded.
    pub fn loaded(owner: &str, name: String, doc: String, schema: Value, make: Make) -> Self {
        let (kind, owner) = (make.kind, owner.into());
        let origin = Origin::Loaded { owner, schema, make };
        Self { kind, name: name.leak(), doc: doc.leak(), origin }
    }

    /// JSON Schema of its settings, without `type`.
    pub fn schema(&self) -> Value {
        match &self.origin {
            Origin::Linked { schema, .. } => schema().to_value(),
            Origin::Loaded { schema, .. } => schema.clone(),
        }
    }

    /// A spec table with example settings: those of its registration, or its defaults.
    pub fn example(&self) -> Value {
        let mut table = match &self.origin {
            Origin::Linked { example, .. } => serde_json::from_str(example).unwrap_or_else(|_| serde_json::json!({})),
            Origin::Loaded { .. } => serde_json::json!({}),
        };
        table["type"] = self.name.into();
        table
    }

    /// The package or library that provides it.
    pub fn owner(&self) -> String {
        match &self.origin {
            Origin::Linked { package, .. } => format!("conefield itself ({package})"),
            Origin::Loaded { owner, .. } => owner.clone(),
        }
    }
}

inventory::collect!(StageType);

/// Types of loaded libraries. Libraries are never unloaded, so neither are their types.
static LOADED: RwLock<Vec<&'static StageType>> = RwLock::new(vec![]);

/// Every registered type, by kind and name.
pub fn stage_types() -> Vec<&'static StageType> {
    let loaded = LOADED.read().unwrap_or_else(PoisonError::into_inner);
    let mut all: Vec<_> = inventory::iter::<StageType>.into_iter().chain(loaded.iter().copied()).collect();
    all.sort_unstable_by_key(|t| (t.kind, t.name));
    all
}

/// The type named `name`.
pub fn find(kind: Kind, name: &str) -> Option<&'static StageType> {
    stage_types().into_iter().find(|t| t.kind == kind && t.name == name)
}

/// The names registered for `kind`.
pub fn names(kind: Kind) -> Vec<&'static str> {
    stage_types().into_iter().filter(|t| t.kind == kind).map(|t| t.name).collect()
}

/// Adds the types of a library. Adds all or none: if a name is taken, the error names both owners.
pub fn add(types: Vec<StageType>) -> Result<()> {
    let mut loaded = LOADED.write().unwrap_or_else(PoisonError::into_inner);
    for (i, t) in types.iter().enumerate() {
        let same = |s: &&StageType| (s.kind, s.name) == (t.kind, t.name);
        let mut known = inventory::iter::<StageType>.into_iter().chain(loaded.iter().copied());
        if let Some(other) = known.find(same).or(types[..i].iter().find(same)) {
            let found = format!("a name that {} has", other.owner());
            return Err(Error::invalid(t.owner(), format!("{} type {:?}", t.kind, t.name), found, "a unique name"));
        }
    }
    loaded.extend(types.into_iter().map(|t| &*Box::leak(Box::new(t))));
    Ok(())
}

#[doc(hidden)]
pub use inventory;
#[doc(hidden)]
pub use schemars;
#[doc(hidden)]
pub use serde;
#[doc(hidden)]
pub use serde_json;

/// Registers a settings type, which implements the given trait of settings, under its name in specs. The type implements `JsonSchema`. If there are no default
/// settings, or they make a large stage, `example = "{ … }"` gives settings in JSON for the conformance kit.
#[macro_export]
macro_rules! stage_type {
    ($spec:ident, $name:literal, $settings:ty, $doc:literal $(,)?) => {
        $crate::stage_type!($spec, $name, $settings, $doc, example = "{}");
    };
    ($spec:ident, $name:literal, $settings:ty, $doc:literal, example = $example:literal $(,)?) => {
        impl $crate::registry::Registered for $settings {
            fn type_name(&self) -> &'static str {
                $name
            }

            fn keys(&self) -> $crate::registry::serde_json::Result<$crate::registry::serde_json::Value> {
                $crate::registry::serde_json::to_value(self)
            }
        }

        $crate::registry::inventory::submit! {
            $crate::registry::StageType {
                kind: <dyn $spec as $crate::registry::Settings>::KIND,
                name: $name,
                doc: $doc,
                origin: $crate::registry::Origin::Linked {
                    package: env!("CARGO_PKG_NAME"),
                    schema: || $crate::registry::schemars::schema_for!($settings),
                    example: $example,
                    make: || {
                        $crate::registry::Make::new::<dyn $spec>(Box::new(|keys| {
                            Ok(Box::new($crate::registry::from_table::<$settings>(keys)?))
                        }))
                    },
                },
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::ProjectorSpec;

    fn new(owner: &str, name: &str) -> StageType {
        let make: MakeFn<dyn ProjectorSpec> = Box::new(|_| Err("it makes nothing".into()));
        StageType::loaded(owner, name.into(), "for tests".into(), json!({}), Make::new(make))
    }

    #[test]
    fn a_name_that_is_taken_is_refused_with_both_owners_and_nothing_is_added() {
        add(vec![new("one 1.0 (one.so)", "test-one")]).unwrap();
        let refused =
            |owner: &str, names: [&str; 2]| add(names.map(|name| new(owner, name)).into()).unwrap_err().to_string();
        let e = refused("two 1.0 (two.so)", ["test-two", "test-one"]);
        assert!(e.contains("one 1.0 (one.so)") && e.contains("two 1.0 (two.so)") && e.contains("test-one"), "{e}");
        assert!(find(Kind::Projector, "test-two").is_none());
        assert!(find(Kind::Projector, "test-one").is_some_and(|t| t.owner() == "one 1.0 (one.so)"));
        let e = refused("three", ["test-twin"; 2]);
        assert!(e.contains("test-twin"), "{e}");
    }
}
