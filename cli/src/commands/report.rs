//! `conefield report`

mod runs;
mod scans;

use crate::boundary::{self, Inputs, refuse_existing};
use crate::out;
use crate::run_folder::RunOnDisk;
use clap::Args;
use conefield::memory::Memory;
use conefield::parse::{self, HoldOut};
use conefield::projection;
use conefield_core::Result;
use conefield_evaluation::report::page::{Page, PageVolume, coarser, png_url};
use scans::{Group, Options};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Show runs in one HTML page that any browser opens offline.
///
/// The page has slices, a rendering and values of the volumes, differences to the reference and between runs, scores,
/// times, memory, training curves, measured and predicted projections with residuals, the geometry, the spec and what
/// it builds, and warnings. RUN is the folder of "conefield reconstruct", "conefield compare" or "conefield study".
/// Scan and reference are read from where the run read them; missing ones are left out with a note.
#[derive(Args)]
pub struct ReportArgs {
    /// The folder of a run, a comparison or a study; several are shown side by side.
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// The page, such as report.html.
    #[arg(short, long = "output", value_name = "FILE")]
    output: PathBuf,
    /// Replace FILE.
    #[arg(long)]
    force: bool,
    /// The scan of all runs, if it has moved.
    #[arg(long, value_name = "SCAN")]
    scan: Option<PathBuf>,
    /// The reference, if the runs name none or it has moved: a file, or "truth" for the one in the scan.
    #[arg(long, value_name = "VOLUME")]
    reference: Option<PathBuf>,
    /// Views to show, such as 3,17 or every:10 [default: six].
    #[arg(long, value_name = "VIEWS", value_parser = parse::hold_out)]
    views: Option<HoldOut>,
    /// Voxel projector: joseph, siddon or trilinear.
    #[arg(long, value_name = "TYPE", default_value = projection::PROJECTOR)]
    projector: String,
    /// Total size of the volumes in the page before compression, at two bytes per voxel. Larger volumes are reduced by
    /// averaging blocks of voxels.
    #[arg(long, value_name = "SIZE", default_value = "64MiB", value_parser = parse::bytes)]
    embed: u64,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

impl ReportArgs {
    pub fn run(self) -> Result<()> {
        boundary::ends(&self.output, "html")?;
        refuse_existing(&self.output, self.force)?;
        let found = runs::find(&self.runs)?;
        Inputs::of(&self.runs)
            .and(found.iter().map(|r| &r.folder))
            .and(found.iter().filter_map(|r| r.scan_path()))
            .and(found.iter().filter_map(|r| r.reference()))
            .and(&self.scan)
            .and(&self.reference)
            .spare_file(&self.output)?;
        let options = Options {
            scan: self.scan.as_deref(),
            reference: self.reference.as_deref(),
            views: self.views.as_ref(),
            projector: projection::projector(Value::String(self.projector.clone()))?,
        };
        let mut page = Page::default();
        let groups = Group::all(&found, &options, &mut page)?;
        let voxels: Vec<u64> = groups.iter().flat_map(Group::voxels).collect();
        let coarser = coarser(&voxels, self.embed);
        self.check_memory(&groups, &options)?;

        page.runs = runs::page_runs(&found, &mut page.warnings);
        let mut results: Vec<Option<PageVolume>> = found.iter().map(|_| None).collect();
        let mut references = vec![];
        for group in groups {
            group.show(&found, &options, coarser, &mut page, &mut results, &mut references)?;
        }
        page.volumes = results.into_iter().flatten().chain(named(references)).collect();
        if let [_] = &page.runs[..] {
            page.beside = (1..page.volumes.len()).find(|i| page.volumes[*i].reference);
        }
        page.spreads = runs::spreads(&self.runs)?;
        page.title = runs::title(&page);
        page.notes = notes(&page, coarser);
        let bytes = page.write(&self.output)?;
        self.summarize(&page, coarser, bytes)
    }

    /// Refuses a page that does not fit into memory: one volume at a time with its scan, and the data of the page.
    fn check_memory(&self, groups: &[Group], options: &Options) -> Result<()> {
        let all: u64 = groups.iter().flat_map(Group::voxels).sum::<u64>() * 2;
        // Worst case: incompressible data as text, and before that its two halves.
        let packed = 2 * all.min(self.embed);
        let moments = groups.iter().map(|g| g.memory(options, packed)).collect::<Result<Vec<_>>>()?;
        Memory::most(&moments.concat()).check()
    }

    fn summarize(&self, page: &Page, coarser: usize, bytes: u64) -> Result<()> {
        let views: Vec<usize> = page.scans.iter().flat_map(|s| s.views.iter().map(|v| v.view)).collect();
        if self.json {
            let volumes = page.volumes.iter().map(|v| json!({ "name": v.name, "shape": v.shape }));
            return out::json(&json!({
                "page": self.output.display().to_string(), "bytes": bytes, "runs": page.runs.iter().map(|r| &r.name).collect::<Vec<_>>(),
                "volumes": volumes.collect::<Vec<_>>(), "coarser": coarser, "views": views,
                "warnings": page.warnings.iter().map(|w| &w.found).collect::<Vec<_>>(),
            }));
        }
        let mut lines = vec![format!(
            "{}: {}, {}, {} in {}",
            self.output.display(),
            out::counted(page.runs.len(), "run"),
            out::counted(page.volumes.len(), "volume"),
            out::counted(views.len(), "view"),
            out::bytes(bytes),
        )];
        if coarser > 1 {
            let limit = out::bytes(self.embed);
            lines.push(format!(
                "the volumes take more than {limit} (--embed): means of {coarser} x {coarser} x {coarser} voxels are shown"
            ));
        }
        lines.extend(page.warnings.iter().map(|w| format!("warning: {}", w.found)));
        out::say(&lines.join("\n"))
    }
}

/// The page of an unfinished run: curves, spec and the live picture, without large files. Browsers renew it after
/// `seconds`.
pub fn standing(folder: &Path, seconds: u64) -> Result<String> {
    let found = [RunOnDisk::read(folder)?];
    let mut page = Page { renewed: Some(seconds), ..Page::default() };
    page.runs = runs::page_runs(&found, &mut page.warnings);
    // The run is still active, so the warning about an interrupted run does not apply.
    page.warnings.clear();
    page.title = runs::title(&page);
    let live = folder.join("live.png");
    for run in page.runs.iter_mut().filter(|run| run.record.is_none()) {
        run.status = "in progress".into();
        run.live = std::fs::read(&live).ok().map(|png| png_url(&png));
    }
    page.html(&folder.display().to_string())
}

/// References with names that distinguish them.
fn named(references: Vec<(PathBuf, PageVolume)>) -> impl Iterator<Item = PageVolume> {
    let several = references.len() > 1;
    references.into_iter().map(move |(path, mut reference)| {
        if several {
            reference.name = format!("{} {}", scans::REFERENCE, path.display());
        }
        reference
    })
}

/// Notes on the page.
fn notes(page: &Page, coarser: usize) -> Vec<String> {
    let mut notes =
        vec![format!("Made by conefield {}. The page is complete: it fetches nothing.", env!("CARGO_PKG_VERSION"))];
    if !page.volumes.is_empty() {
        let coarse = if coarser > 1 { ", averaged over blocks," } else { "" };
        notes.push(format!(
            "Voxel values{coarse} are stored in 16 bits, in even steps from each volume's lowest to its highest value; \
             the step size is shown below the volume. Scores come from the run's record and use all voxels of its \
             files."
        ));
        notes.push(
            "Lung, soft tissue and bone are windows in Hounsfield units: level −600, 40 and 400, width 1500, 400 and \
             1800. They are correct if air has the value 0 and water the value shown next to them, which is a guess: \
             set it to match your data."
                .into(),
        );
    }
    notes
}
