//! Small files that claim or unpack to much. Memory is drawn from one allowance as it is allocated, whatever a header,
//! a packed size or an estimate says; work that grows faster than its input has its own limit.

use crate::case::{Case, put, table};
use conefield_tests::hostile::seeds;
use std::collections::BTreeMap;
use std::path::Path;

/// A shipped spec of a field.
const NAF: &str = include_str!("../../../conefield/specs/naf.toml");

/// Weights of one tensor with these notes.
fn field(d: &Path, spec: &str, attenuation: &str, unit_mm: &str, masks: &str) {
    let placement = format!(
        "{{\"grid\":{{\"shape\":[8,8,8],\"spacing\":[1,1,1],\"center\":[0,0,0]}},\"attenuation\":{attenuation},\
         \"unit_mm\":{unit_mm},\"masks\":{masks}}}"
    );
    let notes = [("spec", spec), ("placement", &placement)].map(|(k, v)| (k.to_owned(), v.to_owned()));
    let tensors = [("encoder.table", &[4][..], &[0.0f32; 4][..])];
    conefield_io::write_weights(&d.join("w.safetensors"), &tensors, &BTreeMap::from(notes)).unwrap();
}

/// Weights whose notes name a network of 137 GB.
fn huge_network(masks: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| {
        let spec = NAF.replace("features = 2", "features = 8").replace("log2_table_size = 19", "log2_table_size = 28");
        assert_ne!(spec, NAF);
        field(d, &spec, "0.02", "1.0", masks);
    }
}

/// Weights whose placement holds these two numbers.
fn placed(attenuation: &'static str, unit_mm: &'static str) -> impl Fn(&Path) + Sync + Send {
    move |d| field(d, NAF, attenuation, unit_mm, "[]")
}

/// `z.npy` of zeros in gzip.
fn packed_npy(d: &Path, name: &str, shape: &str, bytes: usize) {
    put(d.join(name), seeds::gzip(seeds::npy_bytes("|u1", shape, &vec![0; bytes])));
}

/// `b.nii.gz`: 400³ voxels of zeros.
fn packed_nifti(d: &Path) {
    seeds::scan_toml(d);
    seeds::nifti(d);
    let mut bytes = std::fs::read(d.join("a.nii")).unwrap();
    bytes.truncate(352);
    for axis in 0..3 {
        bytes[42 + 2 * axis..44 + 2 * axis].copy_from_slice(&400i16.to_le_bytes());
    }
    // Unsigned bytes, so that they grow again when read.
    bytes[70..74].copy_from_slice(&[2, 0, 8, 0]);
    bytes.resize(352 + 400 * 400 * 400, 0);
    put(d.join("b.nii.gz"), seeds::gzip(bytes));
}

/// R2-Gaussian's folder with 16 packed projections of 134 MB each.
fn packed_r2(d: &Path) {
    seeds::r2(d);
    let meta = d.join("r2/meta_data.json");
    let mut value: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&meta).unwrap()).unwrap();
    value["scanner"]["nDetector"] = serde_json::json!([8192, 16384]);
    let packed = seeds::gzip(seeds::npy_bytes("|u1", "(8192, 16384)", &vec![0; 8192 * 16384]));
    let frames = (0..16).map(|i| {
        put(d.join(format!("r2/{i}.npy")), &packed);
        serde_json::json!({ "file_path": format!("{i}.npy"), "angle": 0.3 * f64::from(i) })
    });
    value["proj_train"] = frames.collect();
    put(&meta, value.to_string());
}

/// A pickle of one dict with `count` times the same key.
fn repeated_keys(d: &Path, count: usize) {
    // PROTO 2, EMPTY_DICT, MARK, then SHORT_BINSTRING "k" with None again and again, SETITEMS, STOP.
    let bytes = [&b"\x80\x02}("[..], &b"U\x01kN".repeat(count), b"u."].concat();
    put(d.join("scan.pickle"), bytes);
}

/// RTK's geometry of `count` views; all but the first repeat the previous one.
fn many_views(d: &Path, count: usize) {
    let first = "<Projection><SourceToIsocenterDistance>500</SourceToIsocenterDistance>\
                 <SourceToDetectorDistance>800</SourceToDetectorDistance></Projection>\n";
    let rest = "<Projection/>\n".repeat(count - 1);
    // The last one is invalid.
    let last = "<Projection><SourceToDetectorDistance>0</SourceToDetectorDistance></Projection>";
    let text =
        format!("<RTKThreeDCircularGeometry version=\"3\">\n{first}{rest}{last}\n</RTKThreeDCircularGeometry>\n");
    put(d.join("geometry.xml"), text);
}

/// Chains that each extend two others, 20 files deep: 2^20 files to read.
fn doubling(d: &Path) {
    for i in 0..20 {
        let next = i + 1;
        let text = format!(
            "type = \"chain\"\nname = \"x\"\n[[methods]]\nextends = \"{next}.toml\"\n[[methods]]\nextends = \"{next}.toml\"\n"
        );
        put(d.join(format!("{i}.toml")), text);
    }
    put(d.join("20.toml"), "type = \"fdk\"\nname = \"x\"\n");
}

/// 10 000 specs, each extending the next.
fn long_chain(d: &Path) {
    for i in 0..10_000 {
        put(d.join(format!("{i}.toml")), format!("extends = \"{}.toml\"\nname = \"x\"\n", i + 1));
    }
    put(d.join("10000.toml"), "type = \"fdk\"\nname = \"x\"\n");
}

/// A scan with one line integral near the limit of single precision.
fn extreme(d: &Path) {
    seeds::scan_toml(d);
    let path = d.join("scan/projections.npy");
    let mut bytes = std::fs::read(&path).unwrap();
    let [views, rows, columns] = seeds::SHAPE;
    let at = bytes.len() - 4 * (views * rows * columns - (rows + 2) * columns - 3);
    bytes[at..at + 4].copy_from_slice(&3.4e38f32.to_le_bytes());
    put(path, bytes);
}

pub fn cases() -> Vec<Case> {
    const SCAN: &str = "reconstruct scan --spec fdk -o run";
    table! {
        "weights of a few bytes whose notes name a network of 137 GB", huge_network("[]"),
            "export w.safetensors -o v.npy", ["w.safetensors", "found nothing", "a tensor of shape"];
        "the same with a mask, which leaves less of it", huge_network("[[0]]"),
            "export w.safetensors -o v.npy", ["parameters", "--memory"];
        "weights of attenuation below 0", placed("-0.02", "1.0"),
            "export w.safetensors -o v.npy", ["w.safetensors", "placement.attenuation: found -0.02", "above 0"];
        "weights of a unit below 0", placed("0.02", "-1.0"),
            "export w.safetensors -o v.npy", ["w.safetensors", "placement.unit_mm: found -1", "above 0"];
        "DICOM run lengths of 4 MB that stand for 268 MB of zeros", |d| seeds::dicom_of_zeros(d, 8192),
            "info series", ["memory", "200 MiB"].memory(Some("200MiB"));
        "DICOM run lengths that stand for more than there is", |d| seeds::dicom_of_zeros(d, 16384),
            "convert series out.npy", ["memory"].memory(None);
        "a TIFF of 0.1 MB that unpacks to 96 MB", |d| seeds::scanner_tiff_of_zeros(d, 4000),
            "import scanner.toml -o scan", ["memory: needs", "200 MiB"].memory(Some("200MiB"));
        "the same, asked about", |d| seeds::scanner_tiff_of_zeros(d, 4000),
            "info scanner.toml", ["memory: needs", "200 MiB"].memory(Some("200MiB"));
        "16 packed projections of 0.13 MB, 134 MB each", packed_r2, "info r2", ["memory"].memory(None);
        "a packed volume of 64 kB, 256 MB, as a reference", packed_nifti,
            "reconstruct scan --spec sirt -o run --reference b.nii.gz",
            ["b.nii.gz", "data", "--memory"].memory(Some("60MiB"));
        "the same to start from", packed_nifti,
            "reconstruct scan --spec sirt -o run --init b.nii.gz", ["memory: needs", "60.0 MiB"].memory(Some("60MiB"));
        "the same to score", packed_nifti,
            "evaluate b.nii.gz b.nii.gz", ["memory: needs", "60.0 MiB"].memory(Some("60MiB"));
        "a demo in 40 MiB", |_| {}, "demo -o out", ["memory: needs", "40.0 MiB"].memory(Some("40MiB"));
        "a packed array of 60 kB as a volume", |d| packed_npy(d, "z.npy", "(400, 400, 400)", 64_000_000),
            "info z.npy", ["memory: needs", "60.0 MiB"].memory(Some("60MiB"));
        "a pickle of 40 000 times the same key", |d| repeated_keys(d, 40_000),
            "info scan.pickle", ["scan.pickle", "keys", "at most 1024"];
        "RTK's geometry of 500 000 views, the last one wrong", |d| many_views(d, 500_000),
            "info geometry.xml", ["line 500002", "SourceToDetectorDistance"];
        "specs that extend two others each", doubling, "explain 0.toml", ["extends", "256"];
        "10 000 specs, each over the next", long_chain, "explain 0.toml", ["extends", "32 specs"];
        "a line integral at the end of single precision", extreme, SCAN, ["projections[1, 2, 3]", "1e15"];
    }
}
