//! The stage types that a spec may name.
//!
//! Built-in types register with [`stage_type!`](crate::stage_type) beside their `typetag` implementation; types of
//! libraries loaded at run time are registered by [`add`]. Editor schemas and the lists in error messages use this
//! registry.

use crate::basis::BasisSpec;
use crate::data_term::DataTermSpec;
use crate::error::{Error, Result};
use crate::regularizer::RegularizerSpec;
use crate::settings::{EncoderSpec, FieldSpec, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec};
use crate::voxel::VoxelProjectorSpec;
use schemars::Schema;
use serde_json::Value;
use std::fmt;
use std::sync::{PoisonError, RwLock};

/// Defines the kinds: name in a spec, settings trait and description.
macro_rules! kinds {
    (
        linked { $($(#[$linked_doc:meta])* $linked:ident $linked_name:literal,)* }
        loadable { $($(#[$doc:meta])* $kind:ident $name:literal $spec:ident,)* }
    ) => {
        /// Kinds of types in a spec: methods, and the stages that they consist of.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
        #[serde(rename_all = "kebab-case")]
        pub enum Kind {
            $($(#[$linked_doc])* $linked,)*
            $($(#[$doc])* $kind,)*
        }

        impl Kind {
            /// Every kind: methods, then their stages in order.
            pub const ALL: &'static [Self] = &[$(Self::$linked,)* $(Self::$kind,)*];

            /// Its name in a spec.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$linked => $linked_name,)*
                    $(Self::$kind => $name,)*
                }
            }
        }

        /// The [`MakeFn`] of each kind that a library can provide.
        pub enum Make {
            $($(#[$doc])* $kind(MakeFn<dyn $spec>),)*
        }

        impl Make {
            fn kind(&self) -> Kind {
                match self {
                    $(Self::$kind(_) => Kind::$kind,)*
                }
            }
        }

        $(impl Settings for dyn $spec {
            const KIND: Kind = Kind::$kind;

            fn made_by(make: &Make) -> Option<&MakeFn<Self>> {
                match make {
                    Make::$kind(make) => Some(make),
                    _ => None,
                }
            }
        })*
    };
}

kinds! {
    linked {
        /// Scan to volume.
        Method "method",
        /// Observes training and acts on it.
        Callback "callback",
    }
    loadable {
        /// Points to features.
        Encoder "encoder" EncoderSpec,
        /// Features to features.
        Normalizer "normalizer" NormalizerSpec,
        /// Features to attenuation.
        Field "field" FieldSpec,
        /// Rays to samples of a field.
        Projector "projector" ProjectorSpec,
        /// Source of weights.
        Initializer "initializer" InitializerSpec,
        /// Predicted against measured values.
        Loss "loss" LossSpec,
        /// A penalty on a field, independent of the measurements.
        Prior "prior" PriorSpec,
        /// Line integrals of voxels, for iterative methods.
        VoxelProjector "voxel-projector" VoxelProjectorSpec,
        /// Coefficients to voxels, for iterative methods.
        Basis "basis" BasisSpec,
        /// Distance between computed and measured line integrals, for iterative methods.
        DataTerm "data-term" DataTermSpec,
        /// Penalty of coefficients with its proximal map, for iterative methods.
        Regularizer "regularizer" RegularizerSpec,
    }
}

/// The settings of one kind of stage.
pub trait Settings {
    /// The kind.
    const KIND: Kind;

    /// The constructor of a library's type of this kind; `None` for kinds that libraries cannot provide.
    fn made_by(make: &Make) -> Option<&MakeFn<Self>> {
        let _ = make;
        None
    }
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
    /// Linked into the program; known to `typetag`.
    Linked {
        /// The package that defines it.
        package: &'static str,
        /// JSON Schema of its settings, without `type`.
        schema: fn() -> Schema,
        /// Example settings in JSON, without `type`, for tests.
        example: &'static str,
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

/// Builds a stage's settings from the keys of a spec except `type`.
pub type MakeFn<T> = Box<dyn Fn(Value) -> Result<Box<T>> + Send + Sync>;

impl StageType {
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
    all.sort_by_key(|t| (t.kind, t.name));
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

/// Adds the types of one library `owner` (in readable form). Adds all or none: if a name is taken, the error names both
/// owners.
pub fn add(owner: &str, types: Vec<NewType>) -> Result<()> {
    let mut loaded = LOADED.write().unwrap_or_else(PoisonError::into_inner);
    let mut fresh: Vec<&NewType> = vec![];
    for t in &types {
        let kind = t.make.kind();
        let taken = inventory::iter::<StageType>.into_iter().chain(loaded.iter().copied());
        let taken = taken.filter(|s| s.kind == kind && s.name == t.name).map(StageType::owner).next();
        let twin = fresh.iter().any(|s| s.make.kind() == kind && s.name == t.name).then(|| owner.to_string());
        if let Some(other) = taken.or(twin) {
            let found = format!("a name that {other} has");
            return Err(Error::invalid(owner, format!("{kind} type {:?}", t.name), found, "a unique name"));
        }
        fresh.push(t);
    }
    loaded.extend(types.into_iter().map(|t| &*Box::leak(Box::new(t.owned_by(owner)))));
    Ok(())
}

/// A type to [`add`].
pub struct NewType {
    /// The value of `type`.
    pub name: String,
    /// A one-line description.
    pub doc: String,
    /// JSON Schema of its settings, without `type`.
    pub schema: Value,
    /// Builds its settings.
    pub make: Make,
}

impl NewType {
    fn owned_by(self, owner: &str) -> StageType {
        let Self { name, doc, schema, make } = self;
        StageType {
            kind: make.kind(),
            name: name.leak(),
            doc: doc.leak(),
            origin: Origin::Loaded { owner: owner.into(), schema, make },
        }
    }
}

#[doc(hidden)]
pub use inventory;
#[doc(hidden)]
pub use schemars;

/// Registers a settings type under its name in specs. The type implements `JsonSchema`. If there are no default
/// settings, or they make a large stage, `example = "{ … }"` gives settings in JSON for the conformance kit.
#[macro_export]
macro_rules! stage_type {
    ($kind:ident, $name:literal, $settings:ty, $doc:literal $(,)?) => {
        $crate::stage_type!($kind, $name, $settings, $doc, example = "{}");
    };
    ($kind:ident, $name:literal, $settings:ty, $doc:literal, example = $example:literal $(,)?) => {
        $crate::registry::inventory::submit! {
            $crate::registry::StageType {
                kind: $crate::registry::Kind::$kind,
                name: $name,
                doc: $doc,
                origin: $crate::registry::Origin::Linked {
                    package: env!("CARGO_PKG_NAME"),
                    schema: || $crate::registry::schemars::schema_for!($settings),
                    example: $example,
                },
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    fn new(name: &str) -> NewType {
        let make: MakeFn<dyn ProjectorSpec> = Box::new(|_| Err(Error::unsupported("a test", "it makes nothing")));
        let schema = serde_json::json!({});
        NewType { name: name.into(), doc: "for tests".into(), schema, make: Make::Projector(make) }
    }

    #[test]
    fn a_name_that_is_taken_is_refused_with_both_owners_and_nothing_is_added() {
        add("one 1.0 (one.so)", vec![new("test-one")]).unwrap();
        let e = add("two 1.0 (two.so)", vec![new("test-two"), new("test-one")]).unwrap_err().to_string();
        assert!(e.contains("one 1.0 (one.so)") && e.contains("two 1.0 (two.so)") && e.contains("test-one"), "{e}");
        assert!(find(Kind::Projector, "test-two").is_none());
        assert!(find(Kind::Projector, "test-one").is_some_and(|t| t.owner() == "one 1.0 (one.so)"));
        let e = add("three", vec![new("test-twin"), new("test-twin")]).unwrap_err().to_string();
        assert!(e.contains("test-twin"), "{e}");
    }
}
