//! Plugins with one fault each, made by an edit of what `plugins new` writes, and the outcome: refused when loaded,
//! refused in the trial, found by the check, or an error of the run. The table of `faulty.md` is generated from this;
//! `CONEFIELD_BLESS=1` writes it.

use crate::build::{cc, example, sources};
use crate::common::{Folder, text};
use rayon::prelude::*;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A plugin with one fault.
struct Fault {
    /// Description for the page.
    what: &'static str,
    /// What makes it of the sound plugin.
    edit: Edit,
    /// Part of the message of each of `plugins list`, `plugins check` and `reconstruct`; empty for success.
    list: &'static str,
    check: &'static str,
    reconstruct: &'static str,
}

const fn fault(what: &'static str, edit: Edit, [list, check, reconstruct]: [&'static str; 3]) -> Fault {
    Fault { what, edit, list, check, reconstruct }
}

/// An edit of a plugin: a text that is there once, and the two that take its place, one after the other.
type Edit = [&'static str; 3];

const fn before(at: &'static str, code: &'static str) -> Edit {
    [at, code, at]
}

const fn instead(at: &'static str, code: &'static str) -> Edit {
    [at, code, ""]
}

const NOTHING: Edit = [""; 3];

fn edit(plugin: &str, [at, code, rest]: Edit) -> String {
    assert!(at.is_empty() || plugin.matches(at).count() == 1, "{at:?} is not there once");
    plugin.replacen(at, &format!("{code}{rest}"), 1)
}

/// Refused in the same way wherever it is loaded.
const fn refused(what: &'static str, edit: Edit, why: &'static str) -> Fault {
    fault(what, edit, [why; 3])
}

/// Loads, but its stage fails the trial.
const fn untried(what: &'static str, edit: Edit, why: &'static str) -> Fault {
    fault(what, edit, ["", why, why])
}

/// A table of faults, a row each: how it ends, what it is, the edit that makes it, and what is said about it.
macro_rules! faults {
    ($($ends:ident $what:expr, $edit:ident $at:expr, $code:expr, $says:expr;)*) => {
        &[$($ends($what, $edit($at, $code), $says)),*]
    };
}

/// A kind of stage and its faults.
struct Kind {
    kind: &'static str,
    /// What gives the sound plugin a function that the template lacks.
    more: Edit,
    /// The run, and the setting that puts the plugin into it.
    run: &'static str,
    set: &'static str,
    faults: &'static [Fault],
}

const SCAN: &str = "simulate phantom:head:16 -o scan --views 6 --detector 16x16";

/// C that fails, at once or after some calls.
const FAILS: &str = "return say(error, \"no more numbers\"), CONEFIELD_FAILED; ";
const FAILS_LATER: &str = "if (calls++ > 20) return say(error, \"no more numbers\"), CONEFIELD_FAILED; ";

const FAST: &str = "--spec fast --steps 100 --set training.rays=16 --set projector.samples=16 --set";
const FISTA: &str = "--spec fista --steps 40 --set";

const KINDS: [Kind; 7] = [
    Kind { kind: "encoder", more: NOTHING, run: FAST, set: "encoder.type=faulty", faults: ENCODER_FAULTS },
    Kind { kind: "projector", more: FITTED_RAYS, run: FAST, set: "projector.type=faulty", faults: RAY_FAULTS },
    Kind { kind: "loss", more: FITTED_LOSS, run: FAST, set: "loss.type=faulty", faults: LOSS_FAULTS },
    Kind { kind: "prior", more: NOTHING, run: FAST, set: "priors.0.type=faulty", faults: PRIOR_FAULTS },
    Kind { kind: "regularizer", more: NOTHING, run: FISTA, set: "prior.type=faulty", faults: REGULARIZER_FAULTS },
    Kind { kind: "data-term", more: NOTHING, run: FISTA, set: "data.type=faulty", faults: DATA_TERM_FAULTS },
    Kind { kind: "basis", more: NOTHING, run: FISTA, set: "basis.type=faulty", faults: BASIS_FAULTS },
];

/// After a hundred calls with 18 channels.
const FAILS_AT_LAST: &str = "if (calls++ > 1800) return say(error, \"no more numbers\"), CONEFIELD_FAILED; ";

/// Where an encoder gets more functions.
const MAP: &str = "static const struct ConefieldMap FUNCTIONS = {";

/// Two passes, with no function for them.
const PASSES: &str = "static size_t passes(const void *stage) { return 2; }

static const struct ConefieldMap FUNCTIONS = {
    .passes = passes,";

/// Two passes, of which the second changes what the first has written.
const WRONG_PASSES: &str = "static size_t passes(const void *stage) { return 2; }

static ConefieldStatus forward_pass(const void *stage, size_t pass, const float *params, struct ConefieldTile x,
                                    struct ConefieldTileMut y, struct ConefieldTileMut tape, struct ConefieldText *error) {
    if (pass == 0) return forward(stage, params, x, y, tape, error);
    y.data[0] += 1;
    return CONEFIELD_OK;
}

static const struct ConefieldMap FUNCTIONS = {
    .passes = passes,
    .forward_pass = forward_pass,";

/// Claims to remove channels, but returns itself.
const REDUCE: &str = "static ConefieldStatus reduce(const void *stage, uint32_t side, const size_t *keep, size_t count,
                              struct ConefieldReduced *out, struct ConefieldText *error) {
    static const struct ConefieldRange all = {0, 18};
    static const size_t channels[] = {0, 1, 2};
    *out = (struct ConefieldReduced){(void *)stage, &all, 1, channels, 3};
    return CONEFIELD_OK;
}

static const struct ConefieldMap FUNCTIONS = {
    .reduce = reduce,";

const ENCODER_FAULTS: &[Fault] = faults! {
    fault "nothing", instead "", "", ["", "", ""];
    refused "no plugin: the function is missing", instead "*conefield_plugin(void)", "*another_name(void)",
        "a library without the function conefield_plugin";
    refused "another version of the contract", instead "= CONEFIELD_ABI_MAJOR", "= CONEFIELD_ABI_MAJOR + 1",
        "ABI version: found 5.0, expected 4.x";
    refused "a table that is too short", instead "sizeof PLUGIN", "32", "the table is too short";
    refused "functions that are too few", instead "sizeof FUNCTIONS", "24", "the table is too short";
    refused "a function that must be there is NULL", instead ".forward = forward,", "", "no function forward";
    refused "no stages", instead "sizeof STAGES / sizeof *STAGES", "0", "stages: found 0";
    refused "a name that no spec could write",
        instead "TEXT(\"faulty\"),\n    .doc", "TEXT(\"Faulty Encoder\"),\n    .doc",
        "lower-case letters, digits and hyphens";
    refused "a name that is taken", instead "TEXT(\"faulty\"),\n    .doc", "TEXT(\"hash-grid\"),\n    .doc",
        "a name that conefield itself (conefield-encoders) has";
    refused "a schema that is no JSON", instead "TEXT(SCHEMA)", "TEXT(\"{type: object}\")", "a JSON Schema";
    untried "more channels out than it writes", instead ".output = n", ".output = n + 1", "is left unwritten";
    untried "more parameters than its blocks have", instead ".params = n", ".params = n + 2",
        "blocks of 18 parameters in all, where there are 20";
    untried "two blocks of one name", instead ".blocks = 1", ".blocks = 2", "two blocks are called \"amplitude\"";
    untried "writes past its tile", before "float *to =", "y.data[y.channels * y.stride] = 1; ",
        "it writes outside its output: 1 past";
    untried "passes without a function for them", instead MAP, PASSES,
        "it goes forward in 2 passes with no function forward_pass";
    untried "passes that are not its forward", instead MAP, WRONG_PASSES, "its passes together are not its forward";
    untried "writes before its gradients", before "add_gradient(", "grads.data[-1] = 1; ",
        "it writes outside its gradients: 1 before";
    untried "returns NaN", instead "to[i] = params[c]", "to[i] = NAN", "number 0 of 18 of its output is NaN";
    untried "fails", before "float *to =", FAILS, "forward failed: no more numbers";
    untried "sleeps in forward", before "float *to =", "sleep(600); ", "it did not return within 5 s";
    untried "sleeps in create", before "Waves w = {", "sleep(600); ", "it did not return within 5 s";
    fault "a parameter gradient that is 10 % too large",
        instead "add_gradient(grads, c, sum)", "add_gradient(grads, c, 1.1f * sum)",
        ["", "finite differences: parameters", ""];
    fault "an input gradient of the wrong sign", instead "+= d[i] * params[c] * f", "-= d[i] * params[c] * f",
        ["", "finite differences: inputs", ""];
    fault "keeps all channels where some are to go", instead MAP, REDUCE, ["", "keep outputs", ""];
    untried "too few resolutions", instead "c < count; c++) cells", "c + 1 < count; c++) cells",
        "resolutions: channel 17 of 18 is left unwritten";
    untried "more resolutions than channels", instead "c < count; c++) cells", "c <= count; c++) cells",
        "resolutions: it writes past the 18 channels that there are";
    untried "a resolution that is NaN", instead "cells[c] =", "cells[c] = c == 1 ? NAN :",
        "resolutions: channel 1 of 18 resolves NaN cells";
    untried "a negative resolution", instead "cells[c] =", "cells[c] = c == 1 ? -8.0 :",
        "resolutions: channel 1 of 18 resolves -8 cells";
    fault "results that depend on earlier calls",
        instead "to[i] = params[c]", "to[i] = 1e-6f * (float)(calls++ % 1000) + params[c]",
        ["", "tile sizes: outputs", ""];
    fault "returns NaN after a hundred calls",
        instead "to[i] = params[c]", "to[i] = (calls++ > 100000 ? NAN : 1) * params[c]",
        ["", "extremes", "training diverged"];
    fault "fails after a hundred calls", before "float *to =", FAILS_AT_LAST,
        ["", "no fault", "forward failed: no more numbers"];
    fault "ends the process", before "float *to =", "exit(0); ", ["", ENDED, ENDED];
    fault "calls abort", before "float *to =", "abort(); ", ["", "crashed the checking process (signal 6)", ABORTED];
};

/// After fitting it has an odd number of samples.
const FITTED_RAYS: Edit = instead(
    "static const struct ConefieldProjector FUNCTIONS = {",
    "static ConefieldStatus fitted(const void *stage, const struct ConefieldLengths *lengths, void **out,
                              struct ConefieldText *error) {
    March m = {.samples = 1 + 2 * ((const March *)stage)->samples};
    return hand_over(&m, sizeof m, out, error);
}

static const struct ConefieldProjector FUNCTIONS = {
    .fitted = fitted,",
);

/// Faults of projectors that are fitted to a scene.
const RAY_FAULTS: &[Fault] = faults! {
    fault "a projector that is fitted", instead "", "", ["", "", ""];
    fault "a projector that cannot be fitted", before "March m = {.samples = 1", FAILS,
        ["", "fitted to a scene", "fitted failed: no more numbers"];
    fault "a fitted projector that is the old one",
        instead "return hand_over(&m, sizeof m, out, error)", "*out = (void *)stage; return CONEFIELD_OK",
        ["", "fitted to a scene", "fitted: found the old stage, expected a new one"];
    fault "a fitted projector that returns NaN",
        instead "weights[i] = length", "weights[i] = n % 2 == 1 ? NAN : length",
        ["", "fitted to a scene", "sample 0 is at"];
    fault "a fitted projector whose lengths are 10 % too long",
        instead "weights[i] = length", "weights[i] = n % 2 == 1 ? 1.1f * length : length",
        ["", "fitted to a scene", ""];
    fault "an adjoint that writes nothing", instead RAY_FUNCTIONS, NO_ADJOINT,
        ["", "of its derivatives is left unwritten", "of its derivatives is left unwritten"];
    fault "an adjoint that writes past its end", instead RAY_FUNCTIONS, LONG_ADJOINT, ["", "it writes outside its derivatives", "it writes outside its derivatives"];
};

/// Where a projector gets more functions.
const RAY_FUNCTIONS: &str = "static const struct ConefieldProjector FUNCTIONS = {";

/// Line integrals with an adjoint of its own.
macro_rules! adjoint {
    ($body:literal) => {
        concat!(
            "static double integrate(const void *stage, const float *weights, const double *mu, size_t count) {
    double sum = 0;
    for (size_t i = 0; i < count; i++) sum += weights[i] * mu[i];
    return sum;
}

static void adjoint(const void *stage, const float *weights, double dline, double *dmu, size_t count) {",
            $body,
            "}

static const struct ConefieldProjector FUNCTIONS = {
    .integrate = integrate,
    .adjoint = adjoint,"
        )
    };
}

/// As after a panic.
const NO_ADJOINT: &str = adjoint!("");
const LONG_ADJOINT: &str = adjoint!("for (size_t i = 0; i <= count; i++) dmu[i] = dline;");

/// Learns nothing from a scan.
const FITTED_LOSS: Edit = instead(
    "static const struct ConefieldLoss FUNCTIONS = {",
    "static uint32_t needs_scan(const void *stage) { return 1; }

static ConefieldStatus fitted(const void *stage, const struct ConefieldNoise *noise, void **out,
                              struct ConefieldText *error) {
    return hand_over(stage, sizeof(Rounded), out, error);
}

static const struct ConefieldLoss FUNCTIONS = {
    .needs_scan = needs_scan,
    .fitted = fitted,",
);

const LOSS_FAULTS: &[Fault] = faults! {
    refused "a loss without its function", instead ".at = at,", "", "no function at";
    untried "a negative loss", instead "loss[i] = d", "loss[i] = -d",
        "refused: predicted -0.25, measured -0.5: loss -0.2";
    untried "a loss that is NaN", instead "loss[i] = d", "loss[i] = NAN * d",
        "refused: predicted -0.5, measured -0.5: loss NaN";
    untried "a loss that writes past its slopes", instead "slope[i] = d", "slope[i + (count > 1)] = d",
        "it writes outside its slopes: 1 past 16 numbers";
    untried "a loss that fails", before "double d =", FAILS, "at failed: no more numbers";
    fault "a slope that is 10 % too large", instead "slope[i] = d", "slope[i] = 1.1 * d",
        ["", "finite differences", ""];
    fault "a loss for a scan that is the old one",
        instead "return hand_over(stage, sizeof(Rounded), out, error)", "*out = (void *)stage; return CONEFIELD_OK",
        ["", "learns from a scan", "fitted: found the old stage, expected a new one"];
    fault "a loss that cannot learn from a scan", before "return hand_over(stage", FAILS,
        ["", "learns from a scan", "fitted failed: no more numbers"];
};

const PRIOR_FAULTS: &[Fault] = faults! {
    untried "blocks of one point", instead "ConefieldBlocks *)stage;", "ConefieldBlocks *)stage; out->edge = 1;",
        "edge: found 1, expected 2 to 32";
    untried "a negative penalty", instead "*penalty = sum", "*penalty = -sum", "refused: the penalty of a block is -";
    untried "a penalty that is NaN", instead "*penalty = sum", "*penalty = NAN",
        "refused: the penalty of a block is NaN";
    untried "a prior that writes before its gradient", before "*penalty = sum", "gradient[-1] = 1; ",
        "it writes outside its gradient: 1 before 512 numbers";
    untried "a prior that fails", before "double sum =", FAILS, "block failed: no more numbers";
    fault "a prior's gradient that is 10 % too large", instead "gradient[i] -= scale", "gradient[i] -= 1.1 * scale",
        ["", "finite differences", ""];
    fault "a prior's gradient that overwrites",
        before "double sum =", "memset(gradient, 0, count * sizeof *gradient); ", ["", "gradients add", ""];
};

const REGULARIZER_FAULTS: &[Fault] = faults! {
    fault "a sound regularizer", instead "", "", ["", "", ""];
    refused "a regularizer without its proximal map", instead ".prox = prox,", "", "no function prox";
    untried "a negative penalty of a regularizer", instead "*value = diff", "*value = -diff",
        "refused: the penalty is -";
    untried "a proximal map that is NaN", before "memcpy(u", "at[0] = NAN; ",
        "refused: number 0 of 120 of its coefficients is NaN";
    untried "a proximal map that writes past its coefficients", before "memcpy(u", "u[count] = 1; ",
        "it writes outside its coefficients: 1 past 120 numbers";
    untried "a proximal map below 0", instead "next > 0 ? next : 0", "next", "refused: its proximal map gives -";
    untried "a proximal map that fails", before "float *at", FAILS, "prox failed: no more numbers";
    untried "a regularizer for no grid", before "struct Penalty *p = calloc", FAILS, "on failed: no more numbers";
    untried "a penalty that is the regularizer", instead "*penalty = p", "*penalty = (void *)stage",
        "on: found the old stage, expected a new one";
    untried "two states of one name", instead "index > 0", "index > 1", "two entries are called \"u\"";
    untried "a weight that is NaN", instead "*weight = noise", "*weight = NAN * noise",
        "weight: found NaN, expected a finite number";
    fault "a proximal map that shrinks half as much", instead "- tau * slope[i]", "- 0.5f * tau * slope[i]",
        ["", "proximal map", ""];
    fault "a state that is not reported", instead ".state = state,", "", ["", "state", ""];
    fault "a proximal map that fails later", before "float *at", FAILS_LATER,
        ["", "no fault", "prox failed: no more numbers"];
};

const DATA_TERM_FAULTS: &[Fault] = faults! {
    fault "a sound data term", instead "", "", ["", "", ""];
    refused "a data term for no scan", instead ".of = of,", "", "no function of";
    untried "a negative misfit", instead "*sum += ", "*sum -= ", "refused: the misfit is -";
    untried "a derivative that is NaN", instead "residuals[i] = (", "residuals[i] = i == 0 ? NAN : (",
        "number 0 of 42 of its derivatives is NaN";
    untried "a data term that writes past its values",
        before UNCHANGED, "values[count] = 1; ",
        "it writes outside its curvatures: 1 past 42 numbers";
    untried "noise that is NaN", instead "->noise;", "->noise * NAN;", "refused: the noise that it finds is NaN";
    untried "a data term that refuses a scan", before "float *all", FAILS, "of failed: no more numbers";
    fault "a derivative that is 10 % too large", instead "residuals[i] = (", "residuals[i] = 1.1f * (",
        ["", "finite differences", ""];
    fault "a bound of the curvature that is too low",
        before UNCHANGED, "for (size_t i = 0; i < count; i++) values[i] *= 0.5f; ", ["", "curvature", ""];
    fault "a data term that fails later", before "double scale =", FAILS_LATER,
        ["", "no fault", "differentiate failed: no more numbers"];
};

/// The end of the function that leaves values as they are.
const UNCHANGED: &str = "return CONEFIELD_OK;\n}\n\nstatic const";

/// The loop of `expand`.
const EXPAND: &str = "for (size_t i = 0; i < count(&b->voxels); i++) voxels";

const BASIS_FAULTS: &[Fault] = faults! {
    fault "a sound basis", instead "", "", ["", "", ""];
    untried "no coefficients",
        instead ".double_precision = 1};", ".double_precision = 1}; info->coefficients.shape[0] = 0;",
        "info: coefficients: volume.shape: found [0, 2, 3]";
    untried "a basis that writes past its voxels", before "voxels[i] = coeff", "voxels[i + 1] = ",
        "it writes outside its voxels: 1 past 120 numbers";
    untried "a voxel that is left unwritten",
        instead "i++) voxels[i] = coeff", "i++) if (i + 1 < count(&b->voxels)) voxels[i] = coeff",
        "number 119 of 120 of its voxels is left unwritten";
    untried "a basis that fails", before EXPAND, FAILS, "expand failed: no more numbers";
    fault "an adjoint that is 1 % too long", instead "+= voxels[i]", "+= (real)1.01 * voxels[i]", ["", "adjoint", ""];
    fault "a basis that fails later", before EXPAND, FAILS_LATER, ["", "no fault", "expand failed: no more numbers"];
};

/// Of a plugin that calls `exit(0)`.
const ENDED: &str = "a plugin ended the process";

/// No process survives this fault.
const ABORTED: &str = "(the process is gone)";

/// The same with panics in a Rust plugin.
const PANICS: &[(&str, &str, [&str; 2])] = &[
    ("panics in create", "create", ["create panicked: as ordered, in create"; 2]),
    ("panics in describe", "describe", ["describe panicked: as ordered, in describe"; 2]),
    ("panics in forward", "forward", ["forward panicked: as ordered, in forward"; 2]),
    ("panics in backward", "backward", ["backward panicked: as ordered, in backward"; 2]),
    ("panics after many rows", "later", ["finite differences: inputs", "forward panicked: as ordered, in call"]),
];

/// Makes the sound plugin of this kind.
fn sound(d: &Folder, kind: &str) {
    d.done(&format!("plugins new faulty --kind {kind} --lang c --into {kind}"));
}

/// The sound plugin of a kind with an edit, compiled in the new folder `own`.
fn edited(d: &Folder, kind: &Kind, fault: Edit, own: &Path) -> PathBuf {
    let code = d.text(format!("{}/faulty/faulty.c", kind.kind));
    // For some faults: functions of the system, and the calls of this process.
    let code = format!("#include <unistd.h>\n\nstatic _Atomic int calls;\n{}", edit(&edit(&code, kind.more), fault));
    std::fs::create_dir(own).unwrap();
    let (source, library) = (own.join("faulty.c"), own.join("faulty.so"));
    std::fs::write(&source, code).unwrap();
    cc(&source, &library);
    library
}

/// A message without these folders.
fn without(mut message: String, folders: &[&Path]) -> String {
    for folder in folders {
        for shown in [&folder.canonicalize().unwrap(), *folder] {
            message = message.replace(&format!("{}/", shown.display()), "");
        }
    }
    message
}

/// The last line of a command's output; empty for success. Omits folders of this test.
fn said(d: &Folder, line: &str, hide: &[&Path]) -> String {
    let output = d.command(line).output().unwrap();
    if output.status.success() {
        return String::new();
    }
    if std::os::unix::process::ExitStatusExt::signal(&output.status).is_some() {
        return ABORTED.into();
    }
    let err = without(String::from_utf8(output.stderr).unwrap(), hide);
    let last = err.lines().rev().find_map(|l| l.strip_prefix("error: ")).unwrap_or_default();
    last.to_owned()
}

fn refusal(d: &Folder, library: &str, hide: &[&Path]) -> String {
    let listed = d.json(&format!("--plugin {library} plugins list --json"));
    without(listed["plugins"][0]["refused"].as_str().unwrap_or_default().to_owned(), hide)
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
    let d = Folder::after(&[SCAN]);
    let dir = d.at("");
    let reconstruct = |library: &str, number: usize, spec: &str, hide: &[&Path]| {
        let found = said(&d, &format!("--plugin {library} reconstruct scan -o run-{number} {spec}"), hide);
        // A failed run leaves no volume.
        assert!(found.is_empty() || !d.has(format!("run-{number}/volume.nii.gz")), "{library}");
        found
    };
    for Kind { kind, .. } in &KINDS {
        sound(&d, kind);
    }
    let all: Vec<_> = KINDS.iter().flat_map(|kind| kind.faults.iter().map(move |f| (kind, f))).enumerate().collect();
    // Some of them sleep, and most of their work has one thread.
    let rows = all.into_par_iter().map(|(i, (kind, fault))| {
        let own = d.at(format!("plugin-{i}"));
        let library = edited(&d, kind, fault.edit, &own);
        let (library, here) = (text(&library), [own.as_path(), &dir]);
        let list = refusal(&d, &library, &here);
        let check = said(&d, &format!("plugins check {library} --settings {{}}"), &here);
        let run = reconstruct(&library, i, &format!("{} {}", kind.run, kind.set), &here);
        fits(fault.what, "list", &list, fault.list);
        fits(fault.what, "check", &check, fault.check);
        fits(fault.what, "reconstruct", &run, fault.reconstruct);
        Row::of(fault.what, [&list, &check, &run], [fault.list, fault.check, fault.reconstruct])
    });
    let pool = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
    let mut rows: Vec<Row> = pool.install(|| rows.collect());
    let panics = example("rehashed");
    let (library, folder) = (text(&panics), panics.parent().unwrap());
    for (i, (what, when, [check, run])) in PANICS.iter().enumerate() {
        let line = format!("plugins check {library} --type panics --settings '{{\"when\": \"{when}\"}}'");
        let checked = said(&d, &line, &[folder]);
        let set = format!("{FAST} encoder.type=panics --set encoder.when={when}");
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
    let d = Folder::after(&[SCAN]);
    sound(&d, "encoder");
    let edge = "to[i] = (x.data[i] > 0.96f && x.data[x.stride + i] > 0.96f ? NAN : 1) * params[c]";
    let library = text(&edited(&d, &KINDS[0], instead("to[i] = params[c]", edge), &d.at("plugin")));
    let checked = said(&d, &format!("plugins check {library}"), &[]);
    assert!(checked.contains("faulty: finite"), "{checked}");
    let sets = "--spec fast --steps 100 --set encoder.type=faulty --set projector.samples=64";
    let ran = said(&d, &format!("--plugin {library} reconstruct scan -o run {sets}"), &[]);
    let named = "the first stage whose output is not finite: encoder (";
    assert!(ran.contains("training diverged") && ran.contains(named), "{ran}");
}

#[test]
fn more_parameters_than_memory_holds_are_refused_before_memory_is_taken() {
    let d = Folder::after(&[SCAN]);
    sound(&d, "encoder");
    let kind = Kind { more: instead(".shape = {3, (size_t)bands}", ".shape = {1, (size_t)1 << 38}"), ..KINDS[0] };
    let library = text(&edited(&d, &kind, instead(".params = n", ".params = (size_t)1 << 38"), &d.at("plugin")));
    let run = "reconstruct scan -o run --spec fast --set encoder.type=faulty";
    for line in [format!("plugins check {library}"), format!("--plugin {library} {run}")] {
        let found = said(&d, &format!("--memory 4GiB {line}"), &[]);
        assert!(found.contains("parameters: found 2097152 MiB more"), "{line}: {found:?}");
    }
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

/// The table of all faults, the end of the page.
fn page(rows: &[Row]) {
    let path = sources().join("cli/tests/plugins/faulty.md");
    let found = std::fs::read_to_string(&path).unwrap();
    let head = "| fault | found by | message |\n| --- | --- | --- |\n";
    let mut text = format!("{}{head}", found.split_once(head).unwrap().0);
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
    conefield_tests::blessed::check(&path, &text);
}
