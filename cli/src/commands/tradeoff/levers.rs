//! What may be turned, and the candidates that come of it: every base as it is, and seeded draws from the product of
//! its levers' values.

use crate::{files, method, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::files::toml_line;
use conefield_core::random::mix;
use conefield_tradeoff::front::Unknowns;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// The levers that come with the program.
pub const SHIPPED: &str = include_str!("../../../../specs/tradeoff/levers.toml");
/// Longest levers file, in bytes.
const LONGEST: u64 = 1 << 20;
/// Draws for one that is new, before the product counts as used up.
const TRIES: u64 = 200;

/// A levers file as it is written.
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

/// Bases with their levers.
pub struct Levers {
    bases: Vec<Base>,
}

/// A spec and what may be changed of it.
struct Base {
    name: String,
    /// As `--spec` has it.
    spec: String,
    kind: Unknowns,
    /// The spec without its name and description, to tell whether two are the same.
    tree: Value,
    levers: Vec<Lever>,
}

/// A key of a spec and the values that it may take.
struct Lever {
    key: String,
    values: Vec<toml::Value>,
}

/// A method to be tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    pub name: String,
    /// The name of the base that it comes from.
    pub base: String,
    /// As `--spec` has it, and what `--set` changes of it.
    pub spec: String,
    pub sets: Vec<String>,
    pub kind: Unknowns,
}

impl Levers {
    /// The shipped ones.
    pub fn shipped() -> Result<Self> {
        Self::parse(SHIPPED, "levers.toml (shipped)", Path::new(""))
    }

    /// Reads a levers file. Specs that it names are shipped ones or files beside it.
    pub fn read(path: &Path) -> Result<Self> {
        let text = conefield_core::files::read_text(path, LONGEST)?;
        Self::parse(&text, &path.display().to_string(), path.parent().unwrap_or(Path::new("")))
    }

    fn parse(text: &str, place: &str, folder: &Path) -> Result<Self> {
        let written: Written = toml::from_str(text).map_err(|e| {
            let line = toml_line(text, &e).unwrap_or(1);
            let expected = "a [[base]] with a spec and its [base.levers]; --show-levers prints an example";
            Error::invalid(format!("{place}:{line}"), "levers", e.message(), expected)
        })?;
        let mut bases: Vec<Base> = vec![];
        for (i, base) in written.base.into_iter().enumerate() {
            let base = Base::of(base, &format!("base[{i}]"), place, folder)?;
            if bases.iter().any(|b| b.name == base.name) {
                let found = format!("{:?}, the name of another base", base.name);
                return Err(Error::invalid(place, format!("base[{i}].spec"), found, "a name of its own"));
            }
            bases.push(base);
        }
        ensure(!bases.is_empty(), place, "base", "none", "at least one [[base]] with a spec")?;
        Ok(Self { bases })
    }

    /// Only the bases with these names; all where none is named.
    pub fn only(mut self, names: &[String]) -> Result<Self> {
        let all: Vec<&str> = self.bases.iter().map(|b| &b.name[..]).collect();
        if let Some(name) = names.iter().find(|n| !all.contains(&&n[..])) {
            let expected = format!("some of {}", all.join(", "));
            return Err(Error::invalid("tradeoff", "--bases", format!("{name:?}"), expected));
        }
        self.bases.retain(|b| names.is_empty() || names.contains(&b.name));
        Ok(self)
    }

    /// `count` candidates: every base, then a draw of each in turn. There are fewer where the products are used up.
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
                    // Values that each fit may still not fit together: such a draw is none.
                    let Some(tree) = base.built(&sets).ok().map(|(tree, _)| tree) else { continue };
                    if !seen.contains(&tree) {
                        seen.push(tree);
                        // A base of the user's may be called what a draw would be.
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
        let shipped = specs::SHIPPED.iter().any(|s| s.name == written.spec);
        let spec = if shipped || !beside.is_file() { written.spec } else { beside.display().to_string() };
        let found = format!("{spec:?}");
        let refused = |e: Error| Error::invalid(place, format!("{field}.spec"), &found, e.to_string());
        let loaded = specs::read(&spec, &[]).map_err(refused)?;
        let name: String = match &loaded.spec.name[..] {
            "" => files::stem(&spec),
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
                    Error::invalid(place, field, value.to_string(), format!("a value that {} takes: {e}", base.name))
                })?;
            }
        }
        Ok(base)
    }

    /// One value of every lever.
    fn draw(&self, seed: u64) -> Vec<String> {
        let draw = |(i, l): (usize, &Lever)| set(l, &l.values[(mix(seed, i as u64) % l.values.len() as u64) as usize]);
        self.levers.iter().enumerate().map(draw).collect()
    }

    /// The base with `sets`, built for trial.
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

/// `key=value` as `--set` has it.
fn set(lever: &Lever, value: &toml::Value) -> String {
    format!("{}={value}", lever.key)
}

/// Goes through `"encoder.levels" = [..]`, `encoder.levels = [..]` and `[encoder] levels = [..]` alike.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Levers> {
        Levers::parse(text, "levers.toml", Path::new(""))
    }

    #[test]
    fn a_base_may_be_called_what_a_draw_would_be() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("levers.toml");
        std::fs::write(dir.path().join("mine.toml"), "extends = \"fast\"\nname = \"fast-1\"\n").unwrap();
        let levers = "training.rays = [64, 128, 256]\n";
        let text = format!("[[base]]\nspec = \"fast\"\n[base.levers]\n{levers}[[base]]\nspec = \"mine.toml\"\n");
        std::fs::write(&path, text).unwrap();
        let all = Levers::read(&path).unwrap().candidates(4, 0).unwrap();
        let names: Vec<&str> = all.iter().map(|c| &c.name[..]).collect();
        assert_eq!(names, ["fast", "fast-1", "fast-2", "fast-3"]);
    }

    #[test]
    fn the_shipped_levers_give_candidates_that_differ() {
        let levers = Levers::shipped().unwrap();
        let all = levers.candidates(30, 0).unwrap();
        assert_eq!(all.len(), 30);
        assert!(all.iter().any(|c| c.kind == Unknowns::Field) && all.iter().any(|c| c.kind == Unknowns::Voxels));
        for (i, c) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|o| o.name != c.name && (o.base != c.base || o.sets != c.sets)), "{}", c.name);
        }
        assert_eq!(levers.candidates(30, 0).unwrap(), all, "the same seed draws the same");
        assert_ne!(levers.candidates(30, 1).unwrap(), all);
        assert_eq!(levers.candidates(12, 0).unwrap(), all[..12], "more candidates leave the first ones");
    }

    #[test]
    fn bases_that_are_not_named_are_left_out() {
        let names = ["balanced".to_owned(), "fdk".to_owned()];
        let all = Levers::shipped().unwrap().only(&names).unwrap().candidates(6, 0).unwrap();
        assert!(all.len() == 6 && all.iter().all(|c| names.contains(&c.base)), "{all:?}");
        let e = Levers::shipped().unwrap().only(&["fkd".into()]).err().unwrap().to_string();
        assert!(e.contains("--bases") && e.contains("\"fkd\"") && e.contains("fista-tv"), "{e}");
    }

    #[test]
    fn a_product_is_used_up_without_repeating() {
        // The base itself has 10 subsets: 3 x 2 combinations, of which it is one.
        let levers =
            parse("[[base]]\nspec = 'os-sart'\n[base.levers]\nsubsets = [5, 10, 25]\nrelaxation = [0.4, 0.5]\n");
        let all = levers.unwrap().candidates(100, 3).unwrap();
        let default = specs::read("os-sart", &[]).unwrap().tree.clone();
        let own = [5, 10, 25].contains(&default["subsets"].as_i64().unwrap())
            && [0.4, 0.5].contains(&default["relaxation"].as_f64().unwrap());
        assert_eq!(all.len(), if own { 6 } else { 7 });
        assert_eq!((&all[0].name[..], &all[0].sets[..]), ("os-sart", &[][..]));
        assert_eq!(all[1].name, "os-sart-1");
        assert!(all[1..].iter().all(|c| c.sets.len() == 2));
    }

    #[test]
    fn three_ways_to_write_a_key_are_one() {
        let sets = |text: &str| {
            parse(&format!("[[base]]\nspec = 'fdk'\n{text}\n")).unwrap().candidates(2, 0).unwrap()[1].sets.clone()
        };
        for text in ["levers.cutoff = [0.5]", "[base.levers]\n'cutoff' = [0.5]", "[base.levers]\ncutoff = [0.5]"] {
            assert_eq!(sets(text), ["cutoff=0.5"], "{text}");
        }
    }

    #[test]
    fn mistakes_are_told_with_their_place() {
        for (text, want) in [
            ("", "levers.toml: base: found none"),
            ("[[base]]\n", "levers.toml:1: levers: found missing field `spec`"),
            ("[[base]]\nspec = 'fdk'\nlever = 3\n", "unknown field `lever`"),
            ("[[base]]\nspec = 'fdkk'\n", "base[0].spec: found \"fdkk\""),
            ("[[base]]\nspec = 'fdk'\n[[base]]\nspec = 'fdk'\n", "base[1].spec"),
            ("[[base]]\nspec = 'fdk'\nlevers.cutoff = 0.5\n", "base[0].levers.cutoff: found 0.5"),
            ("[[base]]\nspec = 'fdk'\nlevers.cutoff = []\n", "at least one value"),
            ("[[base]]\nspec = 'fdk'\nlevers.cutof = [1]\n", "\"cutoff\""),
            ("[[base]]\nspec = 'fast'\nlevers.encoder.levels = [4, -1]\n", "base[0].levers.encoder.levels: found -1"),
        ] {
            let e = parse(text).err().unwrap().to_string();
            assert!(e.contains(want), "{text}\n{e}\n{want}");
        }
        let few = parse("[[base]]\nspec = 'fdk'\n[[base]]\nspec = 'sirt'\n").unwrap().candidates(1, 0);
        assert!(few.unwrap_err().to_string().contains("at least 2"));
    }
}
