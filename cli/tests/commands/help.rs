//! Help, and exit status 2 for wrong use.

use crate::common::{conefield, done, refused};

const COMMANDS: [&str; 21] = [
    "simulate", "import", "calibrate", "reconstruct", "compare", "study", "tradeoff", "pretrain", "evaluate", "export",
    "project", "report", "features", "explain", "info", "convert", "backends", "plugins", "schema", "completions",
    "demo",
];

#[test]
fn every_subcommand_has_help() {
    let all = done(&["--help"]);
    for c in COMMANDS {
        assert!(all.contains(&format!("\n  {c} ")), "{c} is listed");
        let help = done(&[c, "--help"]);
        assert!(help.contains(&format!("Usage: conefield {c}")), "{help}");
        assert!(!help.contains("[OPTIONS]") || help.contains("--help"));
    }
    // The help of a command describes its output, in more than one line.
    for (command, words) in [
        ("tradeoff", "Candidates are drawn from levers"),
        ("reconstruct", "RUN receives volume.nii.gz"),
        ("evaluate", "Dice is 2|A"),
        ("import", "SCANNER.toml names the files"),
    ] {
        let help = done(&[command, "--help"]).split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(help.contains(words), "{command}: {help}");
    }
    // One line per subcommand and for `help` itself: only tested commands are listed.
    let listed = all.lines().skip_while(|l| *l != "Commands:").skip(1).take_while(|l| !l.is_empty()).count();
    assert_eq!(listed, COMMANDS.len() + 1);
}

#[test]
fn lists_of_specs_and_stage_types_are_whole() {
    let page = include_str!("../../../docs/reference/methods-and-stages.md");
    let names = conefield::specs::names();
    assert!(["balanced", "fista-tv", "sart"].iter().all(|n| names.contains(n)), "{names:?}");
    for command in ["reconstruct", "compare", "pretrain", "explain"] {
        let help = done(&[command, "--help"]).split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(help.contains(&format!("shipped spec ({}) or a file", names.join(", "))), "{command}: {help}");
    }
    // A command generates both tables.
    for table in done(&["schema", "--tables"]).trim().split("\n\n") {
        let wanted = "docs/reference/methods-and-stages.md: put in what `conefield schema --tables` prints";
        assert!(page.contains(table), "{wanted}:\n{table}");
    }
}

#[test]
fn shells_and_man_know_every_command() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = done(&["completions", shell]);
        for word in COMMANDS.iter().chain(&["hold-out"]) {
            assert!(script.contains(word), "{shell}: {word}");
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let folder = crate::common::text(&dir.path().join("man1"));
    done(&["completions", "--man", &folder]);
    let page = |name: &str| std::fs::read_to_string(dir.path().join("man1").join(name)).unwrap();
    assert!(page("conefield.1").contains("conefield\\-reconstruct"));
    assert!(page("conefield-reconstruct.1").contains("hold\\-out"));
    assert!(refused(1, &["completions", "--man", &folder]).contains("--force"));
    assert!(refused(2, &["completions", "tcsh"]).contains("fish"));
}

#[test]
fn version_is_printed() {
    assert_eq!(done(&["--version"]).trim(), concat!("conefield ", env!("CARGO_PKG_VERSION")));
}

#[test]
fn wrong_use_exits_with_2() {
    for (args, want) in [
        (&["reconstruct"][..], "<SCAN>"),
        (&["recontruct"], "reconstruct"),
        (&["simulate", "v", "-o", "s", "--noise", "salt"], "poisson"),
        (&["simulate", "v", "-o", "s", "--values", "hu:x"], "hu:MU_WATER"),
        (&["simulate", "v", "-o", "s", "--downsample", "0"], "--downsample"),
        (&["reconstruct", "s", "--spec", "naf", "-o", "r", "--budget", "0s"], "--budget"),
        (&["reconstruct", "s", "--spec", "naf", "-o", "r", "--budget", "soon"], "600s"),
        (&["reconstruct", "s", "--spec", "naf", "-o", "r", "--steps", "0"], "--steps"),
        (&["reconstruct", "s", "--spec", "naf", "-o", "r", "--hold-out", "x"], "every:10"),
        (&["reconstruct", "s", "--spec", "naf", "-o", "r", "--backend", "abacus"], "cpu"),
        (&["compare", "s", "-o", "r"], "--specs <SPEC,SPEC>"),
        (&["reconstruct", "s", "-o", "r"], "--spec fista-tv"),
        (&["reconstruct", "s", "-o", "r", "--budget", "9s", "--steps", "3"], "--steps"),
        (&["reconstruct", "s", "-o", "r", "--budget", "9s", "--front", "f", "--spec", "naf"], "--front"),
        (&["tradeoff", "-o", "r"], "<SCAN>"),
        (&["tradeoff", "s", "-o", "r", "--keep", "2"], "at most 1"),
        (&["compare", "s", "--specs", "fdk", "-o", "r", "--force", "--resume"], "--resume"),
        (&["import", "s.toml", "-o", "s", "--i0", "water"], "or air"),
        (&["evaluate", "a", "b", "--hu", "-1000,2000"], "--segmenter"),
        (&["evaluate", "a", "b", "--labels", "--segmenter", "s {in} {out}"], "--labels"),
        (&["features", "r", "-o", "f.png", "--after", "field"], "normalizers"),
        (&["pretrain", "--spec", "naf", "-o", "w"], "<VOLUME>"),
        (&["project", "v.nii", "-o", "p"], "--like <SCAN>"),
    ] {
        let said = refused(2, args);
        assert!(said.contains(want), "{args:?}: {said}");
    }
    // Without a subcommand the help is printed.
    conefield(&[]).assert().code(2);
}
