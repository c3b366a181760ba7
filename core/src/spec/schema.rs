//! JSON Schemas: of one stage type, and of a whole spec for editors.

use super::PluginPaths;
use crate::registry::{Kind, StageType, stage_types};
use serde_json::{Map, Value, json};

/// Marks, in a settings schema, a value that is itself a stage: `{"x-stage": "encoder"}`, written by
/// [`super::stage::schema`].
pub const NESTED: &str = "x-stage";

/// Marks, in a settings schema, groups of mutually exclusive keys:
/// `#[schemars(extend("x-one-of" = [["steps", "seconds"]]))]`.
pub const ONE_OF: &str = "x-one-of";

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

/// The schemas of the keys that every spec has besides those of its method.
pub(super) fn label() -> [(&'static str, Value); 3] {
    let mut plugins = schemars::schema_for!(PluginPaths).to_value();
    if let Value::Object(s) = &mut plugins {
        s.remove("$schema");
        s.insert("description".into(), "Libraries with stages that the spec names.".into());
    }
    [
        ("name", json!({ "type": "string", "description": "Short name, shown in tables." })),
        ("description", json!({ "type": "string", "description": "Purpose, in a sentence." })),
        ("plugins", plugins),
    ]
}

/// The JSON Schema of a spec file, for editors: every registered type with its settings.
pub fn spec() -> Value {
    let mut defs = Map::new();
    for &kind in Kind::ALL {
        let mut any = vec![];
        // Types with defaults for all their settings.
        let mut alone = vec![];
        for t in stage_types().into_iter().filter(|t| t.kind == kind) {
            let (name, schema) = (format!("{}.{}", kind.name(), t.name), of_type(t));
            if schema["required"].is_null() {
                alone.push(t.name);
            }
            defs.insert(name.clone(), relocated(schema, &name));
            any.push(json!({ "$ref": format!("#/$defs/{name}") }));
        }
        let table = json!({ "type": "object", "properties": { "type": { "type": "string" } }, "anyOf": any });
        defs.insert(kind.name().into(), json!({ "anyOf": [{ "enum": alone }, table] }));
    }
    let mut common = Map::new();
    common.insert("$schema".into(), json!({ "type": "string", "description": "Path or URL of the schema." }));
    common.insert(
        "extends".into(),
        json!({ "type": "string", "description": "The spec that this one modifies: a shipped name, or a file relative to this one." }),
    );
    for (key, schema) in label() {
        common.insert(key.into(), relocated(schema, key));
    }
    // The other keys of a spec belong to its type, or to the type of the spec it extends.
    let methods = stage_types().into_iter().filter(|t| t.kind == Kind::Method);
    let methods: Vec<Value> = methods
        .map(|t| {
            let mut schema = relocated(of_type(t), &format!("method.{}", t.name));
            if let Some(p) = schema["properties"].as_object_mut() {
                p.extend(common.clone());
            }
            if let Some(s) = schema.as_object_mut() {
                s.remove("$defs");
                s.remove("required");
            }
            schema
        })
        .collect();
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "conefield spec",
        "description": "A reconstruction method. `type` names it; the other keys are its settings. Every stage is a table with a `type`; its other keys are that type's settings. A stage with default settings may be the name of its type. A file that `extends` another may leave out what it does not change.",
        "type": "object",
        "allOf": [{ "anyOf": methods }, { "anyOf": [{ "required": ["extends"] }, { "required": ["type"] }] }],
        "$defs": defs,
    })
}

/// `schema` with its references adjusted to its place under `#/$defs/name`, and nested stages referring to theirs.
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
