//! The table in `cases.md`.

use crate::case::Outcome;
use conefield_tests::blessed;
use std::path::Path;

const HEAD: &str = "# Bad inputs and what conefield says\n\nWritten by `CONEFIELD_BLESS=1 cargo test --release --workspace --test bad_input`.\n";

/// Compares the table with the outcomes, or writes it.
pub fn check(run: &[(&str, Vec<Outcome>)]) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bad_input/cases.md");
    blessed::check(&path, &format!("{HEAD}{}", table(run)));
}

fn table(run: &[(&str, Vec<Outcome>)]) -> String {
    let mut text = String::new();
    for (title, outcomes) in run {
        text.push_str(&format!("\n## {title}\n\n| Input | Command | Status | Message |\n| --- | --- | --- | --- |\n"));
        for o in outcomes {
            let status = o.status.map_or("killed".into(), |s| s.to_string());
            let message = o.message.strip_prefix("error: ").unwrap_or(&o.message);
            let [what, command, message] = [o.what, &o.command, message].map(|t| t.replace('|', "\\|"));
            text.push_str(&format!("| {what} | `{command}` | {status} | {} |\n", escaped(&message)));
        }
    }
    text
}

/// Escapes text for Markdown.
fn escaped(text: &str) -> String {
    text.replace('<', "&lt;").replace('*', "\\*").replace('_', "\\_").replace('[', "\\[")
}
