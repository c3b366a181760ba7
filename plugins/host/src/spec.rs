//! Types of a library as settings in a spec.

use crate::library::{Library, Type};
use crate::stage::basis::BasisStage;
use crate::stage::data_term::DataTermStage;
use crate::stage::loss::LossStage;
use crate::stage::map::MapStage;
use crate::stage::prior::PriorStage;
use crate::stage::projector::ProjectorStage;
use crate::stage::regularizer::RegularizerStage;
use crate::stage::{build, initializer};
use conefield_core::prelude::*;
use conefield_core::registry::{self, Kind, Make, Registered, StageType};
use serde_json::Value;
use std::sync::Arc;

/// Registers every type of `library`: all of them, or none if a name is taken.
pub fn register(library: &Library) -> Result<()> {
    let new = |t: &Arc<Type>| {
        let (name, doc, schema) = (t.name.clone(), t.doc.clone(), t.schema.clone());
        Ok(StageType::loaded(&library.owner(), name, doc, schema, make(t.clone())?))
    };
    registry::add(library.types.iter().map(new).collect::<Result<_>>()?)
}

/// Settings of a library's stage, with all defaults written out.
struct Loaded {
    ty: Arc<Type>,
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

/// Implements the settings traits of all kinds.
macro_rules! kinds {
    ($($kind:ident $spec:ident ($self:ident $(, $argument:ident: $type:ty)?) -> $stage:ty { $build:expr })*) => {
        fn make(ty: Arc<Type>) -> Result<Make> {
            let name: &'static str = ty.name.clone().leak();
            let kind = ty.kind;
            let settings =
                move |written: Value| Loaded { settings: with_defaults(&ty.schema, written), name, ty: ty.clone() };
            Ok(match kind {
                $(Kind::$kind => Make::new::<dyn $spec>(Box::new(move |v| Ok(Box::new(settings(v))))),)*
                other => return Err(Error::unsupported(name, format!("a {other} cannot come from a plugin"))),
            })
        }

        $(impl $spec for Loaded {
            fn build(&$self $(, $argument: $type)?) -> Result<Box<$stage>> {
                Ok(Box::new($build?))
            }
        })*
    };
}

kinds! {
    Encoder EncoderSpec(self) -> dyn Encoder { self.map(3) }
    Normalizer NormalizerSpec(self, width: usize) -> dyn Normalizer { self.map(width) }
    Field FieldSpec(self, width: usize) -> dyn Field { self.map(width) }
    Projector ProjectorSpec(self) -> dyn Projector { build(&self.ty, &self.settings, 0, ProjectorStage::tried) }
    Loss LossSpec(self) -> dyn Loss { build(&self.ty, &self.settings, 0, LossStage::tried) }
    Prior PriorSpec(self) -> dyn Prior { build(&self.ty, &self.settings, 0, PriorStage::tried) }
    Regularizer RegularizerSpec(self) -> dyn Regularizer { build(&self.ty, &self.settings, 0, RegularizerStage::tried) }
    DataTerm DataTermSpec(self) -> dyn DataTerm { build(&self.ty, &self.settings, 0, DataTermStage::tried) }
    Basis BasisSpec(self) -> dyn Basis { build(&self.ty, &self.settings, 0, BasisStage::tried) }
    Initializer InitializerSpec(self, weights: &dyn Fn(&str) -> Result<Weights>) -> dyn Initializer {
        initializer::build(&self.ty, &self.settings, weights)
    }
}

impl Loaded {
    fn map(&self, width: usize) -> Result<MapStage> {
        build(&self.ty, &self.settings, width, move |handle| MapStage::tried(handle, width))
    }
}
