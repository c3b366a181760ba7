//! One HTML file that shows runs: volumes in a viewer, scores, curves, projections, geometry, specs, warnings.
//!
//! The file contains all data and code and fetches nothing; its content security policy forbids it. Only the page of a
//! run that goes on asks its own server for a newer one. The viewer and the plots use third-party libraries
//! (`evaluation/page/vendor`).

mod picture;
mod volume;

pub use picture::{Scale, geometry_url, picture_url, png_url, spread};
pub use volume::{PageVolume, coarser};

use conefield_core::{Error, Result};
use conefield_io::write_atomic;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;

const FRAME: &str = include_str!("../../page/page.html");
const STYLES: [&str; 2] = [include_str!("../../page/vendor/uPlot.min.css"), include_str!("../../page/page.css")];
const PLOTS: &str = include_str!("../../page/vendor/uPlot.iife.min.js");
const VIEWER: &str = include_str!("../../page/vendor/niivue.min.js");
const SCRIPT: &str = include_str!("../../page/page.js");
const LICENCES: &str = include_str!("../../page/vendor/LICENCES.txt");

/// The content of a page.
#[derive(Debug, Default, Serialize)]
pub struct Page {
    /// Its title.
    pub title: String,
    /// What readers of the results should know first.
    pub warnings: Vec<Notice>,
    /// Results in the order of `runs`, then references.
    pub volumes: Vec<PageVolume>,
    /// Index of the volume that the page shows beside the first when it opens.
    pub beside: Option<usize>,
    /// The runs.
    pub runs: Vec<PageRun>,
    /// Their scans.
    pub scans: Vec<PageScan>,
    /// Statistics over the seeds of studies.
    pub spreads: Vec<PageSpread>,
    /// Remarks about the page itself.
    pub notes: Vec<String>,
    /// Seconds after which the page asks its server for a newer one; without a server it fetches nothing.
    pub renewed: Option<u64>,
}

/// A warning.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Notice {
    /// The finding.
    pub found: String,
    /// What to do about it, if not obvious.
    pub advice: String,
}

/// A run.
#[derive(Debug, Default, Serialize)]
pub struct PageRun {
    /// A name that distinguishes it from the others.
    pub name: String,
    /// Its folder.
    pub folder: String,
    /// Its progress.
    pub status: String,
    /// Its spec, with all settings.
    pub spec: String,
    /// A description of what the spec builds.
    pub plan: Option<String>,
    /// The `record.json` of a finished run.
    pub record: Option<Value>,
    /// The lines of its `metrics.jsonl`.
    pub curves: Vec<Value>,
    /// The current slices of an unfinished run, as a picture ([`png_url`]).
    pub live: Option<String>,
    /// Index of its scan on the page, if known.
    pub scan: Option<usize>,
    /// Its result projected to the scan's views.
    pub views: Option<PredictedViews>,
}

/// Predicted measurements of a result.
#[derive(Debug, Serialize)]
pub struct PredictedViews {
    /// The projector used.
    pub projector: String,
    /// Root mean square of measured minus predicted line integrals, over the views shown.
    pub rms: f64,
    /// The same relative to the largest measured line integral of these views.
    pub relative: f64,
    /// In the order of the scan's views.
    pub images: Vec<PredictedView>,
}

/// One view of a result.
#[derive(Debug, Serialize)]
pub struct PredictedView {
    /// The predicted line integrals, as a picture ([`picture_url`]).
    pub predicted: String,
    /// Measured minus predicted, as a picture.
    pub residual: String,
    /// Root mean square of the residual.
    pub rms: f64,
}

/// A case and a method of a study over its seeds.
#[derive(Debug, Serialize)]
pub struct PageSpread {
    /// Case and method.
    pub name: String,
    /// Figures by their names in `table.json`, each with `mean`, `sd` (null for a single value) and `n`.
    pub figures: Value,
}

/// A scan.
#[derive(Debug, Default, Serialize)]
pub struct PageScan {
    /// Its name.
    pub name: String,
    /// Its sizes in a sentence.
    pub line: String,
    /// Number of views.
    pub count: usize,
    /// A description of its files.
    pub facts: Option<String>,
    /// A picture of its geometry ([`geometry_url`]).
    pub geometry: Option<String>,
    /// The views that are shown.
    pub views: Vec<MeasuredView>,
    /// The line integrals shown as black and white.
    pub window: [f32; 2],
    /// The residual shown in the deepest red, over all runs.
    pub residual_span: f32,
}

/// One measured view.
#[derive(Debug, Serialize)]
pub struct MeasuredView {
    /// Its index, from 0.
    pub view: usize,
    /// Whether it was held out from a run.
    pub held_out: bool,
    /// The line integrals, as a picture ([`picture_url`]).
    pub measured: String,
}

impl Page {
    /// Writes the page as HTML to `path`; returns its size in bytes.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<u64> {
        let path = path.as_ref();
        let mut written = 0;
        write_atomic(path, &mut |out| {
            self.pieces(&path.display().to_string(), &mut |piece| {
                written += piece.len() as u64;
                out.write_all(piece.as_bytes()).map_err(|e| Error::io(path, e))
            })
        })?;
        Ok(written)
    }

    /// The page as HTML; `place` is its name in errors.
    pub fn html(&self, place: &str) -> Result<String> {
        let mut html = String::new();
        self.pieces(place, &mut |piece| {
            html += piece;
            Ok(())
        })?;
        Ok(html)
    }

    /// Produces the HTML piece by piece.
    fn pieces(&self, place: &str, put: &mut dyn FnMut(&str) -> Result<()>) -> Result<()> {
        let text = self.data().map_err(|e| Error::invalid(place, "page", e, "what JSON can hold"))?;
        // Inserted content is not searched for placeholders.
        for (i, piece) in FRAME.split('@').enumerate() {
            match piece {
                text if i % 2 == 0 => put(text)?,
                "server" => put(self.renewed.map_or("", |_| " 'self'"))?,
                "title" => put(&in_markup(&self.title))?,
                "styles" => STYLES.into_iter().try_for_each(&mut *put)?,
                "page" => put(&text)?,
                "volumes" => {
                    for (i, volume) in self.volumes.iter().enumerate() {
                        put(&format!("<script type=\"application/octet-stream\" id=\"volume-{i}\">"))?;
                        put(volume.packed())?;
                        put("</script>\n")?;
                    }
                }
                "plots" => put(PLOTS)?,
                "viewer" => put(VIEWER)?,
                _ => put(SCRIPT)?,
            }
        }
        Ok(())
    }

    /// Everything but the voxels, as JSON that is safe inside an HTML element.
    fn data(&self) -> serde_json::Result<String> {
        let mut all = serde_json::to_value(self)?;
        all["colours"] = json!(crate::report::curves::COLOURS.map(|c| format!("#{:02x}{:02x}{:02x}", c.0, c.1, c.2)));
        all["diverging"] = diverging();
        all["licences"] = json!(LICENCES);
        let text = serde_json::to_string(&all)?;
        // JSON has none of these outside strings, and inside strings they can be escaped.
        let mut escaped = String::with_capacity(text.len());
        for c in text.chars() {
            match c {
                '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => escaped += &format!("\\u{:04x}", c as u32),
                c => escaped.push(c),
            }
        }
        Ok(escaped)
    }
}

/// The colour map of differences in the viewer's format.
fn diverging() -> Value {
    let at = [0u8, 64, 128, 191, 255];
    let channel = |k: usize| at.map(|i| crate::report::canvas::diverging(2.0 * f32::from(i) / 255.0 - 1.0).0[k]);
    // Large differences are opaque in a rendering, and zero is invisible.
    json!({ "R": channel(0), "G": channel(1), "B": channel(2), "A": [160, 60, 0, 60, 160], "I": at })
}

/// `text`, escaped as the text of an element.
fn in_markup(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_frame_has_every_mark_once_and_the_libraries_end_no_element() {
        let marks: Vec<&str> = FRAME.split('@').skip(1).step_by(2).collect();
        assert_eq!(marks, ["server", "title", "styles", "page", "volumes", "plots", "viewer", "script"]);
        for script in [PLOTS, VIEWER, SCRIPT] {
            let lower = script.to_lowercase();
            assert!(!lower.contains("</script") && !lower.contains("<!--"));
        }
        assert!(STYLES.iter().all(|s| !s.contains('<')));
        for name in ["NiiVue", "uPlot", "fflate", "gl-matrix", "nifti-reader-js"] {
            assert!(LICENCES.contains(name), "{name}");
        }
    }

    #[test]
    fn hostile_text_stays_text() {
        let bad = "</script><script>alert(1)</script><!-- \u{2028} & \"";
        let page = Page { title: bad.into(), notes: vec![bad.into()], ..Page::default() };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("page.html");
        let bytes = page.write(&path).unwrap();
        let html = std::fs::read_to_string(&path).unwrap();
        assert_eq!(html.len() as u64, bytes);
        assert!(!html.contains("alert(1)</script>") && !html.contains("<script>alert"));
        assert!(html.contains("<title>&lt;/script&gt;"));
        let (_, rest) = html.split_once("<script type=\"application/json\" id=\"page\">").unwrap();
        let data: Value = serde_json::from_str(rest.split_once("</script>").unwrap().0).unwrap();
        assert_eq!((data["title"].as_str(), data["notes"][0].as_str()), (Some(bad), Some(bad)));
    }
}
