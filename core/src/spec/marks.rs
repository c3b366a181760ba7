//! What a spec names, by the JSON Schemas of its stages: their types, and the settings that a schema marks, whatever their
//! name: files to read, sizes of tables.

use super::check::Context;
use crate::registry::{Kind, find};
use serde_json::Value;
use std::collections::BTreeSet;

/// A setting: its path, as for `--set`, and its value.
pub type Setting = (String, Value);

/// Every setting of the spec `tree` whose schema is `marked`.
pub fn marked(tree: &Value, marked: &dyn Fn(&Value) -> bool) -> Vec<Setting> {
    Search::of(tree, marked).found
}

/// Kind and name of every type in the spec `tree`.
pub fn types(tree: &Value) -> BTreeSet<(Kind, String)> {
    Search::of(tree, &|_| false).types
}

struct Search<'a> {
    marked: &'a dyn Fn(&Value) -> bool,
    found: Vec<Setting>,
    types: BTreeSet<(Kind, String)>,
}

impl<'a> Search<'a> {
    fn of(tree: &Value, marked: &'a dyn Fn(&Value) -> bool) -> Self {
        let mut search = Self { marked, found: vec![], types: BTreeSet::new() };
        search.stage(tree, Kind::Method, "");
        search
    }

    fn stage(&mut self, value: &Value, kind: Kind, path: &str) {
        let Some(name) = value.get("type").unwrap_or(value).as_str() else { return };
        self.types.insert((kind, name.into()));
        if let Some(stage) = find(kind, name) {
            let schema = stage.schema();
            self.within(value, &schema, &Context::new(&schema, Some(kind)), path);
        }
    }

    fn setting(&mut self, value: &Value, schema: &Value, cx: &Context<'_>, path: &str) {
        if !schema.is_object() {
            return;
        }
        match cx.nested(schema, value.get("type").is_some()) {
            Some(kind) if schema["$ref"].is_null() => self.stage(value, kind, path),
            _ => self.within(value, schema, cx, path),
        }
    }

    fn within(&mut self, value: &Value, schema: &Value, cx: &Context<'_>, path: &str) {
        let target = Some(cx.resolve(schema)).filter(|target| !std::ptr::eq(*target, schema));
        let choices = ["anyOf", "oneOf", "allOf"].into_iter().filter_map(|key| schema[key].as_array()).flatten();
        target.into_iter().chain(choices).for_each(|schema| self.setting(value, schema, cx, path));
        let setting = (path.to_owned(), value.clone());
        if !value.is_null() && (self.marked)(schema) && !self.found.contains(&setting) {
            self.found.push(setting);
        }
        let below = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
        match value {
            Value::Array(all) => {
                for (i, v) in all.iter().enumerate() {
                    let inner = schema["prefixItems"].get(i).unwrap_or(&schema["items"]);
                    self.setting(v, inner, cx, &below(&i.to_string()));
                }
            }
            Value::Object(map) => {
                for (key, v) in map {
                    let path = below(key);
                    // A pattern may be meant for any key.
                    let patterns = schema["patternProperties"].as_object().into_iter().flat_map(|all| all.values());
                    let named = schema["properties"].get(key).unwrap_or(&schema["additionalProperties"]);
                    patterns.chain([named]).for_each(|inner| self.setting(v, inner, cx, &path));
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input_file::FORMAT;
    use crate::registry::{Make, StageType, add};
    use crate::settings::{EncoderSpec, LossSpec};
    use serde_json::json;

    #[test]
    fn settings_and_types_are_found_by_the_schemas_of_stages() {
        let file = json!({ "type": ["string", "null"], "format": FORMAT });
        let schema = json!({
            "properties": {
                "atlas": file,
                "maps": { "type": "array", "items": file },
                "deep": { "anyOf": [{ "$ref": "#/$defs/Deep" }, { "type": "null" }] },
                "pair": { "type": "array", "prefixItems": [{ "type": "string" }, file] },
                "named": { "type": "object", "additionalProperties": file },
                "numbered": { "type": "object", "patternProperties": { "^[0-9]+$": file }, "additionalProperties": false },
                "note": { "type": "string" },
            },
            "$defs": { "Deep": { "properties": { "file": file } } },
        });
        // A loss has the name of the encoder that reads files, and reads none.
        let make = Make::new::<dyn EncoderSpec>(Box::new(|_| Err("this type is never built".into())));
        let other = Make::new::<dyn LossSpec>(Box::new(|_| Err("this type is never built".into())));
        let loaded = |schema, make| StageType::loaded("a test", "reads-files".into(), "test".into(), schema, make);
        add(vec![loaded(schema, make), loaded(json!({}), other)]).unwrap();
        let stage = json!({
            "type": "reads-files", "atlas": "a.nii", "maps": ["b.npy", "c.npy"], "deep": { "file": "d.mha" }, "note": "e",
            "pair": ["g", "h.npy"], "named": { "left": "i.npy" }, "numbered": { "7": "j.npy" },
        });
        let field = json!({ "type": "test-field", "encoder": { "type": "test-stack", "below": stage } });
        let tree = json!({ "type": "test-chain", "methods": [field, { "type": "unknown", "atlas": "f" }] });
        let mut found = marked(&tree, &|schema| schema["format"] == FORMAT);
        found.sort_unstable_by(|a, b| a.0.cmp(&b.0));
        let want = [
            ("atlas", "a.nii"),
            ("deep.file", "d.mha"),
            ("maps.0", "b.npy"),
            ("maps.1", "c.npy"),
            ("named.left", "i.npy"),
            ("numbered.7", "j.npy"),
            ("pair.1", "h.npy"),
        ];
        let want = want.map(|(path, file)| (format!("methods.0.encoder.below.{path}"), Value::from(file)));
        assert_eq!(found, want);
        let named = types(&tree);
        let has = |kind, name: &str| named.contains(&(kind, name.into()));
        assert!(has(Kind::Method, "test-field") && has(Kind::Encoder, "reads-files"), "{named:?}");
        assert!(!has(Kind::Loss, "reads-files"), "{named:?}");
    }
}
