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

    /// The table as text of at most `width` columns: those that do not fit follow below, each part with the names.
    pub fn text_within(&self, width: usize) -> String {
        let widths: Vec<usize> = (0..self.columns())
            .map(|c| self.rows.iter().filter_map(|r| r.get(c)).map(|s| s.chars().count()).max().unwrap_or(0))
            .collect();
        let mut parts: Vec<Vec<usize>> = vec![];
        let mut used = usize::MAX / 2;
        for c in 1..self.columns() {
            if used + 2 + widths[c] > width {
                parts.push(vec![0]);
                used = widths[0];
            }
            used += 2 + widths[c];
            parts.last_mut().into_iter().for_each(|part| part.push(c));
        }
        if parts.len() < 2 {
            return self.text();
        }
        let cells = |row: &Vec<String>, part: &[usize]| part.iter().filter_map(|c| row.get(*c).cloned()).collect();
        let part =
            |part: &Vec<usize>| Self { rows: self.rows.iter().map(|r| cells(r, part)).collect(), notes: vec![] }.text();
        let texts = parts.iter().map(part).chain((!self.notes.is_empty()).then(|| self.notes.join("\n")));
        texts.collect::<Vec<_>>().join("\n\n")
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
        assert_eq!(table.text_within(80), table.text());
        let row = |cells: [&str; 3]| cells.map(str::to_owned).to_vec();
        let wide =
            Table { rows: vec![row(["", "dB", "seconds"]), row(["fdk", "3.10", "20"])], notes: vec!["why".into()] };
        assert_eq!(wide.text_within(10), "       dB\nfdk  3.10\n\n     seconds\nfdk       20\n\nwhy");
        assert_eq!(table.markdown(), "|  | dB |\n| --- | ---: |\n| a\\|b | 3.10 |\n\nc: why\n");
    }
}
