//! Checks a spec as written against the registered stage types, so that a mistake is reported with its line, path and
//! the nearest valid name.

use super::LABEL;
use super::one_of;
use super::schema::{NESTED, label, of_type};
use crate::error::{Error, Result};
use crate::registry::{Kind, find, names};
use crate::written::{Is, Node, listed, parse, suggest};
use serde_json::Value;

/// Refuses unknown keys, unknown types and values of the wrong type.
pub(super) fn spec(root: &Node) -> Result<()> {
    if !matches!(root.kind, Is::Table(_)) {
        return Err(Error::invalid(&root.at, "spec", root.shown(), "a table"));
    }
    for (key, schema) in label() {
        if let Some(value) = root.get(key) {
            setting(value, &schema, &Context::new(&schema, None), key)?;
        }
    }
    stage(root, Kind::Method, "")
}

/// Checks the settings of one stage, with their type, as those in a spec are checked; `source` names them in errors.
pub fn settings(kind: Kind, table: &Value, source: &str) -> Result<()> {
    stage(&parse(source, &table.to_string(), 0)?, kind, "").map_err(|mut e| {
        // They are one line: its columns say nothing.
        if let Error::Invalid { place, .. } = &mut e {
            *place = source.into();
        }
        e
    })
}

/// Checks a stage: its type, then its settings. At the top of a spec (empty `path`) the spec's own keys are allowed
/// too.
fn stage(node: &Node, kind: Kind, path: &str) -> Result<()> {
    let known = names(kind);
    let types = || format!("a type: {}", listed(&known));
    // A type name stands for its default settings.
    let alone = node.text().is_some();
    let at = if alone { path.into() } else { join(path, "type") };
    let name = if alone { Some(node) } else { node.get("type") };
    if !alone && !matches!(node.kind, Is::Table(_)) {
        return Err(Error::invalid(&node.at, path, node.shown(), format!("a table, or the name of {}", types())));
    }
    let Some(name) = name else { return Err(Error::invalid(&node.at, &at, "nothing", types())) };
    let Some(text) = name.text() else { return Err(Error::invalid(&name.at, &at, name.shown(), types())) };
    let Some(found) = find(kind, text) else {
        let mut expected = suggest(text, &known);
        if kind.is_of_plugins() {
            expected += "; if it comes from a plugin, load it with --plugin PATH";
        }
        return Err(Error::invalid(&name.at, &at, format!("no {} type {text:?}", kind.name()), expected));
    };
    let schema = of_type(found);
    let cx = Context::new(&schema, Some(kind));
    one_of::check(node, &schema, &cx, path)?;
    object(node, &schema, &cx, path)
}

/// Target of a schema's references, and the kind of stage it belongs to.
pub(super) struct Context<'a> {
    root: &'a Value,
    kind: Option<Kind>,
}

impl<'a> Context<'a> {
    pub(super) fn new(root: &'a Value, kind: Option<Kind>) -> Self {
        Self { root, kind }
    }

    /// The schema that `schema` refers to, or `schema` itself.
    pub(super) fn resolve<'b>(&'b self, schema: &'b Value) -> &'b Value {
        let target = schema["$ref"].as_str().and_then(|r| self.root.pointer(r.trim_start_matches('#')));
        target.unwrap_or(schema)
    }

    /// The kind of the stage that a setting is, if it is one. A table with a `type` where any value may stand is a stage
    /// of the kind that it belongs to.
    pub(super) fn nested(&self, schema: &Value, typed: bool) -> Option<Kind> {
        let open = || self.kind.filter(|_| typed && is_open(schema));
        schema[NESTED].as_str().and_then(Kind::named).or_else(open)
    }
}

/// Checks a value against the schema of its setting.
fn setting(node: &Node, schema: &Value, cx: &Context<'_>, path: &str) -> Result<()> {
    let schema = cx.resolve(schema);
    if let Some(kind) = cx.nested(schema, node.get("type").is_some()) {
        return stage(node, kind, path);
    }
    one_of::check(node, schema, cx, path)?;
    let wrong = || Error::invalid(&node.at, path, node.shown(), wanted(schema, cx));
    let choices: Vec<&Value> =
        ["anyOf", "oneOf"].iter().filter_map(|k| schema[*k].as_array()).flatten().map(|s| cx.resolve(s)).collect();
    if !choices.is_empty() {
        if choices.iter().any(|s| setting(node, s, cx, path).is_ok()) {
            return Ok(());
        }
        // If only one choice has this value's shape, its own message says more.
        let alike = |s: &Value| shape_fits(node, s) && s["const"].is_null() && s["enum"].is_null();
        let mut alike: Vec<&Value> = choices.into_iter().filter(|s| alike(s)).collect();
        if alike.len() > 1 {
            // Tables differ in their keys.
            alike.retain(|s| node.entries().iter().any(|e| !s["properties"][&e.key].is_null()));
        }
        return match alike[..] {
            [one] => setting(node, one, cx, path),
            _ => Err(misnamed(node, path, &constants(schema, cx)).unwrap_or_else(wrong)),
        };
    }
    if !schema["const"].is_null() || !schema["enum"].is_null() {
        let all = constants(schema, cx);
        return if all.contains(&node.to_json()) {
            Ok(())
        } else {
            Err(misnamed(node, path, &all).unwrap_or_else(wrong))
        };
    }
    if !shape_fits(node, schema) {
        return Err(wrong());
    }
    match &node.kind {
        Is::Number(n) => {
            let x = n.as_f64().unwrap_or(f64::NAN);
            let fits = |key: &str, fits: fn(&f64, &f64) -> bool| schema[key].as_f64().is_none_or(|m| fits(&x, &m));
            let within = fits("minimum", f64::ge) && fits("maximum", f64::le);
            let inside = fits("exclusiveMinimum", f64::gt) && fits("exclusiveMaximum", f64::lt);
            if within && inside { Ok(()) } else { Err(wrong()) }
        }
        Is::Array(items) => {
            let n = items.len() as u64;
            if schema["minItems"].as_u64().is_some_and(|m| n < m) || schema["maxItems"].as_u64().is_some_and(|m| n > m)
            {
                return Err(wrong());
            }
            for (i, item) in items.iter().enumerate() {
                let of = if schema["prefixItems"][i].is_null() { &schema["items"] } else { &schema["prefixItems"][i] };
                setting(item, of, cx, &format!("{path}.{i}"))?;
            }
            Ok(())
        }
        Is::Table(_) => object(node, schema, cx, path),
        _ => Ok(()),
    }
}

/// Checks the keys of a table. Refuses one that lacks a key without default.
fn object(node: &Node, schema: &Value, cx: &Context<'_>, path: &str) -> Result<()> {
    let empty = serde_json::Map::new();
    let properties = schema["properties"].as_object().unwrap_or(&empty);
    let label: &[&str] = if path.is_empty() { &LABEL } else { &[] };
    for e in node.entries().iter().filter(|e| !label.contains(&&*e.key)) {
        let at = join(path, &e.key);
        match properties.get(&e.key) {
            Some(s) => setting(&e.value, s, cx, &at)?,
            None if schema["additionalProperties"] == Value::Bool(false) => {
                let own = properties.keys().map(String::as_str).filter(|k| *k != "type");
                let known: Vec<&str> = label.iter().copied().chain(own).collect();
                return Err(Error::invalid(&e.at, &at, "an unknown key", suggest(&e.key, &known)));
            }
            None => {}
        }
    }
    for key in schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        if node.get(key).is_none() {
            let want = properties.get(key).map_or("a value".into(), |s| wanted(cx.resolve(s), cx));
            return Err(Error::invalid(&node.at, join(path, key), "nothing", want));
        }
    }
    Ok(())
}

/// Whether a schema does not restrict a value's type.
fn is_open(schema: &Value) -> bool {
    schema
        .as_object()
        .is_none_or(|s| ["type", "properties", "anyOf", "oneOf", "const", "enum"].iter().all(|k| !s.contains_key(*k)))
}

/// Whether the value has the type of the schema.
fn shape_fits(node: &Node, schema: &Value) -> bool {
    let one = |name: &str| match (&node.kind, name) {
        (Is::Null, "null")
        | (Is::Bool(_), "boolean")
        | (Is::Number(_), "number")
        | (Is::String(_), "string")
        | (Is::Array(_), "array")
        | (Is::Table(_), "object") => true,
        (Is::Number(n), "integer") => n.is_i64() || n.is_u64(),
        _ => false,
    };
    match &schema["type"] {
        Value::String(name) => one(name),
        Value::Array(any) => any.iter().filter_map(Value::as_str).any(one),
        _ => true,
    }
}

/// The fixed values that a schema allows.
fn constants(schema: &Value, cx: &Context<'_>) -> Vec<Value> {
    let schema = cx.resolve(schema);
    let mut all: Vec<Value> = schema["enum"].as_array().cloned().unwrap_or_default();
    if !schema["const"].is_null() {
        all.push(schema["const"].clone());
    }
    for key in ["anyOf", "oneOf"] {
        all.extend(schema[key].as_array().into_iter().flatten().flat_map(|s| constants(s, cx)));
    }
    all
}

/// Describes in words what a schema allows.
fn wanted(schema: &Value, cx: &Context<'_>) -> String {
    let schema = cx.resolve(schema);
    if let Some(kind) = schema[NESTED].as_str().and_then(Kind::named) {
        let article = if kind == Kind::Encoder || kind == Kind::Initializer { "an" } else { "a" };
        return format!("a table with {article} {} type, or its name: {}", kind.name(), listed(&names(kind)));
    }
    let fixed = constants(schema, cx);
    let mut words: Vec<String> = fixed.iter().map(plain).collect();
    for key in ["anyOf", "oneOf"] {
        let open = schema[key].as_array().into_iter().flatten().map(|s| cx.resolve(s));
        words.extend(open.filter(|s| constants(s, cx).is_empty() && s["type"] != "null").map(|s| wanted(s, cx)));
    }
    if words.is_empty() {
        let types: Vec<&str> = match &schema["type"] {
            Value::Array(any) => any.iter().filter_map(Value::as_str).filter(|t| *t != "null").collect(),
            one => one.as_str().into_iter().collect(),
        };
        for t in types {
            words.push(match t {
                "integer" => format!("a whole number{}", limits(schema)),
                "number" => format!("a number{}", limits(schema)),
                "string" => "a text".into(),
                "boolean" => "true or false".into(),
                "array" => list(schema, cx),
                _ => {
                    let keys = schema["properties"].as_object().into_iter().flat_map(|p| p.keys());
                    format!("a table of {}", keys.map(String::as_str).collect::<Vec<_>>().join(", "))
                }
            });
        }
    }
    if words.is_empty() { "another value".into() } else { words.join(" or ") }
}

fn list(schema: &Value, cx: &Context<'_>) -> String {
    let item = if schema["items"].is_object() { format!(", each {}", wanted(&schema["items"], cx)) } else { "".into() };
    match (schema["minItems"].as_u64(), schema["maxItems"].as_u64()) {
        (Some(a), Some(b)) if a == b => format!("a list of {a}{item}"),
        (Some(a), Some(b)) => format!("a list of {a} to {b}{item}"),
        (Some(a), None) => format!("a list of at least {a}{item}"),
        (None, Some(b)) => format!("a list of at most {b}{item}"),
        (None, None) => format!("a list{item}"),
    }
}

fn limits(schema: &Value) -> String {
    let of = |key: &str| schema[key].as_f64();
    match [of("minimum"), of("maximum"), of("exclusiveMinimum"), of("exclusiveMaximum")] {
        [Some(a), Some(b), None, None] => format!(" from {a} to {b}"),
        [None, None, None, None] => String::new(),
        [least, most, above, below] => {
            let words = [("of at least", least), ("above", above), ("of at most", most), ("below", below)];
            let words = words.into_iter().filter_map(|(word, x)| Some(format!("{word} {}", x?)));
            format!(" {}", words.collect::<Vec<_>>().join(" and "))
        }
    }
}

fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Error for a text that is not one of the allowed ones.
fn misnamed(node: &Node, path: &str, allowed: &[Value]) -> Option<Error> {
    let names: Vec<&str> = allowed.iter().filter_map(Value::as_str).collect();
    let text = node.text().filter(|_| !names.is_empty())?;
    Some(Error::invalid(&node.at, path, format!("{text:?}"), suggest(text, &names)))
}

pub(super) fn join(path: &str, key: &str) -> String {
    if path.is_empty() { key.into() } else { format!("{path}.{key}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn an_error_names_the_limits_of_a_number_and_the_one_table_that_is_meant() {
        let table = |key: &str| {
            let number = json!({ "type": "number" });
            json!({ "type": "object", "properties": { key: number }, "additionalProperties": false })
        };
        let schema = json!({ "properties": {
            "share": { "type": "number", "exclusiveMinimum": 0, "maximum": 1 },
            "count": { "type": "integer", "minimum": 0, "exclusiveMaximum": 8 },
            "weight": { "oneOf": [table("fixed"), table("noise")] },
        } });
        for (text, want) in [
            ("share = 1\ncount = 0\nweight.noise = 2", ""),
            ("share = 0", "share: found 0, expected a number above 0 and of at most 1"),
            ("share = 1.5", "share: found 1.5, expected a number above 0 and of at most 1"),
            ("count = 8", "count: found 8, expected a whole number of at least 0 and below 8"),
            ("weight.noise = 'much'", "weight.noise: found the text \"much\", expected a number"),
            ("weight.often = 1", "weight: found a table of often, expected a table of fixed or a table of noise"),
        ] {
            let node = parse("s", text, 0).unwrap();
            let said = object(&node, &schema, &Context::new(&schema, None), "").map_err(|e| e.to_string());
            let said = said.err().unwrap_or_default();
            assert!(said.ends_with(want) && said.is_empty() == want.is_empty(), "{text}: {said}");
        }
    }
}
