//! Files of scanners and programs that conefield does not read, or not alone: one message for each, which names the format
//! and what to name or convert instead, whatever command meets the file.

use crate::folder::extension;
use crate::input::start_of;
use conefield_core::{Error, Result};
use std::path::Path;

/// Bytes that suffice to recognize a file.
const HEAD: u64 = 64;

/// Most files of a folder that are looked at.
const MOST_FILES: usize = 64;

const EXPORT: &str = "export TIFF, NumPy, MetaImage or NIfTI files, and describe projections in a scanner.toml \
                      (docs/guide/formats.md)";
const MAT: &str = "save a volume as .npy, and describe projections in a scanner.toml (docs/guide/formats.md)";
const OBI: &str = "name the ProjectionInfo.xml of its scan, or describe the images in a scanner.toml \
                   (docs/guide/formats.md)";
const XIM: &str = "name the Scan.xml of its scan, or describe the images in a scanner.toml (docs/guide/formats.md)";
const HIS: &str = "name the _Frames.xml of its scan, or describe the images in a scanner.toml (docs/guide/formats.md)";
const ZEISS: &str = "a scan of Zeiss is read from its .txrm, and a volume from TIFF files; describe other projections in \
                     a scanner.toml (docs/guide/formats.md)";

/// First bytes of a file, extension of a file that no first bytes identify (either may be empty: it identifies none), the
/// format's name and what to do.
const FORMATS: &[(&[u8], &str, &str, &str)] = &[
    (b"VARIAN_VA_INTERNAL_HND", "hnd", "Varian's HND, an image of a scan: not read alone", OBI),
    (b"VARIAN_VA_INTERNAL_HNC", "hnc", "Varian's HNC, an image of a scan: not read alone", OBI),
    (b"VMS.XI", "xim", "Varian's XIM, an image of a scan: not read alone", XIM),
    // Type 0x7000, a header of 68 bytes, whose image part has another 32.
    (b"\x00\x70\x44\x00", "his", "HIS, an image of a scan: not read alone", HIS),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "", "an OLE file such as Zeiss' TXM: not read here", ZEISS),
    (b"MATLAB ", "", "MATLAB's MAT file: not read", MAT),
    (b"SIMPLE  =", "", "FITS: not read", EXPORT),
    (b"\x89PNG\r\n", "", "PNG: not read", EXPORT),
    (b"\xff\xd8\xff", "", "JPEG: not read", EXPORT),
    (b"ncaa", "", "VFF: not read", EXPORT),
    (b"", "txm", "Zeiss' TXM, a volume: not read", ZEISS),
];

/// The name of the format of `path`, which starts with `head`, and what to do.
fn format(path: &Path, head: &[u8]) -> Option<(&'static str, &'static str)> {
    let extension = extension(path);
    let marked = FORMATS.iter().find(|(mark, ..)| !mark.is_empty() && head.starts_with(mark));
    let named = || FORMATS.iter().find(|(_, end, ..)| !end.is_empty() && *end == extension);
    marked.or_else(named).map(|(.., name, way)| (*name, *way))
}

/// Refuses the file `path`, which starts with `head`, if its format is one of these. To be called where no reader has
/// recognized it.
pub(crate) fn refuse(path: &Path, head: &[u8]) -> Result<()> {
    match format(path, head) {
        Some((name, way)) => Err(Error::unsupported(format!("{}: {name}", path.display()), way)),
        None => Ok(()),
    }
}

/// Like [`refuse`], for a file of which nothing has been read.
pub(crate) fn refuse_file(path: &Path) -> Result<()> {
    refuse(path, &start_of(path, HEAD)?)
}

/// Refuses a folder in which no reader has found its files, and one of these formats is among the first files.
pub(crate) fn refuse_folder(folder: &Path) -> Result<()> {
    let Ok(paths) = crate::dicom::files(folder) else { return Ok(()) };
    // Pictures beside the files of another format are not the scan.
    let picture = |p: &Path| ["png", "jpg", "jpeg"].contains(&&extension(p)[..]);
    paths.iter().filter(|p| !picture(p)).take(MOST_FILES).try_for_each(|p| refuse_file(p))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_named_by_its_mark_or_extension() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for (name, bytes, words) in [
            ("a.hnd", &b"VARIAN_VA_INTERNAL_HND_1.0"[..], "HND"),
            ("b.bin", b"VARIAN_VA_INTERNAL_HND_1.0", "HND"),
            ("c.hnc", b"VARIAN_VA_INTERNAL_HNCU_1.0", "HNC"),
            ("d.xim", b"VMS.XI\0\0", "XIM"),
            ("e.HIS", b"", "HIS"),
            ("f.txm", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "TXM"),
        ] {
            std::fs::write(at(name), bytes).unwrap();
            for said in [
                refuse_file(&at(name)).unwrap_err(),
                crate::read_volume(at(name)).unwrap_err(),
                crate::read_scan(at(name)).unwrap_err(),
                crate::read_scanner(at(name), None, None).unwrap_err(),
                crate::scan_size(at(name)).unwrap_err(),
                crate::read_scan(dir.path()).unwrap_err(),
                crate::read_volume(dir.path()).unwrap_err(),
            ] {
                let said = said.to_string();
                assert!(said.contains(name) && said.contains(words) && said.contains("scanner.toml"), "{said}");
            }
            std::fs::remove_file(at(name)).unwrap();
        }
        std::fs::write(at("a.txt"), "VARIAN").unwrap();
        std::fs::write(at("a.png"), b"\x89PNG\r\n\x1a\n").unwrap();
        refuse_file(&at("a.txt")).unwrap();
        refuse_folder(dir.path()).unwrap();
        assert!(refuse_file(&at("a.png")).unwrap_err().to_string().contains("PNG"));
    }
}
