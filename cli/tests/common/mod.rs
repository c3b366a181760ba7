//! Helpers shared by the whole-program tests.
#![allow(dead_code)]

use assert_cmd::Command;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Output, Stdio};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime};
use tempfile::TempDir;

/// A scan that is small enough for every test.
pub const SCAN: &str = "simulate phantom:head:16 -o scan --views 8 --detector 16x16";

/// What is in a folder, by name: files with their content, and folders.
pub type Content = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// A new folder, in which commands run: a command is one line, and names in it are relative to the folder.
pub struct Folder(TempDir);

impl Folder {
    /// An empty one.
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    /// One with what these commands make. A program of tests runs each command once and copies its files.
    pub fn after(lines: &[&str]) -> Self {
        let folder = Self::new();
        for (name, file) in made(lines) {
            match file {
                Some(content) => folder.put(name, content),
                None => fs::create_dir(folder.at(name)).unwrap(),
            }
        }
        folder
    }

    /// The path of `name`.
    pub fn at(&self, name: impl AsRef<Path>) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file.
    pub fn put(&self, name: impl AsRef<Path>, content: impl AsRef<[u8]>) {
        fs::write(self.at(name), content).unwrap();
    }

    /// The content of a file.
    pub fn bytes(&self, name: impl AsRef<Path>) -> Vec<u8> {
        let path = self.at(name);
        fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
    }

    /// The content of a text file.
    pub fn text(&self, name: impl AsRef<Path>) -> String {
        String::from_utf8(self.bytes(name)).expect("UTF-8")
    }

    /// The content of a JSON file.
    pub fn read(&self, name: impl AsRef<Path>) -> Value {
        serde_json::from_str(&self.text(name)).expect("JSON")
    }

    /// Whether there is a file or a folder of this name.
    pub fn has(&self, name: impl AsRef<Path>) -> bool {
        self.at(name).exists()
    }

    /// The command of a line, without the plugins of the user who runs the tests.
    pub fn loud(&self, line: &str) -> Command {
        let mut c = Command::cargo_bin("conefield").expect("the command is built with its tests");
        c.env_remove("CONEFIELD_PLUGIN_PATH").env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
        c.current_dir(&self.0).args(words(line));
        c
    }

    /// The same, quiet.
    pub fn command(&self, line: &str) -> Command {
        self.loud(&format!("--quiet {line}"))
    }

    /// Runs to success; returns the output.
    pub fn done(&self, line: &str) -> String {
        let out = self.command(line).assert().success().get_output().stdout.clone();
        String::from_utf8(out).expect("UTF-8")
    }

    /// Runs to success; returns the printed JSON object.
    pub fn json(&self, line: &str) -> Value {
        serde_json::from_str(&self.done(line)).expect("one JSON object on standard output")
    }

    /// Runs to the exit status `code`; returns standard error. Standard output must be empty.
    pub fn refused(&self, code: i32, line: &str) -> String {
        let output = self.command(line).assert().code(code).get_output().clone();
        assert!(output.stdout.is_empty(), "{line}");
        let text = String::from_utf8(output.stderr).expect("UTF-8");
        assert!(text.starts_with("error: "), "{line}: {text}");
        text
    }

    /// The same, with these words in the message.
    pub fn refused_with(&self, code: i32, line: &str, words: &[&str]) {
        let said = self.refused(code, line);
        assert!(words.iter().all(|w| said.contains(w)), "{line}: {words:?} are not all in: {said}");
    }

    /// Checks that each line ends with status 1 and a message with these words, and that it makes nothing called `output`.
    pub fn refuses(&self, output: &str, lines: &[(&str, &str)]) {
        for (line, words) in lines {
            let said = self.refused(1, line);
            assert!(said.contains(words) && !self.has(output), "{line}: {said}");
        }
    }

    /// The command, running; its output can be read at its end.
    pub fn started(&self, line: &str) -> Child {
        let mut command = std::process::Command::new(program());
        command.env_remove("CONEFIELD_PLUGIN_PATH").env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"));
        command.current_dir(&self.0).arg("--quiet").args(words(line));
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    /// Runs a shell's script that starts the command of a line as `"$0" "$@"`.
    pub fn shell(&self, script: &str, line: &str) -> Output {
        let mut command = std::process::Command::new("sh");
        command.current_dir(&self.0).args(["-c", script]).arg(program()).args(words(line)).output().unwrap()
    }

    /// Whether the file has content.
    pub fn filled(&self, name: &str) -> bool {
        fs::metadata(self.at(name)).is_ok_and(|m| m.len() > 0)
    }

    /// Starts the command of a line, and sends it the signal INT or TERM once it is `ready`. It ends with the status of that
    /// signal and prints nothing; returns standard error.
    pub fn interrupted(&self, line: &str, name: &str, ready: &dyn Fn() -> bool) -> String {
        let mut child = self.started(line);
        let until = Instant::now() + Duration::from_secs(60);
        while !ready() && child.try_wait().unwrap().is_none() && Instant::now() < until {
            sleep(Duration::from_millis(2));
        }
        assert!(Instant::now() < until, "{line}: never ready");
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(if name == "INT" { 130 } else { 143 }), "{line}: {said}");
        assert!(output.stdout.is_empty(), "{line}");
        said
    }

    /// Waits until the file has content.
    pub fn wait_for(&self, name: &str) {
        let until = Instant::now() + Duration::from_secs(60);
        while !self.filled(name) {
            assert!(Instant::now() < until, "{name} never came");
            sleep(Duration::from_millis(2));
        }
    }

    /// Starts the command of a line, and kills it once its folder `run` has a checkpoint.
    pub fn killed_at_a_checkpoint(&self, run: &str, line: &str) {
        let mut child = self.started(line);
        let checkpoint = Path::new(run).join("checkpoint.safetensors");
        while !self.has(&checkpoint) && child.try_wait().unwrap().is_none() {
            sleep(Duration::from_millis(1));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(self.has(&checkpoint), "it was over before it could be killed: {line}");
    }

    /// What is in the folder `name`.
    pub fn content(&self, name: &str) -> Content {
        let (place, mut all) = (self.at(name), Content::new());
        for path in fs::read_dir(&place).unwrap().map(|e| e.unwrap().path()) {
            let own = PathBuf::from(path.file_name().unwrap());
            if path.is_dir() {
                all.extend(self.content(&text(&path)).into_iter().map(|(name, file)| (own.join(name), file)));
            }
            all.insert(own, path.is_file().then(|| fs::read(&path).unwrap()));
        }
        all
    }

    /// The names in the folder `name`, sorted.
    pub fn names(&self, name: &str) -> Vec<String> {
        let names = fs::read_dir(self.at(name)).unwrap().map(|e| e.unwrap().file_name());
        let mut all: Vec<String> = names.map(|n| n.to_string_lossy().into_owned()).collect();
        all.sort();
        all
    }

    /// Modification time of every file in the folder `name`.
    pub fn times(&self, name: &str) -> BTreeMap<PathBuf, SystemTime> {
        let files = self.content(name).into_iter().filter(|(_, file)| file.is_some());
        let time = |file: &Path| self.at(name).join(file).metadata().unwrap().modified().unwrap();
        files.map(|(file, _)| (file.clone(), time(&file))).collect()
    }
}

/// What these commands make in an empty folder.
fn made(lines: &[&str]) -> Content {
    static MADE: Mutex<BTreeMap<String, Arc<OnceLock<Content>>>> = Mutex::new(BTreeMap::new());
    let Some((last, before)) = lines.split_last() else { return Content::new() };
    let once = MADE.lock().unwrap_or_else(PoisonError::into_inner).entry(lines.join("\n")).or_default().clone();
    let content = once.get_or_init(|| {
        let folder = Folder::after(before);
        folder.done(last);
        folder.content("")
    });
    content.clone()
}

/// The words of a line: split at spaces, or as in a shell if there are single quotes.
fn words(line: &str) -> Vec<String> {
    match line.contains('\'') {
        true => shlex::split(line).unwrap(),
        false => line.split_whitespace().map(str::to_owned).collect(),
    }
}

/// The program.
pub fn program() -> PathBuf {
    assert_cmd::cargo::cargo_bin("conefield")
}

/// The path as text.
pub fn text(path: &Path) -> String {
    path.display().to_string()
}

/// A number that must be there.
pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// Sends a signal, such as INT, to a process that is still running.
pub fn signal(child: &Child, name: &str) {
    let (name, id) = (format!("-{name}"), child.id().to_string());
    assert!(std::process::Command::new("kill").args([name, id]).status().unwrap().success());
}
