//! Levers files and front files.

use crate::case::{Case, put, refused};
use std::path::Path;

const SEARCH: &str = "tradeoff scan -o out --levers levers.toml";
const PICK: &str = "reconstruct scan -o out --budget 9s --front front.toml";

fn levers(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("levers.toml"), text)
}

fn front(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("front.toml"), text)
}

pub fn cases() -> Vec<Case> {
    vec![
        refused("levers that are missing", |_| {}, SEARCH, &["levers.toml"]),
        refused("levers of bytes", |d| put(d.join("levers.toml"), [0xff, 0xfe, 0]), SEARCH, &["levers.toml", "UTF-8"]),
        refused("levers that are no TOML", levers("[[base\n"), SEARCH, &["levers.toml:1"]),
        refused("levers of nothing", levers(""), SEARCH, &["levers.toml", "at least one [[base]]"]),
        refused("a base without a spec", levers("[[base]]\n"), SEARCH, &["levers.toml:1", "spec"]),
        refused("a base with a misspelt key", levers("[[base]]\nspec = 'fdk'\nlever = 1\n"), SEARCH, &["lever"]),
        refused("a base that is no spec", levers("[[base]]\nspec = 'fkd'\n"), SEARCH, &["base[0].spec", "\"fkd\""]),
        refused(
            "a lever that is no list",
            levers("[[base]]\nspec = 'fdk'\nlevers.cutoff = 0.5\n"),
            SEARCH,
            &["levers.toml: base[0].levers.cutoff", "a list"],
        ),
        refused(
            "a lever that does not exist",
            levers("[[base]]\nspec = 'fast'\nlevers.encoder.level = [4]\n"),
            SEARCH,
            &["base[0].levers.encoder.level", "\"levels\""],
        ),
        refused(
            "one value among several that does not fit",
            levers("[[base]]\nspec = 'fdk'\nlevers.cutoff = [0.5, 7.0]\n"),
            SEARCH,
            &["base[0].levers.cutoff", "7.0"],
        ),
        refused("budgets that fall", |_| {}, "tradeoff scan -o out --budgets 9s,3s", &["--budgets", "ascending"]),
        refused(
            "fewer candidates than bases",
            |_| {},
            "tradeoff scan -o out --candidates 1",
            &["--candidates", "at least"],
        ),
        refused("a front that is missing", |_| {}, PICK, &["front.toml"]),
        refused("a front that is no TOML", front("made = \n"), PICK, &["front.toml:1"]),
        refused("a front of nothing", front("made = 'x'\nscans = []\npoints = []\n"), PICK, &["scans", "none"]),
        refused(
            "a point that took no time at all",
            front(
                "made = 'x'\n[[scans]]\nname = 'a'\nviews = 1\ndetector = [1, 1]\nvolume = [1, 1, 1]\n[[points]]\nname = 'p'\n\
                 kind = 'voxels'\nspec = 'fdk'\nbudget_s = 1.0\n[[points.runs]]\nsteps = 0\ntrain_s = 0.0\ntotal_s = 0.0\npsnr = 9.0\n",
            ),
            PICK,
            &["points[0].runs", "steps"],
        ),
    ]
}
