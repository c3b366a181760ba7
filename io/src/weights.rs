//! Weights and checkpoints as safetensors, `f32` only.
//!
//! The `safetensors` crate reads. This module writes: it streams, and it orders the metadata, so that the same weights
//! give the same bytes.

use crate::input::read_bytes;
use crate::{number, write_atomic};
use conefield_core::arena::Weights;
use conefield_core::error::ensure;
use conefield_core::{Error, Result, allowance, files};
use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

/// The header's entry for free text.
const METADATA: &str = "__metadata__";

/// Longest header that is read: a hundred thousand tensors.
const LONGEST_HEADER: u64 = 16 << 20;

/// Most bytes of memory per byte of a header while it is parsed.
const HEADER_WORDS: u64 = 16;

/// A tensor to write: name, shape and values in C order.
pub type Tensor<'a> = (&'a str, &'a [usize], &'a [f32]);

/// Writes `f32` tensors and free text.
pub fn write_weights(path: &Path, tensors: &[Tensor<'_>], notes: &BTreeMap<String, String>) -> Result<()> {
    let place = path.display().to_string();
    let mut header = Map::new();
    if !notes.is_empty() {
        header.insert(METADATA.into(), json!(notes));
    }
    let mut names = BTreeSet::new();
    let mut at = 0usize;
    for (name, shape, values) in tensors {
        let (own, expected) =
            (*name != METADATA && names.insert(name), format!("a name of its own, other than {METADATA}"));
        ensure(own, &place, "tensor name", format!("\"{name}\""), expected)?;
        let fits = shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s)) == Some(values.len());
        let found = format!("{} values for the shape {shape:?}", values.len());
        ensure(fits, &place, &format!("tensor {name}"), found, "as many values as the shape has")?;
        let end = at + size_of_val(*values);
        header.insert((*name).into(), json!({ "dtype": "F32", "shape": shape, "data_offsets": [at, end] }));
        at = end;
    }
    let mut text = Value::Object(header).to_string();
    // The data starts at a multiple of eight bytes, as the format requires.
    text.push_str(&" ".repeat(text.len().next_multiple_of(8) - text.len()));
    write_atomic(path, &mut |w| {
        let io = |e| Error::io(path, e);
        w.write_all(&(text.len() as u64).to_le_bytes()).map_err(io)?;
        w.write_all(text.as_bytes()).map_err(io)?;
        tensors.iter().try_for_each(|(.., values)| number::write(w, values)).map_err(io)
    })
}

/// Reads a safetensors file of `f32` tensors.
pub fn read_weights(path: impl AsRef<Path>) -> Result<Weights> {
    let path = path.as_ref();
    let place = path.display().to_string();
    let (mut file, size) = files::open(path)?;
    ensure(size >= 8, &place, "header length", format!("{size} bytes"), "a safetensors file")?;
    let mut length = [0u8; 8];
    file.read_exact(&mut length).map_err(|e| Error::io(path, e))?;
    let header = u64::from_le_bytes(length);
    let expected = format!("at most {} in a file of {size} bytes", (size - 8).min(LONGEST_HEADER));
    ensure(header <= (size - 8).min(LONGEST_HEADER), &place, "header length", header, expected)?;
    // The values are briefly in memory twice, as file and as tensors; a parsed header is larger than its text.
    let words = header.saturating_mul(HEADER_WORDS);
    allowance::memory(&place, "file size", size.saturating_mul(2).saturating_add(words))?;
    let raw = read_bytes(path)?;
    let broken = |e| Error::invalid(&place, "header", e, "a whole safetensors file");
    let (_, info) = SafeTensors::read_metadata(&raw).map_err(broken)?;
    let notes = info.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
    let views = SafeTensors::deserialize(&raw).map_err(broken)?;
    let mut tensors = BTreeMap::new();
    for (name, view) in views.iter() {
        let (found, expected) = (format!("{:?}", view.dtype()), "F32; convert the weights to 32-bit floats first");
        ensure(view.dtype() == Dtype::F32, &place, &format!("tensor {name}: dtype"), found, expected)?;
        let (values, _) = view.data().as_chunks::<4>();
        let values = values.iter().map(|b| f32::from_le_bytes(*b)).collect();
        tensors.insert(name.to_string(), (view.shape().to_vec(), values));
    }
    Ok(Weights { tensors, notes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;
    use std::fs;

    fn sample(path: &Path) -> Weights {
        let notes: BTreeMap<_, _> = (0..20).map(|i| (format!("key {i}"), format!("value {i}"))).collect();
        let table: Vec<f32> = (0..40000).map(|i| i as f32 * 0.5).collect();
        let tensors = [
            ("mlp.0.weight", &[2, 3][..], &[1.0f32, -2.0, 3.5, 0.0, 1e-38, 7.0][..]),
            ("encoder.table", &[40000], table.as_slice()),
            ("empty", &[0, 4], &[]),
        ];
        write_weights(path, &tensors, &notes).unwrap();
        let tensors = tensors.into_iter().map(|(n, s, v)| (n.to_string(), (s.to_vec(), v.to_vec()))).collect();
        Weights { tensors, notes }
    }

    #[test]
    fn what_is_written_comes_back_in_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (dir.path().join("a.safetensors"), dir.path().join("b.safetensors"));
        let want = sample(&a);
        assert_eq!(read_weights(&a).unwrap(), want);
        sample(&b);
        assert_eq!(fs::read(&a).unwrap(), fs::read(&b).unwrap());
    }

    #[test]
    fn slips_of_the_writer_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.safetensors");
        let none = BTreeMap::new();
        says(write_weights(&path, &[("w", &[2, 2], &[1.0; 3])], &none), &["tensor w", "[2, 2]"]);
        let twice: [Tensor; 2] = [("w", &[1], &[1.0]), ("w", &[1], &[1.0])];
        assert!(write_weights(&path, &twice, &none).unwrap_err().to_string().contains("\"w\""));
        assert!(!path.exists());
    }

    #[test]
    fn bytes_after_the_last_tensor_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.safetensors");
        sample(&path);
        fs::write(&path, [fs::read(&path).unwrap(), vec![0]].concat()).unwrap();
        says(read_weights(&path), &["a.safetensors", "header"]);
    }
}
