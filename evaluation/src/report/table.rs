//! Tables of numbers for the terminal and in Markdown.

use crate::report::text;

/// Columns with headings, the first one names and the others numbers, and notes below.
#[derive(Debug, Default)]
pub struct Table {
    /// The headings, then the lines.
    pub rows: Vec<Vec<String>>,
    /// Remarks that do not fit into cells.
    pub notes: Vec<String>,
}

impl Table {
    /// The table as text for a terminal.
    pub fn text(&self) -> String {
        let right: Vec<usize> = (1..self.columns()).collect();
        let mut text = text::table(&self.rows, &right);
        if !self.notes.is_empty() {
            text += &format!("\n\n{}", self.notes.join("\n"));
        }
        text
    }

    /// The table in Markdown.
    pub fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|c| c.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        let mut rows = self.rows.iter();
        let mut text = rows.next().map(|heads| line(heads)).unwrap_or_default();
        let rule: Vec<&str> = (0..self.columns()).map(|c| if c == 0 { "---" } else { "---:" }).collect();
        text += &format!("| {} |\n", rule.join(" | "));
        text.extend(rows.map(|row| line(row)));
        for note in &self.notes {
            text += &format!("\n{note}\n");
        }
        text
    }

    fn columns(&self) -> usize {
        self.rows.first().map_or(0, Vec::len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_have_the_same_cells() {
        let row = |cells: [&str; 2]| cells.map(str::to_owned).to_vec();
        let table = Table { rows: vec![row(["", "dB"]), row(["a|b", "3.10"])], notes: vec!["c: why".into()] };
        assert_eq!(table.text(), "       dB\na|b  3.10\n\nc: why");
        assert_eq!(table.markdown(), "|  | dB |\n| --- | ---: |\n| a\\|b | 3.10 |\n\nc: why\n");
    }
}
