//! TIFF stacks, through a scanner's description.

use crate::case::{Case, changed, cut, cut_end, put, refused};
use conefield_tests::hostile::seeds::{
    CIRCLE, scanner_tiff, scanner_tiff_deflate, scanner_tiff_lzw, scanner_tiff_zstd, scanner_toml,
};
use std::io::Cursor;
use std::path::Path;
use tiff::encoder::{Compression, TiffEncoder, colortype};

const IMPORT: &str = "import scanner.toml -o scan";
const FILE: &str = "counts.tif";

/// Changes the entry `tag` of the first page: its type, number of values and value.
fn entry(tag: u16, change: impl Fn(&mut [u8]) + Sync + Send + 'static) -> impl Fn(&Path) + Sync + Send {
    changed(scanner_tiff, FILE, move |b| {
        let start = u32::from_le_bytes(b[4..8].try_into().unwrap()) as usize;
        let entries = b[start + 2..].chunks_exact_mut(12);
        change(&mut entries.into_iter().find(|e| e[..2] == tag.to_le_bytes()).expect("an entry of the seed")[2..]);
    })
}

fn image<C>(width: u32, height: u32, values: Vec<C::Inner>, packing: Compression) -> impl Fn(&Path) + Sync + Send
where
    C: colortype::ColorType,
    C::Inner: Sync + Send,
    [C::Inner]: tiff::encoder::TiffValue,
{
    move |d| {
        let mut file = Cursor::new(Vec::new());
        let mut w = TiffEncoder::new(&mut file).unwrap().with_compression(packing);
        w.write_image::<C>(width, height, &values).unwrap();
        put(d.join(FILE), file.into_inner());
        put(d.join("scanner.toml"), scanner_toml(FILE, CIRCLE));
    }
}

pub fn cases() -> Vec<Case> {
    vec![
        refused("an empty file", changed(scanner_tiff, FILE, cut(0)), IMPORT, &["counts.tif"]),
        refused("cut within the mark", changed(scanner_tiff, FILE, cut(6)), IMPORT, &["counts.tif"]),
        refused("cut in the middle", changed(scanner_tiff, FILE, |b| b.truncate(b.len() / 2)), IMPORT, &["counts.tif"]),
        refused("cut at the end", changed(scanner_tiff_lzw, FILE, cut_end(10)), IMPORT, &["counts.tif"]),
        refused(
            "a first page far behind the end",
            changed(scanner_tiff, FILE, |b| b[4..8].fill(0x7f)),
            IMPORT,
            &["counts.tif"],
        ),
        refused("no columns", entry(256, |e| e[6..].fill(0)), IMPORT, &["counts.tif"]),
        refused("4 billion columns", entry(256, |e| e[6..].fill(255)), IMPORT, &["page 0", "4294967295 pixels"]),
        refused("an entry of 4 GB", entry(273, |e| e[2..6].fill(255)), IMPORT, &["page 0", "in the entry 273"]),
        refused("a packing that does not exist", entry(259, |e| e[6] = 77), IMPORT, &["counts.tif"]),
        refused(
            "packed data that is damaged",
            changed(scanner_tiff_deflate, FILE, |b| b[12..30].fill(0xff)),
            IMPORT,
            &["counts.tif"],
        ),
        refused(
            "Zstandard that is damaged",
            changed(scanner_tiff_zstd, FILE, |b| {
                let start = b.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).expect("a stream of the seed");
                b[start + 6..start + 20].fill(0xff);
            }),
            IMPORT,
            &["counts.tif", "Zstandard"],
        ),
        refused(
            "colours",
            image::<colortype::RGB8>(2, 1, vec![1; 6], Compression::Uncompressed),
            IMPORT,
            &["page 0", "RGB", "grey"],
        ),
        refused(
            "a pixel that is NaN",
            image::<colortype::Gray32Float>(2, 1, vec![1.0, f32::NAN], Compression::Uncompressed),
            IMPORT,
            &["row 0, column 1", "NaN"],
        ),
        refused(
            "a page of another size",
            |d| {
                scanner_tiff(d);
                let mut file = Cursor::new(Vec::new());
                let mut w = TiffEncoder::new(&mut file).unwrap();
                w.write_image::<colortype::Gray8>(3, 2, &[1; 6]).unwrap();
                w.write_image::<colortype::Gray8>(2, 3, &[1; 6]).unwrap();
                put(d.join(FILE), file.into_inner());
            },
            IMPORT,
            &["page 1", "size of the first page"],
        ),
        refused(
            "fewer pages than angles",
            |d| {
                scanner_tiff(d);
                put(
                    d.join("scanner.toml"),
                    scanner_toml(FILE, CIRCLE).replace("range_deg = 360.0", "angles_deg = [0, 90, 180, 270]"),
                );
            },
            IMPORT,
            &["circle.angles_deg", "4 of them", "expected 3"],
        ),
        refused(
            "deflate bomb: 90 million zeros in 90 kB",
            image::<colortype::Gray8>(9000, 10000, vec![0; 90_000_000], Compression::Deflate(Default::default())),
            IMPORT,
            &["page 0", "100 times"],
        ),
        refused(
            "a folder without images",
            |d| {
                std::fs::create_dir(d.join("views")).unwrap();
                put(d.join("scanner.toml"), scanner_toml("views", CIRCLE));
            },
            IMPORT,
            &["files.projections", ".tif"],
        ),
    ]
}
