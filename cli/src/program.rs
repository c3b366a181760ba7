//! How this program starts itself, for work in separate processes and in scripts, and how it waits for other processes.

use conefield_core::{Error, Result};
use std::ffi::OsString;
use std::io::Read;
use std::process::{Child, Command, ExitStatus};
use std::sync::OnceLock;
use std::thread::{JoinHandle, sleep, spawn};
use std::time::Duration;

/// Time between two checks of a process.
const LOOK: Duration = Duration::from_millis(20);

/// The words that start the program, if it is not an executable of its own, and the arguments of this process.
static STARTED: OnceLock<Started> = OnceLock::new();

struct Started {
    program: Option<Vec<OsString>>,
    arguments: Vec<OsString>,
}

/// Remembers how this process was started. The first call counts.
pub fn note(program: Option<Vec<OsString>>, arguments: Vec<OsString>) {
    let _ = STARTED.set(Started { program, arguments });
}

/// The words that start this program: the executable, or an interpreter and its arguments.
pub fn words() -> Result<Vec<OsString>> {
    match STARTED.get().and_then(|s| s.program.clone()) {
        Some(words) => Ok(words),
        None => Ok(vec![std::env::current_exe().map_err(|e| Error::io("conefield", e))?.into()]),
    }
}

/// Starts this program; the caller adds arguments.
pub fn command() -> Result<Command> {
    let words = words()?;
    let mut command = Command::new(&words[0]);
    command.args(&words[1..]);
    Ok(command)
}

/// The arguments of this process, without the program's name.
pub fn arguments() -> &'static [OsString] {
    STARTED.get().map_or(&[], |s| &s.arguments)
}

/// Waits for the end of the process `what`. `look` is called between two checks; its error kills the process.
pub fn wait(child: &mut Child, what: &str, look: &mut dyn FnMut() -> Result<()>) -> Result<ExitStatus> {
    loop {
        if let Some(status) = child.try_wait().map_err(|e| Error::io(what, e))? {
            return Ok(status);
        }
        if let Err(e) = look() {
            let _ = child.kill();
            let _ = child.wait();
            return Err(e);
        }
        sleep(LOOK);
    }
}

/// Reads what a process writes, until its end.
pub fn read(pipe: Option<impl Read + Send + 'static>) -> JoinHandle<String> {
    spawn(move || {
        let mut said = vec![];
        let _ = pipe.map(|mut pipe| pipe.read_to_end(&mut said));
        String::from_utf8_lossy(&said).into_owned()
    })
}
