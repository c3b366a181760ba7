//! Runs the guide's commands as shown on its pages.
//!
//! The `sh` blocks of a page run in order, in a folder of their own, except those below `<!-- not run: REASON -->`. A
//! `toml` block below a line that begins with a file name in backticks is written to that file first.

use crate::common::{Folder, number};
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

/// Writes the files and runs the commands of a page; returns the number of blocks run.
fn run(d: &Folder, name: &str, page: &str) -> usize {
    let program = Path::new(env!("CARGO_BIN_EXE_conefield"));
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap());
    let mut ran = 0;
    for block in blocks(page) {
        let file = block.above.strip_prefix('`').and_then(|rest| rest.split_once('`')).map(|(file, _)| file);
        match (block.language, file) {
            ("toml", Some(file)) => d.put(file, block.text),
            ("sh", _) if !block.above.starts_with("<!-- not run: ") => {
                let script = block.text.replace("--budget 60s", "--budget 12s");
                let output = Command::new("bash")
                    .args(["-euo", "pipefail", "-c", &script])
                    .current_dir(d.at(""))
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
        let ran = run(&Folder::new(), name, page);
        let wanted =
            !["choosing", "gpu", "machines", "python", "troubleshooting", "writing-stages"].contains(&name.as_str());
        assert!(!wanted || ran > 0, "docs/guide/{name}.md: no block ran");
    }
}

/// A folder with the files of a scanner: counts of the projections of a phantom, in the geometry of the page.
fn scanner_files() -> Folder {
    let d = Folder::after(&["simulate phantom:head:32 -o simulated --protocol r2 --views 24 --detector 32x32"]);
    fs::create_dir(d.at("views")).unwrap();
    let simulated = conefield_scans::read_scan(d.at("simulated")).unwrap();
    for (i, view) in simulated.projections.outer_iter().enumerate() {
        let counts: Vec<u16> = view.iter().map(|a| DARK + (OPEN * (-a).exp()) as u16).collect();
        tiff(&d.at(format!("views/view{i}.tif")), 32, &counts);
    }
    tiff(&d.at("flat.tif"), 32, &[DARK + OPEN as u16; 32 * 32]);
    tiff(&d.at("dark.tif"), 32, &[DARK; 32 * 32]);
    d
}

fn tiff(path: &Path, side: u32, counts: &[u16]) {
    let file = fs::File::create(path).unwrap();
    TiffEncoder::new(file).unwrap().write_image::<Gray16>(side, side, counts).unwrap();
}

#[test]
fn a_scan_comes_in_as_the_guide_says() {
    let (_, page) = pages().into_iter().find(|(name, _)| name == "scan-in").unwrap();
    let d = scanner_files();
    let said = d.done("info views");
    assert!(said.contains("scanner.toml") && said.contains("views of a scan"), "{said}");
    assert_eq!(run(&d, "scan-in", &page), 5);
    assert!(d.has("volume.mha"));

    // The quick test predicts held-out views; with a wrong direction it predicts them worse.
    let held_out = |run: &str| number(&d.read(format!("{run}/record.json"))["held_out"]);
    let right = held_out("first");
    assert!(right < 0.05, "{right}");
    d.put("wrong.toml", d.text("scanner.toml").replace("\"counterclockwise\"", "\"clockwise\""));
    d.done("import wrong.toml -o mirrored");
    d.done("reconstruct mirrored --spec fast -o wrong --steps 400 --hold-out every:6");
    let wrong = held_out("wrong");
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
