//! Reading specs: layers, `--set`, and located errors.
//!
//! A spec is read into a tree whose values know their line. `extends` merges it over the named spec, and `--set`
//! overrides single values. The result is checked against the settings of the registered stage types before it becomes
//! a [`Spec`].

use super::{LABEL, Spec, check, one_of};
use crate::allowance::Work;
use crate::error::{Error, Result, ensure};
use crate::spec::marks::marked;
use crate::written::{self, At, Entry, Is, Node};
use crate::{files, input_file, registry};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Longest spec, in bytes; shipped specs are a hundredth of this.
const LONGEST: u64 = 256 << 10;

/// A spec shipped with the program.
#[derive(Debug, Clone, Copy)]
pub struct Shipped {
    /// Its name for users.
    pub name: &'static str,
    /// The file's text, TOML.
    pub text: &'static str,
}

/// A checked spec with its origin.
pub struct Loaded {
    /// The spec.
    pub spec: Spec,
    /// The same with all defaults written out.
    pub tree: Value,
    /// The file or name of a shipped spec.
    pub source: String,
    written: Node,
}

/// Reads the spec `what`: the name of a shipped spec, or a TOML or JSON file. `sets` are overrides `path=value`.
pub fn load(what: &str, sets: &[String], shipped: &[Shipped]) -> Result<Loaded> {
    Draft::find(what, sets, shipped)?.finish()
}

/// Reads a spec from `text`, named `source` in errors; TOML unless it starts like JSON.
pub fn parse(text: &str, source: &str, sets: &[String], shipped: &[Shipped]) -> Result<Loaded> {
    Draft::of(text, source, sets, shipped)?.finish()
}

/// A spec with all its layers, before checking: the stage types it names may still have to be loaded.
pub struct Draft {
    written: Node,
    source: String,
}

impl Draft {
    /// See [`load`].
    pub fn find(what: &str, sets: &[String], shipped: &[Shipped]) -> Result<Self> {
        let none = || Error::invalid("spec", what, NOTHING, format!("a file or {}", names(what, shipped)));
        Self::layered(Layer::find(what, None, shipped)?.ok_or_else(none)?, sets, shipped)
    }

    /// See [`parse`].
    pub fn of(text: &str, source: &str, sets: &[String], shipped: &[Shipped]) -> Result<Self> {
        Self::layered(Layer { origin: Origin::Text(source.into()), text: text.into() }, sets, shipped)
    }

    fn layered(layer: Layer, sets: &[String], shipped: &[Shipped]) -> Result<Self> {
        let source = layer.label();
        let mut written = layer.resolve(shipped, &[], &mut Work::new(MOST_LAYERS))?;
        // The last one wins. Only a new type, which clears the keys of the old one, comes before the keys of that stage,
        // whatever the order on the line.
        let mut ordered: Vec<Set> = vec![];
        for set in sets {
            let set = Set::parse(set)?;
            let before = set
                .stage()
                .and_then(|stage| ordered.iter().position(|s| s.path.starts_with(stage) && s.stage() != Some(stage)));
            ordered.insert(before.unwrap_or(ordered.len()), set);
        }
        for set in ordered {
            set.apply(&mut written)?;
        }
        Ok(Self { written, source })
    }

    /// The plugins it names, each with its location.
    pub fn plugins(&self) -> Vec<(String, PathBuf)> {
        let paths = self.written.get(PLUGINS).and_then(|p| p.get(PATHS)).map(|p| &p.kind);
        let Some(Is::Array(paths)) = paths else { return vec![] };
        paths.iter().filter_map(|p| Some((p.at.to_string(), PathBuf::from(p.text()?)))).collect()
    }

    /// Checks the spec against the available stage types.
    pub fn finish(self) -> Result<Loaded> {
        let Self { mut written, source } = self;
        one_of::settle(&mut written);
        check::spec(&written)?;
        let spec: Spec = written::value(&written)?;
        let tree = serde_json::to_value(&spec).map_err(|e| Error::unsupported("writing the spec", e.to_string()))?;
        Ok(Loaded { spec, tree, source, written })
    }
}

/// Maximum depth of a chain of `extends`.
const DEEPEST: usize = 32;
/// Maximum number of specs combined into one: each method of a chain may extend others.
const MOST_LAYERS: u64 = 256;
/// Key of the methods of a chain.
const METHODS: &str = "methods";
/// Key of the plugins.
const PLUGINS: &str = "plugins";
const PATHS: &str = "paths";

/// The spec as TOML with all defaults written out. Refuses a spec that would not read back the same: TOML has no null,
/// so it cannot express a JSON spec that clears a setting with a default.
pub fn to_toml(spec: &Spec) -> Result<String> {
    let failed = |e: &dyn std::fmt::Display| Error::unsupported("writing the spec as TOML", e.to_string());
    let tree = |s: &Spec| serde_json::to_value(s).map_err(|e| failed(&e));
    let whole = tree(spec)?;
    let text = toml::to_string_pretty(&without_nulls(whole.clone())).map_err(|e| failed(&e))?;
    let back: Spec = written::read("spec.toml", &text)?;
    if whole != tree(&back)? {
        return Err(failed(&"a setting is null, but its default is not: set a value"));
    }
    Ok(text)
}

fn without_nulls(value: Value) -> Value {
    match value {
        Value::Object(mut map) => {
            map.retain(|_, value| !value.is_null());
            map.values_mut().for_each(|value| *value = without_nulls(value.take()));
            map.into()
        }
        Value::Array(items) => items.into_iter().map(without_nulls).collect(),
        other => other,
    }
}

impl Loaded {
    /// Files and shipped specs that this one is made of, as they were named.
    pub fn sources(&self) -> BTreeSet<String> {
        let mut all = BTreeSet::new();
        all.insert(self.source.clone());
        self.written.sources(&mut all);
        all
    }

    /// The files that its settings name ([`InputFile`](crate::input_file::InputFile)), and the libraries of its stages.
    pub fn input_files(&self) -> Vec<String> {
        self.data_files().into_iter().chain(self.spec.plugins.paths.iter().cloned()).collect()
    }

    /// The files that its settings name.
    pub fn data_files(&self) -> Vec<String> {
        let named = marked(&self.tree, &|schema| schema["format"] == input_file::FORMAT).into_iter();
        named.filter_map(|(_, name)| name.as_str().map(str::to_owned)).collect()
    }

    /// The same error, with the line of the spec it refers to.
    pub fn locate(&self, mut error: Error) -> Error {
        if let Error::Invalid { place, field, .. } = &mut error
            && place == "spec"
        {
            // `normalizers[0].epoch` and `normalizers.0.epoch` are the same.
            let dotted = field.replace('[', ".").replace(']', "");
            let path: Vec<&str> = dotted.split('.').filter(|s| !s.is_empty()).collect();
            (*place, *field) = (self.written.nearest(&path).at.to_string(), path.join("."));
        }
        error
    }
}

/// `one of a, b` of the shipped names, with the nearest one first if there is one.
fn names(what: &str, shipped: &[Shipped]) -> String {
    let mut known: Vec<&str> = shipped.iter().map(|s| s.name).collect();
    let types = registry::names(registry::Kind::Method);
    known.extend(types.into_iter().filter(|t| !shipped.iter().any(|s| s.name == *t)));
    format!("the name of a shipped spec or of a method: {}", written::suggest(what, &known))
}

/// Origin of a layer.
#[derive(Debug, Clone, PartialEq)]
enum Origin {
    Shipped(&'static str),
    File(PathBuf),
    Text(String),
}

/// What is found where nothing has a name.
const NOTHING: &str = "neither a shipped spec nor a file";

/// One spec file before merging.
struct Layer {
    origin: Origin,
    text: String,
}

impl Layer {
    /// Finds `what`, as written in a file of `folder`; `None` if nothing has this name. Refuses a file that cannot be read.
    fn find(what: &str, folder: Option<&Path>, shipped: &[Shipped]) -> Result<Option<Self>> {
        if let Some(s) = shipped.iter().find(|s| s.name == what) {
            return Ok(Some(Self { origin: Origin::Shipped(s.name), text: s.text.into() }));
        }
        if let Some(t) = registry::find(registry::Kind::Method, what) {
            let text = format!("type = {name:?}\nname = {name:?}\ndescription = {:?}\n", t.doc, name = t.name);
            return Ok(Some(Self { origin: Origin::Shipped(t.name), text }));
        }
        let path = folder.map_or_else(|| PathBuf::from(what), |f| f.join(what));
        match files::read_text(&path, LONGEST) {
            Ok(text) => Ok(Some(Self { origin: Origin::File(path), text })),
            Err(Error::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }

    fn label(&self) -> String {
        match &self.origin {
            Origin::Shipped(name) => format!("{name} (shipped)"),
            Origin::File(path) => path.display().to_string(),
            Origin::Text(name) => name.clone(),
        }
    }

    /// Merges this layer over those that it extends. `above` are the layers that led here.
    fn resolve(self, shipped: &[Shipped], above: &[Origin], work: &mut Work) -> Result<Node> {
        let label = self.label();
        work.spend(&label, "extends: specs that are read", 1)?;
        // The `--set`s are above the first layer.
        let depth = 1 + above.len();
        let mut node = written::parse(&label, &self.text, depth)?;
        node.take("$schema");
        if let Origin::File(path) = &self.origin {
            anchor_plugins(&mut node, path);
        }
        let above = [above, std::slice::from_ref(&self.origin)].concat();
        self.extend_methods(&mut node, shipped, &above, work)?;
        let Some(mut tree) = self.base(&mut node, shipped, &above, work)? else { return Ok(node) };
        // A description is that of its own spec.
        tree.take("description");
        tree.merge(node);
        Ok(tree)
    }

    /// The tree that `node`, a table of this layer, extends.
    fn base(&self, node: &mut Node, shipped: &[Shipped], above: &[Origin], work: &mut Work) -> Result<Option<Node>> {
        let Some(extends) = node.take("extends") else { return Ok(None) };
        let at = extends.value.at.to_string();
        let Some(what) = extends.value.text() else {
            let found = extends.value.shown();
            return Err(Error::invalid(at, "extends", found, "the name of a shipped spec or a file"));
        };
        let folder = match &self.origin {
            Origin::File(p) => p.parent(),
            _ => None,
        };
        let refused = |found: String, expected: String| Error::invalid(&at, "extends", found, expected);
        let base = Self::find(what, folder, shipped);
        let base = base.map_err(|e| refused(e.to_string(), "a spec that can be read".into()))?;
        let none = || refused(format!("{what:?}, {NOTHING}"), format!("a file or {}", names(what, shipped)));
        let base = base.ok_or_else(none)?;
        if above.iter().any(|o| same(o, &base.origin)) {
            return Err(Error::invalid(at, "extends", format!("{what:?}, which extends this one"), "no circle"));
        }
        ensure(above.len() < DEEPEST, &at, "extends", format!("{DEEPEST} specs on the way"), "fewer")?;
        base.resolve(shipped, above, work).map(Some)
    }

    /// Merges the methods of a chain over what they extend. Only the method of an extended spec is used, with the
    /// plugins it needs.
    fn extend_methods(&self, node: &mut Node, shipped: &[Shipped], above: &[Origin], work: &mut Work) -> Result<()> {
        let Some(Is::Array(methods)) = node.get_mut(METHODS).map(|m| &mut m.kind) else { return Ok(()) };
        let mut plugins = vec![];
        for method in methods {
            let Some(mut tree) = self.base(method, shipped, above, work)? else { continue };
            LABEL.iter().for_each(|key| {
                let taken = tree.take(key).filter(|_| *key == PLUGINS);
                plugins.extend(taken.and_then(|mut p| p.value.take(PATHS)).map(|p| p.value));
            });
            tree.merge(std::mem::replace(method, Node::empty_table(method.at.clone())));
            *method = tree;
        }
        plugins.into_iter().for_each(|paths| node.push_all(&[PLUGINS, PATHS], paths));
        Ok(())
    }
}

/// Makes the plugin paths of a spec file, which are relative to it, absolute, so that merging keeps them valid.
fn anchor_plugins(node: &mut Node, file: &Path) {
    let folder = file.parent().unwrap_or(Path::new(""));
    let Some(Is::Array(paths)) = node.get_mut(PLUGINS).and_then(|p| p.get_mut(PATHS)).map(|p| &mut p.kind) else {
        return;
    };
    for path in paths {
        if let Is::String(path) = &mut path.kind
            && let Ok(absolute) = std::path::absolute(folder.join(&*path))
        {
            *path = absolute.display().to_string();
        }
    }
}

/// Whether two layers are the same file.
fn same(a: &Origin, b: &Origin) -> bool {
    match (a, b) {
        (Origin::File(a), Origin::File(b)) => {
            let real = |p: &Path| p.canonicalize().unwrap_or_else(|_| p.to_path_buf());
            real(a) == real(b)
        }
        _ => a == b,
    }
}

/// A `--set path=value`.
struct Set {
    path: Vec<String>,
    value: Node,
    at: At,
}

impl Set {
    fn parse(text: &str) -> Result<Self> {
        let label = format!("--set {text}");
        let (path, value) = text.split_once('=').map(|(p, v)| (p.trim(), v.trim())).unwrap_or((text, ""));
        if path.is_empty() || !text.contains('=') || path.split('.').any(str::is_empty) {
            return Err(Error::invalid(label, "path", format!("{text:?}"), "path=value, such as encoder.levels=8"));
        }
        let at = At::whole(&label);
        // A TOML value, or else a text without quotes; no text begins like a table or a list.
        let parsed = match written::parse("value.toml", &format!("value = {value}"), 0) {
            Err(Error::Invalid { field, found, expected, .. }) if value.starts_with(['{', '[']) => {
                return Err(Error::invalid(label, field, found, expected));
            }
            parsed => parsed.ok().filter(|n| n.entries().len() == 1),
        };
        let kind = match parsed.and_then(|mut n| n.take("value")) {
            Some(e) => e.value.kind,
            None => Is::String(value.to_owned()),
        };
        let mut value = Node { at: at.clone(), kind };
        relocate(&mut value, &at);
        Ok(Self { path: path.split('.').map(str::to_owned).collect(), value, at })
    }

    /// The stage whose type it may set: by the key `type`, or by a name.
    fn stage(&self) -> Option<&[String]> {
        match self.path.split_last() {
            Some((last, stage)) if last == "type" => Some(stage),
            _ => matches!(self.value.kind, Is::String(_)).then_some(&self.path[..]),
        }
    }

    /// Sets the value in `tree`.
    fn apply(self, tree: &mut Node) -> Result<()> {
        let Self { path, value, at } = self;
        let mut node = tree;
        for (i, step) in path.iter().enumerate() {
            let so_far = path[..=i].join(".");
            let shown = node.shown();
            match &mut node.kind {
                Is::Array(items) => {
                    let n = items.len();
                    let index = step.parse::<usize>().ok().filter(|k| *k <= n).ok_or_else(|| {
                        let range =
                            if n == 0 { "0, to add one".into() } else { format!("0 to {}, or {n} to add one", n - 1) };
                        Error::invalid(&at, &so_far, format!("{step:?}"), range)
                    })?;
                    if index == n {
                        items.push(Node::empty_table(at.clone()));
                    }
                    node = &mut items[index];
                }
                Is::Table(entries) => {
                    // A changed type discards the old settings.
                    let retyped = |e: &Entry| e.key == "type" && e.value.text() != value.text();
                    if i + 1 == path.len() && step == "type" && entries.iter().any(retyped) {
                        entries.retain(|e| LABEL.contains(&&*e.key));
                    }
                    // A number as the next key makes it a list.
                    let list = path.get(i + 1).is_some_and(|next| next.parse::<usize>().is_ok());
                    let entry = Entry::of(entries, step, &at, list);
                    entry.at = at.clone();
                    node = &mut entry.value;
                }
                _ => {
                    let above = path[..i].join(".");
                    let found = format!("a key below {above}, which is {shown}");
                    return Err(Error::invalid(at, so_far, found, format!("{above}=value")));
                }
            }
            if i + 1 < path.len() {
                node.spell_out();
            }
        }
        match value.kind {
            Is::Table(_) => node.merge(value),
            _ => *node = value,
        }
        Ok(())
    }
}

/// Replaces all locations of a value by `at`.
fn relocate(node: &mut Node, at: &At) {
    node.at = at.clone();
    match &mut node.kind {
        Is::Array(items) => items.iter_mut().for_each(|item| relocate(item, at)),
        Is::Table(entries) => entries.iter_mut().for_each(|e| {
            e.at = at.clone();
            relocate(&mut e.value, at);
        }),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method::{Context, Method, Plan};
    use crate::settings::{EncoderSpec, NormalizerSpec};
    use crate::spec::stage;
    use schemars::JsonSchema;
    use serde::{Deserialize, Serialize};

    #[derive(Serialize, Deserialize, JsonSchema, Clone, Copy)]
    #[serde(rename_all = "kebab-case")]
    enum Way {
        Straight,
        Round,
    }

    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(deny_unknown_fields, default)]
    struct TestGrid {
        levels: usize,
        growth: f64,
        way: Way,
        range: [f64; 2],
        top: Option<u32>,
        floor: Option<u32>,
    }

    impl Default for TestGrid {
        fn default() -> Self {
            Self { levels: 4, growth: 2.0, way: Way::Straight, range: [0.0, 1.0], top: None, floor: Some(1) }
        }
    }

    crate::stage_type!(EncoderSpec, "test-grid", TestGrid, "for tests");
    impl EncoderSpec for TestGrid {
        fn build(&self) -> Result<Box<dyn crate::stage::Encoder>> {
            Err(Error::invalid("spec", "levels", self.levels, "another number"))
        }
    }

    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(deny_unknown_fields)]
    struct TestStack {
        #[schemars(extend("x-stage" = "encoder"))]
        below: serde_json::Value,
    }

    crate::stage_type!(EncoderSpec, "test-stack", TestStack, "for tests");
    impl EncoderSpec for TestStack {
        fn build(&self) -> Result<Box<dyn crate::stage::Encoder>> {
            Err(Error::unsupported("test-stack", "for tests"))
        }
    }

    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "kebab-case")]
    enum Pace {
        Even,
        Fast(f64),
        Slow { by: f64 },
    }

    #[derive(Default, Serialize, Deserialize, JsonSchema)]
    #[serde(deny_unknown_fields, default)]
    #[schemars(extend("x-one-of" = [["steps", "seconds", "passes"]]))]
    struct TestClock {
        steps: Option<u64>,
        seconds: Option<f64>,
        passes: Option<u64>,
        pace: Option<Pace>,
    }

    crate::stage_type!(Method, "test-clock", TestClock, "for tests");
    impl Method for TestClock {
        fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
            Err(Error::unsupported("test-clock", "for tests"))
        }
    }

    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(deny_unknown_fields)]
    struct TestField {
        #[schemars(schema_with = "stage::schema::<dyn EncoderSpec>")]
        encoder: Box<dyn EncoderSpec>,
        #[serde(default, deserialize_with = "stage::list")]
        #[schemars(schema_with = "stage::schema_of_list::<dyn NormalizerSpec>")]
        normalizers: Vec<Box<dyn NormalizerSpec>>,
        #[serde(default = "ten")]
        steps: u64,
    }

    fn ten() -> u64 {
        10
    }

    crate::stage_type!(Method, "test-field", TestField, "for tests");
    impl Method for TestField {
        fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
            self.encoder.build().map_err(|e| e.within("encoder"))?;
            Err(Error::unsupported("test-field", "for tests"))
        }
    }

    #[derive(Serialize, Deserialize, JsonSchema)]
    #[serde(deny_unknown_fields)]
    struct TestChain {
        #[serde(deserialize_with = "stage::list")]
        #[schemars(schema_with = "stage::schema_of_list::<dyn Method>")]
        methods: Vec<Box<dyn Method>>,
    }

    crate::stage_type!(Method, "test-chain", TestChain, "for tests");
    impl Method for TestChain {
        fn plan(&self, _: &Context<'_>) -> Result<Box<dyn Plan>> {
            Err(Error::unsupported("test-chain", "for tests"))
        }
    }

    const SHIPPED: &[Shipped] = &[
        Shipped {
            name: "plain",
            text: "type = 'test-field'\nname = 'plain'\n[encoder]\ntype = 'test-grid'\nlevels = 3\n",
        },
        Shipped { name: "curved", text: "extends = 'plain'\nname = 'curved'\n[encoder]\nway = 'round'\n" },
        Shipped { name: "timed", text: "type = 'test-clock'\nseconds = 9\npace = { slow = { by = 2 } }\n" },
    ];

    fn read(text: &str, sets: &[&str]) -> Result<Loaded> {
        parse(text, "a.toml", &sets.iter().map(|s| s.to_string()).collect::<Vec<_>>(), SHIPPED)
    }

    fn plan(loaded: &Loaded) -> Result<Box<dyn Plan>> {
        loaded.spec.method.plan(&Context::new(&Nothing))
    }

    /// A backend that is never reached.
    struct Nothing;

    impl crate::backend::Backend for Nothing {
        fn name(&self) -> &'static str {
            "nothing"
        }
        fn compile(
            &self,
            _: &crate::pipeline::Pipeline,
        ) -> Result<(Box<dyn crate::backend::Executable>, crate::backend::Explain)> {
            Err(Error::unsupported("nothing", "for tests"))
        }
    }

    fn refusal(text: &str, sets: &[&str]) -> String {
        read(text, sets).err().expect("refused").to_string()
    }

    #[test]
    fn layers_and_sets_lie_over_each_other() {
        let l = read("extends = 'curved'\nencoder.growth = 3\n", &["encoder.levels=8", "name=mine"]).unwrap();
        let e = &l.tree["encoder"];
        assert_eq!(e["levels"], 8);
        assert_eq!(e["growth"], 3.0);
        assert_eq!(e["way"], "round");
        assert_eq!(l.tree["name"], "mine");
        assert_eq!(l.tree["steps"], 10, "defaults are written");
    }

    #[test]
    fn what_is_written_out_reads_back_the_same() {
        let l = read("extends = 'curved'\nencoder.top = 7\n", &[]).unwrap();
        let text = to_toml(&l.spec).unwrap();
        assert_eq!(read(&text, &[]).unwrap().tree, l.tree, "{text}");
        let cleared = read("{\"extends\": \"plain\", \"encoder\": {\"floor\": null}}", &[]).unwrap();
        assert!(to_toml(&cleared.spec).unwrap_err().to_string().contains("null"));
        let json = serde_json::to_string(&l.tree).unwrap();
        assert_eq!(read(&json, &[]).unwrap().tree, l.tree);
    }

    #[test]
    fn mistakes_are_reported_with_line_path_and_nearest_name() {
        let base = "extends = 'plain'\n[encoder]\n";
        for (line, want) in [
            ("levels = 2.5", "encoder.levels: found 2.5, expected a whole number"),
            ("way = 'rund'", "a.toml:3:7: encoder.way: found \"rund\", expected \"round\""),
            ("way = 3", "a.toml:3:7: encoder.way: found 3, expected straight or round"),
            ("range = [1]", "a.toml:3:9: encoder.range: found a list of 1, expected a list of 2"),
            ("range = [1, 'a']", "a.toml:3:13: encoder.range.1: found the text \"a\", expected a number"),
            ("top = 'a'", "a.toml:3:7: encoder.top: found the text \"a\", expected a whole number"),
            (
                "type = 'test-stack'",
                "a.toml:2:1: encoder.below: found nothing, expected a table with an encoder type, or its name: one of",
            ),
            ("type = 'test-stack'\nbelow = { type = 'test-grid', level = 2 }", "a.toml:4:31: encoder.below.level"),
        ] {
            let e = refusal(&format!("{base}{line}\n"), &[]);
            assert!(e.contains(want), "{line}\n{e}\n{want}");
        }
        // Plugins bring stages, but no methods.
        let e = refusal("type = 'mine'\n", &[]);
        assert!(e.contains("no method type \"mine\"") && !e.contains("plugin"), "{e}");
        let e = refusal("{\n\"type\": \"test-clock\",\n \"step\": 3}", &[]);
        assert!(e.starts_with("a.toml:3:2: step: found an unknown key, expected \"steps\""), "{e}");
    }

    #[test]
    fn the_name_of_a_type_stands_for_its_default_settings() {
        let alone = read("type = 'test-field'\nencoder = 'test-grid'\n", &[]).unwrap();
        let table = read("type = 'test-field'\nencoder.type = 'test-grid'\n", &[]).unwrap();
        assert_eq!(alone.tree, table.tree);
        assert_eq!(alone.tree["encoder"]["levels"], 4);
        let e = alone.locate(plan(&alone).err().unwrap()).to_string();
        assert!(e.starts_with("a.toml:2:11: encoder.levels"), "{e}");
        // Over another type, in a file and by `--set`, and within a stage.
        let base = "extends = 'plain'\n";
        for (text, sets) in [(&*format!("{base}encoder = 'test-grid'\n"), &[][..]), (base, &["encoder=test-grid"])] {
            assert_eq!(read(text, sets).unwrap().tree["encoder"]["levels"], 4, "{text}");
        }
        let l = read("type = 'test-field'\nencoder = 'test-grid'\n", &["encoder.levels=8"]).unwrap();
        assert_eq!((&l.tree["encoder"]["type"], &l.tree["encoder"]["levels"]), (&"test-grid".into(), &8.into()));
        read(base, &["encoder={type='test-stack', below='test-grid'}"]).unwrap();
        for (line, want) in [
            (
                "encoder = 'tets-grid'",
                "a.toml:2:11: encoder: found no encoder type \"tets-grid\", expected \"test-grid\"",
            ),
            ("encoder = 'test-stack'", "a.toml:2:11: encoder.below: found nothing"),
            ("encoder = 3", "a.toml:2:11: encoder: found 3, expected a table, or the name of a type: one of test-grid"),
            ("normalizers = ['x']", "a.toml:2:16: normalizers.0: found no normalizer type \"x\""),
            ("encoder = { type = 'test-stack', below = 'x' }", "encoder.below: found no encoder type \"x\""),
        ] {
            let e = refusal(&format!("{base}{line}\n"), &[]);
            assert!(e.contains(want), "{line}\n{e}\n{want}");
        }
    }

    #[test]
    fn sets_are_checked_like_files() {
        for (set, want) in [
            ("encoder.levels=8x", "found the text \"8x\", expected a whole number"),
            ("=3", "expected path=value"),
            ("encoder..levels=3", "expected path=value"),
            ("encoder.levels.deep=3", "a key below encoder.levels, which is 3"),
            ("normalizers.0.type=nothing", "no normalizer type"),
            ("normalizers.0=3", "normalizers.0: found 3, expected a table"),
            ("normalizers.0={type=x", "--set normalizers.0={type=x: syntax: found"),
            ("normalizers.0={type='x',eps=inf}", "eps: found inf, expected a finite number"),
            ("name=1\nsteps=2", "name"),
        ] {
            match read("extends = 'plain'", &[set]) {
                Ok(l) => assert_eq!(l.tree["name"], "1\nsteps=2", "{set}"),
                Err(e) => assert!(e.to_string().contains(want), "{set}: {e}"),
            }
        }
    }

    #[test]
    fn a_type_set_clears_the_keys_of_the_old_type_in_any_order() {
        let sets = ["encoder.below={type='test-grid'}", "encoder.type=test-stack"];
        let l = read("extends = 'plain'", &sets).unwrap();
        assert_eq!(l.tree["encoder"]["type"], "test-stack");
        assert!(l.tree["encoder"].get("levels").is_none());
    }

    #[test]
    fn what_an_upper_layer_says_takes_the_place_of_another_way_to_say_it() {
        let said = |text: &str, sets: &[&str]| {
            let method = read(text, sets).unwrap().tree.clone();
            let keys = ["steps", "seconds", "passes"].iter().filter(|k| !method[**k].is_null());
            (keys.copied().collect::<Vec<_>>().join(" "), method["pace"].to_string())
        };
        let base = "extends = 'timed'\n";
        assert_eq!(said(base, &[]), ("seconds".into(), "{\"slow\":{\"by\":2.0}}".into()));
        assert_eq!(said(&format!("{base}steps = 3\n"), &[]).0, "steps");
        assert_eq!(said(&format!("{base}steps = 3\n"), &["passes=4"]).0, "passes");
        assert_eq!(said(&format!("{base}steps = 3\n"), &["seconds=4"]).0, "seconds");
        assert_eq!(said("{\"extends\": \"timed\", \"passes\": null}", &[]).0, "seconds");
        for set in ["pace.fast=0.5", "pace={fast=0.5}"] {
            assert_eq!(said(base, &[set]).1, "{\"fast\":0.5}", "{set}");
        }
        assert_eq!(said(base, &["pace.slow.by=3"]).1, "{\"slow\":{\"by\":3.0}}");
        // Both keys in one layer are a mistake.
        let e = refusal(&format!("{base}steps = 3\npasses = 4\n"), &[]);
        assert!(e.starts_with("a.toml:3:1: passes: found steps beside it, expected one of steps, "), "{e}");
        let e = refusal(base, &["steps=3", "passes=4"]);
        assert!(e.starts_with("--set passes=4: passes: found steps beside it"), "{e}");
        let e = refusal(base, &["pace={fast=1,slow={by=2}}"]);
        assert!(e.contains("pace"), "{e}");
    }

    #[test]
    fn errors_of_a_stage_get_their_line() {
        let l = read("extends = 'plain'\n[encoder]\ngrowth = 2\nlevels = 9\n", &[]).unwrap();
        let e = l.locate(plan(&l).err().unwrap()).to_string();
        assert_eq!(e, "a.toml:4:10: encoder.levels: found 9, expected another number");
    }

    #[test]
    fn circles_are_refused() {
        let dir = std::env::temp_dir().join(format!("conefield-circle-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join("a.toml"), "extends = 'b.toml'\n").unwrap();
        std::fs::write(dir.join("b.toml"), "extends = './a.toml'\n").unwrap();
        let e = load(&dir.join("a.toml").display().to_string(), &[], SHIPPED).err().unwrap().to_string();
        std::fs::remove_dir_all(&dir).unwrap();
        assert!(e.contains("b.toml:1:11: extends") && e.contains("expected no circle"), "{e}");
    }

    #[test]
    fn a_type_alone_is_a_spec_also_below_another() {
        let alone = load("test-clock", &["seconds=3".into()], SHIPPED).unwrap();
        let below = read("extends = 'test-clock'\nseconds = 3\n", &[]).unwrap();
        for tree in [alone.tree, below.tree] {
            let values = ["type", "name", "seconds"].map(|key| tree[key].clone());
            assert_eq!(Value::from_iter(values), serde_json::json!(["test-clock", "test-clock", 3.0]));
        }
    }

    #[test]
    fn methods_of_a_chain_extend_other_specs() {
        let text = "type = 'test-chain'\n[[methods]]\nextends = 'curved'\nencoder.growth = 3\n[[methods]]\nextends = 'timed'\n";
        let l = read(text, &["methods.0.encoder.levels=8", "methods.1.steps=5"]).unwrap();
        let [first, second] = [0, 1].map(|i| l.tree["methods"][i].clone());
        assert_eq!((&first["encoder"]["levels"], &first["encoder"]["way"]), (&8.into(), &"round".into()));
        assert!(first.get("name").is_none() && first["encoder"]["growth"] == 3.0);
        assert_eq!((&second["steps"], &second["seconds"]), (&5.into(), &Value::Null));
        let e = refusal("type = 'test-chain'\n[[methods]]\nextends = 'curved'\nencoder.grow = 3\n", &[]);
        assert!(e.starts_with("a.toml:4:9: methods.0.encoder.grow: found an unknown key"), "{e}");
        let again = read(&to_toml(&l.spec).unwrap(), &[]).unwrap();
        assert_eq!(again.tree, l.tree);
    }
}
