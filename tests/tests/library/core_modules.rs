//! The modules of `core` use each other in one direction: none needs what needs it.

use crate::crates::{Needs, rows};
use std::collections::BTreeSet;
use std::path::Path;

/// Adds what the sources below `folder` use of other modules, under the name of the module at the top.
fn read(folder: &Path, top: Option<&str>, uses: &mut Needs) {
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

#[test]
fn the_modules_of_core_form_no_circle() {
    let mut uses = Needs::new();
    read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../core/src")), None, &mut uses);
    // Types that the crate's root names are of a module that is found as well.
    let modules: BTreeSet<String> = uses.keys().cloned().collect();
    uses.values_mut().for_each(|used| used.retain(|u| modules.contains(u)));
    assert!(uses.len() > 20 && uses["spec"].contains("registry") && uses["method"].contains("backend"), "{uses:?}");
    assert_eq!(rows(&uses).err(), None);
    // A circle is found.
    uses.get_mut("error").unwrap().insert("spec".into());
    assert!(rows(&uses).unwrap_err().contains(&"spec"));
}
