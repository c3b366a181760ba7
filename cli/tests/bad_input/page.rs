//! The table of `docs/reference/bad-inputs.md`.

use crate::case::Outcome;
use std::fs;
use std::path::Path;

const BEGIN: &str = "<!-- the table begins here; it is written by cli/tests/bad_input -->\n";

/// Compares the page with what was seen, or writes it there.
pub fn check(run: &[(&str, Vec<Outcome>)]) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/reference/bad-inputs.md");
    let page = fs::read_to_string(&path).unwrap();
    let (head, _) = page.split_once(BEGIN).expect("the page marks where the table begins");
    let wanted = format!("{head}{BEGIN}{}", table(run));
    if std::env::var_os("CONEFIELD_BLESS").is_some() {
        return fs::write(path, wanted).unwrap();
    }
    let differ = page.lines().zip(wanted.lines()).find(|(a, b)| a != b);
    assert!(page == wanted, "docs/reference/bad-inputs.md is not current (CONEFIELD_BLESS=1 writes it): {differ:?}");
}

fn table(run: &[(&str, Vec<Outcome>)]) -> String {
    let mut text = String::new();
    for (title, outcomes) in run {
        text.push_str(&format!("\n### {title}\n\n| Input | Command | Status | Message |\n| --- | --- | --- | --- |\n"));
        for o in outcomes {
            let status = o.status.map_or("killed".into(), |s| s.to_string());
            let message = o.message.strip_prefix("error: ").unwrap_or(&o.message);
            let [what, command, message] = [o.what, &o.command, message].map(|t| t.replace('|', "\\|"));
            text.push_str(&format!("| {what} | `{command}` | {status} | {} |\n", escaped(&message)));
        }
    }
    text
}

/// As Markdown shows it unchanged.
fn escaped(text: &str) -> String {
    text.replace('<', "&lt;").replace('*', "\\*").replace('_', "\\_").replace('[', "\\[")
}
