//! Plugins with one fault each, and the outcome: refused when loaded, refused in the trial, found by the check, or an
//! error of the run. `faulty.md` is generated from this; `CONEFIELD_BLESS=1` writes it.

use crate::build::{cc, example, sources};
use crate::common::{conefield, done, text};
use rayon::prelude::*;
use std::fmt::Write as _;
use std::path::Path;

/// A plugin with one fault.
struct Fault {
    /// Description for the page.
    what: &'static str,
    /// The fault, or a compiler define `NAME=VALUE`.
    define: &'static str,
    /// Part of the message of each of `plugins list`, `plugins check` and `reconstruct`; empty for success.
    list: &'static str,
    check: &'static str,
    reconstruct: &'static str,
}

const fn fault(what: &'static str, define: &'static str, [list, check, reconstruct]: [&'static str; 3]) -> Fault {
    Fault { what, define, list, check, reconstruct }
}

/// Refused in the same way wherever it is loaded.
const fn refused(what: &'static str, define: &'static str, why: &'static str) -> Fault {
    fault(what, define, [why; 3])
}

/// Loads, but its stage fails the trial.
const fn untried(what: &'static str, define: &'static str, why: &'static str) -> Fault {
    fault(what, define, ["", why, why])
}

/// A table of faults, a row each: how it ends, and the arguments of the function of that name.
macro_rules! faults {
    ($($ends:ident $what:expr, $define:expr, $says:expr;)*) => { &[$($ends($what, $define, $says)),*] };
}

const FAULTS: &[Fault] = faults! {
    fault "nothing", "NONE", ["", "", ""];
    refused "no plugin: the function is missing", "ENTRY=another_name",
        "a library without the function conefield_plugin";
    refused "another version of the contract", "WRONG_ABI", "ABI version: found 5.0, expected 4.x";
    refused "a table that is too short", "SHORT_TABLE", "the table is too short";
    refused "functions that are too few", "SHORT_FUNCTIONS", "the table is too short";
    refused "a function that must be there is NULL", "NO_FORWARD", "no function forward";
    refused "no stages", "NO_STAGES", "stages: found 0";
    refused "a name that no spec could write", "NAME=\"Faulty Encoder\"", "lower-case letters, digits and hyphens";
    refused "a name that is taken", "NAME=\"hash-grid\"", "a name that conefield itself (conefield-encoders) has";
    refused "a schema that is no JSON", "SCHEMA=\"{type: object}\"", "a JSON Schema";
    untried "more channels out than it writes", "MORE_CHANNELS", "is left unwritten";
    untried "more parameters than its blocks have", "MORE_PARAMETERS",
        "blocks of 3 parameters in all, where there are 5";
    untried "two blocks of one name", "TWIN_BLOCKS", "two blocks are called \"factor\"";
    untried "writes past its tile", "PAST_TILE", "it writes outside its output: 1 past";
    untried "passes without a function for them", "NO_FORWARD_PASS",
        "it goes forward in 2 passes with no function forward_pass";
    untried "passes that are not its forward", "WRONG_PASSES", "its passes together are not its forward";
    untried "writes before its gradients", "BEFORE_GRADIENTS", "it writes outside its gradients: 1 before";
    untried "returns NaN", "NOT_A_NUMBER", "number 0 of 3 of its output is NaN";
    untried "fails", "FAILS", "forward failed: no more numbers";
    untried "sleeps in forward", "SLEEPS", "it did not return within 5 s";
    untried "sleeps in create", "SLEEPS_IN_CREATE", "it did not return within 5 s";
    fault "a parameter gradient that is 10 % too large", "WRONG_GRADIENT", ["", "finite differences: parameters", ""];
    fault "an input gradient of the wrong sign", "WRONG_INPUT_GRADIENT", ["", "finite differences: inputs", ""];
    fault "keeps all channels where some are to go", "REDUCES_NOTHING", ["", "keep outputs", ""];
    untried "too few resolutions", "FEW_RESOLUTIONS", "resolutions failed: channel 2 of 3 is left unwritten";
    untried "more resolutions than channels", "MORE_RESOLUTIONS",
        "resolutions failed: it writes past the 3 channels that there are";
    untried "a resolution that is NaN", "NAN_RESOLUTION", "resolutions failed: channel 1 of 3 resolves NaN cells";
    untried "a negative resolution", "NEGATIVE_RESOLUTION", "resolutions failed: channel 1 of 3 resolves -8 cells";
    fault "results that depend on earlier calls", "REMEMBERS", ["", "tile sizes: outputs", ""];
    fault "returns NaN after a hundred calls", "NOT_A_NUMBER_LATER", ["", "extremes", "training diverged"];
    fault "fails after a hundred calls", "FAILS_LATER", ["", "no fault", "forward failed: no more numbers"];
    fault "calls abort", "ABORTS", ["", "crashed the checking process (signal 6)", ABORTED];
};

/// Faults of projectors that are fitted to a scene: `faulty_rays.c`.
const RAY_FAULTS: &[Fault] = faults! {
    fault "a projector that is fitted", "NONE", ["", "", ""];
    fault "a projector that cannot be fitted", "FITS_NOT",
        ["", "fitted to a scene", "fitted failed: no scene suits it"];
    fault "a fitted projector that is the old one", "FITS_ITSELF",
        ["", "fitted to a scene", "fitted: found the old stage, expected a new one"];
    fault "a fitted projector that returns NaN", "FITS_NAN", ["", "fitted to a scene", "sample 0 is at"];
    fault "a fitted projector whose lengths are 10 % too long", "FITS_LONGER", ["", "fitted to a scene", ""];
};

/// Faults of losses: `faulty_loss.c`.
const LOSS_FAULTS: &[Fault] = faults! {
    refused "a loss without its function", "NO_AT", "no function at";
    untried "a negative loss", "NEGATIVE", "refused: predicted -0.25, measured -0.5: loss -0.03125";
    untried "a loss that is NaN", "NOT_A_NUMBER", "refused: predicted -0.5, measured -0.5: loss NaN";
    untried "a loss that writes past its slopes", "PAST_SLOPES", "it writes outside its slopes: 1 past 16 numbers";
    untried "a loss that fails", "FAILS", "at failed: no more numbers";
    fault "a slope that is 10 % too large", "WRONG_SLOPE", ["", "finite differences", ""];
    fault "a loss for a scan that is the old one", "FITS_ITSELF",
        ["", "learns from a scan", "fitted: found the old stage, expected a new one"];
    fault "a loss that cannot learn from a scan", "FITS_NOT",
        ["", "learns from a scan", "fitted failed: no scan suits it"];
};

/// Faults of priors: `faulty_prior.c`.
const PRIOR_FAULTS: &[Fault] = faults! {
    untried "blocks of one point", "FLAT_BLOCKS", "edge: found 1, expected 2 to 32";
    untried "a negative penalty", "NEGATIVE", "refused: the penalty of a block is -";
    untried "a penalty that is NaN", "NOT_A_NUMBER", "refused: the penalty of a block is NaN";
    untried "a prior that writes before its gradient", "BEFORE_GRADIENT",
        "it writes outside its gradient: 1 before 64 numbers";
    untried "a prior that fails", "FAILS", "block failed: no more numbers";
    fault "a prior's gradient that is 10 % too large", "WRONG_GRADIENT", ["", "finite differences", ""];
    fault "a prior's gradient that overwrites", "OVERWRITES", ["", "gradients add", ""];
};

/// Faults of parts of iterative methods: `faulty_pieces.c`, with the spec that uses them.
const PIECE_FAULTS: &[(&str, &[Fault])] = &[
    (
        "prior.type=faulty",
        faults! {
            fault "sound pieces of methods", "NONE", ["", "", ""];
            refused "a regularizer without its proximal map", "R_NO_PROX", "no function prox";
            untried "a negative penalty of a regularizer", "R_NEGATIVE", "refused: the penalty is -";
            untried "a proximal map that is NaN", "R_NOT_A_NUMBER", "refused: number 0 of 120 of its coefficients is NaN";
            untried "a proximal map that writes past its coefficients", "R_PAST",
                "it writes outside its coefficients: 1 past 120 numbers";
            untried "a proximal map below 0", "R_BELOW", "refused: its proximal map gives -";
            untried "a proximal map that fails", "R_FAILS", "prox failed: no more numbers";
            untried "a regularizer for no grid", "R_NO_GRID", "on failed: no such grid";
            untried "a penalty that is the regularizer", "R_ITSELF", "on: found the old stage, expected a new one";
            untried "two states of one name", "R_TWIN_STATE", "two entries are called \"calls\"";
            untried "a weight that is NaN", "R_WEIGHT", "weight: found NaN, expected a finite number";
            fault "a proximal map that shrinks half as much", "R_HALVED", ["", "proximal map", ""];
            fault "a state that is not reported", "R_FORGETS", ["", "state", ""];
            fault "a proximal map that fails later", "R_LATER", ["", "no fault", "prox failed: no more numbers"];
        },
    ),
    (
        "data.type=faulty",
        faults! {
            refused "a data term for no scan", "D_NO_OF", "no function of";
            untried "a negative misfit", "D_NEGATIVE", "refused: the misfit is -";
            untried "a derivative that is NaN", "D_NOT_A_NUMBER", "number 0 of 42 of its derivatives is NaN";
            untried "a data term that writes past its values", "D_PAST",
                "it writes outside its curvatures: 1 past 42 numbers";
            untried "noise that is NaN", "D_NOISE", "refused: the noise that it finds is NaN";
            untried "a data term that refuses a scan", "D_NO_SCAN", "of failed: no such scan";
            fault "a derivative that is 10 % too large", "D_STEEP", ["", "finite differences", ""];
            fault "a bound of the curvature that is too low", "D_LOW_BOUND", ["", "curvature", ""];
            fault "a data term that fails later", "D_LATER", ["", "no fault", "differentiate failed: no more numbers"];
        },
    ),
    (
        "basis.type=faulty",
        faults! {
            untried "no coefficients", "B_NO_COEFFICIENTS", "info failed: coefficients: volume.shape: found [0, 4, 6]";
            untried "a basis that writes past its voxels", "B_PAST", "it writes outside its voxels: 1 past 120 numbers";
            untried "a voxel that is left unwritten", "B_UNWRITTEN", "number 119 of 120 of its voxels is left unwritten";
            untried "a basis that fails", "B_FAILS", "expand failed: no more numbers";
            fault "an adjoint that is 1 % too long", "B_LONG_ADJOINT", ["", "adjoint: single precision", ""];
            fault "a basis that fails later", "B_LATER", ["", "no fault", "expand failed: no more numbers"];
        },
    ),
];

/// No process survives this fault.
const ABORTED: &str = "(the process is gone)";

/// The same with panics in a Rust plugin.
const PANICS: &[(&str, &str, [&str; 2])] = &[
    (
        "panics in create",
        "create",
        ["create panicked: as ordered, in create", "create panicked: as ordered, in create"],
    ),
    (
        "panics in forward",
        "forward",
        ["forward panicked: as ordered, in forward", "forward panicked: as ordered, in forward"],
    ),
    (
        "panics in backward",
        "backward",
        ["backward panicked: as ordered, in backward", "backward panicked: as ordered, in backward"],
    ),
    ("panics after a hundred calls", "later", ["no fault", "forward panicked: as ordered, in call"]),
];

/// The last line of a command's output; empty for success. Omits folders of this test.
fn said(args: &[&str], hide: &[&Path]) -> String {
    let output = conefield(args).output().unwrap();
    if output.status.success() {
        return String::new();
    }
    let mut err = String::from_utf8(output.stderr).unwrap();
    if std::os::unix::process::ExitStatusExt::signal(&output.status).is_some() {
        return ABORTED.into();
    }
    for folder in hide {
        err = err.replace(&format!("{}/", folder.canonicalize().unwrap().display()), "");
        err = err.replace(&format!("{}/", folder.display()), "");
    }
    let last = err.lines().rev().find_map(|l| l.strip_prefix("error: ")).unwrap_or_default();
    last.to_owned()
}

fn refusal(library: &str, hide: &[&Path]) -> String {
    let listed: serde_json::Value =
        serde_json::from_str(&done(&["--plugin", library, "plugins", "list", "--json"])).unwrap();
    let mut why = listed["plugins"][0]["refused"].as_str().unwrap_or_default().to_owned();
    for folder in hide {
        why = why.replace(&format!("{}/", folder.canonicalize().unwrap().display()), "");
        why = why.replace(&format!("{}/", folder.display()), "");
    }
    why
}

/// A line of the page: the message of each command; empty for success.
struct Row {
    what: String,
    list: String,
    check: String,
    run: String,
}

impl Row {
    fn of(what: &str, said: [&str; 3], want: [&str; 3]) -> Self {
        let [list, check, run] = [0, 1, 2].map(|i| shortened(said[i], want[i]));
        Self { what: what.into(), list, check, run }
    }
}

fn fits(what: &str, command: &str, found: &str, want: &str) {
    let fine = if want.is_empty() { found.is_empty() } else { found.contains(want) };
    assert!(fine, "{what}: {command} said {found:?}, expected {want:?}");
}

#[test]
fn every_fault_is_found_and_none_takes_the_process_down() {
    let dir = tempfile::tempdir().unwrap();
    let scan = text(&dir.path().join("scan"));
    done(&["simulate", "phantom:head:16", "-o", &scan, "--views", "6", "--detector", "16x16"]);
    let reconstruct = |library: &str, number: usize, spec: &[&str], hide: &[&Path]| {
        let run = text(&dir.path().join(format!("run-{number}")));
        let mut args = vec!["--plugin", library, "reconstruct", &scan, "-o", &run];
        args.extend(spec);
        let found = said(&args, hide);
        // A failed run leaves no volume.
        let volume = dir.path().join(format!("run-{number}/volume.nii.gz"));
        assert!(found.is_empty() || !volume.exists(), "{library}");
        found
    };
    let fast = ["--spec", "fast", "--steps", "100", "--set", "training.rays=16", "--set"];
    let of_fast = |sets: &[&'static str]| [&fast[..], sets].concat();
    let encoder = of_fast(&["encoder.type=faulty", "--set", "projector.samples=16"]);
    let [rays, loss, prior] =
        ["projector.type=faulty", "loss.type=faulty", "priors.0.type=faulty"].map(|set| of_fast(&[set]));
    let of_piece = |set: &'static str| vec!["--spec", "fista", "--steps", "40", "--set", set];
    let pieces =
        PIECE_FAULTS.iter().flat_map(|(set, faults)| faults.iter().map(|f| (f, "faulty_pieces.c", of_piece(set))));
    let all = FAULTS
        .iter()
        .map(|f| (f, "faulty.c", encoder.clone()))
        .chain(RAY_FAULTS.iter().map(|f| (f, "faulty_rays.c", rays.clone())))
        .chain(LOSS_FAULTS.iter().map(|f| (f, "faulty_loss.c", loss.clone())))
        .chain(PRIOR_FAULTS.iter().map(|f| (f, "faulty_prior.c", prior.clone())))
        .chain(pieces);
    let all: Vec<_> = all.enumerate().collect();
    // Some of them sleep, and most of their work has one thread.
    let rows = all.into_par_iter().map(|(i, (fault, source, set))| {
        let own = dir.path().join(format!("plugin-{i}"));
        std::fs::create_dir(&own).unwrap();
        let library = own.join("faulty.so");
        let fault_is = format!("FAULT={}", fault.define);
        let define = if fault.define.contains('=') { fault.define } else { &fault_is };
        cc(&sources().join("plugins/tests").join(source), &[define], &library);
        let (library, here) = (text(&library), [own.as_path(), dir.path()]);
        let list = refusal(&library, &here);
        let check = said(&["plugins", "check", &library], &here);
        let run = reconstruct(&library, i, &set, &here);
        fits(fault.what, "list", &list, fault.list);
        fits(fault.what, "check", &check, fault.check);
        fits(fault.what, "reconstruct", &run, fault.reconstruct);
        Row::of(fault.what, [&list, &check, &run], [fault.list, fault.check, fault.reconstruct])
    });
    let mut rows: Vec<Row> = rows.collect();
    let panics = example("panics");
    let folder = panics.parent().unwrap();
    for (i, (what, when, [check, run])) in PANICS.iter().enumerate() {
        let library = text(&panics);
        let settings = format!("{{\"when\": \"{when}\"}}");
        let checked = said(&["plugins", "check", &library, "--settings", &settings], &[folder]);
        let when = format!("encoder.when={when}");
        let set = [&fast[..], &["encoder.type=panics", "--set", &when, "--set", "projector.samples=16"]].concat();
        let ran = reconstruct(&library, 200 + i, &set, &[folder]);
        fits(what, "check", &checked, check);
        fits(what, "reconstruct", &ran, run);
        rows.push(Row::of(what, ["", &checked, &ran], ["", check, run]));
    }
    page(&rows);
}

/// Random points miss such a place, and a smaller learning rate does not help.
#[test]
fn numbers_that_are_not_finite_at_an_edge_are_found_and_the_run_names_the_stage() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| text(&dir.path().join(name));
    done(&["simulate", "phantom:head:16", "-o", &at("scan"), "--views", "6", "--detector", "16x16"]);
    let library = dir.path().join("faulty.so");
    cc(&sources().join("plugins/tests/faulty.c"), &["FAULT=NAN_AT_AN_EDGE"], &library);
    let library = text(&library);
    let checked = said(&["plugins", "check", &library], &[dir.path()]);
    assert!(checked.contains("faulty: finite"), "{checked}");
    let sets = ["--spec", "fast", "--steps", "100", "--set", "encoder.type=faulty", "--set", "projector.samples=64"];
    let run = at("run");
    let ran = said(&[&["--plugin", &library, "reconstruct", &at("scan"), "-o", &run][..], &sets].concat(), &[]);
    let named = "the first stage whose output is not finite: encoder (";
    assert!(ran.contains("training diverged") && ran.contains(named), "{ran}");
}

/// A message up to its required part: the rest may depend on the number of threads.
fn shortened(message: &str, want: &str) -> String {
    if message.contains("not hold: ") {
        return format!("does not hold: {want}");
    }
    let end = message.find(want).map_or(message.len(), |at| at + want.len());
    let more = if end < message.len() { " …" } else { "" };
    format!("{}{more}", &message[..end]).replace('|', "\\|").replace('\n', " ")
}

/// The page of all faults.
fn page(rows: &[Row]) {
    let mut text = String::from(
        "# Faulty plugins\n\nWhat happens to plugins with one fault each. `cli/tests/plugins/faulty.rs` makes this table from \
         `plugins/tests`; `CONEFIELD_BLESS=1 cargo test --release --workspace --test plugins` writes it.\n\n- *load*: refused by \
         `plugins list` (which shows the others), `plugins check` and a reconstruction when the library is loaded.\n- *trial*: \
         refused when the stage is made. Each stage is tried on a few rows, between guard zones and with a time limit.\n- \
         *check*: found by `plugins check` only, such as wrong gradients.\n- *run*: an error of the run, which leaves no \
         volume.\n\nA plugin runs in the process that loads it. One that calls `abort`, or writes far out of bounds, ends that \
         process; the check runs in a separate process and reports it.\n\n| fault | found by | message |\n| --- | --- | --- |\n",
    );
    for Row { what, list, check, run } in rows {
        let found = match (list.is_empty(), check.is_empty(), run.is_empty()) {
            (false, ..) => vec![("load", list)],
            (true, true, true) => vec![("nobody: nothing is wrong", run)],
            _ if check == run => vec![("trial", run)],
            _ => [("check", check), ("run", run)].into_iter().filter(|(_, said)| !said.is_empty()).collect(),
        };
        for (by, said) in found {
            let _ = writeln!(text, "| {what} | {by} | {said} |");
        }
    }
    let path = sources().join("cli/tests/plugins/faulty.md");
    if std::env::var_os("CONEFIELD_BLESS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(found == text, "{} is not current; CONEFIELD_BLESS=1 writes it\n{text}", path.display());
}
