//! A walk over the elements of a file that reads only their lengths.
//!
//! `dicom-object` allocates as much as an element claims, up to 4 GiB, and recurses into nested sequences. This walk
//! bounds both.

use super::slice::PIXEL_DATA;
use crate::input::must_unpack;
use conefield_core::error::ensure;
use conefield_core::{Error, Result, files};
use dicom_core::VR;
use dicom_core::dictionary::{DataDictionary, DataDictionaryEntry};
use dicom_object::{StandardDataDictionary, Tag};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Everything before the pixels must be shorter than this.
const LONGEST_HEADER: u64 = 64 << 20;

/// Deepest nesting of sequences; real files stay below ten.
const DEEPEST: usize = 32;

const SYNTAX: Tag = Tag(0x0002, 0x0010);
const ITEM: Tag = Tag(0xfffe, 0xe000);
const ITEM_END: Tag = Tag(0xfffe, 0xe00d);
const SEQUENCE_END: Tag = Tag(0xfffe, 0xe0dd);
const UNDEFINED: u32 = u32::MAX;

/// Value representations whose length has two bytes. It has four for all others, also those that the standard may add.
const SHORT: &str = "AE AS AT CS DA DS DT FD FL IS LO LT PN SH SL SS ST TM UI UL US";

/// How a file stores its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PixelStorage {
    None,
    /// This many bytes, uncompressed.
    Plain(u64),
    /// A compressed image in at most this many bytes.
    Packed(u64),
}

impl PixelStorage {
    /// Refuses an image of `count` values of `size` bytes that cannot come from this storage.
    pub fn must_hold(self, place: &str, count: u64, size: u64) -> Result<()> {
        let want = count * size;
        let (bytes, ok) = match self {
            Self::None => (0, false),
            // Odd lengths are padded to even ones.
            Self::Plain(n) => (n, n == want || n == want + 1),
            Self::Packed(n) => (n, must_unpack(n, want, count).is_ok()),
        };
        let expected = format!("{want} bytes, as Rows, Columns and BitsAllocated say");
        ensure(ok, place, "PixelData", format!("{bytes} bytes"), expected)
    }
}

/// How elements are encoded.
#[derive(Clone, Copy)]
struct Coding {
    explicit: bool,
    big: bool,
}

impl Coding {
    fn half(self, b: [u8; 2]) -> u16 {
        if self.big { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) }
    }

    fn word(self, b: [u8; 4]) -> u32 {
        if self.big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) }
    }

    fn tag(self, [a, b, c, d]: [u8; 4]) -> Tag {
        Tag(self.half([a, b]), self.half([c, d]))
    }
}

enum Level {
    /// An item or sequence that ends at this byte.
    Until(u64),
    /// An item or sequence that ends at its delimiter, and the coding that applies after it.
    Delimited(Coding),
    /// Fragments of a compressed image, up to the delimiter.
    Pieces,
}

struct ElementWalk {
    place: String,
    reader: BufReader<File>,
    at: u64,
    size: u64,
    coding: Coding,
}

/// Walks over `path`, which has DICOM's magic bytes, to the end of its pixels. Returns their storage and the byte after
/// them; nothing beyond that has been checked.
pub(super) fn check(path: &Path) -> Result<(PixelStorage, u64)> {
    let io = |e| Error::io(path, e);
    let (file, size) = files::open(path)?;
    let mut reader = BufReader::new(file);
    reader.seek(SeekFrom::Start(132)).map_err(io)?;
    let coding = Coding { explicit: true, big: false };
    ElementWalk { place: path.display().to_string(), reader, at: 132, size, coding }.run()
}

impl ElementWalk {
    fn run(mut self) -> Result<(PixelStorage, u64)> {
        let mut stack: Vec<Level> = Vec::new();
        let mut syntax = None;
        // The file meta group is always explicit and little-endian.
        let mut in_rest = false;
        let description_end = self.description_end()?;
        loop {
            while matches!(stack.last(), Some(Level::Until(end)) if self.at >= *end) {
                stack.pop();
            }
            if self.at == self.size {
                return Ok((PixelStorage::None, self.at));
            }
            self.refuse_endless(stack.len())?;
            let start = self.at;
            let (tag, rest) = (self.read()?, self.read()?);
            if !in_rest && self.coding.tag(tag).group() != 2 {
                in_rest = true;
                self.refuse_other_end(start, description_end)?;
                self.coding = coding(&self.place, syntax.as_deref())?;
            }
            let tag = self.coding.tag(tag);
            if tag.group() == 0xfffe {
                self.delimiter(tag, self.coding.word(rest), &mut stack)?;
                continue;
            }
            let (kind, length) = self.kind_and_length(tag, rest)?;
            if tag == PIXEL_DATA.0 && stack.is_empty() {
                return match length {
                    UNDEFINED => self.pieces(),
                    n => self.end(tag, n).map(|end| (PixelStorage::Plain(u64::from(n)), end)),
                };
            }
            let sequence = self.coding.explicit && kind == VR::SQ;
            if length == UNDEFINED {
                stack.push(self.undefined(kind));
            } else if sequence || (!self.coding.explicit && self.starts_with_item(length)?) {
                stack.push(Level::Until(self.end(tag, length)?));
            } else if tag == SYNTAX {
                syntax = Some(self.syntax(length)?);
            } else {
                self.skip(tag, length)?;
            }
        }
    }

    fn refuse_endless(&self, levels: usize) -> Result<()> {
        if self.at > LONGEST_HEADER {
            let found = format!("no PixelData in {LONGEST_HEADER} bytes");
            return Err(self.invalid("elements", found, "a shorter header"));
        }
        if levels > DEEPEST {
            let found = format!("more than {DEEPEST} levels at byte {}", self.at);
            return Err(self.invalid("sequences", found, "fewer levels"));
        }
        Ok(())
    }

    /// Refuses a file meta group that ends elsewhere than its length says. `dicom-object` trusts that length, and
    /// anything it took for part of the group would go unchecked.
    fn refuse_other_end(&self, start: u64, description_end: u64) -> Result<()> {
        let found = format!("an end at byte {description_end}");
        let expected = format!("{start}, where other elements begin");
        ensure(start == description_end, &self.place, "FileMetaInformationGroupLength", found, expected)
    }

    /// Handles the start or end of an item or sequence.
    fn delimiter(&mut self, tag: Tag, length: u32, stack: &mut Vec<Level>) -> Result<()> {
        match (tag, stack.last()) {
            (ITEM, Some(Level::Pieces)) => self.skip(tag, length)?,
            (ITEM, _) if length == UNDEFINED => stack.push(Level::Delimited(self.coding)),
            (ITEM, _) => stack.push(Level::Until(self.end(tag, length)?)),
            (ITEM_END | SEQUENCE_END, Some(Level::Delimited(before))) => {
                self.coding = *before;
                stack.pop();
            }
            (SEQUENCE_END, Some(Level::Pieces)) => {
                stack.pop();
            }
            // After an item or sequence of known length a delimiter has no effect.
            (ITEM_END | SEQUENCE_END, Some(Level::Until(_))) => {}
            _ => return Err(self.invalid("elements", format!("{tag} at byte {}", self.at), "an element")),
        }
        Ok(())
    }

    /// The level that an element of undefined length opens.
    fn undefined(&mut self, kind: VR) -> Level {
        if !self.coding.explicit {
            return Level::Delimited(self.coding);
        }
        match kind {
            VR::SQ => Level::Delimited(self.coding),
            VR::UN => {
                let level = Level::Delimited(self.coding);
                // By the standard, an unknown element of undefined length contains no value representations.
                self.coding.explicit = false;
                level
            }
            _ => Level::Pieces,
        }
    }

    /// The transfer syntax of the rest of the file.
    fn syntax(&mut self, length: u32) -> Result<String> {
        self.end(SYNTAX, length)?;
        let mut text = vec![0; length.min(64) as usize];
        self.reader.read_exact(&mut text).map_err(|e| Error::io(&self.place, e))?;
        self.at += text.len() as u64;
        self.skip(SYNTAX, length - text.len() as u32)?;
        Ok(String::from_utf8_lossy(&text).trim_end_matches(['\0', ' ']).to_owned())
    }

    /// End of the file meta group, from its first element.
    fn description_end(&mut self) -> Result<u64> {
        let (head, length) = (self.read::<8>()?, self.read()?);
        let (found, expected) = (format!("{head:02x?}"), "02 00 00 00 55 4c 04 00, then a length");
        let fits = head == [2, 0, 0, 0, b'U', b'L', 4, 0];
        ensure(fits, &self.place, "FileMetaInformationGroupLength", found, expected)?;
        Ok(self.at + u64::from(u32::from_le_bytes(length)))
    }

    /// Walks over the fragments of a compressed image, up to their delimiter or the end of the file.
    fn pieces(mut self) -> Result<(PixelStorage, u64)> {
        let start = self.at;
        while self.at < self.size {
            let tag = self.read()?;
            let (tag, length) = (self.coding.tag(tag), self.read()?);
            match tag {
                ITEM => self.skip(tag, self.coding.word(length))?,
                SEQUENCE_END => break,
                _ => {
                    return Err(self.invalid(
                        "PixelData",
                        format!("{tag} at byte {}", self.at),
                        "a piece of a picture",
                    ));
                }
            }
        }
        Ok((PixelStorage::Packed(self.at - start), self.at))
    }

    /// The value representation of an element and its length, which must be a whole number of values; `rest` follows its
    /// tag.
    fn kind_and_length(&mut self, tag: Tag, rest: [u8; 4]) -> Result<(VR, u32)> {
        let (kind, length) = if self.coding.explicit {
            let [a, b, c, d] = rest;
            let kind = [a, b];
            if !kind.iter().all(u8::is_ascii_uppercase) {
                return Err(self.invalid(&format!("element {tag}"), format!("the kind {kind:02x?}"), "two letters"));
            }
            let kind = VR::from_binary(kind).unwrap_or(VR::UN);
            if SHORT.split(' ').any(|short| short == kind.to_string()) {
                (kind, u32::from(self.coding.half([c, d])))
            } else {
                let length = self.read()?;
                (kind, self.coding.word(length))
            }
        } else {
            let kind = StandardDataDictionary.by_tag(tag).map_or(VR::UN, |e| e.vr().relaxed());
            (kind, self.coding.word(rest))
        };
        let size = match kind {
            VR::US | VR::SS | VR::OW => 2,
            VR::UL | VR::SL | VR::FL | VR::AT | VR::OF | VR::OL => 4,
            VR::FD | VR::OD | VR::SV | VR::UV | VR::OV => 8,
            _ => 1,
        };
        // `dicom-object` reads whole values only and would take the rest for the next element.
        if length != UNDEFINED && !length.is_multiple_of(size) {
            let found = format!("a length of {length} bytes");
            let expected = format!("a multiple of {size}, which a value takes");
            return Err(self.invalid(&format!("element {tag}"), found, &expected));
        }
        Ok((kind, length))
    }

    /// The byte after an element of `length` bytes that starts here; it must lie in the file.
    fn end(&self, tag: Tag, length: u32) -> Result<u64> {
        let left = self.size - self.at;
        if u64::from(length) > left {
            let expected = format!("at most {left} bytes, which is what the file still has");
            return Err(self.invalid(&format!("element {tag}"), format!("a length of {length} bytes"), &expected));
        }
        Ok(self.at + u64::from(length))
    }

    fn skip(&mut self, tag: Tag, length: u32) -> Result<()> {
        self.at = self.end(tag, length)?;
        self.reader.seek_relative(i64::from(length)).map_err(|e| Error::io(&self.place, e))
    }

    fn starts_with_item(&mut self, length: u32) -> Result<bool> {
        if length < 8 {
            return Ok(false);
        }
        let tag = self.read()?;
        self.at -= 4;
        self.reader.seek_relative(-4).map_err(|e| Error::io(&self.place, e))?;
        Ok(self.coding.tag(tag) == ITEM)
    }

    fn read<const N: usize>(&mut self) -> Result<[u8; N]> {
        if self.size - self.at < N as u64 {
            let found = format!("the end of the file at byte {}", self.size);
            return Err(self.invalid("elements", found, "whole elements"));
        }
        self.at += N as u64;
        let mut out = [0; N];
        self.reader.read_exact(&mut out).map_err(|e| Error::io(&self.place, e))?;
        Ok(out)
    }

    fn invalid(&self, field: &str, found: impl ToString, expected: &str) -> Error {
        Error::invalid(&self.place, field, found, expected)
    }
}

fn coding(place: &str, syntax: Option<&str>) -> Result<Coding> {
    match syntax {
        None => Err(Error::invalid(place, "TransferSyntaxUID", "no such element", "one in the file's description")),
        Some("1.2.840.10008.1.2") => Ok(Coding { explicit: false, big: false }),
        Some("1.2.840.10008.1.2.2") => Ok(Coding { explicit: true, big: true }),
        // All supported compressed syntaxes are explicit. Deflated elements are not supported: there is nothing to walk
        // over, and they could hide a decompression bomb.
        Some(other) => super::pixels::packing(place, other).map(|_| Coding { explicit: true, big: false }),
    }
}
