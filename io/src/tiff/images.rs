//! How many images a TIFF holds by the text of its first page. ImageJ above 4 GiB and tifffile with `truncate` write
//! one directory, and all further images after the first one.

use serde_json::Value;

/// The images that an ImageDescription counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Claim {
    pub images: u64,
    /// Channels and points in time: volumes, if the images are slices.
    pub volumes: u64,
    /// Whether the text counts the pages of the whole file, not those of its first series.
    pub whole: bool,
}

/// What ImageJ shows for a stored 8- or 16-bit integer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Calibration {
    /// The first number plus the second times the integer. ImageJ writes signed 16-bit integers like that.
    Line([f64; 2]),
    /// The function of this number.
    Other(u32),
}

/// The value of `name` in ImageJ's lines.
pub(super) fn entry<'t>(text: &'t str, name: &str) -> Option<&'t str> {
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('=')).map(str::trim)
}

impl Calibration {
    /// The calibration in ImageJ's lines; `None` if it shows integers as they are stored.
    pub fn of(text: &str) -> Option<Self> {
        let number = |name| entry(text, name)?.parse::<f64>().ok().filter(|x| x.is_finite());
        let function: u32 = entry(text, "cf").filter(|_| text.starts_with("ImageJ="))?.parse().ok()?;
        match (function, number("c0"), number("c1")) {
            (0, Some(0.0), Some(1.0)) => None,
            (0, Some(at), Some(times)) => Some(Self::Line([at, times])),
            _ => Some(Self::Other(function)),
        }
    }
}

/// The claim of `text` for images of `rows` × `columns`: ImageJ's lines, tifffile's `{"shape": [...]}` or OME's XML.
pub(super) fn claimed(text: &str, [rows, columns]: [u64; 2]) -> Option<Claim> {
    let text = text.trim_start();
    if text.starts_with("ImageJ=") {
        let number = |name: &str| entry(text, name)?.parse::<u64>().ok();
        let volumes = number("channels").unwrap_or(1).saturating_mul(number("frames").unwrap_or(1));
        return Some(Claim { images: number("images")?, volumes, whole: true });
    }
    if text.starts_with('{') {
        return shaped(&serde_json::from_str(text.trim_end_matches('\0')).ok()?, [rows, columns]);
    }
    // A set of several files: the text counts the images of all. A file alone may name itself.
    let mut names = text.split("FileName=").skip(1).filter_map(|rest| rest.split(['"', '\'']).nth(1));
    if names.next().is_some_and(|first| names.any(|name| name != first)) {
        return None;
    }
    let (mut images, mut volumes) = (0u64, 0u64);
    // A prefix of the namespace may stand before the name.
    for (at, _) in text.match_indices("Pixels ").filter(|(at, _)| text[..*at].ends_with(['<', ':'])) {
        let element = &text[at..at + text[at..].find('>')?];
        let size = |name: &str| -> u64 {
            let value = element.split_once(&format!("{name}=")).and_then(|(_, v)| v.strip_prefix(['"', '\'']));
            value.and_then(|v| v.split(['"', '\'']).next()?.parse().ok()).unwrap_or(1)
        };
        let series = size("SizeC").saturating_mul(size("SizeT"));
        images = images.saturating_add(size("SizeZ").saturating_mul(series));
        volumes = volumes.saturating_add(series);
    }
    (images > 0).then_some(Claim { images, volumes, whole: true })
}

/// The claim of tifffile's `shape` and `axes`, whose last two axes are those of an image.
fn shaped(description: &Value, [rows, columns]: [u64; 2]) -> Option<Claim> {
    let shape: Vec<u64> = description.get("shape")?.as_array()?.iter().map(Value::as_u64).collect::<Option<_>>()?;
    let (&[first, second], outer) = shape.split_last_chunk::<2>().map(|(outer, image)| (image, outer))?;
    if [first, second] != [rows, columns] {
        return None;
    }
    let product = |all: &[u64]| all.iter().fold(1u64, |n, s| n.saturating_mul(*s));
    let axes = description.get("axes").and_then(Value::as_str).unwrap_or_default();
    let (slices, series) = outer.split_last().unwrap_or((&1, &[]));
    // The third axis from the end is the slices', unless it says otherwise.
    let other = axes.len() == shape.len() && axes.chars().rev().nth(2).is_some_and(|a| "CT".contains(a));
    let volumes = product(series).saturating_mul(if other { *slices } else { 1 });
    Some(Claim { images: product(outer), volumes, whole: false })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_programs_text_counts_its_images() {
        let found = |text: &str| claimed(text, [12, 16]).map(|c| (c.images, c.volumes));
        assert_eq!(found("ImageJ=1.54f\nimages=8\nslices=8\n"), Some((8, 1)));
        assert_eq!(found("ImageJ=1.54f\nimages=48\nchannels=2\nslices=8\nframes=3\n\0"), Some((48, 6)));
        assert_eq!(found("ImageJ=1.54f\nunit=mm\n"), None);
        assert_eq!(found("{\"shape\": [8, 12, 16], \"axes\": \"ZYX\", \"truncated\": true}\0"), Some((8, 1)));
        assert_eq!(found("{\"shape\": [2, 8, 12, 16]}"), Some((16, 2)));
        assert_eq!(found("{\"shape\": [8, 12, 16], \"axes\": \"TYX\"}"), Some((8, 8)));
        assert_eq!(found("{\"shape\": [12, 16]}"), Some((1, 1)));
        assert_eq!(found("{\"shape\": [12, 16, 3]}"), None);
        assert_eq!(found("{\"shape\": [-1, 12, 16]}"), None);
        let ome = "<?xml version=\"1.0\"?><OME><Image ID=\"Image:0\"><Pixels ID=\"P\" SizeX='16' SizeY='12' SizeZ='8' \
                   SizeC='1' SizeT=\"2\" Type=\"uint16\"><TiffData/></Pixels></Image></OME>";
        assert_eq!(found(ome), Some((16, 2)));
        assert_eq!(found(&ome.replace("<Pixels", "<OME:Pixels")), Some((16, 2)));
        assert_eq!(found(&ome.repeat(2)), Some((32, 4)));
        assert_eq!(found("<Pixels SizeZ="), None);
        assert_eq!(found("<Pixels SizeZ=>"), Some((1, 1)));
        assert_eq!(found("<Pixels SizeZ=é>"), Some((1, 1)));
        assert_eq!(found("a microscope with many Pixels "), None);
        assert_eq!(found(""), None);
    }
}
