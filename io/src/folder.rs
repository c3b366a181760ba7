//! Names of files in a folder: those in a scan's description stay inside it, those of a series come in order.

use conefield_core::error::ensure;
use conefield_core::{Error, Result};
use std::collections::{BTreeMap, HashSet};
use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};

/// The file `name` in `folder`; refuses anything but a plain file name.
pub(crate) fn plain(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let mut parts = Path::new(name).components();
    let one = matches!((parts.next(), parts.next()), (Some(Component::Normal(p)), None) if p == name);
    let expected = "a plain file name inside the folder";
    ensure(one && !name.contains(['/', '\\', ':', '\0']), place, field, format!("\"{name}\""), expected)?;
    inside(folder, place, field, name)
}

/// The file at the relative path `name` in `folder`; refuses a path that leads outside, also through a link.
pub(crate) fn inside(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let path = within(folder, place, field, name)?;
    ensure(path.is_file(), place, field, format!("\"{name}\""), "a file")?;
    Ok(path)
}

/// Like [`inside`], for a file or a folder. A backslash separates folders like a slash, as programs on Windows write it.
pub(crate) fn within(folder: &Path, place: &str, field: &str, name: &str) -> Result<PathBuf> {
    let shown = || format!("\"{name}\"");
    let slashed = name.replace('\\', "/");
    let down = Path::new(&slashed).components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    let expected = "a relative path inside the folder, without \"..\"";
    ensure(!name.is_empty() && down && !name.contains([':', '\0']), place, field, shown(), expected)?;
    let path = folder.join(slashed);
    let real = path.canonicalize().map_err(|e| Error::invalid(place, field, format!("{} ({e})", shown()), "a file"))?;
    let root = folder.canonicalize().map_err(|e| Error::io(folder, e))?;
    let found = format!("{}, a link out of the folder", shown());
    ensure(real.starts_with(&root), place, field, found, "a file inside the folder")?;
    Ok(path)
}

/// The folder that holds `path`.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// The name of a file. What is not UTF-8 in it is replaced.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The extension of a file's name in small letters; empty if there is none.
pub(crate) fn extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_lowercase()
}

/// Splits the name of a file from that of an array, data set or column in it: `scan.npz:counts`, `scan.h5:/exchange/data`.
/// No name of a file in a description holds a colon.
pub(crate) fn split(name: &str) -> (&str, Option<&str>) {
    match name.split_once(':') {
        Some((file, part)) if file.contains('.') => (file, Some(part)),
        _ => (name, None),
    }
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
pub(crate) fn may_replace(folder: &Path, format: &str, known: &dyn Fn(&str) -> bool, mark: &[&str]) -> Result<()> {
    let place = folder.display().to_string();
    // What a killed program kept aside is looked at, too.
    crate::lease::put_back_missing(folder)?;
    if folder.symlink_metadata().is_err() {
        return Ok(());
    }
    if !folder.is_dir() {
        return Err(Error::invalid(place, "folder", "a file", "a new name, an empty folder or an earlier scan"));
    }
    let all = entries(folder)?;
    let names: Vec<_> = all.iter().filter_map(|path| path.file_name()).map(|n| n.to_string_lossy()).collect();
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
    let mut found: Vec<String> = entries(folder)?.iter().filter_map(|path| name_of(path)).collect();
    found.retain(|n| {
        let end = n.rsplit_once('.').map(|(_, e)| e.to_ascii_lowercase()).unwrap_or_default();
        !n.starts_with('.') && ends.contains(&end.as_str())
    });
    found.sort_by_cached_key(|n| natural(n));
    Ok(found)
}

/// The files in `folder` and in folders at most `depth` below it whose names end in one of `ends`, as relative paths with
/// slashes, in the order of [`names`]. Links to folders are not followed.
pub(crate) fn below(folder: &Path, depth: usize, ends: &[&str]) -> Result<Vec<String>> {
    let mut found = names(folder, ends)?;
    if depth == 0 {
        return Ok(found);
    }
    for path in entries(folder)?.iter().filter(|path| is_folder(path)) {
        if let Some(name) = name_of(path) {
            found.extend(below(path, depth - 1, ends)?.into_iter().map(|n| format!("{name}/{n}")));
        }
    }
    found.sort_by_cached_key(|n| natural(n));
    Ok(found)
}

/// The paths in `folder`, sorted; none if there is no folder.
pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let found = match std::fs::read_dir(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(vec![]),
        found => found.and_then(|all| all.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()),
    };
    let mut all = found.map_err(|e| Error::io(folder, e))?;
    all.sort_unstable_by(|a, b| a.as_os_str().cmp(b.as_os_str()));
    Ok(all)
}

/// Whether `path` is a folder, and no link to one.
pub(crate) fn is_folder(path: &Path) -> bool {
    path.symlink_metadata().is_ok_and(|info| info.is_dir())
}

/// The name of the file at `path`, if it is UTF-8.
fn name_of(path: &Path) -> Option<String> {
    path.file_name()?.to_str().map(str::to_owned)
}

/// Those of `names` that are `start`, in small or capital letters, a number and an extension, by their numbers.
pub(crate) fn numbered(names: &[String], start: &str) -> BTreeMap<usize, String> {
    let number = |name: &str| -> Option<usize> {
        let (name, _) = name.rsplit_once('.')?;
        name.get(..start.len()).filter(|s| s.eq_ignore_ascii_case(start))?;
        let number = &name[start.len()..];
        number.bytes().all(|b| b.is_ascii_digit()).then(|| number.parse().ok())?
    };
    names.iter().filter_map(|n| Some((number(n)?, n.clone()))).collect()
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

/// What is odd about the numbers in the `names` of a series, in the order of [`names`]: two series in one folder, or
/// numbers missing between the first and the last. `None` if nothing is.
pub(crate) fn oddity(names: &[String]) -> Option<String> {
    let keys: Vec<_> = names.iter().map(|n| natural(n).0).collect();
    let texts = |i: usize| -> Vec<&str> { keys[i].iter().map(|(text, ..)| text.as_str()).collect() };
    if let Some(i) = (1..keys.len()).find(|&i| texts(i) != texts(i - 1)) {
        return Some(format!("{} and {} look like files of two series, and are read as one", names[i - 1], names[i]));
    }
    let number = |i: usize, k: usize| keys[i][k].2.as_str();
    let parts = keys.first().map_or(0, Vec::len);
    let mut changing = (0..parts).filter(|&k| (1..keys.len()).any(|i| number(i, k) != number(0, k)));
    // Numbers that cannot be counted, and names with two of them, such as an angle beside an index, say nothing.
    let (Some(k), None) = (changing.next(), changing.next()) else { return None };
    let numbers: Vec<u64> = (0..keys.len())
        .map(|i| Some(number(i, k)).filter(|n| !n.is_empty()).map_or(Ok(0), str::parse))
        .collect::<Result<_, _>>()
        .ok()?;
    let steps: Vec<u64> = numbers.windows(2).map(|n| n[1] - n[0]).collect();
    let mut sorted = steps.clone();
    sorted.sort_unstable();
    let usual = sorted[sorted.len() / 2];
    let (even, gaps): (Vec<_>, Vec<_>) = (0..steps.len()).partition(|&i| steps[i] == usual);
    // Times and positions are no numbers of a series.
    if gaps.is_empty() || usual == 0 || even.len() <= gaps.len() {
        return None;
    }
    let shown: Vec<String> = gaps.iter().take(3).map(|&i| format!("{} and {}", names[i], names[i + 1])).collect();
    let more = if gaps.len() > 3 { format!(" and at {} more places", gaps.len() - 3) } else { String::new() };
    Some(format!("no file between {}{more}: are images missing?", shown.join(", between ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::says;

    #[test]
    fn names_sort_by_their_numbers() {
        let mut names = ["p10.tif", "p9.tif", "p010.tif", "P1.tif", "p100000000000000000000000.tif", "a.tif"];
        names.sort_by_cached_key(|n| natural(n));
        assert_eq!(names, ["a.tif", "P1.tif", "p9.tif", "p010.tif", "p10.tif", "p100000000000000000000000.tif"]);
    }

    #[test]
    fn gaps_and_strangers_in_a_series_are_found() {
        let series = |numbers: &mut dyn Iterator<Item = u64>| -> Vec<String> {
            numbers.map(|n| format!("view_{n:04}_90kV.tif")).collect()
        };
        assert_eq!(oddity(&series(&mut (1..100))), None);
        assert_eq!(oddity(&series(&mut (0..100).step_by(5))), None);
        let found = oddity(&series(&mut (1..100).filter(|n| ![17, 18, 40].contains(n)))).unwrap();
        assert!(found.contains("view_0016_90kV.tif and view_0019_90kV.tif") && found.contains("view_0039"), "{found}");
        // Irregular numbers are times or positions; two numbers that change need not be a series.
        assert_eq!(oddity(&series(&mut [3, 10, 18, 90, 91].into_iter())), None);
        assert_eq!(oddity(&(0..9).map(|i| format!("{i}_{}.tif", i * i)).collect::<Vec<_>>()), None);
        assert_eq!(oddity(&["a.tif".into()]), None);
        assert_eq!(oddity(&[]), None);
        let mut mixed = series(&mut (1..4));
        mixed.insert(0, "flat.tif".into());
        assert!(oddity(&mixed).unwrap().contains("flat.tif and view_0001_90kV.tif"));
        assert_eq!(oddity(&["p00000000000000000000000001.tif".into(), "p99999999999999999999999999.tif".into()]), None);
    }

    #[test]
    fn a_backslash_separates_folders_but_does_not_lead_out() {
        let dir = tempfile::tempdir().unwrap();
        let inner = dir.path().join("in");
        std::fs::create_dir_all(inner.join("sub")).unwrap();
        std::fs::write(inner.join("sub/a.npy"), "").unwrap();
        std::fs::write(dir.path().join("out.npy"), "").unwrap();
        for name in ["sub\\a.npy", ".\\sub\\a.npy", "sub/a.npy"] {
            assert!(inside(&inner, "m.json", "file_path", name).unwrap().ends_with("sub/a.npy"), "{name}");
        }
        for name in ["..\\out.npy", "sub\\..\\..\\out.npy", "C:\\out.npy", "\\\\server\\share\\out.npy", "\\out.npy"] {
            says(inside(&inner, "m.json", "file_path", name), &["m.json: file_path", "inside the folder"]);
        }
    }
}
