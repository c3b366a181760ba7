//! The options that select part of a scan.

use clap::Args;
use conefield_scans::{Lines, Selection, ViewChoice};

/// The part of a scan to take, in this order: views, turned and flipped images, a piece of the detector, larger pixels.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Part of a scan")]
pub struct SelectionOptions {
    /// Only these views: 3,7,9 or 0-719:10 (0 to 719 in steps of 10) or every:10.
    #[arg(long, value_name = "VIEWS")]
    views: Option<ViewChoice>,
    /// Turn the images by N quarter turns (NumPy's rot90). Like the flips, this corrects how images were stored; it
    /// does not move source or detector.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=3))]
    turns: u8,
    /// The file has the last row first.
    #[arg(long)]
    flip_rows: bool,
    /// The file has the last column first.
    #[arg(long)]
    flip_columns: bool,
    /// Only these rows, as NumPy slices: 100:900, 50: or 10:-10 (the end is left out).
    #[arg(long, value_name = "FROM:TO", allow_hyphen_values = true)]
    rows: Option<Lines>,
    /// Only these columns.
    #[arg(long, value_name = "FROM:TO", allow_hyphen_values = true)]
    columns: Option<Lines>,
    /// Average blocks of N x N pixels.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    bin: u16,
}

impl SelectionOptions {
    /// The selection.
    pub fn selection(&self) -> Selection {
        let Self { views, turns, flip_rows, flip_columns, rows, columns, bin } = self.clone();
        Selection { views, turns, flip_rows, flip_columns, rows, columns, bin: bin.into() }
    }

    /// The first option given.
    pub fn named(&self) -> Option<&'static str> {
        let all = [
            ("--views", self.views.is_some()),
            ("--turns", self.turns > 0),
            ("--flip-rows", self.flip_rows),
            ("--flip-columns", self.flip_columns),
            ("--rows", self.rows.is_some()),
            ("--columns", self.columns.is_some()),
            ("--bin", self.bin > 1),
        ];
        all.into_iter().find(|(_, asked)| *asked).map(|(name, _)| name)
    }
}
