//! Runs the guide's commands as shown on its pages.
//!
//! The `sh` blocks of a page run in order, in a folder of their own, except those below `<!-- not run: REASON -->`. A
//! `toml` block below a line that begins with a file name in backticks is written to that file first.

use crate::common::{done, text};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tiff::encoder::{TiffEncoder, colortype::Gray16};

const OPEN: f32 = 40_000.0;
const DARK: u16 = 120;

/// A fenced block of a page.
struct Block<'a> {
    language: &'a str,
    /// The last non-empty line above it.
    above: &'a str,
    text: String,
}

fn blocks(page: &str) -> Vec<Block<'_>> {
    let mut found: Vec<Block<'_>> = Vec::new();
    let (mut above, mut inside) = ("", false);
    for line in page.lines() {
        match (line.strip_prefix("```"), inside) {
            (Some(language), false) => found.push(Block { language, above, text: String::new() }),
            (Some(_), true) => {}
            (None, true) => {
                let block = found.last_mut().expect("the fence opened a block");
                block.text += line;
                block.text.push('\n');
            }
            (None, false) if !line.trim().is_empty() => above = line,
            (None, false) => {}
        }
        inside ^= line.starts_with("```");
    }
    assert!(!inside, "a fence is not closed");
    found
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Pages of the guide by name.
fn pages() -> Vec<(String, String)> {
    let mut pages: Vec<(String, String)> = fs::read_dir(repository().join("docs/guide"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "md"))
        .map(|path| (path.file_stem().unwrap().to_str().unwrap().to_owned(), fs::read_to_string(path).unwrap()))
        .collect();
    pages.sort();
    pages
}

/// Writes the files and runs the commands of a page in `dir`; returns the number of blocks run.
fn run(name: &str, page: &str, dir: &Path) -> usize {
    let program = Path::new(env!("CARGO_BIN_EXE_conefield"));
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap());
    let mut ran = 0;
    for block in blocks(page) {
        let file = block.above.strip_prefix('`').and_then(|rest| rest.split_once('`')).map(|(file, _)| file);
        match (block.language, file) {
            ("toml", Some(file)) => fs::write(dir.join(file), block.text).unwrap(),
            ("sh", _) if !block.above.starts_with("<!-- not run: ") => {
                let script = block.text.replace("--budget 60s", "--budget 12s");
                let output = Command::new("bash")
                    .args(["-euo", "pipefail", "-c", &script])
                    .current_dir(dir)
                    .env("PATH", &path)
                    .env_remove("CONEFIELD_PLUGIN_PATH")
                    .env("XDG_DATA_HOME", env!("CARGO_TARGET_TMPDIR"))
                    .stdin(Stdio::null())
                    .output()
                    .unwrap();
                let said = String::from_utf8_lossy(&output.stderr);
                assert!(output.status.success(), "docs/guide/{name}.md:\n{}\n{said}", block.text);
                ran += 1;
            }
            _ => {}
        }
    }
    ran
}

#[test]
fn every_command_of_the_guide_works() {
    for (name, page) in pages().iter().filter(|(name, _)| name != "scan-in") {
        let dir = tempfile::tempdir().unwrap();
        let ran = run(name, page, dir.path());
        let wanted =
            !["choosing", "gpu", "machines", "python", "troubleshooting", "writing-stages"].contains(&name.as_str());
        assert!(!wanted || ran > 0, "docs/guide/{name}.md: no block ran");
    }
}

/// Files of a scanner: counts of the projections of a phantom, in the geometry of the page.
fn scanner_files(dir: &Path) {
    let simulated = text(&dir.join("simulated"));
    let [n, size] = ["24", "32x32"];
    done(&["simulate", "phantom:head:32", "-o", &simulated, "--protocol", "r2", "--views", n, "--detector", size]);
    fs::create_dir(dir.join("views")).unwrap();
    let simulated = conefield_scans::read_scan(simulated).unwrap();
    for (i, view) in simulated.projections.outer_iter().enumerate() {
        let counts: Vec<u16> = view.iter().map(|a| DARK + (OPEN * (-a).exp()) as u16).collect();
        tiff(&dir.join("views").join(format!("view{i}.tif")), 32, &counts);
    }
    tiff(&dir.join("flat.tif"), 32, &[DARK + OPEN as u16; 32 * 32]);
    tiff(&dir.join("dark.tif"), 32, &[DARK; 32 * 32]);
}

fn tiff(path: &Path, side: u32, counts: &[u16]) {
    let file = fs::File::create(path).unwrap();
    TiffEncoder::new(file).unwrap().write_image::<Gray16>(side, side, counts).unwrap();
}

#[test]
fn a_scan_comes_in_as_the_guide_says() {
    let (_, page) = pages().into_iter().find(|(name, _)| name == "scan-in").unwrap();
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    scanner_files(dir.path());
    let said = done(&["info", &text(&at("views"))]);
    assert!(said.contains("scanner.toml") && said.contains("views of a scan"), "{said}");
    assert_eq!(run("scan-in", &page, dir.path()), 5);
    assert!(at("volume.mha").exists());

    // The quick test predicts held-out views; with a wrong direction it predicts them worse.
    let held_out = |run: &Path| -> f64 {
        let record = fs::read_to_string(run.join("record.json")).unwrap();
        serde_json::from_str::<serde_json::Value>(&record).unwrap()["held_out"].as_f64().unwrap()
    };
    let right = held_out(&at("first"));
    assert!(right < 0.05, "{right}");
    let description = fs::read_to_string(at("scanner.toml")).unwrap();
    fs::write(at("wrong.toml"), description.replace("\"counterclockwise\"", "\"clockwise\"")).unwrap();
    let [mirrored, wrong] = ["mirrored", "wrong"].map(|name| text(&at(name)));
    done(&["import", &text(&at("wrong.toml")), "-o", &mirrored]);
    let options = ["--spec", "fast", "-o", &wrong, "--steps", "400", "--hold-out", "every:6"];
    done(&[&["reconstruct", &mirrored][..], &options].concat());
    let wrong = held_out(&at("wrong"));
    assert!(wrong > 1.3 * right, "{wrong} with the wrong direction, {right} with the right one");
}

/// The site checks its own links; these pages are not part of it.
#[test]
fn links_of_the_readmes_lead_somewhere() {
    for page in ["README.md", "python/README.md"] {
        let path = repository().join(page);
        let readme = fs::read_to_string(&path).unwrap();
        let links = readme.split("](").skip(1).map(|rest| rest.split(')').next().unwrap());
        for link in links.filter(|link| !link.starts_with("http")) {
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = path.parent().unwrap().join(file);
            assert!(target.exists(), "{page}: {link}");
            let heading = |line: &str| line.starts_with('#') && slug(line) == anchor;
            let found = anchor.is_empty() || fs::read_to_string(&target).unwrap().lines().any(heading);
            assert!(found, "{page}: {link}");
        }
    }
}

/// The anchor of a heading.
fn slug(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || " -_".contains(*c);
    heading.trim_start_matches('#').trim().to_lowercase().chars().filter(kept).collect::<String>().replace(' ', "-")
}
