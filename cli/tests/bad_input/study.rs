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
        "a study that is no TOML", study("seeds = [\n"), STUDY, ["study.toml:1:10: syntax"];
        "a study of nothing", study("specs = ['fdk']\n"), STUDY, ["study.toml", "neither volumes nor scans"];
        "a study with a misspelt key", with("[simulate]\nnoize = 'none'\n"), STUDY, ["study.toml:4:1: simulate.noize", "\"noise\""];
        "a method that does not exist", study("volumes = ['phantom:head:16']\nspecs = ['fkd']\n"),
            STUDY, ["study.toml:2:10: specs", "fkd"];
        "a setting that does not exist", with("[protocol]\nset = ['windo=1']\n"),
            STUDY, ["study.toml:2:10: specs", "--set windo=1"];
        "a volume that is not there", study("volumes = ['none.nii']\nspecs = ['fdk']\n"),
            STUDY, ["study.toml:1:12: volumes", "none.nii"];
        "the same seed twice", with("seeds = [1, 1]\n"), STUDY, ["study.toml:3:9: seeds", "1 twice"];
        "views by the thousand million", with("views = [1000000000]\n"), STUDY, ["study.toml:1:12: volumes", "views"];
        "a detector larger than memory", with("[simulate]\ndetector = '100000x100000'\n"),
            STUDY, ["study.toml:1:12: volumes", "GiB"];
        "blocks larger than the volume",
            study("volumes = [{ volume = 'phantom:head:16', downsample = 65535 }]\nspecs = ['fdk']\n"),
            STUDY, ["study.toml:1:12: volumes"];
        "a time that is none", with("[protocol]\nseconds = -3\n"), STUDY, ["study.toml:4:11: protocol.seconds", "positive time"];
        "two ends that exclude each other", with("[protocol]\nbudget = 9\nsteps = 3\n"), STUDY, ["study.toml:3:1: budget"];
        "a simulation of nothing", study("scans = ['scan']\nspecs = ['fdk']\n[simulate]\nnoise = 'tigre:1e4,10'\n"),
            STUDY, ["study.toml:3:1: simulate", "no volumes", "volumes beside it"];
        "a baseline that is no method", with("baseline = 'sirt'\n"), STUDY, ["study.toml:3:12: baseline", "fdk"];
        "a name that leads out of the folder",
            study("volumes = [{ volume = 'phantom:head:16', name = '../a' }]\nspecs = ['fdk']\n"),
            STUDY, ["study.toml:1:12: name", "a name for a folder"];
        "weights that are not there",
            study("volumes = ['phantom:head:16']\nspecs = [{ spec = 'fast', init = 'none' }]\n"),
            STUDY, ["study.toml:2:10: specs", "none"];
    }
}
