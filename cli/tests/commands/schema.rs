//! The schema files for editors are current.

use crate::common::Folder;
use conefield_tests::blessed;
use serde_json::Value;

#[test]
fn the_files_in_specs_are_current() {
    for (file, line) in [("spec.schema.json", "schema"), ("study.schema.json", "schema --study")] {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../conefield/specs/schema").join(file);
        blessed::check(&path, &Folder::new().done(line));
    }
}

#[test]
fn every_reference_leads_somewhere() {
    fn walk(value: &Value, root: &Value, count: &mut usize) {
        match value {
            Value::Object(map) => {
                if let Some(Value::String(r)) = map.get("$ref") {
                    assert!(root.pointer(r.trim_start_matches('#')).is_some(), "{r}");
                    *count += 1;
                }
                assert!(!map.contains_key("x-stage"), "a nested stage refers to its kind");
                map.values().for_each(|v| walk(v, root, count));
            }
            Value::Array(items) => items.iter().for_each(|v| walk(v, root, count)),
            _ => {}
        }
    }
    let schema: Value = Folder::new().json("schema");
    let mut count = 0;
    walk(&schema, &schema, &mut count);
    assert!(count > 10);
}
