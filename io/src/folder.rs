//! Names of files in a folder: those in a scan's description stay inside it, those of a series come in order.

use conefield_core::{Error, Result};
use std::collections::HashSet;
use std::path::{Component, Path, PathBuf};

/// The file `name` in `folder`; refuses anything but a plain file name.
pub(crate) fn plain(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let mut parts = Path::new(name).components();
    let one = matches!((parts.next(), parts.next()), (Some(Component::Normal(p)), None) if p == name);
    if !one || name.contains(['/', '\\', ':', '\0']) {
        return Err(Error::invalid(place, field, format!("\"{name}\""), "a plain file name inside the folder"));
    }
    inside(folder, place, field, name)
}

/// The file at the relative path `name` in `folder`; refuses a path that leads outside, also through a link.
pub(crate) fn inside(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let path = within(folder, place, field, name)?;
    if !path.is_file() {
        return Err(Error::invalid(place, field, format!("\"{name}\""), "a file"));
    }
    Ok(path)
}

/// Like [`inside`], for a file or a folder.
pub(crate) fn within(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let shown = || format!("\"{name}\"");
    let down = Path::new(name).components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if name.is_empty() || !down || name.contains(['\\', ':', '\0']) {
        return Err(Error::invalid(
            place,
            field,
            shown(),
            "a relative path inside the folder, without \"..\" and backslashes",
        ));
    }
    let path = folder.join(name);
    let real = path.canonicalize().map_err(|e| Error::invalid(place, field, format!("{} ({e})", shown()), "a file"))?;
    let root = folder.canonicalize().map_err(|e| Error::io(folder, e))?;
    if !real.starts_with(&root) {
        let found = format!("{}, a link out of the folder", shown());
        return Err(Error::invalid(place, field, found, "a file inside the folder"));
    }
    Ok(path)
}

/// The files that a description has named so far. A short description that names one large file many times would
/// otherwise fill memory.
#[derive(Default)]
pub(crate) struct NamedFiles(HashSet<(PathBuf, Option<String>)>);

impl NamedFiles {
    /// Refuses `part` (the array of an archive, say) of `path` if it has been named before.
    pub fn once(&mut self, place: &str, field: &str, path: &Path, part: Option<&str>) -> Result<()> {
        let real = path.canonicalize().map_err(|e| Error::io(path, e))?;
        if self.0.insert((real, part.map(str::to_owned))) {
            return Ok(());
        }
        let found = format!("{} a second time", path.display());
        Err(Error::invalid(place, field, found, "each file once"))
    }
}

/// Refuses to replace a folder that holds anything but the files that the format itself writes, as `known` decides.
pub(crate) fn may_replace(folder: &Path, format: &str, known: impl Fn(&str) -> bool, mark: &[&str]) -> Result<()> {
    let place = folder.display().to_string();
    let io = |e| Error::io(folder, e);
    if folder.symlink_metadata().is_err() {
        return Ok(());
    }
    if !folder.is_dir() {
        return Err(Error::invalid(place, "folder", "a file", "a new name, an empty folder or an earlier scan"));
    }
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        names.push(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    if names.is_empty() {
        return Ok(());
    }
    let stranger = names.iter().find(|n| !known(n));
    if let Some(n) = stranger.or_else(|| (!mark.iter().any(|m| names.iter().any(|n| n == m))).then(|| &names[0])) {
        let expected = format!("a new name, an empty folder or a {format} with nothing else in it");
        return Err(Error::invalid(place, "folder", format!("\"{n}\" in it"), expected));
    }
    Ok(())
}

/// The names in `folder` that end in one of `ends` (small letters, no dot), in the order of the numbers in them; hidden
/// files are left out.
pub(crate) fn names(folder: &Path, ends: &[&str]) -> Result<Vec<String>> {
    let io = |e| Error::io(folder, e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        found.extend(entry.map_err(io)?.file_name().into_string());
    }
    found.retain(|n| {
        let end = n.rsplit_once('.').map(|(_, e)| e.to_ascii_lowercase()).unwrap_or_default();
        !n.starts_with('.') && ends.contains(&end.as_str())
    });
    found.sort_by_cached_key(|n| natural(n));
    Ok(found)
}

/// A sort key that puts `view2` before `view10`: runs of digits count as numbers.
fn natural(name: &str) -> (Vec<(String, usize, String)>, String) {
    let mut parts = Vec::new();
    let mut rest = name;
    while !rest.is_empty() {
        let digits = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
        let (text, tail) = rest.split_at(digits);
        let end = tail.find(|c: char| !c.is_ascii_digit()).unwrap_or(tail.len());
        let (number, tail) = tail.split_at(end);
        let number = number.trim_start_matches('0');
        // Of two numbers without leading zeros the longer is the larger.
        parts.push((text.to_lowercase(), number.len(), number.to_string()));
        rest = tail;
    }
    (parts, name.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_by_their_numbers() {
        let mut names = ["p10.tif", "p9.tif", "p010.tif", "P1.tif", "p100000000000000000000000.tif", "a.tif"];
        names.sort_by_cached_key(|n| natural(n));
        assert_eq!(names, ["a.tif", "P1.tif", "p9.tif", "p010.tif", "p10.tif", "p100000000000000000000000.tif"]);
    }
}
