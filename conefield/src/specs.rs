//! Specs by name.

use crate::plugins;
pub use crate::shipped::{FAST_WEIGHTS, SHIPPED};
use conefield_core::method::Plan;
use conefield_core::registry;
use conefield_core::spec::load::{Draft, Loaded, to_toml};
use conefield_core::{Error, Result, checksum};
use std::collections::BTreeMap;
use std::path::Path;

/// All names of specs: built-in ones, and methods that need no settings.
pub fn names() -> Vec<&'static str> {
    let mut names: Vec<&str> = SHIPPED.iter().map(|s| s.name).collect();
    let methods = registry::names(registry::Kind::Method).into_iter();
    let alone: Vec<&str> = methods.filter(|t| !names.contains(t) && read(t, &[]).is_ok()).collect();
    names.extend(alone);
    names
}

/// The part of a help text about specs.
pub fn help() -> String {
    format!("A shipped spec ({}) or a file", names().join(", "))
}

/// Reads a built-in spec by name, or a file, with overriding settings `sets`.
pub fn read(what: &str, sets: &[String]) -> Result<Loaded> {
    loaded(Draft::find(what, sets, SHIPPED)?)
}

/// Parses a spec in TOML or JSON with overriding settings `sets`; errors name `source`.
pub fn parse(text: &str, source: &str, sets: &[String]) -> Result<Loaded> {
    loaded(Draft::of(text, source, sets, SHIPPED)?)
}

/// Parses a spec from a saved file; errors name `source`.
pub fn reread(text: &str, source: &str) -> Result<Loaded> {
    loaded(Draft::of(text, source, &[], &[])?)
}

fn loaded(draft: Draft) -> Result<Loaded> {
    plugins::of_spec(&draft)?;
    draft.finish()
}

/// Notes on the origin of weights.
pub fn notes(loaded: &Loaded, seed: u64) -> Result<BTreeMap<String, String>> {
    let mut notes = BTreeMap::from([
        ("conefield".into(), env!("CARGO_PKG_VERSION").into()),
        ("seed".into(), seed.to_string()),
        ("spec".into(), to_toml(&loaded.spec)?),
    ]);
    notes.extend(plugins::identity(&plugins::used(&loaded.tree)));
    Ok(notes)
}

/// Checksums of the files, not folders, that a spec names.
pub fn checksums(loaded: &Loaded) -> Result<BTreeMap<String, String>> {
    let files = loaded.data_files().into_iter().filter(|name| Path::new(name).is_file());
    files.map(|name| Ok((name.clone(), checksum::of_file(Path::new(&name))?))).collect()
}

/// Refuses a setting that needs held-out views if `held` is empty.
pub fn check_held_out(loaded: &Loaded, plan: &dyn Plan, held: &[usize]) -> Result<()> {
    match plan.needs_held_out() {
        Some(setting) if held.is_empty() => {
            let expected = "held-out views, such as --hold-out every:10";
            Err(loaded.locate(Error::invalid("spec", setting, "no held-out views", expected)))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::method;
    use conefield_backend_cpu::Cpu;

    #[test]
    fn every_shipped_spec_builds() {
        for s in SHIPPED {
            let loaded = read(s.name, &[]).unwrap();
            assert_eq!(loaded.spec.name, s.name);
            assert!(!loaded.spec.description.is_empty());
            let outline = method::plan(&loaded, &Cpu::new()).unwrap().outline();
            assert!(!outline.method.kind.is_empty(), "{}", s.name);
        }
    }

    #[test]
    fn the_last_of_several_settings_counts() {
        for (sets, want) in [(["stop.passes=8", "stop={passes=3}"], 3), (["stop={passes=3}", "stop.passes=8"], 8)] {
            let loaded = read("sirt", &sets.map(String::from)).unwrap();
            assert_eq!(loaded.tree["stop"]["passes"], want);
        }
    }

    #[test]
    fn a_key_below_a_word_and_a_bare_type_are_as_good_as_a_table() {
        let tree = |sets: &[&str]| {
            read("balanced", &sets.iter().map(|s| s.to_string()).collect::<Vec<_>>()).unwrap().tree.clone()
        };
        let [table, key] = ["scene.support={cylinder={radius=35}}", "scene.support.cylinder.radius=35"];
        assert_eq!(tree(&[key])["scene"], tree(&[table])["scene"]);
        assert_eq!(tree(&["encoder.levels=5", "encoder=dense-grid"])["encoder"]["levels"], 5);
        // The last of two names of a stage counts.
        let last = tree(&["encoder=hash-grid", "encoder=dense-grid"]);
        assert_eq!(last["encoder"]["type"], "dense-grid");
    }

    /// A chain cannot contain a chain, so `smooth-gaussians` repeats the methods of `smooth-tv`, and `smooth-patches` all but
    /// two priors.
    #[test]
    fn specs_repeat_the_methods_of_smooth_tv() {
        let methods = |name| {
            let spec = serde_json::to_value(&read(name, &[]).unwrap().spec).unwrap();
            spec["methods"].as_array().unwrap().clone()
        };
        let [tv, all] = ["smooth-tv", "smooth-gaussians"].map(methods);
        assert_eq!((tv.len(), all.len()), (3, 4));
        assert_eq!(tv, all[..3]);
        let mut patches = methods("smooth-patches");
        (1..3).for_each(|k| patches[k]["prior"] = tv[k]["prior"].clone());
        assert_eq!(tv, patches);
    }

    #[test]
    fn a_method_is_named_by_its_type_alone() {
        for name in ["sart", "cgls", "asd-pocs", "fista"] {
            let loaded = read(name, &[]).unwrap();
            assert_eq!((&loaded.spec.name[..], &loaded.source[..]), (name, &*format!("{name} (shipped)")));
            method::plan(&loaded, &Cpu::new()).unwrap();
        }
        assert!(read("neural-field", &[]).err().unwrap().to_string().contains("encoder"));
    }
}
