//! A library's types as settings that a spec may hold.

use crate::library::{Library, Type};
use crate::stage::{initializer, loss, map, prior, projector};
use conefield_core::arena::Weights;
use conefield_core::error::Result;
use conefield_core::loss::Loss;
use conefield_core::prior::Prior;
use conefield_core::registry::{self, Kind, Make, NewType};
use conefield_core::settings::{
    EncoderSpec, FieldSpec, Initializer, InitializerSpec, LossSpec, NormalizerSpec, PriorSpec, ProjectorSpec,
};
use conefield_core::stage::{Encoder, Field, Normalizer, Projector};
use serde::{Serialize, Serializer};
use serde_json::Value;
use std::sync::Arc;

/// Registers every type of `library`: all of them, or none if a name is taken.
pub fn register(library: &Library) -> Result<()> {
    let new = |t: &Arc<Type>| NewType {
        name: t.name.clone(),
        doc: t.doc.clone(),
        schema: t.schema.clone(),
        make: make(t.clone()),
    };
    registry::add(&library.owner(), library.types.iter().map(new).collect())
}

/// Settings of a stage of a library, with every default written.
struct Loaded {
    ty: Arc<Type>,
    /// The type's name, for as long as the program runs.
    name: &'static str,
    settings: Value,
}

fn make(ty: Arc<Type>) -> Make {
    let name: &'static str = ty.name.clone().leak();
    let kind = ty.kind;
    let settings = move |written: Value| Loaded { settings: with_defaults(&ty.schema, written), name, ty: ty.clone() };
    match kind {
        Kind::Encoder => Make::Encoder(Box::new(move |v| Ok(Box::new(settings(v))))),
        Kind::Normalizer => Make::Normalizer(Box::new(move |v| Ok(Box::new(settings(v))))),
        Kind::Field => Make::Field(Box::new(move |v| Ok(Box::new(settings(v))))),
        Kind::Projector => Make::Projector(Box::new(move |v| Ok(Box::new(settings(v))))),
        Kind::Loss => Make::Loss(Box::new(move |v| Ok(Box::new(settings(v))))),
        Kind::Prior => Make::Prior(Box::new(move |v| Ok(Box::new(settings(v))))),
        // A library's table has stages of these seven kinds.
        _ => Make::Initializer(Box::new(move |v| Ok(Box::new(settings(v))))),
    }
}

/// `written` with the defaults of `schema` for what it leaves out.
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

impl Serialize for Loaded {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.settings.serialize(serializer)
    }
}

// `#[typetag::serde]` gives a type one name; here it is the loaded type's. Its two methods are therefore written out. To
// read settings back, the registry is asked (`conefield_core::spec::stage`).
macro_rules! named {
    () => {
        fn typetag_name(&self) -> &'static str {
            self.name
        }

        fn typetag_deserialize(&self) {}
    };
}

impl EncoderSpec for Loaded {
    fn build(&self) -> Result<Box<dyn Encoder>> {
        Ok(Box::new(map::build(&self.ty, &self.settings, 3)?))
    }

    named!();
}

impl NormalizerSpec for Loaded {
    fn build(&self, width: usize) -> Result<Box<dyn Normalizer>> {
        Ok(Box::new(map::build(&self.ty, &self.settings, width)?))
    }

    named!();
}

impl FieldSpec for Loaded {
    fn build(&self, width: usize) -> Result<Box<dyn Field>> {
        Ok(Box::new(map::build(&self.ty, &self.settings, width)?))
    }

    named!();
}

impl ProjectorSpec for Loaded {
    fn build(&self) -> Result<Box<dyn Projector>> {
        Ok(Box::new(projector::build(&self.ty, &self.settings)?))
    }

    named!();
}

impl LossSpec for Loaded {
    fn build(&self) -> Result<Box<dyn Loss>> {
        Ok(Box::new(loss::build(&self.ty, &self.settings)?))
    }

    named!();
}

impl PriorSpec for Loaded {
    fn build(&self) -> Result<Box<dyn Prior>> {
        Ok(Box::new(prior::build(&self.ty, &self.settings)?))
    }

    named!();
}

impl InitializerSpec for Loaded {
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        Ok(Box::new(initializer::build(&self.ty, &self.settings, weights)?))
    }

    named!();
}
