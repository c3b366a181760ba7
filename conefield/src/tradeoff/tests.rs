//! Levers and reports with the shipped specs.

use crate::specs;
use crate::tradeoff::front::Unknowns;
use crate::tradeoff::levers::Levers;
use crate::tradeoff::report::end;
use conefield_core::Result;
use std::path::Path;

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
    // The base itself has 10 subsets. Of the 3 × 2 combinations one is the base.
    let levers = parse("[[base]]\nspec = 'os-sart'\n[base.levers]\nsubsets = [5, 10, 25]\nrelaxation = [0.4, 0.5]\n");
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

/// The tests of bad inputs have others.
#[test]
fn mistakes_are_reported_with_their_place() {
    for (text, want) in [
        ("[[base]]\nspec = 'fdk'\n[[base]]\nspec = 'fdk'\n", "base[1].spec"),
        ("[[base]]\nspec = 'fdk'\nlevers.cutoff = []\n", "at least one value"),
        ("[[base]]\nspec = 'fast'\nlevers.encoder.levels = [4, -1]\n", "base[0].levers.encoder.levels: found -1"),
    ] {
        let e = parse(text).err().unwrap().to_string();
        assert!(e.contains(want), "{text}\n{e}\n{want}");
    }
}

#[test]
fn every_method_ends_after_its_steps() {
    for (spec, sets, want) in [
        ("fdk", vec![], None),
        ("os-sart", vec![], Some("stop.passes=105")),
        ("fast", vec![], Some("training.steps=105")),
        ("field-tv", vec!["methods.1.stop.passes=5".to_owned()], Some("methods.0.training.steps=100")),
    ] {
        let loaded = specs::read(spec, &sets).unwrap();
        let set = end(&loaded.tree, 105);
        assert_eq!(set.as_deref(), want, "{spec}");
        specs::read(spec, &set.into_iter().collect::<Vec<_>>()).unwrap();
    }
}
