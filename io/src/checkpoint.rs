//! Checkpoints: safetensors with a format version and a checksum over all text, names, shapes and values.

use crate::weights::{Tensor, read_weights, write_weights};
use conefield_core::arena::Weights;
use conefield_core::{Error, Result};
use flate2::Crc;
use std::collections::BTreeMap;
use std::path::Path;

/// The format name in a checkpoint.
const FORMAT: &str = "conefield-checkpoint";
/// Incremented whenever an older reader would misread a newer file.
const VERSION: &str = "3";
/// The key of the checksum.
const SUM: &str = "crc32";

/// Writes a checkpoint: `f32` tensors and free text. An earlier file of that name stays intact until the new one is on
/// disk.
pub fn write_checkpoint(path: &Path, tensors: &[Tensor<'_>], text: &BTreeMap<String, String>) -> Result<()> {
    let mut text = text.clone();
    text.extend([("format", FORMAT), ("format_version", VERSION)].map(|(k, v)| (k.to_owned(), v.to_owned())));
    // The file holds tensors in the order of their names.
    let mut order = tensors.to_vec();
    order.sort_unstable_by_key(|(name, ..)| *name);
    let sum = checksum(&text, &mut order.into_iter());
    text.insert(SUM.to_owned(), sum);
    write_weights(path, tensors, &text)
}

/// Reads a checkpoint. Refuses other files, other versions and values that fail the checksum.
pub fn read_checkpoint(path: impl AsRef<Path>) -> Result<Weights> {
    let path = path.as_ref();
    let mut file = read_weights(path)?;
    let expect = |key: &str, said: Option<String>, expected: &str| {
        if said.as_deref() == Some(expected) {
            return Ok(());
        }
        let said = said.map_or("nothing".into(), |s| format!("\"{s}\""));
        Err(Error::invalid(path.display().to_string(), key, said, format!("\"{expected}\"")))
    };
    let said = file.notes.remove(SUM);
    for (key, expected) in [("format", FORMAT), ("format_version", VERSION)] {
        expect(key, file.notes.get(key).cloned(), expected)?;
    }
    let mut tensors = file.tensors.iter().map(|(name, (shape, values))| (&name[..], &shape[..], &values[..]));
    expect(SUM, said, &checksum(&file.notes, &mut tensors))?;
    file.notes.retain(|key, _| !["format", "format_version"].contains(&&key[..]));
    Ok(file)
}

/// Checksum over every text and tensor. Each is preceded by its length, so that nothing can move from one into the
/// next.
fn checksum<'a>(text: &BTreeMap<String, String>, tensors: &mut dyn Iterator<Item = Tensor<'a>>) -> String {
    let mut crc = Crc::new();
    let word = |crc: &mut Crc, bytes: &[u8]| {
        crc.update(&(bytes.len() as u64).to_le_bytes());
        crc.update(bytes);
    };
    for part in text.iter().flat_map(|(key, value)| [key, value]) {
        word(&mut crc, part.as_bytes());
    }
    let mut raw = Vec::with_capacity(1 << 16);
    for (name, shape, values) in tensors {
        word(&mut crc, name.as_bytes());
        word(&mut crc, &shape.iter().flat_map(|n| (*n as u64).to_le_bytes()).collect::<Vec<_>>());
        for part in values.chunks(1 << 14) {
            raw.clear();
            raw.extend(part.iter().flat_map(|x| x.to_le_bytes()));
            crc.update(&raw);
        }
    }
    format!("{:08x}", crc.sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;

    #[test]
    fn a_changed_value_another_version_and_other_files_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("checkpoint.safetensors");
        let text = BTreeMap::from([("step".to_owned(), "7".to_owned())]);
        let tensors = [("b", &[2][..], &[1.0f32, 2.0][..]), ("a", &[3], &[0.5, -1.0, 4.0])];
        write_checkpoint(&path, &tensors, &text).unwrap();
        let back = read_checkpoint(&path).unwrap();
        assert_eq!((back.notes, back.tensors["a"].1[2]), (text.clone(), 4.0));
        let good = std::fs::read(&path).unwrap();
        let refused = |bytes: &[u8], word: &str| {
            std::fs::write(&path, bytes).unwrap();
            says(read_checkpoint(&path), &[word, "checkpoint.safetensors"]);
        };
        refused(&good[..good.len() - 1], "header");
        let at = good.windows(10).position(|w| w == b"\"step\":\"7\"").unwrap();
        refused(&[&good[..at + 8], b"5", &good[at + 9..]].concat(), "crc32");
        let at = good.windows(20).position(|w| w == b"\"format_version\":\"3\"").unwrap();
        refused(&[&good[..at + 18], b"2", &good[at + 19..]].concat(), "format_version");
    }
}
