//! Results on standard output, readable or as JSON.

pub use conefield::tradeoff::json::to_json;
pub use conefield_core::words::{counted, plural};
use conefield_core::{Error, Result};
use conefield_evaluation::report::Table;
pub use conefield_evaluation::report::text::{bytes, duration, number, table};
use serde::Serialize;
use std::fmt::Write as _;
use std::io::{ErrorKind, Write};

/// Maximum characters shown of a line of the log or of an error.
pub const LONGEST_LINE: usize = 4000;

/// Prints `text` and a line end. A closed reader (`| head`) is not an error.
pub fn say(text: &str) -> Result<()> {
    let text = plain(text);
    print(&width().map_or(text.clone(), |width| wrapped(&text, width)))
}

/// The table as text that fits into the terminal, if standard output is one.
pub fn fitted(table: &Table) -> String {
    width().map_or_else(|| table.text(), |width| table.text_within(width))
}

/// Columns of the terminal, if standard output is one.
fn width() -> Option<usize> {
    terminal_size::terminal_size_of(std::io::stdout()).map(|(width, _)| width.0.into())
}

/// `text` with lines of at most `width` characters. The rest of a line stands below its last column, which begins after
/// two spaces.
fn wrapped(text: &str, width: usize) -> String {
    let lines = text.split('\n').map(|line| {
        let mut rest: Vec<char> = line.chars().collect();
        let column = rest.windows(3).rposition(|w| w[0] == ' ' && w[1] == ' ' && w[2] != ' ').map_or(2, |at| at + 2);
        let indent = if column <= width / 2 { column } else { 4.min(width / 4) };
        let mut folded = String::new();
        while rest.len() > width {
            let Some(at) = rest[..=width].iter().rposition(|c| *c == ' ').filter(|at| *at > indent) else { break };
            folded.extend(&rest[..at]);
            folded.push('\n');
            let after = rest.split_off(at + 1);
            rest = [vec![' '; indent], after].concat();
        }
        folded.extend(&rest);
        folded
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// Prints one JSON object.
pub fn json(value: &impl Serialize) -> Result<()> {
    // JSON does not escape these characters by itself, but may.
    let text = to_json(value)?;
    print(&escaped(&text, &|c| c.is_control() && c != '\n', &|c, out| write!(out, "\\u{:04x}", c as u32)))
}

fn print(text: &str) -> Result<()> {
    raw(format!("{text}\n").as_bytes())
}

/// Prints bytes as they are.
pub fn raw(bytes: &[u8]) -> Result<()> {
    match std::io::stdout().write_all(bytes) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::io("standard output", e)),
        _ => Ok(()),
    }
}

/// `text` without terminal control characters except line ends.
fn plain(text: &str) -> String {
    escaped(text, &|c| obeyed(c) && c != '\n', &|c, out| write!(out, "{}", c.escape_default()))
}

/// `text` as one line of at most `most` characters, without terminal control characters. A longer text loses its
/// middle, so that the start of a message and the expectation at its end stay.
pub fn plain_line(text: &str, most: usize) -> String {
    let count = text.chars().count();
    if count <= most {
        return escaped(text, &obeyed, &|c, out| write!(out, "{}", c.escape_default()));
    }
    let byte = |n: usize| text.char_indices().nth(n).map_or(text.len(), |(at, _)| at);
    let (begin, end) = (&text[..byte(most / 2)], &text[byte(count - most / 2)..]);
    let (begin, end) = (plain_line(begin, most), plain_line(end, most));
    format!("{begin}… ({} characters left out) …{end}", count - 2 * (most / 2))
}

/// Characters that control a terminal: control characters, and those that change the writing direction.
fn obeyed(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}' | '\u{2029}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn escaped(text: &str, bad: &dyn Fn(char) -> bool, escape: &dyn Fn(char, &mut String) -> std::fmt::Result) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        if bad(c) {
            // Writing to a string cannot fail.
            let _ = escape(c, &mut out);
        } else {
            out.push(c);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_continue_below_their_last_column() {
        let text = "a  one two three\nshort";
        assert_eq!(wrapped(text, 11), "a  one two\n   three\nshort");
        assert_eq!(wrapped("abcdefghijkl", 5), "abcdefghijkl");
        assert_eq!(wrapped("one two three four", 9), "one two\n  three\n  four");
    }

    #[test]
    fn what_a_terminal_obeys_is_shown_instead() {
        let bad = "a\u{1b}[2Jb\nerror: c\u{9b}d\u{202e}e";
        assert_eq!(plain_line(bad, 100), "a\\u{1b}[2Jb\\nerror: c\\u{9b}d\\u{202e}e");
        assert_eq!(plain("a\tb\nc"), "a\\tb\nc");
        assert_eq!(plain_line("äöü", 100), "äöü");
    }

    #[test]
    fn of_a_long_line_the_middle_is_left_out() {
        let cut = plain_line(&format!("begin {} end", "é".repeat(10_000)), 100);
        assert!(cut.starts_with("begin é") && cut.ends_with("é end"), "{cut}");
        assert!(cut.contains("(9910 characters left out)") && cut.chars().count() < 140, "{cut}");
    }
}
