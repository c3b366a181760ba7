//! `conefield reconstruct`

use super::summary::summary;
use super::units::HounsfieldOption;
use super::{EndOptions, calibrate, protocol::RunProtocol, watch};
use crate::board::Board;
use crate::boundary::{self, Inputs};
use crate::outgoing::{self, WrittenVolume};
use crate::progress::{Progress, Renewed};
use crate::run_folder::RunFolder;
use crate::{out, signals};
use clap::error::ErrorKind;
use clap::{Args, CommandFactory};
use conefield::files::Interrupted;
use conefield::input::{self, Input};
use conefield::memory;
use conefield::method::Read;
use conefield::parse;
use conefield::record::{RunRecord, ScanRecord, Written};
use conefield::session::{self, Request, Run, Session, Solved};
use conefield::tradeoff::front::Front;
use conefield::{files, ranks, specs};
use conefield_backend_cpu::Cpu;
use conefield_core::backend::Backend;
use conefield_core::checkpoint::Resume;
use conefield_core::method::Record;
use conefield_core::scan::Scan;
use conefield_core::spec::load::{Loaded, to_toml};
use conefield_core::{Error, Result};
use conefield_evaluation::hounsfield::Calibration;
use conefield_evaluation::report::MiddleSlices;
use conefield_evaluation::report::text::bytes;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::PathBuf;
use std::time::Instant;

/// Reconstruct a volume from a scan.
///
/// RUN receives volume.nii.gz, metrics.jsonl, spec.toml (every setting), weights.safetensors, slices.png and, at the
/// end, record.json. Ctrl-C stops the run after its step; the same command with --resume continues. With --budget the
/// command first measures this machine for one to three seconds (less for a short budget) and then plans its work to
/// fit the budget.
#[derive(Args)]
pub struct ReconstructArgs {
    /// The scan.
    scan: PathBuf,
    #[arg(long, help = spec_help())]
    spec: Option<String>,
    /// Let --budget choose the spec from this front instead of the shipped one.
    #[arg(long, value_name = "FILE", conflicts_with = "spec", requires = "budget")]
    front: Option<PathBuf>,
    /// The folder for the results; new or empty.
    #[arg(short, long = "output", value_name = "RUN")]
    output: PathBuf,
    /// Replace the files of an earlier run in RUN.
    #[arg(long)]
    force: bool,
    /// Continue the interrupted run in RUN; all other options must be the same.
    #[arg(long, conflicts_with = "force")]
    resume: bool,
    #[command(flatten)]
    protocol: RunProtocol,
    /// Start from weights of "conefield pretrain", or from a volume.
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    #[command(flatten)]
    units: HounsfieldOption,
    /// Draw the middle slices of the current volume to live.png in RUN at this interval, such as 5s.
    #[arg(long, value_name = "TIME", value_parser = parse::seconds)]
    live: Option<f64>,
    /// Write events.out.tfevents.conefield in RUN, in which TensorBoard shows curves and pictures during the run.
    #[arg(long)]
    tensorboard: bool,
    /// Serve the page of "conefield report" at http://127.0.0.1:PORT/ during the run, with live.png every 5 s unless
    /// --live says otherwise [default: a free port].
    #[arg(long, value_name = "PORT", num_args = 0..=1, require_equals = true, default_missing_value = "0")]
    watch: Option<u16>,
    /// Print one JSON object: the content of record.json.
    #[arg(long)]
    json: bool,
    /// The run is part of another command: its error also goes to standard output, and the end of standard input stops
    /// it like a signal.
    #[arg(long, hide = true)]
    as_part: bool,
    /// What the demonstration calls the run. Such a run keeps no checkpoint and uses no scratch file.
    #[arg(skip)]
    pub shown_as: Option<&'static str>,
}

fn spec_help() -> String {
    format!("{}; optional with --budget, which then chooses the best that fits", specs::help())
}

/// Prefix of an error on standard output.
pub const FAILED: &str = "failed: ";

/// The file for the state of an interrupted run.
const CHECKPOINT: &str = "checkpoint.safetensors";

/// Seconds between two live pictures for --watch.
const WATCHED: f64 = 5.0;

/// A held-out error above this may be due to a wrong geometry.
const DOUBTFUL: f64 = 0.05;

impl ReconstructArgs {
    pub fn run(self) -> Result<()> {
        if self.spec.is_none() && self.protocol.budget.is_none() {
            Self::without_a_spec();
        }
        if self.as_part {
            signals::follow_input();
        }
        let done = self.reconstruct();
        if let (Err(e), true) = (&done, self.as_part) {
            out::say(&format!("{FAILED}{}", out::plain_line(&e.to_string(), out::LONGEST_LINE)))?;
        }
        match done? {
            None => Ok(()),
            Some(record) if self.json => out::json(&record),
            Some(record) => out::say(&summary(&record, &self.output)),
        }
    }

    /// Exits with a usage error and advice.
    fn without_a_spec() -> ! {
        let mut whole = crate::Cli::command();
        whole.build();
        let name = "reconstruct";
        let command = whole.find_subcommand_mut(name).map(std::mem::take).unwrap_or(clap::Command::new(name));
        let what = "neither --spec nor --budget is given\n\n  --budget 60s     the best method for a minute, all in all, on \
                    this machine\n  --spec fista-tv  total variation\n  --spec balanced  a neural field, for one to five \
                    minutes; conefield explain SPEC says what a spec does";
        command.bin_name("conefield reconstruct").error(ErrorKind::MissingRequiredArgument, what).exit()
    }

    /// The work of a process that does not lead: what the leading one computes, without a file or a word.
    fn follow(&self, begin: Instant) -> Result<()> {
        memory::allow_scratch(conefield_io::folder_of(&self.output));
        let backend = self.protocol.backend.open()?;
        let session = self.session(backend.as_ref(), begin)?;
        let (input, _, earlier) = self.input(&session)?;
        let earlier = earlier.map(|(earlier, _)| earlier);
        let mut run = session.plan(input, earlier.as_ref(), &|| false)?;
        signals::listen();
        // Such a process is quiet.
        match run.solve(None, earlier.as_ref().map(|e| &e.resume), &mut Progress::new("reconstruct", None)) {
            // The leading process writes the checkpoint and says so.
            Err(Error::Interrupted { .. }) => Ok(()),
            done => done.map(drop),
        }
    }

    /// Does the run and returns its record, if this process leads.
    pub fn reconstruct(&self) -> Result<Option<RunRecord>> {
        let begin = Instant::now();
        if ranks::count() > 1 && self.protocol.budget.is_some() {
            let expected = "--spec without --budget: processes that measure their own speed would choose differently";
            return Err(Error::invalid("mpirun", "--budget", "several processes", expected));
        }
        if ranks::rank() > 0 {
            return self.follow(begin).map(|()| None);
        }
        let mut folder = RunFolder::take(&self.output)?;
        if !self.resume {
            folder.may_begin(self.force)?;
        }
        // A spec stores this file name as text; a name that is not UTF-8 would be stored as another one.
        self.init.as_deref().map(boundary::text).transpose()?;
        if self.shown_as.is_none() {
            memory::allow_scratch(conefield_io::folder_of(&self.output));
        }
        let backend = self.protocol.backend.open_for_run(self.protocol.budget)?;
        // An invalid spec, and weights that cannot be read or do not fit, are reported before anything is created.
        let session = self.session(backend.as_ref(), begin)?;
        let inputs = Inputs::of([&self.scan])
            .and(&self.front)
            .and(&self.init)
            .and(self.protocol.reference.iter().filter(|r| !input::is_truth(r)))
            .and(self.units.path());
        let inputs = match session.requested() {
            Some(loaded) if !self.resume => inputs.and_spec(loaded),
            _ => inputs,
        };
        inputs.spare_folder(&self.output)?;
        let (input, scan, earlier) = self.input(&session)?;
        let (earlier, files) = earlier.unzip();
        conefield_io::check_shape(folder.file("volume.nii.gz"), input.scan.geometry.volume.shape)?;
        let affine = input.reference.as_ref().and_then(|r| r.affine);
        let (unit, grid) = (&input.scan.unit, &input.scan.geometry.volume);
        let hu = self.units.of_attenuation()?.open(&self.scan, Some(unit), grid, affine.as_ref())?;

        let mut run = session.plan(input, earlier.as_ref(), &|| signals::caught().is_some())?;
        let resume = earlier.as_ref().map(|e| &e.resume);
        let loaded = &run.method.loaded;
        let files = files.map_or_else(|| specs::checksums(loaded), Ok)?;
        let identity = identity(loaded, &self.protocol, &run.input.held, &scan, &files)?;
        signals::listen();
        // The parent process has ended, and nothing of this run has been written yet.
        if signals::caught().is_some() {
            return Err(Error::Aborted { part: "preparation".into() });
        }
        folder.warn_without_room(4 * run.input.scan.header().voxels());
        if resume.is_none() {
            inputs.and_spec(loaded).spare_folder(&self.output)?;
        }
        let (metrics, recorded) = begin_or_go_on(&mut folder, loaded, resume)?;
        if let Some(port) = self.watch {
            watch::serve(&self.output, port)?;
        }
        let mut progress = self.progress(&folder, metrics, identity)?;
        progress.history = run.history.clone();
        let solved = run.solve(None, resume, &mut progress).map_err(|e| match e {
            Error::Interrupted { step } if folder.file(CHECKPOINT).exists() => {
                Error::Stopped { part: format!("the run, after step {step}") }
            }
            e => e,
        })?;
        if ranks::count() > 1 {
            tracing::info!("{} processes; this one sent {} to the others", ranks::count(), bytes(ranks::sent()));
        }
        // A run resumed after its last pass adds no record.
        let last = progress.latest.take().or(recorded);
        let board = progress.board.take();
        drop(progress);

        let (record, failed) =
            self.results(&folder, &run, &solved, hu.as_ref(), &scan, files, last.as_ref(), backend.as_ref())?;
        let picture = folder.file("slices.png");
        if let Some(Err(e)) = board.map(|mut board| board.picture(solved.solution.steps, "slices", &picture)) {
            tracing::warn!("{e}");
        }
        folder.finish()?;
        if let Some(e) = failed {
            return Err(e);
        }
        self.doubt(&run.input.scan, record.held_out);
        Ok(Some(record))
    }

    /// Writes the volumes, the scores and the record. Returns the record, and an error that only the volume in Hounsfield
    /// units had: the finished run stays.
    fn results(
        &self,
        folder: &RunFolder,
        run: &Run<'_>,
        solved: &Solved,
        hu: Option<&Calibration>,
        scan: &ScanRecord,
        files: BTreeMap<String, String>,
        last: Option<&Record>,
        backend: &dyn Backend,
    ) -> Result<(RunRecord, Option<Error>)> {
        let affine = run.input.reference.as_ref().and_then(|r| r.affine);
        let written = write(folder, run, solved, self.protocol.seed, backend)?;
        let hounsfield = hu.map(|hu| {
            let mut voxels = solved.solution.result.voxels(backend)?;
            outgoing::write_only(&folder.file("volume-hu.nii.gz"), voxels.as_mut(), affine, Some(hu), None)
        });
        let (hounsfield, failed) = match hounsfield.transpose() {
            Ok(levels) => (levels.flatten(), None),
            Err(e) => (None, Some(e)),
        };
        let record = RunRecord {
            scan: Some(scan.clone()),
            init: self.init.as_ref().map(|init| init.display().to_string()),
            reference: self.protocol.named_reference(),
            files,
            hounsfield,
            ..run.record(solved, last, written)
        };
        conefield_io::write_text_atomic(folder.file("record.json"), &out::to_json(&record)?)?;
        Ok((record, failed))
    }

    /// If held-out views are predicted badly, checks whether the geometry is the cause. The run is complete, so an
    /// interruption only ends the check. Runs that are part of another command skip it.
    fn doubt(&self, scan: &Scan, held_out: Option<f64>) {
        if held_out.is_some_and(|error| error > DOUBTFUL)
            && !self.as_part
            && let Ok(Some(warning)) = calibrate::suspicion(scan, &Cpu::new())
        {
            tracing::warn!("{}: {warning}", self.scan.display());
        }
    }

    /// The requested spec, or the front within a budget.
    fn session<'a>(&self, backend: &'a dyn Backend, begin: Instant) -> Result<Session<'a>> {
        let asked = self.asked();
        let read = asked.as_ref().map(|spec| |sets: &[String]| specs::read(spec, sets));
        let request = Request {
            spec: read.as_ref().map(|read| read as Read<'_>),
            front: self.front.as_deref().map(Front::read).transpose()?,
            sets: self.protocol.sets.clone(),
            // A run resumed without a spec reads the start from its own spec.
            init: self.init.clone().filter(|_| self.spec.is_some() || !self.resume),
            limits: self.protocol.ends.limits(),
            budget: self.protocol.budget,
            seed: self.protocol.seed,
        };
        let run = memory::Run { resume: self.resume, ..self.protocol.memory(conefield_io::scan_size(&self.scan)?) };
        Session::open(request, backend, run, begin)
    }

    /// Reads all inputs, and the checkpoint that a resumed run continues from, with the checksums of its spec's files.
    fn input(&self, session: &Session<'_>) -> Result<(Input, ScanRecord, Option<Earlier>)> {
        let (surrounded, reference) = (session.surrounded(), self.protocol.reference.as_deref());
        let (whole, reference) = session.reading(|| input::read(&self.scan, reference, surrounded))?;
        let (input, record) = self.protocol.input(&self.scan, whole, reference)?;
        let earlier = match session.requested() {
            Some(loaded) if self.resume => {
                let files = specs::checksums(loaded)?;
                let identity = identity(loaded, &self.protocol, &input.held, &record, &files)?;
                Some((files::read_checkpoint(&self.output.join(CHECKPOINT), &identity)?, files))
            }
            _ => None,
        };
        Ok((input, record, earlier))
    }

    /// Display and recording of the run.
    fn progress(
        &self,
        folder: &RunFolder,
        metrics: (PathBuf, File),
        run: BTreeMap<String, String>,
    ) -> Result<Progress> {
        let board = self.tensorboard.then(|| Board::new(&folder.file("events.out.tfevents.conefield"), &metrics.0));
        let mut progress = Progress::new(self.shown_as.unwrap_or("reconstruct"), Some(metrics));
        let keeper = || Renewed::new(folder.file(CHECKPOINT), self.protocol.checkpoint_every);
        progress.keeper = self.shown_as.is_none().then(keeper);
        progress.run = run;
        let interval = self.live.or(self.watch.map(|_| WATCHED));
        progress.live = interval.map(|seconds| Renewed::new(folder.file("live.png"), seconds));
        progress.board = board.transpose()?;
        Ok(progress)
    }

    /// The requested spec. A resumed run reads its choice from its folder.
    fn asked(&self) -> Option<String> {
        let chosen = || self.output.join("spec.toml").display().to_string();
        self.spec.clone().or_else(|| self.resume.then(chosen))
    }
}

/// A checkpoint, and the checksums of the files that its spec names.
type Earlier = (Interrupted, BTreeMap<String, String>);

/// Begins a run in its folder, or resumes it. Returns its file of metrics, and the last record that it keeps.
fn begin_or_go_on(
    folder: &mut RunFolder,
    loaded: &Loaded,
    resume: Option<&Resume>,
) -> Result<((PathBuf, File), Option<Record>)> {
    if let Some(resume) = resume {
        folder.0.go_on();
        return folder.metrics_until(resume.standing.recorded);
    }
    Ok((folder.begin(&to_toml(&loaded.spec)?)?, None))
}

/// Writes the result of a run with this `seed` to its folder, and scores it.
fn write(folder: &RunFolder, run: &Run<'_>, solved: &Solved, seed: u64, backend: &dyn Backend) -> Result<Written> {
    let (reference, result) = (run.input.reference.as_ref(), &solved.solution.result);
    let place = folder.file("volume.nii.gz");
    let start = Instant::now();
    let parameters = session::parameters(result);
    if let Some(field) = result.field() {
        let notes = specs::notes(&run.method.loaded, seed)?;
        files::write_field(folder.file("weights.safetensors"), field, notes)?;
    }
    let mut voxels = result.voxels(backend)?;
    let affine = reference.and_then(|r| r.affine);
    let WrittenVolume { slices, whole } = outgoing::write(&place, voxels.as_mut(), affine, reference.is_some())?;
    let export_s = start.elapsed().as_secs_f64();
    let start = Instant::now();
    files::picture(folder.file("slices.png"), reference.map(MiddleSlices::of).as_ref(), &slices)?;
    let picture_s = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let scores = whole.map(|v| run.scores(&place.display().to_string(), &v)).transpose()?.flatten();
    let score_s = start.elapsed().as_secs_f64();
    Ok(Written { parameters, export_s, picture_s, score_s, scores })
}

/// Properties that must match to resume a run or to count it as finished; `files` are the checksums of the spec's files.
pub fn identity(
    loaded: &Loaded,
    protocol: &RunProtocol,
    held: &[usize],
    scan: &ScanRecord,
    files: &BTreeMap<String, String>,
) -> Result<BTreeMap<String, String>> {
    let mut all = specs::notes(loaded, protocol.seed)?;
    all.extend(conditions(scan, held, &protocol.ends, protocol.budget, files)?);
    Ok(all)
}

/// The part of [`identity`] that is not in the spec.
pub fn conditions(
    scan: &ScanRecord,
    held: &[usize],
    ends: &EndOptions,
    budget: Option<f64>,
    files: &BTreeMap<String, String>,
) -> Result<impl Iterator<Item = (String, String)>> {
    let conditions = [
        ("projections".into(), scan.projections_fnv1a64.clone()),
        ("geometry".into(), scan.geometry_fnv1a64.clone()),
        ("held_out_views".into(), format!("{held:?}")),
        ("limits".into(), out::to_json(ends)?),
        ("budget".into(), budget.map_or("none".into(), |s| s.to_string())),
    ];
    Ok(conditions.into_iter().chain(files.iter().map(|(name, sum)| (format!("file {name}"), sum.clone()))))
}
