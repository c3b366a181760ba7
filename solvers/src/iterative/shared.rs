//! Common settings of the iterative methods: projector, start volume, stopping criteria.

use super::order::Subsets;
use super::plan::Iterative;
use super::problem::Problem;
use super::regions::Regions;
use super::stop::Stop;
use crate::fit::{Object, object};
use crate::support::meets_the_volume;
use crate::surround::Corrected;
use conefield_core::Error;
use conefield_core::error::{Result, ensure};
use conefield_core::finite::stray;
use conefield_core::geometry::{Geometry, VoxelGrid};
use conefield_core::input_file::InputFile;
use conefield_core::method::{Job, Line, Observer};
use conefield_core::parallel;
use conefield_core::place::{Array, Bounds, Mask, MeasuredViews, Place};
use conefield_core::scan::{Scan, ScanHeader, Volume};
use conefield_core::scene::VoxelScene;
use conefield_core::settings::KnownVolume;
use conefield_core::space::Space;
use conefield_core::voxel::{VoxelProjector, VoxelProjectorSpec};
use ndarray::Array3;
use std::sync::Arc;

/// Defines the settings of a method: those that all iterative methods have, the method's own stages and settings with
/// their defaults, and [`Method`](conefield_core::method::Method) by its function `built`.
macro_rules! settings {
    (
        $(#[$about:meta])*
        $name:ident {
            $(stages { $($(#[$stage_about:meta])* $stage:ident: $stage_type:ty = $stage_default:expr,)* })?
            $(#[$start_about:meta])*
            start,
            stop: $stop:expr,
            $($(#[$own_about:meta])* $own:ident: $own_type:ty = $own_default:expr,)*
        }
    ) => {
        $(#[$about])*
        #[derive(serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name {
            /// Voxel projector.
            #[schemars(
                schema_with = "conefield_core::spec::stage::schema::<dyn conefield_core::voxel::VoxelProjectorSpec>"
            )]
            pub projector: Box<dyn conefield_core::voxel::VoxelProjectorSpec>,
            $($($(#[$stage_about])* pub $stage: $stage_type,)*)?
            /// Support of the object, and attenuation beyond the volume.
            pub scene: conefield_core::scene::VoxelScene,
            $(#[$start_about])*
            #[serde(skip_serializing_if = "Option::is_none")]
            pub start: Option<conefield_core::input_file::InputFile>,
            /// Stopping criteria.
            pub stop: $crate::iterative::Stop,
            $($(#[$own_about])* pub $own: $own_type,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self {
                    projector: Box::new(conefield_projectors::voxel::Joseph {}),
                    $($($stage: $stage_default,)*)?
                    scene: Default::default(),
                    start: None,
                    stop: $stop,
                    $($own: $own_default,)*
                }
            }
        }

        impl $name {
            /// The settings that all iterative methods have, built.
            fn shared(&self) -> conefield_core::Result<$crate::iterative::shared::Shared> {
                use $crate::iterative::shared::Shared;
                let kind = conefield_core::registry::Registered::type_name(self);
                Shared::of(kind, self.projector.as_ref(), &self.scene, &self.start, &self.stop)
            }
        }

        impl conefield_core::method::Method for $name {
            fn plan(
                &self,
                _: &conefield_core::method::Context<'_>,
            ) -> conefield_core::Result<Box<dyn conefield_core::method::Plan>> {
                Ok(Box::new($crate::iterative::plan::IterativePlan(Box::new(self.built()?))))
            }

            fn start_setting(&self, file: &conefield_core::method::StartFile) -> Option<(String, serde_json::Value)> {
                file.as_volume()
            }
        }
    };
}
pub(super) use settings;

/// The common settings, built, and the outline of a method.
pub(super) struct Shared {
    /// The method's type name.
    pub(super) kind: &'static str,
    /// Description of its settings.
    pub(super) text: String,
    /// Its own stages: key, type and description.
    pub(super) stages: Vec<Line>,
    /// Its subsets of views, by default all at once.
    pub(super) subsets: Subsets,
    pub(super) projector: Arc<dyn VoxelProjector>,
    /// The projector's type name.
    pub(super) projector_kind: &'static str,
    pub(super) scene: VoxelScene,
    /// File of the start volume.
    pub(super) start: Option<InputFile>,
    pub(super) stop: Stop,
}

impl Shared {
    /// Builds the settings at the keys `projector`, `scene`, `start` and `stop` of a method of the type `kind`.
    pub(super) fn of(
        kind: &'static str,
        projector: &dyn VoxelProjectorSpec,
        scene: &VoxelScene,
        start: &Option<InputFile>,
        stop: &Stop,
    ) -> Result<Self> {
        stop.validate()?;
        scene.validate()?;
        let projector_kind = projector.type_name();
        let projector = projector.build().map_err(|e| e.within("projector"))?;
        Ok(Self {
            kind,
            text: String::new(),
            stages: vec![],
            subsets: Subsets::Count(1),
            projector: projector.into(),
            projector_kind,
            scene: scene.clone(),
            start: start.clone(),
            stop: stop.clone(),
        })
    }

    /// Whether there is a start volume.
    pub(super) fn has_start(&self, job: &Job<'_>) -> bool {
        job.start.is_some() || self.start.is_some()
    }

    /// The start volume, in 1/mm; 0 if there is none, and outside the object's support.
    pub(super) fn start(&self, job: &Job<'_>, problem: &Problem<'_>, space: &Space) -> Result<Array> {
        let mut x = self.known(job, space)?;
        problem.outside(&mut x, 0.0)?;
        Ok(x)
    }

    /// The known volume, in 1/mm; 0 if there is none.
    pub(super) fn known(&self, job: &Job<'_>, space: &Space) -> Result<Array> {
        let named = self.start.as_ref().map(|file| KnownVolume { path: file.0.clone(), steps: 0 });
        let Some((volume, ..)) = known_volume(job, named)? else { return space.volume() };
        space.hold(4 * space.header().voxels());
        space.place().adopt(volume.data)
    }

    /// Validates the scan, logs `text`, which describes `method`, and its projector, and finds the object's support.
    /// `grid` is the grid of the unknowns; `bin` × `bin` pixels are averaged to one.
    pub(super) fn open(
        &self,
        grid: VoxelGrid,
        bin: usize,
        text: &str,
        method: &dyn Iterative,
        job: &Job<'_>,
        observer: &mut dyn Observer,
    ) -> Result<Opened> {
        job.scan.validate("scan")?;
        let g = &job.scan.geometry;
        meets_the_volume(g)?;
        let place = self.place(method, job, observer)?;
        let on = place.device().map(|device| format!(", on {device}")).unwrap_or_default();
        observer.note(&format!("{text}; {}{on}", self.projector.describe()));
        // Uses the views as measured: the attenuation subtracted later is too coarse for carving.
        let Object { support, solid, found } = object(job.scan, &self.scene.support, Some(job.volumes))?;
        found.iter().for_each(|line| observer.note(line));
        let regions = Regions::of(&self.scene.bounds, support.as_ref(), job)?;
        let inside = support.map(|support| {
            let mut inside = Array3::from_elem(grid.shape, false);
            parallel::over(inside.outer_iter_mut(), |x, mut plane| {
                plane.indexed_iter_mut().for_each(|((y, z), i)| *i = support.holds(grid.voxel([x, y, z])));
            });
            let some = inside.iter().any(|held| *held);
            ensure(some, "spec", "scene.support", "a region that holds no centre of a voxel", "a region with voxels")?;
            place.mask(inside)
        });
        let inside = inside.transpose()?;
        let corrected = Corrected::of(job, self.scene.surround, solid.as_ref(), observer)?;
        let binned = (bin > 1).then(|| Corrected::job(corrected.as_ref(), job).scan.binned(bin));
        let seen = binned.as_ref().map_or(g, |scan| &scan.geometry);
        let geometry = Geometry { volume: grid, ..seen.clone() };
        let mut bounds = self.scene.bounds.in_mm(job.scan.unit.mm);
        if let (None, Some(solid)) = (self.scene.bounds.high, &solid) {
            bounds.high = solid.attenuation as f32;
        }
        let (projector, started) = (self.projector.clone(), self.has_start(job));
        Ok(Opened { place, projector, started, bounds, regions, inside, corrected, binned, geometry })
    }

    /// The backend's place, if it has room for all arrays of `method`; else one that streams them.
    fn place(&self, method: &dyn Iterative, job: &Job<'_>, observer: &mut dyn Observer) -> Result<Arc<dyn Place>> {
        let mut place = job.backend.place();
        let header = job.scan.header();
        let bytes = method.bytes(&header).saturating_add(4 * header.voxels());
        if !place.holds(bytes)
            && let (Some(device), Some(streamed)) = (place.device(), place.streamed())
        {
            let gib = bytes as f64 / f64::from(1 << 30);
            observer.note(&format!(
                "{device} has no room for {gib:.1} GiB of arrays: they stay in the host's memory, and it computes the line \
                 integrals of one slab after another"
            ));
            place = streamed;
        }
        place.admits(self.projector.as_ref())?;
        Ok(place)
    }

    /// Adds the memory of the driver and of the projector for a subset to the method's own arrays in `space`; returns
    /// all bytes except the resulting volume.
    pub(super) fn price(&self, space: &Space, knows_change: bool) -> u64 {
        let _ = super::drive::buffers(&self.stop, knows_change, space);
        let header = space.header();
        space.pass(self.projector.scratch(header, header.views.div_ceil(self.subsets.count(header.views))));
        space.bytes().saturating_sub(4 * space.header().voxels())
    }
}

/// The inputs of a voxel reconstruction.
pub(super) struct Opened {
    place: Arc<dyn Place>,
    projector: Arc<dyn VoxelProjector>,
    /// Whether there is a start volume.
    started: bool,
    bounds: Bounds,
    regions: Regions,
    /// The object's support, if known.
    inside: Option<Mask>,
    /// The scan without beam hardening or attenuation beyond the volume.
    corrected: Option<Corrected>,
    /// The binned scan, if requested.
    binned: Option<Scan>,
    /// The geometry of the scan in use, with the grid of the unknowns.
    geometry: Geometry,
}

impl Opened {
    /// The job with the views that the method uses.
    pub(super) fn job<'a>(&'a self, job: &Job<'a>) -> Job<'a> {
        Corrected::job(self.corrected.as_ref(), job)
    }

    /// A space in the problem's place.
    pub(super) fn space(&self, header: ScanHeader) -> Space {
        Space::new(header, self.place.clone())
    }

    /// Its problem, with every pixel as measured or binned.
    pub(super) fn problem<'a>(&'a self, job: &Job<'a>) -> Problem<'a> {
        let scan = self.binned.as_ref().unwrap_or(job.scan);
        Problem {
            scan,
            geometry: &self.geometry,
            place: self.place.as_ref(),
            projector: self.projector.as_ref(),
            seed: job.seed,
            started: self.started,
            bounds: self.bounds,
            regions: &self.regions,
            inside: self.inside.as_ref(),
            shadow: None,
            views: MeasuredViews { measured: &scan.projections, here: None },
        }
    }
}

/// The start volume of a field, in 1/mm, the number of steps to learn it, and its source: the job, or the initializer's
/// file.
pub fn known_volume(job: &Job<'_>, named: Option<KnownVolume>) -> Result<Option<(Volume, u64, String)>> {
    match (job.start, named) {
        (Some(given), named) => {
            let steps = named.map_or(KnownVolume::STEPS, |n| n.steps);
            Ok(Some((in_mm(job, "start", given.clone())?, steps, "the volume of the previous method".into())))
        }
        (None, Some(KnownVolume { path, steps })) => Ok(Some((in_mm(job, &path, (job.volumes)(&path)?)?, steps, path))),
        (None, None) => Ok(None),
    }
}

/// Converts a volume from 1/unit of the scan to 1/mm. Refuses one that does not match the scan.
fn in_mm(job: &Job<'_>, place: &str, volume: Volume) -> Result<Volume> {
    let shape = job.scan.geometry.volume.shape;
    let found = format!("{:?}", volume.data.shape());
    ensure(volume.data.shape() == shape, place, "shape", found, format!("{shape:?}, the voxels of the scan"))?;
    if let Some((at, x)) = stray(&volume.data) {
        return Err(Error::invalid(place, format!("voxel {at:?}"), x, "a finite attenuation"));
    }
    let mm = job.scan.unit.mm as f32;
    Ok(Volume { grid: job.scan.geometry.volume, ..volume.mapped(|x| x / mm) })
}
