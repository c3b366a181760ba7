//! JSON Schemas: of one stage type, and of a whole spec for editors.

use super::{PluginPaths, Precision, SceneSettings};
use crate::registry::{Kind, StageType, stage_types};
use serde_json::{Map, Value, json};

/// Marks, in a settings schema, a value that is itself a stage: `#[schemars(extend("x-stage" = "encoder"))]` or a
/// `schema_with` function that returns `{"x-stage": "encoder"}`.
pub const NESTED: &str = "x-stage";

/// Marks, in a settings schema, groups of keys of which a table has only one:
/// `#[schemars(extend("x-one-of" = [["steps", "seconds"]]))]`.
pub const ONE_OF: &str = "x-one-of";

/// The keys of a spec that hold a stage, with the kind that stands there. `normalizers` is a list.
pub(super) const STAGES: [(&str, Kind); 6] = [
    ("encoder", Kind::Encoder),
    ("normalizers", Kind::Normalizer),
    ("field", Kind::Field),
    ("projector", Kind::Projector),
    ("initializer", Kind::Initializer),
    ("solver", Kind::Solver),
];

/// The settings schema of a stage type, with its `type` key.
pub(super) fn of_type(stage: &StageType) -> Value {
    let mut schema = stage.schema();
    if let Value::Object(s) = &mut schema {
        s.remove("$schema");
        let properties = s.entry("properties").or_insert_with(|| json!({}));
        if let Value::Object(p) = properties {
            p.insert("type".into(), json!({ "const": stage.name, "description": stage.doc }));
        }
    }
    schema
}

/// The keys of a spec that hold settings of no stage, with their schemas.
pub(super) fn tables() -> [(&'static str, Value); 3] {
    let of = |schema: schemars::Schema| {
        let mut schema = schema.to_value();
        if let Value::Object(s) = &mut schema {
            s.remove("$schema");
        }
        schema
    };
    [
        ("scene", of(schemars::schema_for!(SceneSettings))),
        ("plugins", of(schemars::schema_for!(PluginPaths))),
        ("precision", of(schemars::schema_for!(Precision))),
    ]
}

/// The JSON Schema of a spec file, for editors: every registered stage type with its settings.
pub fn pipeline() -> Value {
    let mut defs = Map::new();
    for (name, schema) in tables() {
        defs.insert(name.into(), relocated(schema, name));
    }
    for (_, kind) in STAGES {
        let mut any = vec![];
        for t in stage_types().into_iter().filter(|t| t.kind == kind) {
            let name = format!("{}.{}", kind.name(), t.name);
            defs.insert(name.clone(), relocated(of_type(t), &name));
            any.push(json!({ "$ref": format!("#/$defs/{name}") }));
        }
        defs.insert(
            kind.name().into(),
            json!({ "type": "object", "properties": { "type": { "type": "string" } }, "anyOf": any }),
        );
    }
    let stage = |kind: &str, doc: &str| json!({ "$ref": format!("#/$defs/{kind}"), "description": doc });
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "conefield pipeline",
        "description": "A reconstruction pipeline. Every stage is a table with a `type`; its other keys are that type's settings. A file that `extends` another may leave out what it does not change.",
        "type": "object",
        "properties": {
            "$schema": { "type": "string", "description": "Where this schema is." },
            "extends": { "type": "string", "description": "A shipped spec, or a file relative to this one, that this one changes." },
            "name": { "type": "string", "description": "Short name, shown in tables." },
            "description": { "type": "string", "description": "What it is for, in a sentence." },
            "scene": stage("scene", "How the scan is mapped to what stages see."),
            "plugins": stage("plugins", "Libraries with stages that the spec names."),
            "precision": stage("precision", "In which precision a field computes."),
            "encoder": stage("encoder", "Points to features."),
            "normalizers": {
                "description": "Features to features, in order.",
                "type": "array",
                "items": { "$ref": "#/$defs/normalizer" },
            },
            "field": stage("field", "Features to attenuation."),
            "projector": stage("projector", "Rays to samples."),
            "initializer": stage("initializer", "Where weights come from."),
            "solver": stage("solver", "Scan to volume."),
        },
        "additionalProperties": false,
        "anyOf": [{ "required": ["extends"] }, { "required": ["solver"] }],
        "$defs": defs,
    })
}

/// `schema` with its references changed for its place under `#/$defs/name`, and nested stages referring to theirs.
fn relocated(mut schema: Value, name: &str) -> Value {
    fn walk(value: &mut Value, name: &str) {
        match value {
            Value::Object(map) => {
                if let Some(Value::String(kind)) = map.remove(NESTED) {
                    map.insert("$ref".into(), json!(format!("#/$defs/{kind}")));
                    return;
                }
                if let Some(Value::String(r)) = map.get_mut("$ref") {
                    *r = r.replacen("#/$defs/", &format!("#/$defs/{name}/$defs/"), 1);
                }
                map.values_mut().for_each(|v| walk(v, name));
            }
            Value::Array(items) => items.iter_mut().for_each(|v| walk(v, name)),
            _ => {}
        }
    }
    walk(&mut schema, name);
    schema
}
