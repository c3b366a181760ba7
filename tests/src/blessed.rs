//! Files in the tree that a test writes.

use std::path::Path;

/// Checks that the file has this `text`. With the variable `CONEFIELD_BLESS`, writes it.
pub fn check(path: &Path, text: &str) {
    if std::env::var_os("CONEFIELD_BLESS").is_some() {
        return std::fs::write(path, text).unwrap();
    }
    let found = std::fs::read_to_string(path).unwrap_or_default();
    let differ = found.lines().zip(text.lines()).find(|(a, b)| a != b);
    assert!(found == text, "{} is not current (CONEFIELD_BLESS=1 writes it): {differ:?}", path.display());
}
