//! TOML and JSON as written: values with their locations, and errors that name them.

mod deserializer;
mod node;
mod notation;

pub(crate) use node::{At, Entry, Is, Node};

use crate::allowance;
use crate::error::Result;
use notation::{parse_json, parse_toml};
use serde::de::DeserializeOwned;
use std::path::Path;

/// Most bytes of memory per byte of text: of a list of digits, each one is a [`Node`].
const NODE_BYTES: u64 = 48;

/// Reads `text`, the content of the file `place`. Errors name line and column, and for an unknown key the nearest valid
/// one.
pub fn read<T: DeserializeOwned>(place: &str, text: &str) -> Result<T> {
    value(&parse(place, text, 0)?)
}

/// Reads a value.
pub(crate) fn value<T: DeserializeOwned>(node: &Node) -> Result<T> {
    T::deserialize(node).map_err(|e| e.located(&node.at))
}

/// Parses `text`, the content of `place`, with `depth` layers above it: JSON if the extension says so or
/// the text begins with a brace, as no TOML does, else TOML.
pub(crate) fn parse(place: &str, text: &str, depth: usize) -> Result<Node> {
    allowance::memory(place, "text", (text.len() as u64).saturating_mul(NODE_BYTES))?;
    let json = Path::new(place).extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if json || text.trim_start().starts_with('{') {
        parse_json(place, text, depth)
    } else {
        parse_toml(place, text, depth)
    }
}

/// Line and column of byte `offset` in `text`, the content of the file `place`: `place:line:column`.
pub fn location(place: &str, text: &str, offset: usize) -> String {
    let before = &text.as_bytes()[..offset.min(text.len())];
    let line = before.iter().filter(|b| **b == b'\n').count() + 1;
    let rest = String::from_utf8_lossy(before.rsplit(|b| *b == b'\n').next().unwrap_or_default());
    format!("{place}:{line}:{}", rest.chars().count() + 1)
}

/// For an error message: the name of `known` that is nearest to `name`, or all.
pub(crate) fn suggest(name: &str, known: &[&str]) -> String {
    let distance = |k: &str| strsim::osa_distance(&name.to_lowercase(), k);
    let alike = |k: &str| distance(k) <= (k.len() / 3).max(2) || k.starts_with(name) || name.starts_with(k);
    let near = known.iter().filter(|k| alike(k)).min_by_key(|k| distance(k));
    match (near, known) {
        (_, []) => "none; this build has none".into(),
        (Some(near), [_]) => format!("{near:?}"),
        (Some(near), _) => format!("{near:?} (of {})", known.join(", ")),
        (None, _) => listed(known),
    }
}

/// For an error message: all names of `known`.
pub(crate) fn listed(known: &[&str]) -> String {
    match known {
        [] => "none is known here".into(),
        [one] => (*one).into(),
        _ => format!("one of {}", known.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn toml_and_json_read_alike_and_know_their_lines() {
        let t = parse_toml("a.toml", "x = 1\n[b]\n  y = [2.5, \"é\"]\n", 1).unwrap();
        let j = parse_json("a.json", "{ \"x\": 1,\n \"b\": {\n\n \"y\": [2.5, \"\\u00e9\"] } }", 1).unwrap();
        assert_eq!(t.to_json(), j.to_json());
        assert_eq!(t.nearest(&["b", "y", "1"]).at.to_string(), "a.toml:3:13");
        assert_eq!(j.nearest(&["b", "y", "1"]).at.to_string(), "a.json:4:13");
        assert_eq!(j.nearest(&["b", "z"]).at.to_string(), "a.json:2:7");
        let e = parse_json("a.json", "{\n \"x\": }", 1).unwrap_err().to_string();
        assert!(e.starts_with("a.json:2:") && e.contains("syntax"), "{e}");
    }

    #[test]
    fn values_are_read_and_errors_name_place_and_path() {
        #[derive(Debug, PartialEq, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Part {
            size: [f64; 2],
            kind: Option<Kind>,
            at: Option<toml::Spanned<u8>>,
        }
        #[derive(Debug, PartialEq, serde::Deserialize)]
        #[serde(rename_all = "kebab-case")]
        enum Kind {
            Plain,
            Of { sides: i64 },
            Pair(u8, u8),
        }
        #[derive(Debug, PartialEq, serde::Deserialize)]
        struct Whole {
            parts: Vec<Part>,
        }
        let whole: Whole = read("a.toml", "[[parts]]\nsize = [1, 2.5]\nkind = 'plain'\n").unwrap();
        assert_eq!(whole.parts, [Part { size: [1.0, 2.5], kind: Some(Kind::Plain), at: None }]);
        let text = r#"{"parts": [{"size": [-1, 2], "kind": {"of": {"sides": -3}}}, {"size": [0, 0], "kind": {"pair": [1, 2]}, "at": 7}]}"#;
        let whole: Whole = read("no extension", text).unwrap();
        assert_eq!(whole.parts[0].kind, Some(Kind::Of { sides: -3 }));
        assert_eq!(whole.parts[1].kind, Some(Kind::Pair(1, 2)));
        let at = whole.parts[1].at.as_ref().unwrap();
        assert_eq!((*at.get_ref(), &text[at.span().start..][..2]), (7, "7}"));
        for (text, says) in [
            ("[[parts]]\nsize = [1, true]", "a.toml:2:12: parts.0.size.1: found true, expected a number"),
            ("[[parts]]\nsize = [1, 2, 3]", "a.toml:2:8: parts.0.size: found a list of 3, expected 2"),
            ("[[parts]]\nsize = [1]", "a.toml:2:8: parts.0.size: found a list of 1, expected a list of 2"),
            (
                "[[parts]]\nsize = [1, 2]\nkin = 1",
                "a.toml:3:1: parts.0.kin: found a key that is not known here, expected \"kind\"",
            ),
            ("[[parts]]\nkind = 'plain'", "a.toml:1:1: parts.0.size: found nothing, expected a value"),
            ("parts = 3", "a.toml:1:9: parts: found 3, expected a list"),
            ("parts = [[[1, 2]]]", "a.toml:1:10: parts.0: found a list of 1, expected a table"),
            ("[[parts]]\nsize = [1, 2]\nkind = 'plane'", "a.toml:3:8: parts.0.kind: found unknown variant `plane`"),
            (
                "[[parts]]\nsize = [1, 2]\nat = 300",
                "a.toml:3:6: parts.0.at: found 300, expected a whole number from 0 to 255",
            ),
            ("parts = [", "a.toml:1:"),
        ] {
            let e = read::<Whole>("a.toml", text).unwrap_err().to_string();
            assert!(e.starts_with(says), "{e}\n{says}");
        }
    }

    #[test]
    fn numbers_above_0_are_named_in_words() {
        let e = read::<std::collections::BTreeMap<String, std::num::NonZeroUsize>>("a.toml", "k = 0").unwrap_err();
        assert_eq!(e.to_string(), "a.toml:1:5: k: found 0, expected a whole number of at least 1");
    }

    #[test]
    fn a_changed_type_drops_the_keys_of_the_old_one() {
        let mut base = parse_toml("base", "[a]\ntype = 'one'\nk = 1\n[b]\ntype = 'one'\nk = 1\n", 1).unwrap();
        base.merge(parse_toml("over", "[a]\ntype = 'two'\n[b]\nl = 2\n", 1).unwrap());
        let want = serde_json::json!({"a": {"type": "two"}, "b": {"type": "one", "k": 1, "l": 2}});
        assert_eq!(base.to_json(), want);
    }
}
