//! The tables in `cases.md`.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// One part is written at a time.
static PAGE: Mutex<()> = Mutex::new(());

/// The picture of how errors grow, in the documentation.
pub fn picture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/images/error-growth.png")
}

/// Whether pages are written instead of compared.
pub fn blessing() -> bool {
    std::env::var_os("CONEFIELD_BLESS").is_some()
}

/// The head of a table of cases.
pub fn head(title: &str) -> String {
    format!("\n### {title}\n\n| Case | Expected | Ended | Figure | Held against |\n| --- | --- | --- | --- | --- |\n")
}

/// Writes `text` between the marks of `part`, or compares what stands there but for its figures.
pub fn keep(part: &str, text: &str) {
    let _alone = PAGE.lock().unwrap_or_else(|e| e.into_inner());
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/extremes/cases.md");
    let page = fs::read_to_string(&path).unwrap();
    let (begin, end) =
        (format!("<!-- {part}: written by tests/tests/extremes -->\n"), format!("\n<!-- end of {part} -->"));
    let (before, rest) = page.split_once(&begin).expect("the page marks where the part begins");
    let (old, after) = rest.split_once(&end).expect("the page marks where the part ends");
    if blessing() {
        return fs::write(&path, format!("{before}{begin}{text}{end}{after}")).unwrap();
    }
    let (old, new): (Vec<_>, Vec<_>) = (old.lines().map(lasting).collect(), text.lines().map(lasting).collect());
    let differ = old.iter().zip(&new).find(|(a, b)| a != b);
    assert!(old == new, "{} is not current (CONEFIELD_BLESS=1 writes it): {differ:?}", path.display());
}

/// What of a line is the same on every machine: the first three cells of a row, without numbers in the third.
fn lasting(line: &str) -> String {
    let cells: Vec<&str> = line.split(" | ").collect();
    let Some(ended) = cells.get(2).filter(|_| line.starts_with('|')) else { return line.to_owned() };
    let words = ended.replace(|c: char| c.is_ascii_digit() || ".-".contains(c), "");
    [cells[0], cells[1], &words].join(" | ")
}

/// As Markdown shows it unchanged.
pub fn escaped(text: &str) -> String {
    text.replace('|', "\\|").replace('<', "&lt;").replace('*', "\\*").replace('_', "\\_").replace('[', "\\[")
}
