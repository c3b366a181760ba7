//! What a scan has need of: where its object can be, how fine its data are, how far apart samples stand.

use crate::support::carve;
use conefield_core::error::Result;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::Scan;
use conefield_core::scene::{LevelRule, Scene, SceneSettings, SupportRule};
use conefield_core::support::Support;

/// A scene, and what of a pipeline it has need of.
pub struct Fitted {
    /// Between the world and what stages see.
    pub scene: Scene,
    /// The encoder's channels that are needed, where some are not.
    pub needed: Option<Vec<usize>>,
    /// What was found, for people.
    pub found: Vec<String>,
    /// Whether a stage is another one for this scene.
    pub changed: bool,
}

/// Where the object can be, if the settings have it looked for, and what was found.
pub fn support(scan: &Scan, rule: SupportRule) -> (Option<Support>, Option<String>) {
    match rule {
        SupportRule::Box => (None, None),
        SupportRule::Carve => {
            let carved = carve(scan);
            (carved.support, Some(format!("support: {}", carved.said)))
        }
    }
}

/// The scene of a scan under a spec's settings. Makes `pipeline` count in its lengths.
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

/// Which of the encoder's channels are needed to tell `cells` apart.
fn levels(pipeline: &Pipeline, needed: Option<&[usize]>, cells: f64) -> Result<String> {
    let info = pipeline.encoder.info();
    let data = format!("the data tell {cells:.0} cells a side apart");
    Ok(match needed {
        None if pipeline.encoder.resolutions().is_none() => {
            "all channels, as the encoder does not say how fine they are".into()
        }
        None => format!("all channels, as {data}"),
        Some(keep) => {
            let params = pipeline.encoder.keep_outputs(keep)?.stage.info().params;
            let saved = if info.params == 0 { 0.0 } else { 100.0 * (1.0 - params as f64 / info.params as f64) };
            format!(
                "{} of {} channels, {saved:.0}% fewer parameters of the encoder, as {data}",
                keep.len(),
                info.output
            )
        }
    })
}
