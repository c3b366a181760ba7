//! First contact with a GPU: what it is, what it can do at most, whether kernels are right on it, and how fast they are.
//!
//! `contact [--adapter N] [--software] [--out FILE] [STAGE...]` runs each stage as a process of its own with a time limit,
//! so that a hanging driver costs one stage. Each finding is one JSON line, written as soon as it is known. A finding has
//! `stage`, and the last one of a stage has `outcome` and `seconds`. The exit status is 1 where a stage failed and 2 where
//! there is no GPU; `--software` accepts a CPU that acts as one.
//!
//! `benches/contact.sh` puts this program, the `conefield` command, parity tests and scans into one folder.

mod speed;

use conefield_backend_wgpu::{Adapter, Wgpu, adapters};
use serde_json::{Value, json};
use std::error::Error;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::thread;
use std::time::{Duration, Instant};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// What a stage runs.
enum Work {
    /// A function of this program, in a process of its own. It prints findings.
    Own(fn(&Asked) -> Result<()>),
    /// A program of the folder that this one lies in, with arguments. Its exit status is the finding.
    Program(&'static str, &'static [&'static str]),
}

/// A stage and the seconds that it may take.
struct Stage {
    name: &'static str,
    limit_s: u64,
    work: Work,
}

const fn own(name: &'static str, limit_s: u64, work: fn(&Asked) -> Result<()>) -> Stage {
    Stage { name, limit_s, work: Work::Own(work) }
}

const fn program(name: &'static str, limit_s: u64, program: &'static str, arguments: &'static [&'static str]) -> Stage {
    Stage { name, limit_s, work: Work::Program(program, arguments) }
}

/// The most informative stages come first, because the machine may be available for a few minutes only.
const STAGES: [Stage; 11] = [
    own("adapter", 20, adapter),
    own("limits", 60, limits),
    own("compile", 60, speed::compile),
    own("quick-parity", 90, speed::quick_parity),
    own("kernels", 120, speed::kernels),
    own("voxels", 60, speed::voxels),
    own("classical", 120, speed::classical),
    own("gaussians", 60, speed::gaussians),
    own("training", 100, speed::training),
    program("parity-of-stages", 120, "parity-stages", &["--test-threads", "1"]),
    program("parity-of-runs", 120, "parity-library", &["--test-threads", "1", "wgpu", "gaussians_on_device"]),
];

/// What was asked for on the command line.
struct Asked {
    adapter: usize,
    software: bool,
}

impl Asked {
    /// The folder of this program, where `benches/contact.sh` puts everything else.
    fn kit() -> Result<PathBuf> {
        Ok(std::env::current_exe()?.parent().ok_or("this program has no folder")?.to_owned())
    }
}

/// Prints a finding.
fn say(finding: &Value) {
    println!("{finding}");
}

const USAGE: &str = "usage: contact [--adapter N] [--software] [--out FILE] [STAGE...]";

fn main() -> ExitCode {
    match run() {
        Ok(code) => code,
        Err(e) => {
            eprintln!("contact: {e}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<ExitCode> {
    let (mut adapter, mut software, mut out, mut within) = (None, false, None, None);
    let mut names = vec![];
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().ok_or(USAGE);
        match argument.as_str() {
            "--adapter" => adapter = Some(value()?.parse::<usize>()?),
            "--software" => software = true,
            "--out" => out = Some(PathBuf::from(value()?)),
            // Says to a process of a stage which one it is.
            "--within" => within = Some(value()?),
            name if STAGES.iter().any(|s| s.name == name) => names.push(argument),
            _ => {
                let known: Vec<&str> = STAGES.iter().map(|s| s.name).collect();
                return Err(format!("found {argument:?}; {USAGE}; stages: {}", known.join(", ")).into());
            }
        }
    }
    let chosen = choose(&adapters(), adapter, software)?;
    let asked = Asked { adapter: chosen.index, software: chosen.software };
    if let Some(within) = within {
        let stage = STAGES.iter().find(|s| s.name == within).ok_or(USAGE)?;
        if let Work::Own(work) = stage.work {
            work(&asked)?;
        }
        return Ok(ExitCode::SUCCESS);
    }
    let out = out.unwrap_or_else(|| "findings.jsonl".into());
    let mut log = File::create(&out).map_err(|e| format!("{}: {e}", out.display()))?;
    let mut failed = 0;
    for stage in STAGES.iter().filter(|s| names.is_empty() || names.iter().any(|n| n == s.name)) {
        failed += usize::from(!contact(stage, &asked, &mut log)?);
    }
    Ok(ExitCode::from(u8::from(failed > 0)))
}

/// The adapter that was asked for, or the best one. A software device must be wanted.
fn choose(all: &[Adapter], index: Option<usize>, software: bool) -> Result<Adapter> {
    let best = || all.iter().max_by_key(|a| (a.rank(), std::cmp::Reverse(a.index)));
    let chosen = match index {
        Some(i) => all.iter().find(|a| a.index == i).ok_or(format!("no adapter {i}; there are {}", all.len()))?,
        None => best().ok_or("found no Vulkan, Metal or DX12 adapter; is a driver installed?")?,
    };
    if chosen.software && !software {
        return Err(format!("found only a software device: {chosen}; --software accepts it").into());
    }
    Ok(chosen.clone())
}

/// Every adapter with its limits and features, and which one is used.
fn adapter(asked: &Asked) -> Result<()> {
    adapters().iter().for_each(|a| say(&json!({ "adapter": a, "used": a.index == asked.adapter })));
    Ok(())
}

/// Rates of the device, by micro-benchmarks.
fn limits(asked: &Asked) -> Result<()> {
    say(&json!({ "limits": Wgpu::open(Some(asked.adapter))?.ceiling()? }));
    Ok(())
}

/// Runs a stage and writes its findings; whether it passed.
fn contact(stage: &Stage, asked: &Asked, log: &mut File) -> Result<bool> {
    let mut command = match stage.work {
        Work::Own(_) => {
            let mut command = Command::new(std::env::current_exe()?);
            command.args(["--within", stage.name, "--adapter", &asked.adapter.to_string()]);
            command.args(asked.software.then_some("--software"));
            command
        }
        Work::Program(name, arguments) => {
            let mut command = Command::new(Asked::kit()?.join(name));
            command.args(arguments).env("CONEFIELD_ADAPTER", asked.adapter.to_string());
            command
        }
    };
    // Without it a Vulkan layer complains at each start of a device, which hides what a test says.
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        command.env("XDG_RUNTIME_DIR", std::env::temp_dir());
    }
    let started = Instant::now();
    let spawned = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let (outcome, passed, tail) = match spawned {
        Err(e) => (format!("did not start: {e}"), false, String::new()),
        Ok(child) => watch(child, stage, log)?,
    };
    let mut last = json!({ "stage": stage.name, "outcome": outcome, "seconds": started.elapsed().as_secs_f64() });
    if !passed {
        last["tail"] = json!(tail);
    }
    write(log, &last)?;
    Ok(passed)
}

/// Passes on what `child` finds until it ends or its time is over: the outcome, whether it is a good one, and the end of what it
/// said otherwise.
fn watch(mut child: Child, stage: &Stage, log: &mut File) -> Result<(String, bool, String)> {
    let (stdout, mut stderr) = (child.stdout.take().ok_or("no pipe")?, child.stderr.take().ok_or("no pipe")?);
    let errors = thread::spawn(move || {
        let mut text = String::new();
        let _ = stderr.read_to_string(&mut text);
        text
    });
    let (mut findings, name) = (log.try_clone()?, stage.name);
    let own = matches!(stage.work, Work::Own(_));
    let lines = thread::spawn(move || {
        let mut other = String::new();
        for line in BufReader::new(stdout).lines().map_while(std::result::Result::ok) {
            match serde_json::from_str::<Value>(&line) {
                Ok(mut finding) if own && finding.is_object() => {
                    finding["stage"] = json!(name);
                    let _ = write(&mut findings, &finding);
                }
                _ => other += &(line + "\n"),
            }
        }
        other
    });
    let deadline = Instant::now() + Duration::from_secs(stage.limit_s);
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break Some(status);
        }
        if Instant::now() >= deadline {
            child.kill()?;
            child.wait()?;
            break None;
        }
        thread::sleep(Duration::from_millis(20));
    };
    let said = lines.join().unwrap_or_default() + &errors.join().unwrap_or_default();
    let tail: Vec<&str> = said.lines().rev().take(20).collect();
    let tail = tail.into_iter().rev().collect::<Vec<_>>().join("\n");
    Ok(match status {
        Some(status) if status.success() => ("passed".into(), true, tail),
        Some(status) => (format!("failed: {status}"), false, tail),
        None => (format!("stopped after {} s", stage.limit_s), false, tail),
    })
}

/// Writes a finding where a lost machine does not take it along.
fn write(log: &mut File, finding: &Value) -> Result<()> {
    println!("{finding}");
    writeln!(log, "{finding}")?;
    Ok(log.sync_data()?)
}

/// A file of the kit.
fn file(name: &str) -> Result<PathBuf> {
    let path = Asked::kit()?.join(name);
    if !Path::exists(&path) {
        return Err(format!("{}: not found; benches/contact.sh puts it there", path.display()).into());
    }
    Ok(path)
}
