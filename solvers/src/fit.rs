//! Adapts a pipeline to a scan: the object's support, the resolution of the data, the distance of samples.

use crate::solid::{self, Solid};
use crate::support::carve;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::geometry::VoxelGrid;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::{Scan, Volume};
use conefield_core::scene::{CuboidSettings, CylinderSettings, LevelRule, Scene, SceneSettings, SupportRule};
use conefield_core::support::{Cylinder, Support};

/// A scene, and the parts of a pipeline that it needs.
pub struct Fitted {
    /// Maps between the world and the stages.
    pub scene: Scene,
    /// The solid that the object is, if the settings look for one and there is one.
    pub solid: Option<Solid>,
    /// The encoder's channels that are needed, if not all.
    pub needed: Option<Vec<usize>>,
    /// Findings, for the log.
    pub found: Vec<String>,
    /// A warning about the samples of rays.
    pub doubt: Option<String>,
    /// Whether a stage changed for this scene.
    pub changed: bool,
}

/// What the settings and the views say about the object.
#[derive(Default)]
pub struct Object {
    /// Where it can be, if not everywhere.
    pub support: Option<Support>,
    /// The solid that it is, if the settings look for one and there is one.
    pub solid: Option<Solid>,
    /// Findings, for the log.
    pub found: Vec<String>,
}

/// Reads a volume by the name of its file.
pub type ReadVolume<'a> = &'a dyn Fn(&str) -> Result<Volume>;

/// The object of a scan. Without `read`, a support in a file is only named.
///
/// # Errors
/// The views show no solid, the given region lies outside the volume, or its file does not suit the scan.
pub fn object(scan: &Scan, rule: &SupportRule, read: Option<ReadVolume<'_>>) -> Result<Object> {
    let (volume, mm) = (&scan.geometry.volume, scan.unit.mm);
    let given = |key: &str, found: String, support: Option<Support>| {
        let outside =
            || Error::invalid("spec", format!("scene.support.{key}"), found, "a region that meets the volume");
        Ok(Object { support: Some(support.ok_or_else(outside)?), ..Object::default() })
    };
    match *rule {
        SupportRule::Box => Ok(Object::default()),
        SupportRule::Carve => Ok(carved(scan, vec![])),
        SupportRule::Cylinder(CylinderSettings { center, radius }) => {
            let cylinder = Cylinder { center: center.map(|x| x * mm), radius: radius * mm };
            given("cylinder", format!("{center:?}, {radius}"), Support::cylinder(cylinder, volume))
        }
        SupportRule::Cuboid(CuboidSettings { low, high }) => {
            let corners = [low, high].map(|p| p.map(|x| x * mm));
            given("cuboid", format!("{low:?} to {high:?}"), Support::cuboid(corners, volume))
        }
        SupportRule::File(ref file) => {
            let found = vec![format!("support: the voxels above 0 in {file}")];
            let support = read.map(|read| in_file(file, read, volume)).transpose()?;
            Ok(Object { support, solid: None, found })
        }
        SupportRule::Solid | SupportRule::SolidOrCarve => {
            let fitted = solid::fit(scan).and_then(|solid| {
                let support = Support::cylinder(solid.cylinder, volume);
                support.map(|support| (solid, support)).ok_or_else(|| "the solid lies outside the volume".into())
            });
            match fitted {
                Ok((solid, support)) => {
                    let found = vec![solid.describe(&scan.unit)];
                    Ok(Object { support: Some(support), solid: Some(solid), found })
                }
                Err(why) if *rule == SupportRule::Solid => {
                    let expected = "\"solid-or-carve\", \"carve\" or \"box\" for these views";
                    Err(Error::invalid("spec", "scene.support", format!("\"solid\", but {why}"), expected))
                }
                Err(why) => Ok(carved(scan, vec![format!("support: no solid, because {why}")])),
            }
        }
    }
}

/// The voxels above 0 of the volume in a file.
fn in_file(file: &str, read: ReadVolume<'_>, grid: &VoxelGrid) -> Result<Support> {
    let marks = read(file)?.data;
    let expected = format!("{:?}, the voxels of the scan", grid.shape);
    ensure(marks.shape() == grid.shape, file, "shape", format!("{:?}", marks.shape()), expected)?;
    let occupied = marks.mapv(|x| x > 0.0);
    Support::voxels(grid, occupied.view()).ok_or_else(|| Error::invalid(file, "voxels", "none above 0", "at least one"))
}

/// The object as it is carved.
fn carved(scan: &Scan, mut found: Vec<String>) -> Object {
    let carved = carve(scan);
    found.push(format!("support: {}", carved.said));
    Object { support: carved.support, solid: None, found }
}

/// The scene of a scan under a spec's settings. Converts the lengths of `pipeline` to that scene.
pub fn fit(
    scan: &Scan,
    settings: &SceneSettings,
    read: Option<ReadVolume<'_>>,
    pipeline: &mut Pipeline,
) -> Result<Fitted> {
    let mut scene = Scene::new(scan, settings)?;
    let Object { support, solid, mut found } = object(scan, &settings.support, read)?;
    if let Some(support) = support {
        scene = scene.within(support, settings);
    }
    let changed = pipeline.fit(&scene)?;
    let mut needed = None;
    if settings.levels == LevelRule::Needed {
        let cells = scene.cells(&scan.geometry);
        needed = pipeline.needed(cells);
        found.push(format!("levels: {}", levels(pipeline, needed.as_deref(), cells)?));
    }
    let g = &scan.geometry;
    let middle = scene.pixel_ray(g, 0, g.detector[0] / 2, g.detector[1] / 2);
    let doubt = pipeline.projector.doubt(&middle);
    Ok(Fitted { scene, solid, needed, found, doubt, changed })
}

/// Finds the encoder's channels that are needed to resolve `cells`.
fn levels(pipeline: &Pipeline, needed: Option<&[usize]>, cells: f64) -> Result<String> {
    let info = pipeline.encoder.info();
    let data = format!("the data resolve {cells:.0} cells along each side");
    Ok(match needed {
        None if pipeline.encoder.resolutions().is_none() => {
            "all channels, as the encoder does not state their resolutions".into()
        }
        None => format!("all channels, as {data}"),
        Some(keep) => {
            let params = pipeline.encoder.keep_outputs(keep)?.stage.info().params;
            let saved = if info.params == 0 { 0.0 } else { 100.0 * (1.0 - params as f64 / info.params as f64) };
            format!("{} of {} channels, {saved:.0}% fewer encoder parameters, as {data}", keep.len(), info.output)
        }
    })
}
