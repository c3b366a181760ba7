//! Per-view numbers in a separate file: text (such as CSV), arrays of NumPy or MATLAB, or HDF5.

use crate::input::Input;
use crate::text::{misfit, read_foreign};
use crate::{folder, hdf5, mat, npy, npz};
use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use serde::Deserialize;
use serde_json::Value;
use std::path::Path;

/// Longest text, in bytes.
const LONGEST: u64 = 64 << 20;

/// Rows of numbers, or the name of a file with them.
#[derive(Deserialize)]
#[serde(try_from = "Value")]
pub(crate) enum Numbers {
    /// A list in the description; a row of one number may stand without brackets.
    List(Vec<Vec<f64>>),
    /// `FILE`, `FILE.npz:ARRAY`, `FILE.mat:ARRAY`, `FILE.h5:/PATH` or `FILE.csv:COLUMN`.
    File(String),
}

impl TryFrom<Value> for Numbers {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        let row = |one: &Value| match one {
            Value::Array(all) => all.iter().map(Value::as_f64).collect(),
            one => one.as_f64().map(|x| vec![x]),
        };
        let rows = match &value {
            Value::String(name) => return Ok(Self::File(name.clone())),
            Value::Array(all) => all.iter().map(row).collect::<Option<_>>(),
            _ => None,
        };
        rows.map(Self::List).ok_or_else(|| misfit(&value, "a list of numbers, or the name of a file with them"))
    }
}

impl Numbers {
    /// The rows of `width` numbers, of the entry `field` of a description in `folder`; see [`read`].
    pub fn rows(&self, folder: &Path, place: &str, field: &str, width: usize) -> Result<Vec<Vec<f64>>> {
        let rows = match self {
            Self::List(rows) => rows,
            Self::File(name) => return read(folder, place, field, name, width),
        };
        for (i, row) in rows.iter().enumerate() {
            let found = format!("{} numbers", row.len());
            ensure(row.len() == width, place, &format!("{field}[{i}]"), found, width.to_string())?;
        }
        Ok(rows.clone())
    }
}

/// Reads rows of `width` numbers from the file `name` in `folder`.
///
/// Text has one row per line; commas, semicolons or blanks separate its numbers. Comments after `#` and a first line
/// without a number are skipped. For rows of one number, `FILE.csv:NAME` selects the column NAME. HDF5 provides the
/// named data set, or the angles of a scan's projections. Refuses rows of another width and numbers that are not
/// finite.
fn read(folder: &Path, place: &str, field: &str, name: &str, width: usize) -> Result<Vec<Vec<f64>>> {
    let (file, part) = folder::split(name);
    let path = folder::inside(folder, place, field, file)?;
    let head = Input::open(&path)?.take(8)?;
    let place = path.display().to_string();
    let rows = if head == hdf5::MAGIC {
        arrayed(&place, hdf5::read_exact(&path, part)?, width)?
    } else if mat::is_mat(&head) {
        arrayed(&place, mat::read_exact(&path, part)?, width)?
    } else if head.starts_with(npz::MAGIC) {
        arrayed(&place, npz::read_exact(&path, part)?, width)?
    } else if !head.starts_with(npy::MAGIC) {
        texts(&path, part, width)?
    } else if let Some(array) = part {
        let expected = "an .npz archive, the only file of NumPy whose arrays have names";
        return Err(Error::invalid(place, "array", format!("the name \"{array}\""), expected));
    } else {
        arrayed(&place, npy::read_exact(&mut Input::open(&path)?)?, width)?
    };
    for (i, row) in rows.iter().enumerate() {
        if let Some(x) = row.iter().find(|x| !x.is_finite()) {
            return Err(Error::invalid(place, format!("row {i}"), x, "finite numbers"));
        }
    }
    Ok(rows)
}

fn arrayed(place: &str, (shape, values): (Vec<usize>, Vec<f64>), width: usize) -> Result<Vec<Vec<f64>>> {
    let fits = match shape[..] {
        // MATLAB keeps a list as a row.
        [_] | [1, _] if width == 1 => true,
        [_, w] => w == width,
        _ => false,
    };
    let alone = if width == 1 { "[views] or " } else { "" };
    let expected = format!("{alone}[views, {width}]");
    ensure(fits, place, "shape", format!("{shape:?}"), expected)?;
    Ok(values.chunks(width).map(<[f64]>::to_vec).collect())
}

fn texts(path: &Path, column: Option<&str>, width: usize) -> Result<Vec<Vec<f64>>> {
    let text = read_foreign(path, LONGEST)?;
    let place = path.display();
    let lines = text.lines().map(|l| l.split('#').next().unwrap_or_default().trim()).enumerate();
    let mut lines = lines.filter(|(_, l)| !l.is_empty()).map(|(i, l)| (i + 1, cells(l))).peekable();
    let heads = lines.next_if(|(_, cells)| cells.iter().all(|c| c.parse::<f64>().is_err()));
    let at = match (column, &heads) {
        (None, _) => None,
        (Some(name), Some((_, heads))) => match heads.iter().position(|h| *h == name) {
            Some(at) => Some(at),
            None => {
                let expected = format!("one of its columns: {}", heads.join(", "));
                return Err(Error::invalid(place.to_string(), "column", format!("\"{name}\""), expected));
            }
        },
        (Some(name), None) => {
            let expected = "a first line with the names of the columns";
            return Err(Error::invalid(place.to_string(), format!("column \"{name}\""), "no names", expected));
        }
    };
    let row = |(line, cells): (usize, Vec<&str>)| -> Result<Vec<f64>> {
        let place = || format!("{place}: line {line}");
        let chosen: Vec<&str> = match at {
            Some(at) => cells.get(at).copied().into_iter().collect(),
            None => cells,
        };
        if chosen.len() != width {
            let numbers = if width == 1 {
                "one number; of several columns, FILE:NAME takes the one under that name".to_owned()
            } else {
                format!("{width} numbers")
            };
            return Err(Error::invalid(place(), "row", format!("{} cells", chosen.len()), numbers));
        }
        let number =
            |c: &&str| c.parse::<f64>().map_err(|_| Error::invalid(place(), "row", format!("\"{c}\""), "a number"));
        chosen.iter().map(number).collect()
    };
    lines.map(row).collect()
}

/// The cells of a line: separated by commas or semicolons if there are any, else by blanks.
fn cells(line: &str) -> Vec<&str> {
    if line.contains([',', ';']) {
        let line = line.trim_end_matches([',', ';']);
        line.split([',', ';']).map(|c| c.trim().trim_matches('"')).collect()
    } else {
        line.split_whitespace().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{npy_bytes, says};
    use std::fs;

    fn found(name: &str, content: &[u8], width: usize) -> Result<Vec<Vec<f64>>> {
        let dir = tempfile::tempdir().unwrap();
        let (file, _) = folder::split(name);
        fs::write(dir.path().join(file), content).unwrap();
        read(dir.path(), "s.toml", "circle.angles_deg", name, width)
    }

    #[test]
    fn text_and_arrays_hold_the_same_numbers() {
        let want = vec![vec![0.0], vec![0.1], vec![-1e-3]];
        for text in [
            "0\n0.1\n-1e-3\n",
            "# degrees\n\n0 # first\n0.1\n-0.001",
            "angle\r\n0\r\n0.1\r\n-0.001\r\n",
            "0,\n0.1,\n-0.001,\n",
        ] {
            assert_eq!(found("a.csv", text.as_bytes(), 1).unwrap(), want, "{text}");
        }
        assert_eq!(found("a.csv:angle", b"\xef\xbb\xbfangle\r\n0\r\n0.1\r\n-0.001\r\n", 1).unwrap(), want);
        assert_eq!(found("a.csv:angle", b"angle,\xb5m\n0,1\n0.1,1\n-0.001,1\n", 1).unwrap(), want);
        let named = "\"view\";angle\n0;0\n1;0.1\n2;-0.001";
        assert_eq!(found("a.csv:angle", named.as_bytes(), 1).unwrap(), want);
        let numbers = [0.0f64, 0.1, -1e-3].map(f64::to_le_bytes).concat();
        assert_eq!(found("a.npy", &npy_bytes("<f8", false, "(3,)", &numbers), 1).unwrap(), want);
        assert_eq!(found("a.npy", &npy_bytes("<f8", false, "(3, 1)", &numbers), 1).unwrap(), want);
        let two = found("a.txt", b"1 2\n3\t4\n", 2).unwrap();
        assert_eq!(two, [[1.0, 2.0], [3.0, 4.0]]);
        // The rows of an array in Fortran order are read correctly.
        let turned = [1.0f64, 3.0, 2.0, 4.0].map(f64::to_le_bytes).concat();
        assert_eq!(found("a.npy", &npy_bytes("<f8", true, "(2, 2)", &turned), 2).unwrap(), two);
    }

    #[test]
    fn what_is_no_table_is_refused_in_words() {
        let refused = |name: &str, content: &[u8], width, words: &[&str]| says(found(name, content, width), words);
        refused("a.csv", b"0\nx\n", 1, &["a.csv: line 2", "\"x\"", "a number"]);
        refused("a.csv", b"0,1\n2,3\n", 1, &["line 1", "2 cells", "one number", "NAME"]);
        refused("a.csv", b"1,2\n3\n", 2, &["line 2", "1 cells", "2 numbers"]);
        refused("a.csv:b", b"a,c\n1,2\n", 1, &["column", "\"b\"", "a, c"]);
        refused("a.csv:b", b"1,2\n", 1, &["no names"]);
        refused("a.csv", b"\xff\xfe0\0\n\0", 1, &["a.csv: text", "UTF-16"]);
        refused("a.csv", b"0\nnan\n", 1, &["row 1", "NaN", "finite"]);
        let numbers = [0.0f64; 3].map(f64::to_le_bytes).concat();
        refused("a.npy", &npy_bytes("<f8", false, "(3,)", &numbers), 12, &["shape", "[3]", "[views, 12]"]);
        refused("a.npy:x", &npy_bytes("<f8", false, "(3,)", &numbers), 1, &["array", "\"x\"", ".npz"]);
        for name in ["../a.csv", "none.csv"] {
            let found = read(Path::new("."), "s.toml", "circle.angles_deg", name, 1);
            says(found, &["s.toml: circle.angles_deg", name]);
        }
    }
}
