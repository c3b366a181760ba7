//! Inputs and outputs of a command: an output never removes or overwrites an input.
//!
//! Files are compared by identity as reported by the system, not by name.

use conefield_core::error::ensure;
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result, written};
use conefield_io::folder_of;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The ends of the files of which a folder is read whatever their names are.
const SLICES: [&str; 3] = ["tif", "tiff", "dcm"];

/// The files and folders that a command reads.
#[derive(Default)]
pub struct Inputs(Vec<PathBuf>);

impl Inputs {
    /// The inputs in `paths`; entries that are not files, such as names of phantoms, are harmless.
    pub fn of<P: AsRef<Path>>(paths: impl IntoIterator<Item = P>) -> Self {
        Self::default().and(paths)
    }

    /// Adds further inputs.
    pub fn and<P: AsRef<Path>>(mut self, paths: impl IntoIterator<Item = P>) -> Self {
        paths.into_iter().for_each(|path| self.add(path.as_ref()));
        self
    }

    fn add(&mut self, path: &Path) {
        if path.exists() {
            self.0.push(path.to_path_buf());
        }
        self.0.extend(conefield_io::data_file(path));
    }

    /// Adds a spec with everything it extends and names.
    pub fn and_spec(self, loaded: &Loaded) -> Self {
        self.and(loaded.sources()).and(loaded.input_files())
    }

    /// Adds a description in TOML or JSON with every file that it names.
    pub fn and_description(self, path: &Path) -> Self {
        let text = conefield_core::files::read_text(path, 16 << 20).unwrap_or_default();
        let tree: Value = written::read(&path.display().to_string(), &text).unwrap_or_default();
        let mut named = vec![];
        texts(&tree, &mut named);
        let folder = path.parent().unwrap_or(Path::new("")).to_path_buf();
        self.and([path]).and(named.into_iter().map(|n| folder.join(n)))
    }

    /// Refuses to replace an existing output unless `force`, and one that this command reads in any case.
    pub fn spare(&self, output: &Path, force: bool) -> Result<()> {
        refuse_existing(output, force)?;
        self.spare_file(output)?;
        self.spare_folder(output)
    }

    /// Refuses to write a file that is an input or lies in an input folder. A new file may lie there unless it would be read
    /// as a slice.
    pub fn spare_file(&self, output: &Path) -> Result<()> {
        // Its voxels are written beside it.
        if output.extension().is_some_and(|e| e.eq_ignore_ascii_case("mhd")) {
            self.spare_file(&output.with_extension("raw"))?;
        }
        if output.symlink_metadata().is_err() {
            let slice = output.extension().is_some_and(|e| SLICES.iter().any(|end| e.eq_ignore_ascii_case(end)));
            let beside = |input: &PathBuf| same_file::is_same_file(input, folder_of(output)).unwrap_or(false);
            let joins = slice && self.0.iter().any(beside);
            return ensure(
                !joins,
                &place(output),
                "output",
                "a slice in a folder that this command reads",
                "another folder",
            );
        }
        for input in &self.0 {
            let same = same_file::is_same_file(input, output).unwrap_or(false);
            ensure(!same, &place(output), "output", "a file that this command reads", "another name")?;
            let found = format!("a file of {}, which this command reads", input.display());
            let inside =
                input.is_dir() && [output.canonicalize().ok(), named(output)].iter().flatten().any(|o| below(o, input));
            ensure(!inside, &place(output), "output", found, "another name")?;
        }
        Ok(())
    }

    /// Refuses to replace a folder that is an input or contains one.
    pub fn spare_folder(&self, output: &Path) -> Result<()> {
        for input in self.0.iter().filter(|_| output.exists()) {
            let found = format!("{} in it, which this command reads", input.display());
            let inside = [input.canonicalize().ok(), named(input)].iter().flatten().any(|i| below(i, output));
            ensure(!inside, &place(output), "output", found, "another folder")?;
        }
        Ok(())
    }
}

fn place(path: &Path) -> String {
    path.display().to_string()
}

/// The location of a path, without following it if it is a link.
fn named(path: &Path) -> Option<PathBuf> {
    Some(folder_of(path).canonicalize().ok()?.join(path.file_name()?))
}

/// Whether the absolute `path` is `folder` or lies in it.
fn below(path: &Path, folder: &Path) -> bool {
    folder.canonicalize().is_ok_and(|f| path.starts_with(f))
}

/// All strings of `tree`.
fn texts(tree: &Value, found: &mut Vec<String>) {
    match tree {
        Value::String(text) => found.push(text.clone()),
        Value::Array(all) => all.iter().for_each(|v| texts(v, found)),
        Value::Object(map) => map.values().for_each(|v| texts(v, found)),
        _ => {}
    }
}

/// Refuses to overwrite an existing path unless `force`.
pub fn refuse_existing(path: &Path, force: bool) -> Result<()> {
    let empty = std::fs::read_dir(path).is_ok_and(|mut d| d.next().is_none());
    let free = force || empty || path.symlink_metadata().is_err();
    ensure(free, &place(path), "output", "an existing file or folder", "a new name, or --force")
}

/// Refuses a path without the file extension of the output: another extension would mean another format.
pub fn ends(path: &Path, end: &str) -> Result<()> {
    let found = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let fits = path.extension().is_some_and(|e| e.eq_ignore_ascii_case(end));
    ensure(fits, &place(path), "file name", found, format!("an end of .{end}"))
}

/// Refuses a picture path that is not a picture, or that would overwrite an input.
pub fn picture(path: Option<&Path>, inputs: &Inputs) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    ends(path, "png")?;
    inputs.spare_file(path)
}

/// A path that can be stored in a spec.
pub fn text(path: &Path) -> Result<&str> {
    let found = || format!("{}, a name with bytes that are not UTF-8", path.display());
    path.to_str().ok_or_else(|| {
        Error::invalid(
            "command line",
            "file name",
            found(),
            "a name in UTF-8, which a spec can hold: rename or link it",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_read_gets_no_slice() {
        let d = tempfile::tempdir().unwrap();
        let inputs = Inputs::of([d.path()]);
        for (name, free) in [("a.TIF", false), ("a.dcm", false), ("a.png", true), ("a.nii.gz", true), ("b/a.tif", true)]
        {
            assert_eq!(inputs.spare_file(&d.path().join(name)).is_ok(), free, "{name}");
        }
    }

    #[test]
    fn the_data_file_of_a_header_is_spared() {
        let d = tempfile::tempdir().unwrap();
        let at = |name: &str| d.path().join(name);
        let nrrd = "NRRD0004\ntype: float\ndata file: a.raw\n";
        for (header, text) in [("a.nhdr", nrrd), ("b.mhd", "NDims = 3\nElementDataFile = a.raw\n")] {
            std::fs::write(at(header), text).unwrap();
            std::fs::write(at("a.raw"), "voxels").unwrap();
            let inputs = Inputs::of([at(header)]);
            for (output, free) in [("a.mhd", false), ("a.raw", false), ("c.mhd", true)] {
                assert_eq!(inputs.spare(&at(output), true).is_ok(), free, "{header} {output}");
            }
        }
    }
}
