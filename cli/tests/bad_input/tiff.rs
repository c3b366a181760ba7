//! TIFF stacks, through a scanner's description.

use crate::case::{Case, End, changed, cut, cut_end, put, refused, replaced, table, then};
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

/// Pages of grey images.
fn pages(write: fn(&mut TiffEncoder<&mut Cursor<Vec<u8>>>)) -> impl Fn(&Path) + Sync + Send {
    then(scanner_tiff, move |d| {
        let mut file = Cursor::new(Vec::new());
        write(&mut TiffEncoder::new(&mut file).unwrap());
        put(d.join(FILE), file.into_inner());
    })
}

/// A folder with one image under these names.
fn folder(names: &'static [&'static str]) -> impl Fn(&Path) + Sync + Send {
    then(scanner_tiff, move |d| {
        std::fs::create_dir(d.join("views")).unwrap();
        let image = std::fs::read(d.join(FILE)).unwrap();
        names.iter().for_each(|name| put(d.join(format!("views/{name}.tif")), &image));
        put(d.join("scanner.toml"), scanner_toml("views", CIRCLE));
    })
}

/// One directory with ImageJ's text, `counted` images in it and `stored` after each other: 2 x 3 pixels of 16 bits.
fn one_directory(counted: Option<usize>, stored: usize) -> impl Fn(&Path) + Sync + Send {
    move |d| {
        let text = counted.map_or("a detector".to_owned(), |n| format!("ImageJ=1.54f\nimages={n}\nslices={n}\n"));
        let entries: [(u16, u16, u32, u32); 9] = [
            (256, 4, 1, 3),
            (257, 4, 1, 2),
            (258, 3, 1, 16),
            (259, 3, 1, 1),
            (262, 3, 1, 1),
            (270, 2, text.len() as u32, 200),
            (273, 4, 1, 300),
            (278, 4, 1, 2),
            (279, 4, 1, 12),
        ];
        let mut bytes = [b"II*\0\x08\0\0\0".as_slice(), &(entries.len() as u16).to_le_bytes()].concat();
        for (tag, kind, count, value) in entries {
            bytes.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
            bytes.extend([count.to_le_bytes(), value.to_le_bytes()].concat());
        }
        bytes.resize(200, 0);
        bytes.extend(text.as_bytes());
        bytes.resize(300, 0);
        bytes.extend((0..6 * stored as u16).flat_map(|i| (9000 + i).to_le_bytes()));
        put(d.join(FILE), bytes);
        put(d.join("scanner.toml"), scanner_toml(FILE, CIRCLE));
    }
}

/// A view of Varian's format, named in `args`.
fn hnd(what: &'static str, args: &'static str) -> Case {
    let make = |d: &Path| put(d.join("a.hnd"), b"VARIAN_VA_INTERNAL_HND_1.0");
    refused(what, make, args, &["a.hnd", "Varian's HND", "ProjectionInfo.xml"])
}

pub fn cases() -> Vec<Case> {
    let mut all = table! {
        "an empty file", changed(scanner_tiff, FILE, cut(0)), IMPORT, ["counts.tif"];
        "cut within the mark", changed(scanner_tiff, FILE, cut(6)), IMPORT, ["counts.tif"];
        "cut in the middle", changed(scanner_tiff, FILE, |b| b.truncate(b.len() / 2)), IMPORT, ["counts.tif"];
        "cut at the end", changed(scanner_tiff_lzw, FILE, cut_end(10)), IMPORT, ["counts.tif"];
        "a first page far behind the end", changed(scanner_tiff, FILE, |b| b[4..8].fill(0x7f)), IMPORT, ["counts.tif"];
        "no columns", entry(256, |e| e[6..].fill(0)), IMPORT, ["counts.tif"];
        "4 billion columns", entry(256, |e| e[6..].fill(255)), IMPORT, ["page 0", "4294967295 pixels"];
        "an entry of 4 GB", entry(273, |e| e[2..6].fill(255)), IMPORT, ["page 0", "in the entry 273"];
        "a packing that does not exist", entry(259, |e| e[6] = 77), IMPORT, ["counts.tif"];
        "packed data that is damaged", changed(scanner_tiff_deflate, FILE, |b| b[12..30].fill(0xff)),
            IMPORT, ["counts.tif"];
        "Zstandard that is damaged", changed(scanner_tiff_zstd, FILE, |b| {
            let start = b.windows(4).position(|w| w == [0x28, 0xb5, 0x2f, 0xfd]).expect("a stream of the seed");
            b[start + 6..start + 20].fill(0xff);
        }), IMPORT, ["counts.tif", "Zstandard"];
        "colours", image::<colortype::RGB8>(2, 1, vec![1; 6], Compression::Uncompressed),
            IMPORT, ["page 0", "RGB", "grey"];
        "a pixel that is NaN", image::<colortype::Gray32Float>(2, 1, vec![1.0, f32::NAN], Compression::Uncompressed),
            IMPORT, ["row 0, column 1", "NaN"];
        "a page of another size", pages(|w| {
            w.write_image::<colortype::Gray8>(3, 2, &[1; 6]).unwrap();
            w.write_image::<colortype::Gray8>(2, 3, &[1; 6]).unwrap();
        }), IMPORT, ["page 1", "size of the first page"];
        "fewer pages than angles",
            replaced(scanner_tiff, "scanner.toml", "range_deg = 360.0", "angles_deg = [0, 90, 180, 270]"),
            IMPORT, ["circle.angles_deg", "4 of them", "expected 3"];
        "deflate bomb: 90 million zeros in 90 kB",
            image::<colortype::Gray8>(9000, 10000, vec![0; 90_000_000], Compression::Deflate(Default::default())),
            IMPORT, ["page 0", "100 times"];
        "a folder without images", folder(&[]), IMPORT, ["files.projections", ".tif"];
        "one directory for eight images, of which three are there", one_directory(Some(8), 3),
            IMPORT, ["images", "found 8 in the ImageDescription", "36 bytes"];
        "one directory, and images that nothing counts", one_directory(None, 3),
            IMPORT, ["file size", "24 bytes after the one page"];
        "pages of other numbers", pages(|w| {
            w.write_image::<colortype::Gray16>(3, 2, &[1; 6]).unwrap();
            w.write_image::<colortype::Gray8>(3, 2, &[1; 6]).unwrap();
        }), IMPORT, ["page 1", "8-bit unsigned", "16-bit unsigned"];
        "a folder whose numbers have a gap",
            folder(&["view_0001", "view_0002", "view_0003", "view_0004", "view_0007", "view_0008", "view_0009"]),
            IMPORT, ["files.projections", "view_0004.tif and view_0007.tif"].ends(End::Warned);
        "a folder with two series", folder(&["flat", "view_1", "view_2"]),
            IMPORT, ["files.projections", "flat.tif and view_1.tif", "two series"].ends(End::Warned);
        "HND of Varian, cut off", |d| {
            folder(&[])(d);
            put(d.join("views/Proj_00001.hnd"), b"VARIAN_VA_INTERNAL_HND_1.0");
        }, IMPORT, ["Proj_00001.hnd", "header", "512 bytes"];
    };
    all.extend([
        hnd("HND of Varian, asked about", "info a.hnd"),
        hnd("HND of Varian in place of a description", "import a.hnd -o scan"),
        hnd("HND of Varian in place of a volume", "simulate a.hnd -o scan"),
        hnd("HND of Varian in place of a scan", "reconstruct a.hnd --spec fdk -o run"),
    ]);
    all
}
