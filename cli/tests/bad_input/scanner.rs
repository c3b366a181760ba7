//! A scanner's description in TOML, with RTK's geometry and ASTRA's vectors.

use crate::case::{Case, End, changed, put, replaced, table, then};
use conefield_tests::hostile::seeds::{CIRCLE, scanner_npy, scanner_rtk, scanner_toml, scanner_vectors};
use std::path::Path;

const IMPORT: &str = "import scanner.toml -o scan";

fn circle(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(scanner_npy, "scanner.toml", from, to)
}

fn vectors(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(scanner_vectors, "scanner.toml", from, to)
}

fn rtk(from: &'static str, to: &'static str) -> impl Fn(&Path) + Sync + Send {
    replaced(scanner_rtk, "geometry.xml", from, to)
}

/// An XML file with ten entities nested nine deep, which expand to 10⁹ words.
fn laughs(dir: &Path) {
    scanner_rtk(dir);
    let mut text = "<?xml version=\"1.0\"?>\n<!DOCTYPE RTKGEOMETRY [\n<!ENTITY a0 \"ha\">\n".to_owned();
    for i in 1..10 {
        let ten = format!("&a{};", i - 1).repeat(10);
        text.push_str(&format!("<!ENTITY a{i} \"{ten}\">\n"));
    }
    text.push_str(
        "]>\n<RTKThreeDCircularGeometry version=\"3\"><Projection>&a9;</Projection></RTKThreeDCircularGeometry>\n",
    );
    put(dir.join("geometry.xml"), text);
}

pub fn cases() -> Vec<Case> {
    table! {
        "an empty file", |d| put(d.join("scanner.toml"), ""), IMPORT, ["scanner.toml", "format"];
        "no UTF-8", |d| put(d.join("scanner.toml"), b"format = \"\xff\""), IMPORT, ["scanner.toml", "UTF-8"];
        "UTF-16", |d| put(d.join("scanner.toml"), b"\xff\xfef\0o\0"), IMPORT, ["scanner.toml", "UTF-16", "UTF-8"];
        "a folder", |d| std::fs::create_dir(d.join("views")).unwrap(),
            "import views -o scan", ["SCANNER.toml", "a folder", "a text file"];
        "an image", |d| put(d.join("view.TIF"), ""),
            "import view.TIF -o scan", ["SCANNER.toml", "a .tif file of projections", "a text file"];
        "another format", circle("conefield-scanner", "conefield-scan"), IMPORT, ["format", "conefield-scan"];
        "a later version", circle("version = 1", "version = 2"), IMPORT, ["version", "found 2"];
        "no TOML", circle("[files]", "[files"), IMPORT, ["scanner.toml:4:7: syntax"];
        "a misspelt key", circle("dso =", "DSO ="), IMPORT, ["scanner.toml:8:1: circle.DSO", "\"dso\""];
        "a missing key", circle("dsd = 800.0\n", ""), IMPORT, ["dsd", "nothing"];
        "a negative distance", circle("dso = 500.0", "dso = -500.0"), IMPORT, ["circle.dso", "-500"];
        "an infinite distance", circle("dsd = 800.0", "dsd = inf"), IMPORT, ["circle.dsd", "inf"];
        "a detector nearer than the axis", circle("dsd = 800.0", "dsd = 0"), IMPORT, ["circle.dsd"];
        "a source within the volume", circle("dso = 500.0", "dso = 0.1"), IMPORT, ["views[0]", "inside the volume"];
        "a pixel of size zero", circle("pixel = { u = 2.0", "pixel = { u = 0.0"), IMPORT, ["circle.pixel.u", "found 0"];
        "an angle that is NaN", circle("range_deg = 360.0", "angles_deg = [0, nan, 3]"),
            IMPORT, ["circle.angles_deg.1: found nan"];
        "a file of angles that is not there", circle("range_deg = 360.0", "angles_deg = \"none.csv\""),
            IMPORT, ["circle.angles_deg", "none.csv"];
        "a tilt that is infinite", circle("range_deg = 360.0", "range_deg = 360.0\ntilt_deg = { u = inf }"),
            IMPORT, ["circle.tilt_deg.u", "inf"];
        "angles said twice", circle("range_deg = 360.0", "range_deg = 360.0\nstep_deg = 1.0"),
            IMPORT, ["circle.step_deg", "several ways"];
        "two geometries", circle("[values]", "[vectors]\ncone_vec = []\n[values]"),
            IMPORT, ["circle", "several geometries"];
        "an open beam that is negative", circle("i0 = 20000.0", "i0 = -1"), IMPORT, ["-1"];
        "counts taken for line integrals", circle("kind = \"counts\"\ni0 = 20000.0", "kind = \"line-integrals\""),
            IMPORT, ["line integrals", "--i0"].ends(End::Warned);
        "a volume without voxels", circle("shape = [4, 3, 2]", "shape = [4, 0, 2]"),
            IMPORT, ["volume.shape", "at least one voxel"];
        "a volume past 2^64", circle("shape = [4, 3, 2]", "shape = [4294967296, 4294967296, 4294967296]"),
            IMPORT, ["volume.shape", "addressed"];
        "a file in the folder above", circle("counts.npy", "../counts.npy"),
            IMPORT, ["files.projections", "without \"..\""];
        "a file of the system", circle("counts.npy", "/etc/passwd"), IMPORT, ["files.projections", "inside the folder"];
        "one file a thousand times", |d| {
            scanner_npy(d);
            let list = format!("projections = [{}]", "\"counts.npy\", ".repeat(1000));
            put(
                d.join("scanner.toml"),
                scanner_toml("counts.npy", CIRCLE).replace("projections = \"counts.npy\"", &list),
            );
        }, IMPORT, ["files.projections", "a second time"];
        "tables a thousand deep", |d| put(d.join("scanner.toml"), format!("a = {}1", "{a = ".repeat(1000))),
            IMPORT, ["scanner.toml:1:"];
        "a text of 17 MB", |d| put(d.join("scanner.toml"), " ".repeat(17 << 20)),
            IMPORT, ["file size", "at most 16777216 bytes"];
        "ASTRA: eleven numbers in a vector", vectors("[500, 0, 0, ", "[500, 0, "), IMPORT, ["scanner.toml"];
        "ASTRA: fewer vectors than views", vectors("  [0, 500, 0, 0, -300, 0, -2, 0, 0, 0, 0, -2],\n", ""),
            IMPORT, ["vectors.cone_vec", "2 of them", "expected 3"];
        "ASTRA: a vector with NaN", vectors("[500, 0, 0, -300", "[nan, 0, 0, -300"), IMPORT, ["vectors.cone_vec.0.0: found nan"];
        "ASTRA: parallel rows and columns", vectors("0, 2, 0, 0, 0, -2]", "0, 2, 0, 0, 2, 0]"),
            IMPORT, ["views[0]", "parallel"];
        "ASTRA: a source in the detector's plane", vectors("[500, 0, 0, -300,", "[-300, 0, 0, -300,"),
            IMPORT, ["views[0]", "plane of the detector"];
        "RTK: an empty file", changed(scanner_rtk, "geometry.xml", Vec::clear), IMPORT, ["geometry.xml", "XML"];
        "RTK: cut in the middle", changed(scanner_rtk, "geometry.xml", |b| b.truncate(b.len() / 2)),
            IMPORT, ["geometry.xml", "XML"];
        "RTK: another root",
            rtk("<RTKThreeDCircularGeometry version=\"3\">", "<RTKThreeDCircularGeometry version=\"9\">"),
            IMPORT, ["version", "found 9"];
        "RTK: an angle that is NaN", rtk("<GantryAngle>", "<GantryAngle>nan"), IMPORT, ["GantryAngle", "\"nan"];
        "RTK: a misspelt element", rtk("<GantryAngle>", "<GantryAngel>3</GantryAngel><GantryAngle>"),
            IMPORT, ["line 7", "<GantryAngel>"];
        "RTK: a matrix that contradicts", rtk("<SourceToDetectorDistance>800", "<SourceToDetectorDistance>801"),
            IMPORT, ["Matrix"];
        "RTK: entities of entities (a billion words)", laughs, IMPORT, ["geometry.xml", "XML"];
        "RTK: elements 100 000 deep", then(scanner_rtk, |d| put(d.join("geometry.xml"), "<a>".repeat(100_000))),
            IMPORT, ["geometry.xml"];
    }
}
