//! The steps of docs/your-data.md, as they stand there.

use crate::common::{conefield, done, text};
use std::fs;
use std::path::Path;
use tiff::encoder::{TiffEncoder, colortype::Gray16};

const OPEN: f32 = 40_000.0;
const DARK: u16 = 120;

fn tiff(path: &Path, side: u32, counts: &[u16]) {
    let file = fs::File::create(path).unwrap();
    TiffEncoder::new(file).unwrap().write_image::<Gray16>(side, side, counts).unwrap();
}

/// The text between fences of `language`.
fn blocks<'a>(page: &'a str, language: &str) -> Vec<&'a str> {
    let fence = format!("```{language}\n");
    page.split(&fence).skip(1).map(|rest| rest.split("```").next().unwrap()).collect()
}

#[test]
fn every_step_of_the_page_works() {
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/your-data.md");
    let page = fs::read_to_string(page).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);

    // What a scanner would have given: counts of the projections of a phantom, in the geometry of the page.
    let simulated = text(&at("simulated"));
    let [n, size] = ["24", "32x32"];
    done(&["simulate", "phantom:head:32", "-o", &simulated, "--protocol", "r2", "--views", n, "--detector", size]);
    fs::create_dir(at("views")).unwrap();
    let simulated = conefield_io::read_scan(at("simulated")).unwrap();
    for (i, view) in simulated.projections.outer_iter().enumerate() {
        let counts: Vec<u16> = view.iter().map(|a| DARK + (OPEN * (-a).exp()) as u16).collect();
        tiff(&at("views").join(format!("view{i}.tif")), 32, &counts);
    }
    tiff(&at("flat.tif"), 32, &[DARK + OPEN as u16; 32 * 32]);
    tiff(&at("dark.tif"), 32, &[DARK; 32 * 32]);

    let toml = blocks(&page, "toml");
    assert_eq!(toml.len(), 1);
    fs::write(at("scanner.toml"), toml[0]).unwrap();
    let commands: Vec<&str> = blocks(&page, "sh").into_iter().flat_map(str::lines).collect();
    assert_eq!(commands.len(), 7);
    for line in commands {
        let line = line.replace("--budget 10m", "--steps 3");
        let words: Vec<&str> = line.split(' ').collect();
        assert_eq!(words[0], "conefield");
        conefield(&words[1..]).current_dir(dir.path()).assert().success();
    }
    assert!(at("volume.mha").exists());

    // The first look predicts the views that it has not seen, and a wrong direction does so worse.
    let held_out = |run: &Path| -> f64 {
        let record = fs::read_to_string(run.join("record.json")).unwrap();
        serde_json::from_str::<serde_json::Value>(&record).unwrap()["held_out"].as_f64().unwrap()
    };
    let right = held_out(&at("first"));
    assert!(right < 0.05, "{right}");
    fs::write(at("wrong.toml"), toml[0].replace("\"counterclockwise\"", "\"clockwise\"")).unwrap();
    done(&["import", &text(&at("wrong.toml")), "-o", &text(&at("mirrored"))]);
    let wrong = text(&at("wrong"));
    done(&[
        "reconstruct",
        &text(&at("mirrored")),
        "--spec",
        "fast",
        "-o",
        &wrong,
        "--steps",
        "400",
        "--hold-out",
        "every:6",
    ]);
    let wrong = held_out(&at("wrong"));
    assert!(wrong > 1.3 * right, "{wrong} with the wrong direction, {right} with the right one");
}
