//! Adapts a pipeline to a scan: the object's support, the resolution of the data, the distance of samples.

use crate::support::carve;
use conefield_core::error::Result;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::Scan;
use conefield_core::scene::{LevelRule, Scene, SceneSettings, SupportRule};
use conefield_core::support::Support;

/// A scene, and the parts of a pipeline that it needs.
pub struct Fitted {
    /// Maps between the world and the stages.
    pub scene: Scene,
    /// The encoder's channels that are needed, if not all.
    pub needed: Option<Vec<usize>>,
    /// Findings, for the log.
    pub found: Vec<String>,
    /// Whether a stage changed for this scene.
    pub changed: bool,
}

/// The object's support, if the settings ask for it, and a log line.
pub fn support(scan: &Scan, rule: SupportRule) -> (Option<Support>, Option<String>) {
    match rule {
        SupportRule::Box => (None, None),
        SupportRule::Carve => {
            let carved = carve(scan);
            (carved.support, Some(format!("support: {}", carved.said)))
        }
    }
}

/// The scene of a scan under a spec's settings. Converts the lengths of `pipeline` to that scene.
pub fn fit(scan: &Scan, settings: &SceneSettings, pipeline: &mut Pipeline) -> Result<Fitted> {
    let mut scene = Scene::new(scan, settings)?;
    let (support, said) = support(scan, settings.support);
    let mut found: Vec<String> = said.into_iter().collect();
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
    Ok(Fitted { scene, needed, found, changed })
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
