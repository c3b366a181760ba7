//! What a scan has need of: where its object can be, how fine its data are, how far apart samples stand.

use crate::support::{carve, cells};
use conefield_core::error::Result;
use conefield_core::pipeline::Pipeline;
use conefield_core::scan::Scan;
use conefield_core::scene::Scene;
use conefield_core::spec::{self, LevelRule, OccupancyRule, Refined, SupportRule};
use conefield_core::support::Support;

/// A scene, and what of a pipeline it has need of.
pub struct Fitted {
    /// Between the world and what stages see.
    pub scene: Scene,
    /// The encoder's channels that are needed, where some are not.
    pub needed: Option<Vec<usize>>,
    /// What was found, for people.
    pub found: Vec<String>,
}

/// Where the object can be, if the settings have it looked for, and what was found.
pub fn support(scan: &Scan, settings: &spec::SceneSettings) -> (Option<Support>, Option<String>) {
    match settings.support {
        SupportRule::Box => (None, None),
        SupportRule::Carve => {
            let carved = carve(scan);
            (carved.support, Some(format!("support: {}", carved.said)))
        }
    }
}

/// The scene of a scan under a spec's settings. Makes `pipeline` count in its lengths.
pub fn fit(scan: &Scan, settings: &spec::SceneSettings, pipeline: &mut Pipeline) -> Result<Fitted> {
    let mut scene = Scene::new(scan, settings)?;
    let (support, said) = support(scan, settings);
    let mut found: Vec<String> = said.into_iter().collect();
    if let Some(support) = support {
        scene = scene.within(support, settings);
    }
    if let OccupancyRule::Refined(refined) = settings.occupancy {
        found.push(format!("occupancy: {}", occupancy(&scene, refined)));
    }
    pipeline.fit(&scene)?;
    let mut needed = None;
    if settings.levels == LevelRule::Needed {
        let cells = scene.cells(&scan.geometry);
        needed = pipeline.needed(cells);
        found.push(format!("levels: {}", levels(pipeline, needed.as_deref(), cells)?));
    }
    Ok(Fitted { scene, needed, found })
}

/// How the support is refined while the field trains.
fn occupancy(scene: &Scene, Refined { after, every, below, probe }: Refined) -> String {
    let [x, y, z] = cells(&scene.grid).shape;
    format!(
        "from step {after} on looked for every {every} steps in {x} x {y} x {z} cells; those below {below} of the \
         attenuation scale are sampled by one ray in {probe}"
    )
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
