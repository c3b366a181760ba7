//! `conefield plugins new`

use crate::out;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ValueEnum};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::registry::{self, Kind};
use std::fs;
use std::path::{Component, Path, PathBuf};

/// Create a plugin: a stage, its test, and a spec that uses it. It builds without changes.
#[derive(Args)]
pub struct New {
    /// The name of plugin, folder and stage type: lower-case letters, digits and hyphens.
    name: String,
    /// The kind of stage.
    #[arg(long, value_parser = kinds())]
    kind: Template,
    /// The language.
    #[arg(long, default_value = "rust")]
    lang: Language,
    /// The parent folder.
    #[arg(long, value_name = "FOLDER", default_value = ".")]
    into: PathBuf,
    /// conefield's sources for a Rust plugin [default: those that this program was built from if they still exist, else
    /// the published crates].
    #[arg(long, value_name = "FOLDER")]
    sources: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Language {
    Rust,
    C,
}

/// Names that a crate or its types cannot have: Rust keywords and crates always in scope.
const RESERVED: [&str; 62] = [
    "abstract", "alloc", "as", "async", "await", "become", "box", "break", "const", "continue", "core", "crate", "do",
    "dyn", "else", "enum", "extern", "false", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro",
    "match", "mod", "move", "mut", "override", "priv", "proc-macro", "pub", "ref", "return", "self", "static", "std",
    "struct", "super", "test", "trait", "true", "try", "type", "typeof", "unsafe", "unsized", "use", "virtual",
    "where", "while", "yield", "conefield-plugin", "conefield-conformance", "build", "deps", "examples", "incremental",
];

macro_rules! template {
    ($name:expr) => {
        include_str!(concat!("../../../templates/", $name))
    };
}

/// The files of a new plugin and its build command.
struct Start {
    /// File names and contents.
    files: Vec<(String, String)>,
    /// The resulting library.
    library: String,
    /// The commands that build it; in Rust, that also run the conformance kit.
    build: &'static str,
}

/// A kind of stage that a plugin can be made for.
#[derive(Debug, Clone, Copy)]
struct Template {
    kind: Kind,
    /// The stage in C and in Rust, without what all kinds have in common.
    c: &'static str,
    rust: &'static str,
    /// The type of its functions in C, the place of these, and the kind's code.
    functions: &'static str,
    table: &'static str,
    code: &'static str,
    /// A small spec, and the place of the stage there.
    spec: &'static str,
    place: &'static str,
}

/// Makes the templates from the list of the contract.
macro_rules! templates {
    ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {
        const TEMPLATES: &[Template] = &[$($(Template {
            kind: Kind::$kind,
            c: template!(concat!("c/", stringify!($name), ".c")),
            rust: template!(concat!("rust/", stringify!($name), ".rs")),
            functions: stringify!($table),
            table: stringify!($field),
            code: stringify!($code),
            spec: stringify!($spec),
            place: $place,
        },)+)*];
    };
}

conefield_plugin_abi::kinds! { templates }

/// The template of the kind that an argument names.
fn kinds() -> impl TypedValueParser<Value = Template> {
    let of = |name: String| TEMPLATES.iter().copied().find(|t| t.kind.name() == name).ok_or("no such kind");
    PossibleValuesParser::new(TEMPLATES.iter().map(|t| t.kind.name())).try_map(of)
}

impl New {
    pub fn run(self) -> Result<()> {
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        let good = self.name.starts_with(|c: char| c.is_ascii_lowercase())
            && self.name.chars().all(plain)
            && (2..=40).contains(&self.name.len())
            && !self.name.ends_with('-');
        let own = format!("{:?}", self.name);
        let expected = "2 to 40 lower-case letters, digits and hyphens, a letter first";
        ensure(good, "plugins new", "NAME", &own, expected)?;
        let free = !RESERVED.contains(&&self.name[..]);
        ensure(free, "plugins new", "NAME", &own, "a name that is not a Rust keyword or crate")?;
        if let Some(taken) = registry::find(self.kind.kind, &self.name) {
            let found = format!("{own}, the {} of {}", taken.kind, taken.owner());
            return Err(Error::invalid("plugins new", "NAME", found, "an unused name"));
        }
        let folder = self.into.join(&self.name);
        let (place, expected) = (folder.display().to_string(), "the name of a new folder");
        ensure(!folder.exists(), &place, "NAME", "an existing file or folder", expected)?;
        let Start { files, library, build } = match self.lang {
            Language::Rust => self.rust()?,
            Language::C => self.c(),
        };
        for (file, text) in &files {
            let path = folder.join(file);
            let parent = path.parent().unwrap_or(&folder);
            fs::create_dir_all(parent).map_err(|e| Error::io(parent, e))?;
            conefield_io::write_text_atomic(&path, text)?;
        }
        out::say(&format!(
            "{place}: {} files. Next:\n  cd {place}\n  {build}\n  conefield plugins check {library}\n  conefield --plugin \
             {library} reconstruct SCAN --spec spec.toml -o run",
            files.len(),
        ))?;
        match self.lang {
            Language::Rust => out::say("The first build and test compile conefield's crates, too: some minutes each."),
            Language::C => Ok(()),
        }
    }

    fn rust(&self) -> Result<Start> {
        let files = vec![
            ("Cargo.toml".into(), self.fill(template!("rust/manifest.toml"))?),
            (".gitignore".into(), "/target\n".into()),
            ("src/lib.rs".into(), self.fill(&self.stage())?),
            ("tests/conformance.rs".into(), self.fill(template!("rust/test.rs"))?),
            ("spec.toml".into(), self.spec()),
        ];
        let name = self.name.replace('-', "_");
        let (prefix, suffix) = (std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
        let library = format!("target/release/{prefix}{name}{suffix}");
        Ok(Start { files, library, build: "cargo build --release\n  cargo test --release" })
    }

    /// The Rust template of the kind with what all of them have in common; a template lists its settings as
    /// `pub name: type = default,`.
    fn stage(&self) -> String {
        let Template { kind, rust, .. } = self.kind;
        let (above, rest) = rust.split_once("@stage ").unwrap_or_default();
        let (doc, rest) = rest.split_once('\n').unwrap_or_default();
        let (listed, below) = rest.split_once("@\n").unwrap_or_default();
        let (mut settings, mut defaults) = (vec![], vec![]);
        for line in listed.lines() {
            match line.trim().strip_prefix("pub ").and_then(|rest| rest.trim_end_matches(',').split_once(" = ")) {
                Some((field, default)) => {
                    let name = field.split(':').next().unwrap_or_default();
                    defaults.push(format!("{name}: {default}"));
                    settings.push(format!("    pub {field},"));
                }
                None => settings.push(line.into()),
            }
        }
        let stage = template!("rust/stage.rs").replace("@kind@", &format!("{kind:?}")).replace("@doc@", doc);
        let stage = stage.replace("@settings@", &settings.join("\n")).replace("@defaults@", &defaults.join(", "));
        format!("{above}{stage}{below}")
    }

    /// The C template of the kind with its tables; a template ends with the functions that it has, `of` or `curve=as_is`.
    fn tables(&self) -> String {
        let Template { c, functions, table, code, .. } = self.kind;
        let (above, rest) = c.split_once("@plugin ").unwrap_or_default();
        let entry = |word: &str| {
            let (name, function) = word.split_once('=').unwrap_or((word, word));
            format!("    .{name} = {function},")
        };
        let entries: Vec<String> = rest.trim_end().trim_end_matches('@').split(' ').map(entry).collect();
        let tables =
            template!("c/plugin.c").replace("@functions@", functions).replace("@entries@", &entries.join("\n"));
        above.to_owned() + &tables.replace("@kind@", code).replace("@table@", table)
    }

    fn c(&self) -> Start {
        let named = |text: &str| text.replace("@name@", &self.name);
        let files = vec![
            (format!("{}.c", self.name), named(&self.tables())),
            ("conefield_plugin.h".into(), conefield_plugin_abi::HEADER.into()),
            ("conefield_helpers.h".into(), conefield_plugin_abi::HELPERS.into()),
            ("Makefile".into(), named(template!("c/Makefile"))),
            ("spec.toml".into(), self.spec()),
        ];
        Start { files, library: format!("./{}.so", self.name), build: "make" }
    }

    /// A small method that uses the new stage.
    fn spec(&self) -> String {
        let (name, Template { kind, spec, place, .. }) = (&self.name, self.kind);
        let (first, base, with) = match spec {
            "fast" => ("The small spec that ships with conefield, with", "extends", "the spec fast"),
            _ => ("Ordered-subset FISTA with", "type", spec),
        };
        format!(
            "# {first} the stage of this plugin.\n{base} = \"{spec}\"\nname = \"{name}\"\ndescription = \"The {kind} of the \
             plugin {name} in {with}.\"\n\n{place}\ntype = \"{name}\"\n"
        )
    }

    /// A Rust template with names and dependencies filled in.
    fn fill(&self, template: &str) -> Result<String> {
        let from = |package: &str, folder: &str| -> Result<String> {
            Ok(match self.sources()? {
                Some(root) => {
                    let path = toml::Value::String(self.relative(&root.join(folder)).display().to_string());
                    format!("{package} = {{ path = {path} }}")
                }
                None => format!("{package} = \"{}\"", env!("CARGO_PKG_VERSION")),
            })
        };
        Ok(template
            .replace("@sdk@", &from("conefield-plugin", "plugins/sdk")?)
            .replace("@kit@", &from("conefield-conformance", "tests/kit")?)
            .replace("@name@", &self.name)
            .replace("@crate@", &self.name.replace('-', "_")))
    }

    /// `target` as seen from the folder of the plugin; `target` itself where no such path leads.
    fn relative(&self, target: &Path) -> PathBuf {
        let Ok(from) = self.into.canonicalize().map(|into| into.join(&self.name)) else { return target.into() };
        let shared = from.components().zip(target.components()).take_while(|(a, b)| a == b).count();
        if shared == 0 {
            return target.into();
        }
        let up = from.components().skip(shared).map(|_| Component::ParentDir);
        up.chain(target.components().skip(shared)).collect()
    }

    /// The folder of conefield's sources.
    fn sources(&self) -> Result<Option<PathBuf>> {
        let sound = |root: &Path| root.join("plugins/sdk/Cargo.toml").is_file();
        match &self.sources {
            Some(root) if sound(root) => root.canonicalize().map(Some).map_err(|e| Error::io(root, e)),
            Some(root) => {
                let expected = "a folder with conefield's sources: it has plugins/sdk";
                Err(Error::invalid("plugins new", "--sources", root.display(), expected))
            }
            None => {
                let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().map(Path::to_path_buf);
                Ok(root.filter(|r| sound(r)))
            }
        }
    }
}
