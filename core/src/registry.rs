//! The stage types that a spec may name.
//!
//! Built-in types register themselves with [`stage_type!`](crate::stage_type) beside their `typetag` implementation;
//! editors' schemas and the lists in error messages come from here.

use schemars::Schema;

/// The kinds of stage that a spec puts together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// Points to features.
    Encoder,
    /// Features to features.
    Normalizer,
    /// Features to attenuation.
    Field,
    /// Rays to samples.
    Projector,
    /// Where weights come from.
    Initializer,
    /// Scan to volume.
    Solver,
}

/// A type that a spec may name.
pub struct StageType {
    /// What it is.
    pub kind: Kind,
    /// The value of `type`.
    pub name: &'static str,
    /// One line for people.
    pub doc: &'static str,
    /// JSON Schema of its settings, without `type`.
    pub schema: fn() -> Schema,
}

inventory::collect!(StageType);

/// Every registered type, by kind and name.
pub fn stage_types() -> Vec<&'static StageType> {
    let mut all: Vec<_> = inventory::iter::<StageType>.into_iter().collect();
    all.sort_by_key(|t| (t.kind, t.name));
    all
}

/// The names registered for `kind`.
pub fn names(kind: Kind) -> Vec<&'static str> {
    stage_types().into_iter().filter(|t| t.kind == kind).map(|t| t.name).collect()
}

#[doc(hidden)]
pub use inventory;
#[doc(hidden)]
pub use schemars;

/// Registers a settings type under the name that specs use. The type implements `JsonSchema`.
#[macro_export]
macro_rules! stage_type {
    ($kind:ident, $name:literal, $settings:ty, $doc:literal) => {
        $crate::registry::inventory::submit! {
            $crate::registry::StageType {
                kind: $crate::registry::Kind::$kind,
                name: $name,
                doc: $doc,
                schema: || $crate::registry::schemars::schema_for!($settings),
            }
        }
    };
}
