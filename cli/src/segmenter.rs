//! An external program that segments a volume, such as an installed TotalSegmentator.

use crate::{program, signals};
use conefield_core::error::{Error, Result, ensure};
use conefield_core::scan::Volume;
use ndarray::Array3;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::str::FromStr;

/// Placeholders of the files in the command.
const FILES: [&str; 2] = ["{in}", "{out}"];
/// Maximum bytes of a failed command's output in an error.
const TAIL: u64 = 600;

/// A command with `{in}` and `{out}` in its words.
#[derive(Debug, Clone, PartialEq)]
pub struct Segmenter {
    program: String,
    arguments: Vec<String>,
}

impl FromStr for Segmenter {
    type Err = String;

    /// Splits and unquotes words like a POSIX shell; nothing is expanded and no shell runs.
    fn from_str(text: &str) -> Result<Self, String> {
        let words = shlex::split(text).ok_or("an unclosed quote or a trailing backslash")?;
        let Some((program, arguments)) = words.split_first() else { return Err("expected a command".into()) };
        match FILES.iter().find(|file| !arguments.iter().any(|a| a.contains(**file))) {
            Some(file) => Err(format!("expected {file} in an argument, such as 'segment -i {{in}} -o {{out}}'")),
            None => Ok(Self { program: program.clone(), arguments: arguments.to_vec() }),
        }
    }
}

impl Segmenter {
    /// Segments `volume`, called `name` in errors. Intermediate files are in a temporary folder, which is removed
    /// afterwards.
    pub fn run(&self, name: &str, volume: &Volume) -> Result<Array3<u32>> {
        let dir =
            tempfile::Builder::new().prefix("conefield-").tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))?;
        let [input, output] = ["volume.nii.gz", "labels.nii.gz"].map(|f| dir.path().join(f));
        conefield_io::write_volume(&input, volume)?;
        let (status, said) = self.start(name, dir.path(), [&input, &output])?;
        let what = || format!("segmenter {}, given {name}", self.program);
        if !status.success() {
            return Err(Error::unsupported(what(), format!("it ended with {status}; {said}")));
        }
        if !output.exists() {
            return Err(Error::unsupported(what(), format!("it wrote no file for {{out}}; {said}")));
        }
        // The file is in a temporary folder that the user cannot find again.
        let own = output.display().to_string();
        let read = |e: Error| {
            let why = e.to_string().replace(&own, "{out}");
            Error::unsupported(what(), format!("its label map cannot be used: {why}"))
        };
        let voxels = conefield_io::volume_voxels(&output).map_err(read)?;
        let place = format!("the label map of {name}");
        let (found, expected) = (format!("{voxels} voxels"), format!("{}, as the volume has", volume.data.len()));
        ensure(voxels == volume.data.len() as u64, &place, "shape", found, expected).map_err(read)?;
        let labels = conefield_io::read_volume(&output).map_err(read)?;
        let (found, expected) =
            (format!("{:?}", labels.data.shape()), format!("{:?}, the volume's", volume.data.shape()));
        ensure(labels.data.shape() == volume.data.shape(), &place, "shape", found, expected).map_err(read)?;
        conefield_evaluation::metrics::label_map(&place, labels.data.view()).map_err(read)
    }

    /// Runs the process to its end; returns its status and the end of its standard error.
    fn start(&self, name: &str, dir: &Path, files: [&Path; 2]) -> Result<(ExitStatus, String)> {
        let log = dir.join("stderr");
        let mut errors = File::options()
            .create(true)
            .read(true)
            .write(true)
            .truncate(true)
            .open(&log)
            .map_err(|e| Error::io(&log, e))?;
        let arguments = self
            .arguments
            .iter()
            .map(|a| FILES.iter().zip(files).fold(a.clone(), |a, (key, file)| a.replace(key, &file.to_string_lossy())));
        let mut command = Command::new(&self.program);
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null());
        command.stderr(errors.try_clone().map_err(|e| Error::io(&log, e))?);
        let what = format!("segmenter {}", self.program);
        let mut child = command.spawn().map_err(|e| Error::unsupported(&what, e.to_string()))?;
        let status = program::wait(&mut child, &what, &mut || match signals::caught() {
            Some(_) => Err(Error::Aborted { part: format!("the segmentation of {name}") }),
            None => Ok(()),
        })?;
        Ok((status, tail(&mut errors).map_err(|e| Error::io(&log, e))?))
    }
}

/// The last lines of a log, joined into one.
fn tail(log: &mut File) -> std::io::Result<String> {
    let length = log.seek(SeekFrom::End(0))?;
    log.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
    let mut last = vec![];
    log.take(TAIL).read_to_end(&mut last)?;
    let text = String::from_utf8_lossy(&last);
    // A progress bar ends its lines with carriage returns; colours begin with control characters.
    let lines = text.split(['\n', '\r']).map(str::trim).filter(|l| !l.is_empty());
    let lines: Vec<String> = lines.map(|l| l.chars().filter(|c| !c.is_control()).collect()).collect();
    Ok(if lines.is_empty() { "it printed nothing".into() } else { format!("it printed: {}", lines.join(" | ")) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_split_without_a_shell() {
        let s: Segmenter = r#"'my tool' -i={in} "a b" $HOME;ls --out {out}/x"#.parse().unwrap();
        assert_eq!(s.program, "my tool");
        assert_eq!(s.arguments, ["-i={in}", "a b", "$HOME;ls", "--out", "{out}/x"]);
        for (bad, word) in [
            ("", "a command"),
            ("tool {in}", "{out}"),
            ("tool {out}", "{in}"),
            ("{in} {out}", "{in}"),
            ("'tool {in} {out}", "quote"),
        ] {
            let e = bad.parse::<Segmenter>().unwrap_err();
            assert!(e.contains(word), "{bad}: {e}");
        }
    }
}
