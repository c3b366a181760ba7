//! The settings to vary, and the candidates: every base unchanged, and random draws from the product of its levers'
//! values.

pub use crate::shipped::LEVERS;
use crate::shipped::SHIPPED;
use crate::tradeoff::front::Unknowns;
use crate::{method, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::random::mix;
use conefield_core::written;
use conefield_evaluation::report::text::stem;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// Longest levers file, in bytes.
const LONGEST: u64 = 1 << 20;
/// Attempts to draw a new combination before the product counts as exhausted.
const TRIES: u64 = 200;

/// A levers file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    #[serde(default)]
    base: Vec<WrittenBase>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WrittenBase {
    spec: String,
    #[serde(default)]
    levers: toml::Table,
}

/// Base specs with their levers.
pub struct Levers {
    bases: Vec<Base>,
}

/// A base spec and its levers.
struct Base {
    name: String,
    /// Value of `--spec`.
    spec: String,
    kind: Unknowns,
    /// The spec without name and description, for comparisons.
    tree: Value,
    levers: Vec<Lever>,
}

/// A key of a spec and its possible values.
struct Lever {
    key: String,
    values: Vec<toml::Value>,
}

/// A method to try.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Its name.
    pub name: String,
    /// The name of its base spec.
    pub base: String,
    /// Value of `--spec`.
    pub spec: String,
    /// Values of `--set`.
    pub sets: Vec<String>,
    /// Its unknowns.
    pub kind: Unknowns,
}

impl Levers {
    /// The built-in levers.
    pub fn shipped() -> Result<Self> {
        Self::parse(LEVERS, "levers.toml (shipped)", Path::new(""))
    }

    /// Reads a levers file. Its specs are built in, or files next to it.
    pub fn read(path: &Path) -> Result<Self> {
        let text = conefield_core::files::read_text(path, LONGEST)?;
        Self::parse(&text, &path.display().to_string(), path.parent().unwrap_or(Path::new("")))
    }

    /// Parses a levers file in `folder`; errors name `place`.
    pub fn parse(text: &str, place: &str, folder: &Path) -> Result<Self> {
        let written: Written = written::read(place, text)?;
        let mut bases: Vec<Base> = vec![];
        for (i, base) in written.base.into_iter().enumerate() {
            let base = Base::of(base, &format!("base[{i}]"), place, folder)?;
            if bases.iter().any(|b| b.name == base.name) {
                let found = format!("{:?}, the name of another base", base.name);
                return Err(Error::invalid(place, format!("base[{i}].spec"), found, "a unique name"));
            }
            bases.push(base);
        }
        ensure(!bases.is_empty(), place, "base", "none", "at least one [[base]] with a spec")?;
        Ok(Self { bases })
    }

    /// Keeps only the bases with these names; all if there are none.
    pub fn only(mut self, names: &[String]) -> Result<Self> {
        let all: Vec<&str> = self.bases.iter().map(|b| &b.name[..]).collect();
        if let Some(name) = names.iter().find(|n| !all.contains(&&n[..])) {
            let expected = format!("some of {}", all.join(", "));
            return Err(Error::invalid("tradeoff", "--bases", format!("{name:?}"), expected));
        }
        self.bases.retain(|b| names.is_empty() || names.contains(&b.name));
        Ok(self)
    }

    /// `count` candidates: every base, then draws from each in turn. There are fewer if the products are exhausted.
    pub fn candidates(&self, count: usize, seed: u64) -> Result<Vec<Candidate>> {
        let least = self.bases.len();
        ensure(count >= least, "tradeoff", "--candidates", count, format!("at least {least}, one for each base"))?;
        let mut all: Vec<Candidate> = self.bases.iter().map(|b| b.candidate(0, vec![])).collect();
        let mut seen: Vec<Value> = self.bases.iter().map(|b| b.tree.clone()).collect();
        let mut open: Vec<(usize, u64, usize)> = (0..self.bases.len()).map(|b| (b, 0, 0)).collect();
        while all.len() < count && !open.is_empty() {
            open.retain_mut(|(b, draws, made)| {
                if all.len() >= count {
                    return true;
                }
                let base = &self.bases[*b];
                for _ in 0..TRIES {
                    let sets = base.draw(seed ^ mix(*b as u64, *draws));
                    *draws += 1;
                    // Values that are valid by themselves may not fit together: such a draw is skipped.
                    let Some(tree) = base.built(&sets).ok().map(|(tree, _)| tree) else { continue };
                    if !seen.contains(&tree) {
                        seen.push(tree);
                        // A user's base may have the name that a draw would get.
                        let candidate = loop {
                            *made += 1;
                            let candidate = base.candidate(*made, sets.clone());
                            if all.iter().all(|c| c.name != candidate.name) {
                                break candidate;
                            }
                        };
                        all.push(candidate);
                        return true;
                    }
                }
                false
            });
        }
        Ok(all)
    }
}

impl Base {
    fn of(written: WrittenBase, field: &str, place: &str, folder: &Path) -> Result<Self> {
        let beside = folder.join(&written.spec);
        let shipped = SHIPPED.iter().any(|s| s.name == written.spec);
        // A front names it, which is read in other folders.
        let beside = std::path::absolute(&beside).unwrap_or(beside);
        let spec = if shipped || !beside.is_file() { written.spec } else { beside.display().to_string() };
        let found = format!("{spec:?}");
        let refused = |e: Error| Error::invalid(place, format!("{field}.spec"), &found, e.to_string());
        let loaded = specs::read(&spec, &[]).map_err(refused)?;
        let name: String = match &loaded.spec.name[..] {
            "" => stem(&spec),
            name => name.chars().map(|c| if c.is_alphanumeric() || "._+-".contains(c) { c } else { '-' }).collect(),
        };
        let mut levers = vec![];
        flatten("", written.levers, &mut |key, value| {
            let field = format!("{field}.levers.{key}");
            let found = value.to_string();
            let toml::Value::Array(values) = value else {
                return Err(Error::invalid(place, field, found, "a list of the values to try"));
            };
            ensure(!values.is_empty(), place, &field, found, "at least one value")?;
            levers.push(Lever { key, values });
            Ok(())
        })?;
        let mut base = Self { name, spec, kind: Unknowns::Voxels, tree: Value::Null, levers };
        (base.tree, base.kind) = base.built(&[]).map_err(refused)?;
        for lever in &base.levers {
            for value in &lever.values {
                base.built(&[set(lever, value)]).map_err(|e| {
                    let field = format!("{field}.levers.{}", lever.key);
                    Error::invalid(place, field, value.to_string(), format!("a value that {} accepts: {e}", base.name))
                })?;
            }
        }
        Ok(base)
    }

    /// Draws one value of every lever.
    fn draw(&self, seed: u64) -> Vec<String> {
        let draw = |(i, l): (usize, &Lever)| set(l, &l.values[(mix(seed, i as u64) % l.values.len() as u64) as usize]);
        self.levers.iter().enumerate().map(draw).collect()
    }

    /// Test-builds the base with `sets`.
    fn built(&self, sets: &[String]) -> Result<(Value, Unknowns)> {
        let loaded = specs::read(&self.spec, sets)?;
        let plan = method::plan_without_files(&loaded, &Cpu::new())?;
        let mut tree = loaded.tree;
        for key in ["name", "description"] {
            tree[key] = Value::Null;
        }
        Ok((tree, Unknowns::of(plan.as_ref())))
    }

    fn candidate(&self, number: usize, sets: Vec<String>) -> Candidate {
        let name = if number == 0 { self.name.clone() } else { format!("{}-{number}", self.name) };
        Candidate { name, base: self.name.clone(), spec: self.spec.clone(), sets, kind: self.kind }
    }
}

/// `key=value`, as in `--set`.
fn set(lever: &Lever, value: &toml::Value) -> String {
    format!("{}={value}", lever.key)
}

/// Treats `"encoder.levels" = [..]`, `encoder.levels = [..]` and `[encoder] levels = [..]` alike.
fn flatten(above: &str, table: toml::Table, each: &mut impl FnMut(String, toml::Value) -> Result<()>) -> Result<()> {
    for (key, value) in table {
        let path = if above.is_empty() { key } else { format!("{above}.{key}") };
        match value {
            toml::Value::Table(inner) => flatten(&path, inner, each)?,
            value => each(path, value)?,
        }
    }
    Ok(())
}
