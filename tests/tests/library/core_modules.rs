//! The modules of `core` use each other in one direction: none needs what needs it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

type Uses = BTreeMap<String, BTreeSet<String>>;

/// Adds what the sources below `folder` use of other modules, under the name of the module at the top.
fn read(folder: &Path, top: Option<&str>, uses: &mut Uses) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let module = top.unwrap_or(&name);
        if path.is_dir() {
            read(&path, Some(module), uses);
        } else if path.extension().is_some_and(|e| e == "rs") && name != "lib" {
            let text = std::fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]").next().unwrap();
            let lines = code.lines().filter(|l| !l.trim_start().starts_with("//"));
            let used = lines.flat_map(|l| l.split("crate::").skip(1)).map(|rest| {
                let word: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                word
            });
            uses.entry(module.into()).or_default().extend(used.filter(|u| u != module));
        }
    }
}

/// A way from `module` back to itself.
fn circle(uses: &Uses, module: &str) -> Option<Vec<String>> {
    let mut ways = vec![vec![module.to_owned()]];
    let mut seen = BTreeSet::new();
    while let Some(way) = ways.pop() {
        for next in uses.get(way.last()?).into_iter().flatten() {
            if next == module {
                return Some([way, vec![next.clone()]].concat());
            }
            if seen.insert(next.clone()) {
                ways.push([way.clone(), vec![next.clone()]].concat());
            }
        }
    }
    None
}

#[test]
fn the_modules_of_core_form_no_circle() {
    let mut uses = Uses::new();
    read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../core/src")), None, &mut uses);
    assert!(uses.len() > 20 && uses["spec"].contains("registry") && uses["method"].contains("backend"), "{uses:?}");
    for module in uses.keys() {
        assert_eq!(circle(&uses, module), None);
    }
    // A circle is found.
    uses.get_mut("error").unwrap().insert("spec".into());
    assert!(circle(&uses, "spec").is_some());
}
