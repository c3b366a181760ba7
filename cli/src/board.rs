//! `events.out.tfevents.conefield`: the curves and pictures of a run for TensorBoard.

use conefield_core::{Error, Result};
use conefield_io::EventFile;
use serde_json::Value;
use std::fs;
use std::path::Path;

/// The event file of a run.
pub struct Board(EventFile);

impl Board {
    /// Opens the file `path` for a run with the existing records in `metrics`, one per line. Events up to the last
    /// record stay in the file; records after its last event are added.
    pub fn new(path: &Path, metrics: &Path) -> Result<Self> {
        let text = fs::read_to_string(metrics).map_err(|e| Error::io(metrics, e))?;
        let records: Vec<Value> = text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
        let (file, last) = match records.last() {
            Some(record) => EventFile::resume(path, step(record))?,
            None => (EventFile::create(path)?, None),
        };
        let mut board = Self(file);
        for record in records.iter().filter(|record| last.is_none_or(|last| step(record) > last)) {
            board.record(record)?;
        }
        Ok(board)
    }

    /// Adds a line of `metrics.jsonl`: one point per number, to the curve of that number.
    pub fn record(&mut self, record: &Value) -> Result<()> {
        let numbers = record.as_object().into_iter().flatten().filter(|(name, _)| *name != "step");
        self.0.scalars(step(record), numbers.filter_map(|(name, x)| Some((name.as_str(), x.as_f64()?))))
    }

    /// Adds the picture in the file `png` as `name`.
    pub fn picture(&mut self, step: u64, name: &str, png: &Path) -> Result<()> {
        self.0.picture(step, name, &fs::read(png).map_err(|e| Error::io(png, e))?)
    }
}

/// The step of a record.
fn step(record: &Value) -> u64 {
    record["step"].as_u64().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_run_keeps_its_pictures_and_repeats_no_point() {
        let dir = tempfile::tempdir().unwrap();
        let [events, metrics] = ["events", "metrics.jsonl"].map(|name| dir.path().join(name));
        let line = |step: u64| format!("{{\"step\":{step},\"loss\":0.5}}\n");
        let count = |word: &str| {
            let bytes = fs::read(&events).unwrap();
            bytes.windows(word.len()).filter(|w| *w == word.as_bytes()).count()
        };
        fs::write(&metrics, "").unwrap();
        let mut board = Board::new(&events, &metrics).unwrap();
        board.record(&serde_json::from_str(&line(10)).unwrap()).unwrap();
        let png = dir.path().join("live.png");
        fs::write(&png, b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x07\0\0\x01\0rest").unwrap();
        board.picture(15, "live", &png).unwrap();
        board.record(&serde_json::from_str(&line(20)).unwrap()).unwrap();
        board.picture(25, "live", &png).unwrap();
        // The run continues after step 20: the later picture is written again.
        fs::write(&metrics, line(10) + &line(20)).unwrap();
        drop(Board::new(&events, &metrics).unwrap());
        assert_eq!([count("IHDR"), count("loss")], [1, 2]);
        fs::write(&metrics, line(10) + &line(20) + &line(30)).unwrap();
        drop(Board::new(&events, &metrics).unwrap());
        assert_eq!([count("IHDR"), count("loss")], [1, 3]);
        // A new run starts a new file.
        fs::write(&metrics, "").unwrap();
        drop(Board::new(&events, &metrics).unwrap());
        assert_eq!([count("IHDR"), count("loss")], [0, 0]);
    }
}
