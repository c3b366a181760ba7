//! Stages as a spec writes them: a table with a `type`.
//!
//! `typetag` reads the types that are linked in. Those of loaded libraries it cannot see, as every library has statics
//! of its own; [`one`] and [`list`] look their names up at run time.

use super::{EncoderSpec, FieldSpec, InitializerSpec, NormalizerSpec, ProjectorSpec, SolverSpec};
use crate::basis::BasisSpec;
use crate::data_term::DataTermSpec;
use crate::registry::{Kind, Make, MakeFn, Origin, find};
use crate::regularizer::RegularizerSpec;
use crate::voxel::VoxelProjectorSpec;
use serde::Deserialize;
use serde::de::{DeserializeOwned, Deserializer, Error};
use serde_json::Value;

/// The settings of one kind of stage.
pub trait Settings {
    /// Which.
    const KIND: Kind;

    /// How a loaded type of this kind is made.
    fn made_by(make: &Make) -> Option<&MakeFn<Self>>;
}

macro_rules! settings {
    ($($kind:ident $spec:ident)*) => {$(
        impl Settings for dyn $spec {
            const KIND: Kind = Kind::$kind;

            fn made_by(make: &Make) -> Option<&MakeFn<Self>> {
                match make {
                    Make::$kind(make) => Some(make),
                    _ => None,
                }
            }
        }
    )*};
}

settings! {
    Encoder EncoderSpec
    Normalizer NormalizerSpec
    Field FieldSpec
    Projector ProjectorSpec
    Initializer InitializerSpec
    Solver SolverSpec
    VoxelProjector VoxelProjectorSpec
    Basis BasisSpec
    DataTerm DataTermSpec
    Regularizer RegularizerSpec
}

/// The settings that `value` says.
pub fn read<T: Settings + ?Sized>(mut value: Value) -> Result<Box<T>, String>
where
    Box<T>: DeserializeOwned,
{
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

/// For `#[serde(deserialize_with = …)]`: a stage that may be left out.
pub fn one<'de, T: Settings + ?Sized, D: Deserializer<'de>>(from: D) -> Result<Option<Box<T>>, D::Error>
where
    Box<T>: DeserializeOwned,
{
    let value = Option::<Value>::deserialize(from)?.filter(|v| !v.is_null());
    value.map(read).transpose().map_err(D::Error::custom)
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
