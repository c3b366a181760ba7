//! Settings that the JSON Schema of their stage marks, whatever their name: files to read, sizes of tables.

use crate::registry::stage_types;
use serde_json::Value;

/// A setting: its path, as for `--set`, and its value.
pub type Setting = (String, Value);

/// Every setting in `tree` whose schema is `marked`: of all tables with a registered `type`, at any depth.
pub fn marked(tree: &Value, marked: &dyn Fn(&Value) -> bool) -> Vec<Setting> {
    let mut search = Search { marked, found: vec![] };
    search.stages(tree, "");
    search.found
}

struct Search<'a> {
    marked: &'a dyn Fn(&Value) -> bool,
    found: Vec<Setting>,
}

impl Search<'_> {
    fn stages(&mut self, value: &Value, path: &str) {
        if let Some(name) = value.get("type").and_then(Value::as_str) {
            for stage in stage_types().into_iter().filter(|t| t.name == name) {
                let schema = stage.schema();
                self.by_schema(value, &schema, &schema, path);
            }
        }
        each(value, path, |_, v, path| self.stages(v, path));
    }

    /// `root` resolves references of `schema`.
    fn by_schema(&mut self, value: &Value, schema: &Value, root: &Value, path: &str) {
        if let Some(target) = schema["$ref"].as_str().and_then(|r| root.pointer(r.trim_start_matches('#'))) {
            self.by_schema(value, target, root, path);
        }
        for choice in ["anyOf", "oneOf", "allOf"].into_iter().filter_map(|key| schema[key].as_array()).flatten() {
            self.by_schema(value, choice, root, path);
        }
        let setting = (path.to_owned(), value.clone());
        if !value.is_null() && (self.marked)(schema) && !self.found.contains(&setting) {
            self.found.push(setting);
        }
        each(value, path, |key, v, path| {
            let inner = key.map_or(&schema["items"], |key| &schema["properties"][key]);
            self.by_schema(v, inner, root, path);
        });
    }
}

/// Calls `f` with every entry of a table (with its key) or list, and its path.
fn each(value: &Value, path: &str, mut f: impl FnMut(Option<&str>, &Value, &str)) {
    let below = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
    match value {
        Value::Array(all) => all.iter().enumerate().for_each(|(i, v)| f(None, v, &below(&i.to_string()))),
        Value::Object(map) => map.iter().for_each(|(key, v)| f(Some(key), v, &below(key))),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input_file::FORMAT;
    use crate::registry::{Make, StageType, add};
    use crate::settings::LossSpec;
    use serde_json::json;

    #[test]
    fn settings_are_found_under_any_key_by_the_schema_of_their_stage() {
        let file = json!({ "type": ["string", "null"], "format": FORMAT });
        let schema = json!({
            "properties": {
                "atlas": file,
                "maps": { "type": "array", "items": file },
                "deep": { "anyOf": [{ "$ref": "#/$defs/Deep" }, { "type": "null" }] },
                "note": { "type": "string" },
            },
            "$defs": { "Deep": { "properties": { "file": file } } },
        });
        let make = Make::new::<dyn LossSpec>(Box::new(|_| Err("this type is never built".into())));
        add(vec![StageType::loaded("a test", "reads-files".into(), "test".into(), schema, make)]).unwrap();
        let stage = json!({
            "type": "reads-files", "atlas": "a.nii", "maps": ["b.npy", "c.npy"], "deep": { "file": "d.mha" }, "note": "e",
        });
        let tree = json!({ "methods": [{ "loss": stage }, { "type": "unknown", "atlas": "f" }] });
        let mut found = marked(&tree, &|schema| schema["format"] == FORMAT);
        found.sort_unstable_by(|a, b| a.0.cmp(&b.0));
        let want = [("atlas", "a.nii"), ("deep.file", "d.mha"), ("maps.0", "b.npy"), ("maps.1", "c.npy")];
        let want = want.map(|(path, file)| (format!("methods.0.loss.{path}"), Value::from(file)));
        assert_eq!(found, want);
    }
}
