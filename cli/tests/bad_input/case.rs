//! One bad input: how it is made, the command, and its required outcome.

use assert_cmd::Command;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

/// Address space of the command in KiB; small inputs need far less.
const MEMORY_KIB: u64 = 1 << 20;
/// Default value of `--memory`.
const USUAL: &str = "1GiB";
/// More than any header claims, so that a reader checks the actual content of a file.
pub const AMPLE: Option<&str> = Some("1000TiB");
/// Processor seconds for the command.
const SECONDS: u64 = 20;
/// Wall time after which a waiting command is killed.
const PATIENCE: Duration = Duration::from_secs(60);

/// Required outcome of a command.
#[derive(Clone, Copy)]
pub enum End {
    /// With status 1 and one line that starts with `error:`.
    Refused,
    /// With status 2: wrong use of the command line.
    WrongUse,
    /// With status 0 and a warning: suspicious but possible.
    Warned,
}

/// One bad input.
pub struct Case {
    what: &'static str,
    make: Box<dyn Fn(&Path) + Sync + Send>,
    args: &'static str,
    end: End,
    says: &'static [&'static str],
    /// Value of `--memory`, if given.
    memory: Option<&'static str>,
}

/// An input that must be refused: its description, how it is made in an empty folder, the words of the command (split
/// at spaces, or as in a shell if there are single quotes; it runs in that folder), and parts of the message.
pub fn refused(
    what: &'static str,
    make: impl Fn(&Path) + Sync + Send + 'static,
    args: &'static str,
    says: &'static [&'static str],
) -> Case {
    Case { what, make: Box::new(make), args, end: End::Refused, says, memory: Some(USUAL) }
}

/// A table of inputs that must be refused, a row each: the arguments of [`refused`], then how the case differs.
macro_rules! table {
    ($($what:expr, $make:expr, $args:expr, [$($says:expr),*] $(.$change:ident($to:expr))*;)*) => {
        vec![$($crate::case::refused($what, $make, $args, &[$($says),*])$(.$change($to))*),*]
    };
}
pub(crate) use table;

impl Case {
    /// The same with another outcome.
    pub fn ends(self, end: End) -> Self {
        Self { end, ..self }
    }

    /// The same with another `--memory`, or none, so that only the address space is limited.
    pub fn memory(self, memory: Option<&'static str>) -> Self {
        Self { memory, ..self }
    }

    /// Runs the command under limits.
    pub fn run(&self) -> Outcome {
        let dir = tempfile::tempdir().unwrap();
        (self.make)(dir.path());
        let before = standing(dir.path());
        let program = assert_cmd::cargo::cargo_bin("conefield");
        // Two threads, because each one takes address space.
        let memory = self.memory.map_or(String::new(), |m| format!("--memory {m} "));
        let limited =
            format!("ulimit -v {MEMORY_KIB}; ulimit -t {SECONDS}; ulimit -c 0; exec \"$0\" --threads 2 {memory}\"$@\"");
        let mut command = Command::new("sh");
        let words: Vec<String> = match self.args.contains('\'') {
            true => shlex::split(self.args).unwrap(),
            false => self.args.split(' ').map(str::to_owned).collect(),
        };
        command.args(["-c", &limited]).arg(program).args(words);
        let start = Instant::now();
        let output = command.current_dir(dir.path()).timeout(PATIENCE).output().unwrap();
        let time = start.elapsed();
        let said = String::from_utf8_lossy(&output.stderr).replace(&dir.path().display().to_string(), "DIR");
        let after = standing(dir.path());
        let mut outcome = Outcome {
            what: self.what,
            command: match self.memory {
                Some(USUAL) => format!("conefield {}", self.args),
                _ => format!("conefield {memory}{}", self.args),
            },
            message: without_figures(message(&said, &String::from_utf8_lossy(&output.stdout), self.end, self.says)),
            status: output.status.code(),
            faults: vec![],
        };
        let mut fault = |text: String| outcome.faults.push(format!("{}: {}: {text}", self.args, self.what));
        let status = match self.end {
            End::Refused => 1,
            End::WrongUse => 2,
            End::Warned => 0,
        };
        if output.status.code() != Some(status) {
            fault(format!("ended with {} after {time:?}: {said}", output.status));
        }
        if said.contains("panicked") {
            fault(format!("panicked: {said}"));
        }
        if matches!(self.end, End::Refused) {
            if !output.stdout.is_empty() {
                fault(format!("printed {}", String::from_utf8_lossy(&output.stdout)));
            }
            let errors = said.lines().filter(|l| l.starts_with("error: ")).count();
            if errors != 1 || !said.lines().last().is_some_and(|l| l.starts_with("error: ")) {
                fault(format!("no single line of error at the end: {said}"));
            }
        }
        if !matches!(self.end, End::Warned) && before != after {
            fault(format!("left something behind: {before:?} became {after:?}"));
        }
        for want in self.says.iter().filter(|w| !outcome.message.contains(**w)) {
            outcome.faults.push(format!("{}: {}: \"{want}\" is not in: {said}", self.args, self.what));
        }
        outcome
    }
}

/// Outcome of a command.
pub struct Outcome {
    pub what: &'static str,
    pub command: String,
    pub message: String,
    pub status: Option<i32>,
    pub faults: Vec<String>,
}

/// The relevant line: the error, or the warning with the words of `says`. `info` and `import` print warnings with their
/// result, readers on standard error.
fn message(said: &str, printed: &str, end: End, says: &[&str]) -> String {
    match end {
        End::Refused | End::WrongUse => said.lines().find(|l| l.starts_with("error: ")).unwrap_or(said).to_owned(),
        End::Warned => {
            // Lines of the log begin with the time.
            let untimed = |l: &'_ str| l.split_once("Z  WARN ").map(|(_, rest)| format!("WARN {rest}"));
            let mut lines =
                said.lines().chain(printed.lines()).map(|l| untimed(l).unwrap_or(l.trim_start().to_owned()));
            let warns = |l: &String| l.starts_with("WARN") || l.starts_with("warning: ");
            lines.find(|l| warns(l) && says.iter().all(|w| l.contains(w))).unwrap_or_default()
        }
    }
}

/// The message without sizes that differ between machines: available memory, and memory held by the program.
fn without_figures(text: String) -> String {
    let marks = [" are available", " already held", " in total, set by --memory"];
    marks.iter().fold(text, |text, mark| {
        let Some(at) = text.find(mark) else { return text };
        let before = text[..at].rsplitn(3, ' ').nth(2).unwrap_or_default();
        format!("{before} …{}", &text[at..])
    })
}

/// Everything below `folder`: length and modification time by path.
fn standing(folder: &Path) -> BTreeMap<String, (u64, Option<SystemTime>)> {
    let mut all = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let info = path.symlink_metadata().unwrap();
        if info.is_dir() {
            all.extend(standing(&path));
            all.insert(path.display().to_string(), (0, None));
        } else {
            all.insert(path.display().to_string(), (info.len(), info.modified().ok()));
        }
    }
    all
}

/// Writes `bytes`.
pub fn put(path: impl AsRef<Path>, bytes: impl AsRef<[u8]>) {
    fs::write(path, bytes).unwrap();
}

/// Creates `seed`, then changes the bytes of `file`.
pub fn changed(
    seed: fn(&Path),
    file: &'static str,
    change: impl Fn(&mut Vec<u8>) + Sync + Send + 'static,
) -> impl Fn(&Path) + Sync + Send {
    move |dir| {
        seed(dir);
        let mut bytes = fs::read(dir.join(file)).unwrap();
        let before = bytes.clone();
        change(&mut bytes);
        assert_ne!(bytes, before, "{file} is not changed");
        put(dir.join(file), bytes);
    }
}

/// Creates `seed`, then replaces `from` by `to` in the text of `file`, which must contain it.
pub fn replaced(
    seed: fn(&Path),
    file: &'static str,
    from: &'static str,
    to: &'static str,
) -> impl Fn(&Path) + Sync + Send {
    move |dir| {
        seed(dir);
        let text = fs::read_to_string(dir.join(file)).unwrap();
        assert!(text.contains(from), "{from} is not in {file}:\n{text}");
        put(dir.join(file), text.replacen(from, to, 1));
    }
}

/// Creates `seed`, then does `more`.
pub fn then(seed: fn(&Path), more: impl Fn(&Path) + Sync + Send + 'static) -> impl Fn(&Path) + Sync + Send {
    move |dir| {
        seed(dir);
        more(dir);
    }
}

/// Overwrites bytes from `at` on.
pub fn at(at: usize, bytes: impl AsRef<[u8]> + Sync + Send) -> impl Fn(&mut Vec<u8>) + Sync + Send {
    move |all| all[at..at + bytes.as_ref().len()].copy_from_slice(bytes.as_ref())
}

/// Cuts after `length` bytes.
pub fn cut(length: usize) -> impl Fn(&mut Vec<u8>) + Sync + Send {
    move |all| all.truncate(length)
}

/// Cuts the last `length` bytes.
pub fn cut_end(length: usize) -> impl Fn(&mut Vec<u8>) + Sync + Send {
    move |all| all.truncate(all.len() - length)
}
