//! Scans and references of the runs in a report, with projections and residuals.

use crate::commands::info::facts;
use crate::commands::info::lines;
use crate::run_folder::RunOnDisk;
use conefield::memory::Memory;
use conefield::parse::HoldOut;
use conefield::record::ScanRecord;
use conefield::{input, projection};
use conefield_core::finite::range;
use conefield_core::geometry::VoxelGrid;
use conefield_core::scan::{Scan, Unit, Volume};
use conefield_core::voxel::VoxelProjector;
use conefield_core::{Error, Result};
use conefield_evaluation::metrics;
use conefield_evaluation::report::page::{
    MeasuredView, Notice, Page, PageScan, PageVolume, PredictedView, PredictedViews, Scale, geometry_url, picture_url,
    spread,
};
use conefield_scans::diagnosis::survey;
use ndarray::{Array3, Axis};
use std::path::{Path, PathBuf};

/// The name of the only reference; of several, each has its path added.
pub const REFERENCE: &str = "reference";

/// Default number of views.
const VIEWS: usize = 6;

/// The requested content.
pub struct Options<'a> {
    pub scan: Option<&'a Path>,
    pub reference: Option<&'a Path>,
    pub views: Option<&'a HoldOut>,
    pub projector: Box<dyn VoxelProjector>,
}

/// All runs of one scan.
pub struct Group {
    /// Path of the scan, if it still exists.
    scan: Option<PathBuf>,
    /// Indices of the runs, and the voxels of their results.
    runs: Vec<(usize, Option<u64>)>,
    /// The reference volumes, and their voxels.
    references: Vec<(PathBuf, u64)>,
}

impl Group {
    /// Groups the runs by scan. Missing files are noted on the page, or refused if they were requested explicitly.
    pub fn all(found: &[RunOnDisk], options: &Options, page: &mut Page) -> Result<Vec<Group>> {
        let mut groups: Vec<Group> = vec![];
        for (i, run) in found.iter().enumerate() {
            let scan = match (options.scan, run.scan_path()) {
                (Some(path), _) => Some(path.to_path_buf()),
                (None, Some(path)) if path.exists() => Some(path.to_path_buf()),
                (None, path) => {
                    let where_ = path
                        .map_or("not known: the run has no record".into(), |p| format!("no longer at {}", p.display()));
                    page.warnings.push(Notice {
                        found: format!(
                            "{}: the scan is {where_}; its geometry and projections are not shown",
                            run.folder.display()
                        ),
                        advice: "name it with conefield report --scan SCAN".into(),
                    });
                    None
                }
            };
            let result = run.volume().map(|v| conefield_io::volume_voxels(&v)).transpose()?;
            let at = groups.iter().position(|g| g.scan == scan && found[g.runs[0].0].same_scan(run));
            let at = at.unwrap_or_else(|| {
                groups.push(Group { scan, runs: vec![], references: vec![] });
                groups.len() - 1
            });
            let group = &mut groups[at];
            group.runs.push((i, result));
            let reference = options.reference.map(Path::to_path_buf).or(run.reference().map(Path::to_path_buf));
            let Some(path) = reference.filter(|p| group.references.iter().all(|(r, _)| r != p)) else { continue };
            let truth = input::is_truth(&path);
            let voxels = match &group.scan {
                Some(scan) if truth => Some(conefield_io::scan_size(scan)?.voxels),
                None if truth => None,
                _ if path.exists() || options.reference.is_some() => Some(conefield_io::volume_voxels(&path)?),
                _ => None,
            };
            match voxels {
                Some(voxels) => group.references.push((path, voxels)),
                None => page.warnings.push(Notice {
                    found: format!("{}: the reference {} is not there", run.folder.display(), path.display()),
                    advice: "name it with conefield report --reference VOLUME".into(),
                }),
            }
        }
        Ok(groups)
    }

    /// The number of voxels of every volume shown.
    pub fn voxels(&self) -> impl Iterator<Item = u64> {
        self.runs.iter().filter_map(|(_, n)| *n).chain(self.references.iter().map(|(_, n)| *n))
    }

    /// Memory of this group in each phase, in addition to `packed` bytes.
    pub fn memory(&self, options: &Options, packed: u64) -> Result<Vec<Memory>> {
        let volume = 8 * self.voxels().max().unwrap_or(0);
        let Some(path) = &self.scan else {
            return Ok(vec![Memory { volume, buffers: packed, ..Memory::default() }]);
        };
        let size = conefield_io::scan_size(path)?;
        let header = size.header();
        let views = options.views.map_or(VIEWS.min(header.views), |v| v.views(header.views).len());
        let pixels = (views * header.detector[0] * header.detector[1]) as u64;
        // Predicted and measured views, the residuals of every run, and volumes with the scan.
        let buffers = packed + options.projector.scratch(&header, views) + 4 * pixels * (2 + self.runs.len() as u64);
        let scan = 4 * size.pixels;
        let reading =
            Memory { scan: scan + size.reading, volume: 4 * size.voxels, buffers: packed, ..Memory::default() };
        Ok(vec![reading, Memory { scan, volume, buffers, ..Memory::default() }])
    }

    /// Adds volumes and projections to the page.
    pub fn show(
        self,
        found: &[RunOnDisk],
        options: &Options,
        coarser: usize,
        page: &mut Page,
        results: &mut [Option<PageVolume>],
        references: &mut Vec<(PathBuf, PageVolume)>,
    ) -> Result<()> {
        let first = &found[self.runs[0].0];
        let scan = self.scan.as_ref().map(|path| read(path, first, options, page)).transpose()?.flatten();
        let grid = scan.as_ref().map(|s| s.geometry.volume);
        let held_out: Vec<usize> = self.runs.iter().flat_map(|(i, _)| found[*i].held_out()).copied().collect();
        let mut shown = scan.as_ref().map(|scan| Shown::new(scan, &held_out, options)).transpose()?;
        let at = page.scans.len();
        for &(i, voxels) in &self.runs {
            let Some(path) = found[i].volume().filter(|_| voxels.is_some()) else { continue };
            let volume = conefield_io::read_volume(&path)?;
            let own = own_grid(&volume, grid.as_ref());
            let mut result = PageVolume::new(&page.runs[i].name, false, &volume, &own, coarser)?;
            set_unit(&mut result, scan.as_ref().map(|s| &s.unit));
            results[i] = Some(result);
            if let Some(shown) = &mut shown {
                page.runs[i].scan = Some(at);
                page.runs[i].views = Some(shown.predict(&volume, own, options)?);
            }
        }
        let mut window_from = None;
        for (path, _) in &self.references {
            let volume = match (&scan, &self.scan) {
                (Some(scan), Some(place)) => input::reference(path, place, scan)?,
                _ if !input::is_truth(path) && path.exists() => conefield_io::read_volume(path)?,
                // The truth in this scan is not the one of the run.
                _ => continue,
            };
            let mut reference = PageVolume::new(REFERENCE, true, &volume, &own_grid(&volume, grid.as_ref()), coarser)?;
            set_unit(&mut reference, scan.as_ref().map(|s| &s.unit));
            // The scans of several seeds have the same truth.
            let listed = references.iter().position(|(_, r)| r.same_as(&reference));
            let at = listed.unwrap_or_else(|| {
                references.push((path.clone(), reference));
                references.len() - 1
            });
            window_from.get_or_insert(at);
        }
        if let Some(at) = window_from {
            for (i, _) in &self.runs {
                results[*i].iter_mut().for_each(|r| r.window = references[at].1.window);
            }
        }
        if let (Some(scan), Some(shown), Some(place)) = (&scan, shown, &self.scan) {
            let survey = survey(scan);
            page.warnings
                .extend(survey.warnings.iter().map(|w| Notice { found: w.found.clone(), advice: w.advice.clone() }));
            let record = ScanRecord::of(place, scan)?;
            let mut part = PageScan {
                name: record.name(),
                line: record.line(),
                count: record.views,
                facts: Some(lines(&facts(scan, &survey))),
                geometry: Some(geometry_url(&record.line(), &scan.geometry)?),
                ..PageScan::default()
            };
            shown.finish(&mut part, page, &self.runs)?;
            page.scans.push(part);
        }
        Ok(())
    }
}

/// The scan, if it is the one used by `run`.
fn read(path: &Path, run: &RunOnDisk, options: &Options, page: &mut Page) -> Result<Option<Scan>> {
    let scan = conefield_scans::read_scan(path)?;
    let place = path.display().to_string();
    scan.validate(&place)?;
    if run.is_of(&ScanRecord::of(path, &scan)?) {
        return Ok(Some(scan));
    }
    let found = format!("another scan than the one of {}", run.folder.display());
    if options.scan.is_some() {
        return Err(Error::invalid(place, "--scan", found, "the scan that the run worked on"));
    }
    page.warnings.push(Notice {
        found: format!("{place}: {found}; geometry and projections are not shown"),
        advice: "name it with conefield report --scan SCAN".into(),
    });
    Ok(None)
}

/// The grid of a volume in the scan's world, if there is a scan.
fn own_grid(volume: &Volume, grid: Option<&VoxelGrid>) -> VoxelGrid {
    // Of the readable formats only NumPy arrays have no affine.
    grid.map_or(volume.grid, |g| projection::placed(volume, g, volume.affine.is_some()))
}

/// Sets the unit of attenuation and the value of water: about 0.02/mm at CT energies, or the value to which HU from
/// −1000 to 2000 are mapped in volumes from 0 to 1.
fn set_unit(volume: &mut PageVolume, unit: Option<&Unit>) {
    let Some(unit) = unit else { return };
    (volume.unit, volume.water) =
        (format!("1/{}", unit.name), if unit.is_length() { 0.02 * unit.mm } else { 1.0 / 3.0 });
}

/// Some views of a scan, with what is needed after the runs' predictions.
struct Shown {
    /// Their indices, and whether they were held out from a run.
    views: Vec<(usize, bool)>,
    scan: Scan,
    window: [f32; 2],
    /// Measured minus predicted, for every run with a result.
    residuals: Vec<Array3<f32>>,
}

impl Shown {
    fn new(scan: &Scan, held_out: &[usize], options: &Options) -> Result<Self> {
        let n = scan.geometry.views.len();
        let chosen = match options.views {
            Some(choice) => input::chosen(Some(choice), n)?,
            None => (0..VIEWS.min(n)).map(|i| i * n / VIEWS.min(n)).collect(),
        };
        let some = if chosen.len() == n { scan.clone() } else { scan.select(&chosen) };
        let [low, high] = range(&some.projections);
        let (low, high) = (low.min(0.0), high.max(0.0));
        let window = if low < high { [low, high] } else { [low, low + 1.0] };
        let views = chosen.into_iter().map(|v| (v, held_out.contains(&v))).collect();
        Ok(Self { views, scan: some, window, residuals: vec![] })
    }

    /// Predicts the views of `volume` on `grid`. Pictures of residuals are drawn later, on a common scale.
    fn predict(&mut self, volume: &Volume, grid: VoxelGrid, options: &Options) -> Result<PredictedViews> {
        let mut geometry = self.scan.geometry.clone();
        geometry.volume = grid;
        let (unit_mm, projector) = (self.scan.unit.mm, options.projector.as_ref());
        let mut views = projection::predicted(volume, &geometry, unit_mm, projector, &mut |_| Ok(()))?;
        let pictures =
            views.outer_iter().map(|v| picture_url(v, Scale::Grey(self.window))).collect::<Result<Vec<_>>>()?;
        let left = metrics::residual(&self.scan, &mut views)?;
        self.residuals.push(views);
        let images = pictures
            .into_iter()
            .zip(&left.views)
            .map(|(predicted, rms)| PredictedView { predicted, residual: String::new(), rms: *rms })
            .collect();
        Ok(PredictedViews { projector: options.projector.describe(), rms: left.rms, relative: left.relative, images })
    }

    /// Draws measured views and residuals.
    fn finish(self, part: &mut PageScan, page: &mut Page, runs: &[(usize, Option<u64>)]) -> Result<()> {
        part.window = self.window;
        part.residual_span = spread(self.residuals.iter().flatten().copied());
        for (measured, (view, held_out)) in self.scan.projections.outer_iter().zip(self.views) {
            part.views.push(MeasuredView {
                view,
                held_out,
                measured: picture_url(measured, Scale::Grey(self.window))?,
            });
        }
        let predicted =
            runs.iter().filter_map(|(i, _)| page.runs.get(*i)?.views.is_some().then_some(*i)).collect::<Vec<_>>();
        for (i, residuals) in predicted.into_iter().zip(self.residuals) {
            let Some(views) = &mut page.runs[i].views else { continue };
            for (image, residual) in views.images.iter_mut().zip(residuals.axis_iter(Axis(0))) {
                image.residual = picture_url(residual, Scale::Signed(part.residual_span))?;
            }
        }
        Ok(())
    }
}
