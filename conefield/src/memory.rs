//! Estimates a command's memory before it allocates any, and finds the available memory.
//!
//! An estimate is the peak over reading, training and export. It omits everything that is always small, except the
//! program itself.

use crate::{ranks, scratch};
use conefield_core::backend::Backend;
use conefield_core::method::{Needs, Plan};
use conefield_core::scan::Scan;
use conefield_core::{Error, Result, allowance};
use conefield_evaluation::report::text::bytes;
use conefield_io::{SLAB_BYTES, ScanSize};
use conefield_scans::calibration::{self, Settings};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use sysinfo::{MemoryRefreshKind, ProcessesToUpdate, RefreshKind, System, get_current_pid};
use tracing::info;

/// Code, threads and tables of libraries.
const PROGRAM: u64 = 24 << 20;

/// The limit of `--memory`.
static BUDGET: OnceLock<u64> = OnceLock::new();

/// The folder of `--scratch`, or the one beside an output.
static SCRATCH: OnceLock<PathBuf> = OnceLock::new();

/// Sets the memory limit; `None` means the available memory. Readers check it as they allocate. For programs whose
/// allocator is [`scratch::Allocator`].
pub fn set_budget(bytes: Option<u64>) {
    if let Some(bytes) = bytes {
        let _ = BUDGET.set(bytes);
    }
    let most = bytes.map_or_else(|| available(ranks::on_machine()), |bytes| bytes.min(available(1)));
    allowance::set_memory(most, scratch::allocated);
}

/// Allows arrays that do not fit into memory to live on the disk of `folder`. The first call counts. For programs whose
/// allocator is [`scratch::Allocator`].
pub fn allow_scratch(folder: &Path) {
    let _ = SCRATCH.set(folder.to_owned());
}

/// Bytes at the peak, by use.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Memory {
    /// The projections, and memory for reading them.
    pub scan: u64,
    /// Volumes that are read or computed: a result is held whole only for scoring.
    pub volume: u64,
    /// The reference volume.
    pub reference: u64,
    /// Parameters and gradients.
    pub model: u64,
    /// Both moments of every parameter, parameters and moments of the last good state, and the best parameters.
    pub optimizer: u64,
    /// Working memory of backend, solver and writer, and the program itself.
    pub buffers: u64,
    /// Sum of all.
    pub total: u64,
}

impl Memory {
    /// Computes the sum, including the program.
    fn summed(mut self) -> Self {
        self.buffers += PROGRAM;
        self.total = self.scan + self.volume + self.reference + self.model + self.optimizer + self.buffers;
        self
    }

    /// The largest of several estimates.
    pub fn most(moments: &[Memory]) -> Self {
        moments.iter().map(|m| m.summed()).max_by_key(|m| m.total).unwrap_or_default()
    }

    /// Text for people.
    pub fn line(&self) -> String {
        let names = ["scan", "volume", "reference", "model", "optimizer", "buffers"];
        let parts = [self.scan, self.volume, self.reference, self.model, self.optimizer, self.buffers];
        let parts = names.iter().zip(parts).filter(|(_, n)| *n > 0).map(|(what, n)| format!("{what} {}", bytes(n)));
        format!("{}: {}", bytes(self.total), parts.collect::<Vec<_>>().join(", "))
    }

    /// Bytes for scratch files if the estimate does not fit into `limit`, and arrays may leave memory.
    pub fn beside(&self, limit: u64) -> Option<u64> {
        // What is read and written at random stays in memory.
        let stays = self.model + self.optimizer;
        let fits = self.total <= limit || limit < scratch::LEAST || stays > limit / 4 || !cfg!(target_os = "linux");
        (!fits).then_some(self.total + self.total / 8)
    }

    /// [`Self::check_or`] without suggestions.
    pub fn check(&self) -> Result<()> {
        self.check_or(&|_| vec![])
    }

    /// Moves arrays to the disk if the estimate does not fit and a folder is allowed for them. Else refuses it, with
    /// figures; `smaller` lists what would fit into the given bytes.
    pub fn check_or(&self, smaller: &dyn Fn(u64) -> Vec<String>) -> Result<()> {
        let limit = limit();
        if self.total <= limit {
            return Ok(());
        }
        let beside = self.beside(limit);
        if let (Some(beside), Some(folder)) = (beside, SCRATCH.get()) {
            scratch::begin(folder, limit, beside)?;
            allowance::set_memory(limit.saturating_add(beside), scratch::allocated);
            let (limit, place) = (bytes(limit), folder.display());
            info!("more than {limit} of memory: scratch files in {place} hold the rest of {}", self.line());
            return Ok(());
        }
        let mut smaller = smaller(limit);
        smaller.extend(beside.map(|_| "a run with --scratch FOLDER on a disk with room".to_owned()));
        let hint = match smaller.as_slice() {
            [] => "no single reduction would make it fit".to_owned(),
            all => format!("{} would fit", all.join(" or ")),
        };
        let there = there(limit, BUDGET.get().is_some(), ranks::on_machine());
        Err(Error::unsupported("memory", format!("needs {}; {there}; {hint}", self.line())))
    }
}

/// The limit in words: set by `--memory`, or the share of each of so many processes on this machine.
fn there(limit: u64, set: bool, processes: u64) -> String {
    match (set, processes) {
        (true, _) => format!("--memory allows {}", bytes(limit)),
        (_, 1) => format!("{} are available", bytes(limit)),
        _ => format!("{} are available to each of {processes} processes on this machine", bytes(limit)),
    }
}

/// The limit of `--memory`, else this process's share of the available memory, in bytes. What this process holds already,
/// such as the scan, is part of what a run needs: it counts as available.
pub fn limit() -> u64 {
    BUDGET.get().copied().unwrap_or_else(|| available(ranks::on_machine()).saturating_add(scratch::allocated()))
}

/// Bytes available to each of so many processes: the machine's available memory, less if a control group limits it; no
/// limit if the system does not report it.
fn available(processes: u64) -> u64 {
    let memory = RefreshKind::nothing().with_memory(MemoryRefreshKind::nothing().with_ram());
    let Ok(mut system) = System::new_with_specifics(memory) else { return u64::MAX };
    let machine = Some(system.available_memory()).filter(|n| *n > 0).unwrap_or(u64::MAX);
    let limits = get_current_pid().ok().and_then(|pid| {
        system.refresh_processes(ProcessesToUpdate::Some(&[pid]), false);
        system.process(pid)?.cgroup_limits()
    });
    // The group's free memory excludes reclaimable caches.
    let shared = limits.map_or(machine, |l| machine.min(l.total_memory.saturating_sub(l.rss)));
    (shared / processes).min(addresses())
}

/// The rest of a limited address space. One eighth is reserved for threads and for overhead of the allocator.
fn addresses() -> u64 {
    let used = status("VmSize:").unwrap_or(0);
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let limit = limits.lines().find_map(|l| l.strip_prefix("Max address space"));
    let soft = limit.and_then(|l| l.split_whitespace().next()?.parse::<u64>().ok());
    soft.map_or(u64::MAX, |most| most.saturating_sub(used) / 8 * 7)
}

/// Peak memory of this process, if the system reports it.
pub fn peak() -> Option<u64> {
    status("VmHWM:")
}

/// Bytes that the system reports for this process under `name`.
fn status(name: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix(name))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|k| k << 10)
}

impl Memory {
    /// Memory for volumes with these numbers of voxels, read one after the other. Reordering a file's voxels briefly
    /// takes a second copy of each.
    pub fn of_volumes(voxels: &[u64]) -> Self {
        let mut held = 0;
        let moments = voxels.iter().map(|n| {
            let volume = 4 * (held + 2 * n);
            held += n;
            Memory { volume, ..Memory::default() }
        });
        Self::most(&moments.collect::<Vec<_>>())
    }

    /// Memory for reading a scan's views.
    pub fn of_views(size: &ScanSize) -> Self {
        let scan = 4 * (size.pixels + size.test_pixels) + size.reading;
        Self::most(&[Memory { scan, ..Memory::default() }])
    }

    /// The same, including the scan's volume.
    pub fn of_data_set(size: &ScanSize) -> Self {
        Self::of_data_set_and(size, 0)
    }

    /// The same, and for calibrating the scan, with `shifts` also its single views.
    pub fn of_calibration(size: &ScanSize, settings: &Settings, shifts: bool, backend: &dyn Backend) -> Result<Self> {
        Ok(Self::of_data_set_and(size, calibration::bytes(&size.header(), settings, shifts, backend)?))
    }

    /// Memory for reading a scan with its volume, and for work with it that takes so many bytes.
    fn of_data_set_and(size: &ScanSize, buffers: u64) -> Self {
        let scan = 4 * (size.pixels + size.test_pixels);
        let reading = Memory { scan: scan + size.reading, volume: 4 * size.voxels, ..Memory::default() };
        let reordering = Memory { scan, volume: 8 * size.voxels, ..Memory::default() };
        Self::most(&[reading, reordering, Memory { scan, volume: 4 * size.voxels, buffers, ..Memory::default() }])
    }
}

/// The memory of a run besides its method's needs.
#[derive(Debug, Clone, Copy)]
pub struct Run {
    /// The scan.
    pub scan: ScanSize,
    /// Whether some views are held out.
    pub split: bool,
    /// Whether the whole scan stays in memory beside its parts.
    pub kept: bool,
    /// Whether there is a reference.
    pub reference: bool,
    /// Whether it resumes from a checkpoint.
    pub resume: bool,
}

impl Run {
    /// A run on a scan of this size, without reference, held-out views and checkpoint.
    pub fn on(scan: ScanSize) -> Self {
        Self { scan, split: false, kept: false, reference: false, resume: false }
    }

    /// A run on a scan that is in memory.
    pub fn on_scan(scan: &Scan) -> Self {
        let header = scan.header();
        let (pixels, voxels) = (header.pixels(), header.voxels());
        Self::on(ScanSize { pixels, voxels, test_pixels: 0, reading: 0, views: header.views })
    }

    /// Memory for running `plan`.
    pub fn memory(&self, plan: &dyn Plan) -> Memory {
        self.with(plan.needs(&self.scan.header()))
    }

    /// Memory for reading scan and reference.
    pub fn reading(&self) -> Memory {
        self.with(Needs::default())
    }

    fn with(&self, needs: Needs) -> Memory {
        let projections = 4 * self.scan.pixels;
        let voxels = 4 * self.scan.voxels;
        let reference = if self.reference { voxels } else { 0 };
        let iterate = if needs.volume { voxels } else { 0 };
        let checkpoint = if self.resume { needs.resume } else { 0 };
        let reading = Memory { scan: projections + self.scan.reading, ..Memory::default() };
        // Reordering a file's voxels takes a copy.
        let comparing = Memory { scan: projections, reference: 2 * reference, ..Memory::default() };
        let splitting = Memory { scan: if self.split { 2 * projections } else { 0 }, reference, ..Memory::default() };
        let scan = if self.split && self.kept { 2 * projections } else { projections };
        let surrounding = Memory { scan, reference, buffers: needs.surround, ..Memory::default() };
        let solving = Memory {
            scan: scan + needs.corrected,
            volume: iterate,
            reference,
            model: needs.model,
            optimizer: needs.optimizer,
            // Processes share the arrays of a method, but for what each receives of the others.
            buffers: needs.backend + needs.working / ranks::count() as u64 + checkpoint,
            ..Memory::default()
        };
        // A result is held whole for scoring, beside the method's own volume.
        let volume = iterate + if self.reference { voxels } else { 0 };
        let buffers = needs.evaluating + SLAB_BYTES + checkpoint;
        let exporting = Memory { scan, volume, buffers, ..solving };
        Memory::most(&[reading, comparing, splitting, surrounding, solving, exporting])
    }

    /// Reductions that would fit into `available` bytes, one at a time; `tables` yields plans with tables of the given
    /// number of bits, from the largest below the current one.
    pub fn smaller(
        &self,
        plan: &dyn Plan,
        available: u64,
        tables: &mut dyn Iterator<Item = (u32, Box<dyn Plan>)>,
    ) -> Vec<String> {
        let fits = |run: &Run, plan: &dyn Plan| run.memory(plan).total <= available;
        let mut found = vec![];
        let reference = Run { reference: false, ..*self };
        if self.reference && fits(&reference, plan) {
            found.push("a run without --reference".to_owned());
        }
        let halved = |k: u32| Run { scan: ScanSize { voxels: self.scan.voxels >> (3 * k), ..self.scan }, ..*self };
        let side = |n: u64| (n as f64).cbrt().round() as u64;
        if let Some(run) = (1..8).map(halved).find(|run| fits(run, plan)) {
            found.push(format!("a volume of {}³ voxels", side(run.scan.voxels)));
        }
        let fitting = |(bits, plan): (u32, Box<dyn Plan>)| fits(self, plan.as_ref()).then_some(bits);
        found.extend(tables.filter_map(fitting).next().map(|bits| format!("tables of 2^{bits}")));
        let binned = |k: u32| Run { scan: ScanSize { pixels: self.scan.pixels >> (2 * k), ..self.scan }, ..*self };
        if let Some(k) = (1..5).find(|k| fits(&binned(*k), plan)) {
            found.push(format!("a detector of 1/{} of the rows and columns", 1 << k));
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::method::{Findings, Job, Observer, Outline, Solution};
    use conefield_core::scan::ScanHeader;

    fn run() -> Run {
        let scan = ScanSize { pixels: 1 << 20, voxels: 512 * 512 * 512, test_pixels: 0, reading: 0, views: 1 };
        Run { reference: true, ..Run::on(scan) }
    }

    fn needs(parameters: u64) -> Needs {
        Needs {
            model: 8 * parameters,
            optimizer: 20 * parameters,
            backend: 1 << 20,
            working: 4 << 20,
            evaluating: 24 << 20,
            ..Needs::default()
        }
    }

    /// The same needs for every scan.
    struct Fixed(u64);

    impl Plan for Fixed {
        fn outline(&self) -> Outline {
            Outline::default()
        }
        fn needs(&self, _: &ScanHeader) -> Needs {
            needs(self.0)
        }
        fn inspect(&self, _: &Scan) -> Result<Findings> {
            Ok(Findings::default())
        }
        fn run(&mut self, _: &Job<'_>, _: &mut dyn Observer) -> Result<Solution> {
            Err(Error::unsupported("a test", "it runs nothing"))
        }
    }

    #[test]
    fn the_moment_with_the_largest_need_is_reported() {
        let m = run().memory(&Fixed(1 << 22));
        assert_eq!((m.reference, m.volume), (512 << 20, 512 << 20));
        assert_eq!((m.model, m.optimizer), (32 << 20, 80 << 20));
        assert_eq!(m.total, m.scan + m.volume + m.reference + m.model + m.optimizer + m.buffers);
        let alone = Run { reference: false, ..run() }.memory(&Fixed(1 << 22));
        assert_eq!((alone.reference, alone.volume), (0, 0));
        let split = Run { split: true, ..run() }.memory(&Fixed(1 << 22));
        let kept = Run { split: true, kept: true, ..run() }.memory(&Fixed(1 << 22));
        assert_eq!((split.total, kept.total), (m.total, m.total + (4 << 20)));
        assert!(m.line().contains("reference 512 MiB") && !alone.line().contains("reference"), "{}", m.line());
    }

    #[test]
    fn only_what_fits_is_offered() {
        let plan = Fixed(1 << 22);
        let tables =
            || [(18, 1 << 21), (17, 1 << 20)].map(|(b, n)| (b, Box::new(Fixed(n)) as Box<dyn Plan>)).into_iter();
        let found = run().smaller(&plan, 400 << 20, &mut tables());
        assert_eq!(found, ["a run without --reference", "a volume of 256³ voxels"]);
        let alone = Run { reference: false, ..run() };
        let found = alone.smaller(&plan, alone.memory(&plan).total - (70 << 20), &mut tables());
        assert_eq!(found, ["tables of 2^17"]);
        assert!(run().smaller(&plan, 1 << 20, &mut tables()).is_empty());
    }

    #[test]
    fn a_share_of_the_memory_is_said_to_be_one() {
        let said = [(true, 4), (false, 1), (false, 4)].map(|(set, processes)| there(1 << 30, set, processes));
        let shared = "1.0 GiB are available to each of 4 processes on this machine";
        assert_eq!(said, ["--memory allows 1.0 GiB", "1.0 GiB are available", shared]);
    }

    #[test]
    fn the_machine_has_memory() {
        assert!(available(1) > 1 << 20);
        if cfg!(target_os = "linux") {
            assert!(peak().is_some_and(|p| p > 1 << 20));
        }
    }
}
