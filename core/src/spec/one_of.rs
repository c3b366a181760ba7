//! Mutually exclusive keys of a table. A key of an upper layer replaces the alternatives of lower ones; one layer with
//! two of them is refused.

use super::check::{Context, join};
use super::schema::{ONE_OF, of_type};
use crate::error::{Error, Result};
use crate::registry::{Kind, find};
use crate::written::{Entry, Is, Node, listed};
use serde_json::Value;

/// Keeps, of mutually exclusive keys in the stages of `root`, only those of the uppermost layer.
pub(super) fn settle(root: &mut Node) {
    stage(root, Kind::Method);
}

fn stage(node: &mut Node, kind: Kind) {
    let Some(found) = node.get("type").and_then(Node::text).and_then(|name| find(kind, name)) else { return };
    let schema = of_type(found);
    setting(node, &schema, &Context::new(&schema, None));
}

fn setting(node: &mut Node, schema: &Value, cx: &Context<'_>) {
    let schema = cx.resolve(schema);
    if let Some(kind) = cx.nested(schema, false) {
        return stage(node, kind);
    }
    let entries = match &mut node.kind {
        Is::Array(items) => return items.iter_mut().for_each(|n| setting(n, &schema["items"], cx)),
        Is::Table(entries) => entries,
        _ => return,
    };
    // A table over a setting that is a word: the word was spelled out like the name of a stage.
    let typed = alternatives(schema, cx).iter().any(|s| s["properties"].get("type").is_some());
    let named = |e: &Entry| groups(schema, cx).iter().any(|group| group.contains(&&*e.key));
    if !typed && entries.iter().any(|e| e.key != "type" && named(e)) {
        entries.retain(|e| e.key != "type");
    }
    for group in groups(schema, cx) {
        let said = |key: &str, value: &Node| group.contains(&key) && value.kind != Is::Null;
        let upper = entries.iter().filter(|e| said(&e.key, &e.value)).map(|e| e.at.depth()).min();
        entries.retain(|e| !said(&e.key, &e.value) || Some(e.at.depth()) == upper);
    }
    for e in entries {
        let own = alternatives(schema, cx).into_iter().filter_map(|s| s["properties"].get(&e.key));
        own.for_each(|s| setting(&mut e.value, s, cx));
    }
}

/// Refuses a table with two mutually exclusive keys.
pub(super) fn check(node: &Node, schema: &Value, cx: &Context<'_>, path: &str) -> Result<()> {
    for group in groups(schema, cx) {
        let said = |e: &&Entry| group.contains(&&*e.key) && e.value.kind != Is::Null;
        let mut said: Vec<&Entry> = node.entries().iter().filter(said).collect();
        said.sort_by_key(|e| e.at.offset());
        if let [first, second, ..] = said[..] {
            let found = format!("{} beside it", first.key);
            return Err(Error::invalid(&second.at, join(path, &second.key), found, listed(&group)));
        }
    }
    Ok(())
}

/// Groups of mutually exclusive keys: marked ones, and the names of an enumeration's values.
fn groups<'a>(schema: &'a Value, cx: &'a Context<'_>) -> Vec<Vec<&'a str>> {
    let mut all = vec![];
    for schema in alternatives(schema, cx) {
        let marked = schema[ONE_OF].as_array().into_iter().flatten();
        all.extend(marked.map(|g| g.as_array().into_iter().flatten().filter_map(Value::as_str).collect()));
        let values = schema["oneOf"].as_array().into_iter().flatten();
        all.push(values.filter_map(|s| tag(cx.resolve(s))).collect());
    }
    all
}

/// A schema and its alternatives.
fn alternatives<'a>(schema: &'a Value, cx: &'a Context<'_>) -> Vec<&'a Value> {
    let schema = cx.resolve(schema);
    let choices = ["anyOf", "oneOf"].iter().filter_map(|k| schema[*k].as_array()).flatten();
    std::iter::once(schema).chain(choices.flat_map(|s| alternatives(s, cx))).collect()
}

/// The name of an enumeration value written as a table with that single key.
fn tag(choice: &Value) -> Option<&str> {
    let (properties, required) = (choice["properties"].as_object()?, choice["required"].as_array()?);
    let name = required.first()?.as_str()?;
    (properties.len() == 1 && required.len() == 1 && properties.contains_key(name)).then_some(name)
}
