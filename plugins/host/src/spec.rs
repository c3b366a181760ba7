//! Types of a library as settings in a spec.

use crate::library::{Handle, Library, Type};
use crate::{stage, trial};
use conefield_core::error::Result;
use conefield_core::registry::{self, Kind, Make, Registered, StageType};
use serde_json::Value;
use std::sync::Arc;

/// Registers every type of `library`: all of them, or none if a name is taken.
pub fn register(library: &Library) -> Result<()> {
    let new = |t: &Arc<Type>| {
        let (name, doc, schema) = (t.name.clone(), t.doc.clone(), t.schema.clone());
        StageType::loaded(&library.owner(), name, doc, schema, make(t.clone()))
    };
    registry::add(library.types.iter().map(new).collect())
}

/// Settings of a library's stage, with all defaults written out.
pub(crate) struct Loaded {
    pub ty: Arc<Type>,
    /// The type's name, with static lifetime.
    name: &'static str,
    settings: Value,
}

/// `written`, completed with the defaults of `schema`.
pub fn with_defaults(schema: &Value, mut written: Value) -> Value {
    let properties = schema["properties"].as_object().into_iter().flatten();
    if let Some(keys) = written.as_object_mut() {
        for (key, of) in properties {
            if let Some(default) = of.get("default")
                && !keys.contains_key(key)
            {
                keys.insert(key.clone(), default.clone());
            }
        }
    }
    written
}

impl Registered for Loaded {
    fn type_name(&self) -> &'static str {
        self.name
    }

    fn keys(&self) -> serde_json::Result<Value> {
        Ok(self.settings.clone())
    }
}

/// Makes settings from what a spec says.
pub(crate) type Written = Box<dyn Fn(Value) -> Loaded + Send + Sync>;

impl Loaded {
    /// Creates and tries a stage for `width` input channels, both within the time limit.
    pub(crate) fn build<T: Send + 'static>(
        &self,
        width: usize,
        tried: impl FnOnce(Handle) -> Result<T> + Send + 'static,
    ) -> Result<Box<T>> {
        let (own, settings) = (self.ty.clone(), self.settings.clone());
        trial::timed(&self.ty, move || tried(own.create(&settings, width)?)).map(Box::new)
    }
}

/// Implements the settings traits of kinds, each with the function that makes settings for the registry.
macro_rules! settings {
    ($($name:ident $spec:ident ($self:ident $(, $argument:ident: $type:ty)?) -> $stage:ty { $build:expr })*) => {$(
        pub(crate) fn $name(of: crate::spec::Written) -> conefield_core::registry::Make {
            conefield_core::registry::Make::new::<dyn $spec>(Box::new(move |written| Ok(Box::new(of(written)))))
        }

        impl $spec for crate::spec::Loaded {
            fn build(&$self $(, $argument: $type)?) -> Result<Box<$stage>> {
                Ok($build?)
            }
        }
    )*};
}
pub(crate) use settings;

/// What makes settings of type `ty` for the registry.
fn make(ty: Arc<Type>) -> Make {
    let (kind, name): (_, &'static str) = (ty.kind, ty.name.clone().leak());
    let settings = move |written| Loaded { settings: with_defaults(&ty.schema, written), name, ty: ty.clone() };
    macro_rules! made {
        ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {
            match kind {
                $($(Kind::$kind => stage::$field::$name(Box::new(settings)),)+)*
                other => unreachable!("a {other} cannot come from a plugin"),
            }
        };
    }
    conefield_plugin_abi::kinds! { made }
}
