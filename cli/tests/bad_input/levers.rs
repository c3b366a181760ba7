//! Levers files and front files.

use crate::case::{Case, put, table};
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
    table! {
        "levers that are missing", |_| {}, SEARCH, ["levers.toml"];
        "levers of bytes", |d| put(d.join("levers.toml"), [0xff, 0xfe, 0]), SEARCH, ["levers.toml", "UTF-8"];
        "levers that are no TOML", levers("[[base\n"), SEARCH, ["levers.toml:1"];
        "levers of nothing", levers(""), SEARCH, ["levers.toml", "at least one [[base]]"];
        "a base without a spec", levers("[[base]]\n"), SEARCH, ["levers.toml:1", "spec"];
        "a base with a misspelt key", levers("[[base]]\nspec = 'fdk'\nlever = 1\n"), SEARCH, ["lever"];
        "a base that is no spec", levers("[[base]]\nspec = 'fkd'\n"), SEARCH, ["base[0].spec", "\"fkd\""];
        "a lever that is no list", levers("[[base]]\nspec = 'fdk'\nlevers.cutoff = 0.5\n"),
            SEARCH, ["levers.toml: base[0].levers.cutoff", "a list"];
        "a lever that does not exist", levers("[[base]]\nspec = 'fast'\nlevers.encoder.level = [4]\n"),
            SEARCH, ["base[0].levers.encoder.level", "\"levels\""];
        "one value among several that does not fit", levers("[[base]]\nspec = 'fdk'\nlevers.cutoff = [0.5, 7.0]\n"),
            SEARCH, ["base[0].levers.cutoff", "7.0"];
        "budgets that fall", |_| {}, "tradeoff scan -o out --budgets 9s,3s", ["--budgets", "ascending"];
        "fewer candidates than bases", |_| {}, "tradeoff scan -o out --candidates 1", ["--candidates", "at least"];
        "a front that is missing", |_| {}, PICK, ["front.toml"];
        "a front that is no TOML", front("made = \n"), PICK, ["front.toml:1"];
        "a front of nothing", front("made = 'x'\nscans = []\npoints = []\n"), PICK, ["scans", "none"];
        "a point that took no time at all",
            front("made = 'x'\n[[scans]]\nname = 'a'\nviews = 1\ndetector = [1, 1]\nvolume = [1, 1, 1]\n[[points]]\n\
                   name = 'p'\nkind = 'voxels'\nspec = 'fdk'\nbudget_s = 1.0\n[[points.runs]]\n\
                   steps = 0\ntrain_s = 0.0\ntotal_s = 0.0\npsnr = 9.0\n"),
            PICK, ["points[0].runs", "steps"];
    }
}
