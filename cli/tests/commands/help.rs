//! Help, and exit status 2 for wrong use.

use crate::common::Folder;

const COMMANDS: [&str; 21] = [
    "simulate", "import", "calibrate", "reconstruct", "compare", "study", "tradeoff", "pretrain", "evaluate", "export",
    "project", "report", "features", "explain", "info", "convert", "backends", "plugins", "schema", "completions",
    "demo",
];

/// The help of a command without its line breaks.
fn help(d: &Folder, command: &str) -> String {
    d.done(&format!("{command} --help")).split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn every_subcommand_has_help() {
    let d = Folder::new();
    let all = d.done("--help");
    for c in COMMANDS {
        assert!(all.contains(&format!("\n  {c} ")), "{c} is listed");
        let help = d.done(&format!("{c} --help"));
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
        let help = help(&d, command);
        assert!(help.contains(words), "{command}: {help}");
    }
    // One line per subcommand and for `help` itself: only tested commands are listed.
    let listed = all.lines().skip_while(|l| *l != "Commands:").skip(1).take_while(|l| !l.is_empty()).count();
    assert_eq!(listed, COMMANDS.len() + 1);
}

#[test]
fn lists_of_specs_and_stage_types_are_whole() {
    let d = Folder::new();
    let page = include_str!("../../../docs/reference/methods-and-stages.md");
    let names = conefield::specs::names();
    assert!(["balanced", "fista-tv", "sart"].iter().all(|n| names.contains(n)), "{names:?}");
    for command in ["reconstruct", "compare", "pretrain", "explain"] {
        let help = help(&d, command);
        assert!(help.contains(&format!("shipped spec ({}) or a file", names.join(", "))), "{command}: {help}");
    }
    // A command generates both tables.
    for table in d.done("schema --tables").trim().split("\n\n") {
        let wanted = "docs/reference/methods-and-stages.md: put in what `conefield schema --tables` prints";
        assert!(page.contains(table), "{wanted}:\n{table}");
    }
}

#[test]
fn shells_and_man_know_every_command() {
    let d = Folder::new();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = d.done(&format!("completions {shell}"));
        for word in COMMANDS.iter().chain(&["hold-out"]) {
            assert!(script.contains(word), "{shell}: {word}");
        }
    }
    d.done("completions --man man1");
    assert!(d.text("man1/conefield.1").contains("conefield\\-reconstruct"));
    assert!(d.text("man1/conefield-reconstruct.1").contains("hold\\-out"));
    assert!(d.refused(1, "completions --man man1").contains("--force"));
    assert!(d.refused(2, "completions tcsh").contains("fish"));
}

#[test]
fn version_is_printed() {
    assert_eq!(Folder::new().done("--version").trim(), concat!("conefield ", env!("CARGO_PKG_VERSION")));
}

/// Wrong use; see also `bad_input`.
#[test]
fn wrong_use_exits_with_2() {
    let d = Folder::new();
    for (line, want) in [
        ("reconstruct", "<SCAN>"),
        ("reconstruct s --spec naf -o r --steps 0", "--steps"),
        ("reconstruct s --spec naf -o r --backend abacus", "cpu"),
        ("reconstruct s -o r", "--spec fista-tv"),
        ("reconstruct s -o r", "--budget 60s"),
        ("reconstruct s -o r --budget 9s --steps 3", "--steps"),
        ("reconstruct s -o r --budget 9s --front f --spec naf", "--front"),
        ("compare s -o r", "--specs <SPEC,SPEC>"),
        ("compare s --specs fdk -o r --force --resume", "--resume"),
        ("tradeoff -o r", "<SCAN>"),
        ("tradeoff s -o r --keep 2", "at most 1"),
        ("study s -o r --shard 3/2", "K from 1 to N"),
        ("import s.toml -o s --i0 water", "or air"),
        ("evaluate a b --hu -1000,2000", "--segmenter"),
        ("evaluate a b --labels --segmenter 's {in} {out}'", "--labels"),
        ("features r -o f.png --after field", "normalizers"),
        ("pretrain --spec naf -o w", "<VOLUME>"),
        ("project v.nii -o p", "--like <SCAN>"),
    ] {
        let said = d.refused(2, line);
        assert!(said.contains(want), "{line}: {said}");
    }
    // Without a subcommand the help is printed.
    d.command("").assert().code(2);
}
