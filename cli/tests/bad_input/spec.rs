//! Pipeline specs in TOML and JSON.

use crate::case::{Case, put, table};
use std::path::Path;

const TOML: &str = "explain spec.toml";
const JSON: &str = "explain spec.json";

fn toml(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("spec.toml"), text)
}

fn json(text: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| put(d.join("spec.json"), text)
}

pub fn cases() -> Vec<Case> {
    table! {
        "empty", toml(""), TOML, ["spec.toml:1:1", "type"];
        "no UTF-8", |d| put(d.join("spec.toml"), b"name = \"\xff\xfe\""), TOML, ["spec.toml", "UTF-8"];
        "no TOML", toml("[encoder\n"), TOML, ["spec.toml:1:"];
        "JSON cut in the middle", json("{\"extends\": \"naf\", \"encoder\": {\"lev"), JSON, ["spec.json:1:"];
        "a JSON key twice", json("{\"extends\": \"naf\",\n \"name\": \"a\",\n \"name\": \"b\"}"),
            JSON, ["spec.json:3:2", "a second time"];
        "a misspelt key", toml("extends = \"naf\"\n[encoder]\nlevles = 3\n"),
            TOML, ["spec.toml:3:1", "levles", "\"levels\""];
        "a misspelt type", toml("extends = \"naf\"\n[field]\ntype = \"mpl\"\n"),
            TOML, ["spec.toml:3:8", "\"mpl\"", "\"mlp\""];
        "a text where a number is due", toml("extends = \"naf\"\n[encoder]\nlevels = \"16\"\n"),
            TOML, ["spec.toml:3:10", "the text \"16\""];
        "a negative number", toml("extends = \"naf\"\n[encoder]\nlevels = -1\n"), TOML, ["spec.toml:3:10", "-1"];
        "a number past 2^64", toml("extends = \"naf\"\n[encoder]\nlevels = 99999999999999999999\n"),
            TOML, ["spec.toml:3:10", "64 bits"];
        "features evaluated again after no time",
            toml("extends = \"naf\"\ncallbacks = [{ type = \"drift\", every = 0.0 }]\n"),
            TOML, ["callbacks.0.every", "positive"];
        "no points to record features of", toml("extends = \"naf\"\ncallbacks = [{ type = \"drift\", points = 0 }]\n"),
            TOML, ["callbacks.0.points", "1 to 65536"];
        "a misspelt loss", toml("extends = \"naf\"\n\nloss = \"hubr\"\n"),
            TOML, ["spec.toml:3:8", "loss", "no loss type", "\"huber\""];
        "a loss that is linear from 0 on", toml("extends = \"naf\"\n\nloss = { type = \"huber\", delta = 0.0 }\n"),
            TOML, ["spec.toml:3:34", "loss.delta", "positive"];
        "a prior on blocks of one point", toml("extends = \"naf\"\n[[priors]]\ntype = \"total-variation\"\nedge = 1\n"),
            TOML, ["spec.toml:4:8", "priors.0.edge", "2 to 32"];
        "a prior that is no list", toml("extends = \"naf\"\n\npriors = \"total-variation\"\n"),
            TOML, ["spec.toml:3:10", "priors", "a list, each a table with a prior type, or its name"];
        "a surround by another name", toml("extends = \"naf\"\n[scene]\nsurround = \"coarsely\"\n"),
            TOML, ["spec.toml:3:12", "scene.surround"];
        "a surround without cells", toml("extends = \"naf\"\n[scene]\nsurround = { coarse = { cells = 0 } }\n"),
            TOML, ["scene.surround.coarse.cells", "4 to 256"];
        "a surround that goes nowhere, of fdk",
            toml("extends = \"fdk\"\n[scene]\nsurround = { coarse = { margin = -1.0 } }\n"),
            TOML, ["scene.surround.coarse.margin", "-1"];
        "NaN", toml("extends = \"naf\"\n[scene]\nfill = nan\n"), TOML, ["spec.toml:3:8", "finite"];
        "a grid past memory", toml("extends = \"naf\"\n[encoder]\nlog2_table_size = 60\n"),
            TOML, ["spec.toml:3:19", "found 60"];
        "a layer of 2^62 neurons", toml("extends = \"naf\"\n[field]\nwidth = 4611686018427387904\n"),
            TOML, ["spec.toml:3:9", "4611686018427387904"];
        "2^62 samples along a ray", toml("extends = \"naf\"\n[projector]\nsamples = 4611686018427387904\n"),
            TOML, ["spec.toml:3:11", "4611686018427387904"];
        "patience of no record", toml("extends = \"naf\"\ncallbacks = [{ type = \"patience\", records = 0 }]\n"),
            TOML, ["spec.toml:2:", "callbacks.0.records", "at least 1"];
        "samples given in two ways",
            toml("extends = \"naf\"\n[projector]\nsamples = 64\nstep_voxels = 2\n"),
            TOML,
            ["spec.toml:4:1", "projector.step_voxels", "samples beside it", "one of samples, step_mm, step_voxels"];
        "a batch of 2^62 rays", toml("extends = \"naf\"\n[training]\nrays = 4611686018427387904\n"),
            TOML, ["spec.toml:3:", "4611686018427387904"];
        "a date", toml("extends = \"naf\"\nname = 2026-01-01\n"), TOML, ["spec.toml:2:8", "2026-01-01"];
        "a base that does not exist", toml("extends = \"nothing\"\n"),
            TOML, ["spec.toml:1:11", "neither a shipped spec nor a file"];
        "a base that is this one", toml("extends = \"spec.toml\"\n"), TOML, ["spec.toml:1:11", "no circle"];
        "a base without end", toml("extends = \"/dev/zero\"\n"), TOML, ["spec.toml:1:11", "a regular file"];
        "arrays 100 000 deep", |d| put(d.join("spec.json"), "[".repeat(100_000)), JSON, ["spec.json:1:", "recursion"];
        "tables 100 000 deep", |d| put(d.join("spec.toml"), format!("x = {}", "{x=".repeat(60_000))),
            TOML, ["spec.toml:1:"];
        "20 000 unknown keys", |d| {
            let keys: String = (0..20_000).map(|i| format!("k{i}=1\n")).collect();
            put(d.join("spec.toml"), "type=\"fdk\"\n".to_owned() + &keys);
        }, TOML, ["spec.toml:2:1", "k0"];
        "a text of 300 kB", |d| put(d.join("spec.toml"), "#".repeat(300_000)),
            TOML, ["file size", "at most 262144 bytes"];
        "a folder", |d| std::fs::create_dir(d.join("spec.toml")).unwrap(), TOML, ["spec.toml", "a regular file"];
        "a name that is a slip", |_| (), "explain ni-nef", ["ni-nef", "\"ni-naf\""];
        "--set without a value", |_| (), "explain naf --set encoder.levels", ["--set encoder.levels", "path=value"];
        "--set past the end of a list", |_| (),
            "explain naf --set normalizers.18446744073709551615.type=layer-norm", ["normalizers", "to add one"];
        "--set of an unknown key", |_| (), "explain naf --set encoder.level=3", ["encoder.level", "\"levels\""];
        "a growth past all numbers", toml("extends = \"naf\"\n[encoder]\ngrowth = 1e9\n"),
            TOML, ["spec.toml:3:10", "1000000000"];
    }
}
