//! Study files.

use crate::case::{Case, put, table};
use std::path::Path;

const STUDY: &str = "study study.toml -o out";
const REST: &str = "volumes = ['phantom:head:16']\nspecs = ['fdk']\n";

fn study(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("study.toml"), text)
}

/// A study that is otherwise valid.
fn with(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("study.toml"), format!("{REST}{text}"))
}

pub fn cases() -> Vec<Case> {
    table! {
        "a study that is missing", |_| {}, STUDY, ["study.toml"];
        "a study that is no TOML", study("seeds = [\n"), STUDY, ["study.toml: line 1"];
        "a study of nothing", study("specs = ['fdk']\n"), STUDY, ["study.toml", "neither volumes nor scans"];
        "a study with a misspelt key", with("[simulate]\nnoize = 'none'\n"), STUDY, ["line 4: noize", "`noise`"];
        "a method that does not exist", study("volumes = ['phantom:head:16']\nspecs = ['fkd']\n"),
            STUDY, ["line 2", "fkd"];
        "a setting that does not exist", with("[protocol]\nset = ['windo=1']\n"),
            STUDY, ["line 2: specs", "--set windo=1"];
        "a volume that is not there", study("volumes = ['none.nii']\nspecs = ['fdk']\n"),
            STUDY, ["line 1: volumes", "none.nii"];
        "the same seed twice", with("seeds = [1, 1]\n"), STUDY, ["line 3: seeds", "1 twice"];
        "views by the thousand million", with("views = [1000000000]\n"), STUDY, ["line 1: volumes", "views"];
        "a detector larger than memory", with("[simulate]\ndetector = '100000x100000'\n"),
            STUDY, ["line 1: volumes", "GiB"];
        "blocks larger than the volume",
            study("volumes = [{ volume = 'phantom:head:16', downsample = 65535 }]\nspecs = ['fdk']\n"),
            STUDY, ["line 1: volumes"];
        "a time that is none", with("[protocol]\nseconds = -3\n"), STUDY, ["line 4: seconds", "positive time"];
        "two ends that exclude each other", with("[protocol]\nbudget = 9\nsteps = 3\n"), STUDY, ["line 3: budget"];
        "a baseline that is no method", with("baseline = 'sirt'\n"), STUDY, ["line 3: baseline", "fdk"];
        "a name that leads out of the folder",
            study("volumes = [{ volume = 'phantom:head:16', name = '../a' }]\nspecs = ['fdk']\n"),
            STUDY, ["line 1: name", "a name for a folder"];
        "weights that are not there",
            study("volumes = ['phantom:head:16']\nspecs = [{ spec = 'fast', init = 'none' }]\n"),
            STUDY, ["line 2: specs", "none"];
    }
}
