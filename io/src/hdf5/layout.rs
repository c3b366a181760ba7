//! Where known layouts keep projections, open beam, dark field and angles.

use super::{Container, ScanPart};
use conefield_core::Result;
use hdf5_reader::Dataset;

/// What a name in a file refers to: a data set, or a scan in a known layout.
pub(super) enum Layout {
    /// A plain data set.
    Plain(Box<Dataset>),
    /// A scan of Data Exchange: `data`, `data_white`, `data_dark` and `theta` in the group `exchange`.
    Exchange(String),
    /// A scan with frames of all kinds in one data set, distinguished by an image key (0 projection, 1 open beam, 2 dark, 3
    /// unusable).
    Keyed {
        frames: String,
        /// Absent: all frames are projections.
        keys: Option<String>,
        angles: Vec<String>,
    },
}

/// Data sets in a group `G` that may hold frames, with the possible places of their image keys and angles: NXtomo, then
/// CIL's writer.
const KEYED: &[(&str, &[&str], &[&str])] = &[
    (
        "instrument/detector/data",
        &["instrument/detector/image_key"],
        &["sample/rotation_angle", "sample/transformations/rotation_angle", "data/rotation_angle"],
    ),
    ("data/data", &["data/image_key", "instrument/detector/image_key"], &["config/angles", "data/rotation_angle"]),
];

/// Most groups at the root that are searched.
const MOST_GROUPS: usize = 1000;

impl Layout {
    /// The data set `name`, or the scan in the group `name`; without a name, the only scan in the file.
    pub fn find(file: &Container, name: Option<&str>) -> Result<Self> {
        if let Some(data) = name.and_then(|n| file.data(n)) {
            return Ok(Self::Plain(Box::new(data)));
        }
        let groups = match name {
            Some(group) => vec![group.trim_matches('/').to_owned()],
            None => file.root_groups(),
        };
        let mut found: Vec<(String, Self)> = Vec::new();
        for group in groups.into_iter().take(MOST_GROUPS) {
            let exchange = [group.clone(), format!("{group}/exchange")];
            let exchange = exchange.into_iter().find(|g| is_exchange(file, g)).map(|g| (g.clone(), Self::Exchange(g)));
            let keyed = || [group.clone(), format!("{group}/tomo_entry")].into_iter().find_map(|g| keyed(file, &g));
            found.extend(exchange.or_else(keyed));
        }
        match (found.len(), name) {
            (1, _) => Ok(found.remove(0).1),
            (0, Some(name)) => {
                let expected = "a data set, or a group with a scan (DXchange, NXtomo, CIL) in it";
                Err(file.invalid(name, "no such thing", expected))
            }
            (0, None) => {
                let expected = "DXchange (/exchange/data), NXtomo (/entry/instrument/detector/data) or CIL's layout \
                                (/entry1/tomo_entry/data/data); FILE.h5:/PATH takes any other data set";
                Err(file.invalid("layout", "none that is known", expected))
            }
            (n, _) => {
                let groups: Vec<&str> = found.iter().take(10).map(|(g, _)| g.as_str()).collect();
                let expected = format!("FILE.h5:/GROUP with one of them: {}", groups.join(", "));
                Err(file.invalid("layout", format!("{n} scans"), expected))
            }
        }
    }

    /// The data set with the frames of `part`, and which of them belong to it.
    pub fn frames(&self, file: &Container, part: ScanPart) -> Result<(Dataset, Option<Vec<bool>>)> {
        match self {
            Self::Plain(data) => Ok((*data.clone(), None)),
            Self::Exchange(group) => {
                let name = match part {
                    ScanPart::Projections => "data",
                    ScanPart::Flat => "data_white",
                    ScanPart::Dark => "data_dark",
                };
                Ok((file.needed(&format!("{group}/{name}"))?, None))
            }
            Self::Keyed { frames, .. } => {
                let data = file.needed(frames)?;
                // CIL names the axes.
                if let Some(axis) = file.text_attribute(&data, "dim0").filter(|axis| axis != "angle") {
                    return Err(file.invalid(&format!("{frames} @dim0"), format!("\"{axis}\""), "\"angle\""));
                }
                let (key, what) = match part {
                    ScanPart::Projections => (0, "key 0 (projections)"),
                    ScanPart::Flat => (1, "key 1 (open beam)"),
                    ScanPart::Dark => (2, "key 2 (dark field)"),
                };
                match self.keys(file)? {
                    None if part == ScanPart::Projections => Ok((data, None)),
                    None => Err(file.invalid(frames, "no image_key", format!("image keys, and frames of {what}"))),
                    Some(keys) if !keys.contains(&key) => {
                        Err(file.invalid("image_key", "no such frame", format!("frames of {what}")))
                    }
                    Some(keys) => {
                        file.one_each(&data, keys.len(), file.shape(&data)?.first().copied().unwrap_or_default())?;
                        Ok((data, Some(keys.iter().map(|k| *k == key).collect())))
                    }
                }
            }
        }
    }

    /// The angles of all frames, with the frames' image keys; the numbers of a plain data set.
    pub fn angles(&self, file: &Container) -> Result<(Dataset, Option<Vec<i64>>)> {
        match self {
            Self::Plain(data) => Ok((*data.clone(), None)),
            Self::Exchange(group) => Ok((file.needed(&format!("{group}/theta"))?, None)),
            Self::Keyed { angles, .. } => {
                let data = match angles.iter().find_map(|a| file.data(a)) {
                    Some(data) => data,
                    None => file.needed(&angles[0])?,
                };
                // CIL keeps angles of projections only.
                let keys = self.keys(file)?.filter(|k| data.shape() == [k.len() as u64]);
                Ok((data, keys))
            }
        }
    }

    fn keys(&self, file: &Container) -> Result<Option<Vec<i64>>> {
        let Self::Keyed { keys: Some(keys), .. } = self else { return Ok(None) };
        let values = file.small(&file.needed(keys)?)?;
        Ok(Some(values.into_iter().map(|k| k as i64).collect()))
    }
}

fn is_exchange(file: &Container, group: &str) -> bool {
    group.rsplit('/').next() == Some("exchange") && file.data(&format!("{group}/data")).is_some()
}

fn keyed(file: &Container, group: &str) -> Option<(String, Layout)> {
    let (frames, keys, angles) = KEYED.iter().find(|(f, ..)| file.data(&format!("{group}/{f}")).is_some())?;
    let within = |name: &&str| format!("{group}/{name}");
    let layout = Layout::Keyed {
        frames: within(frames),
        keys: keys.iter().map(within).find(|k| file.data(k).is_some()),
        angles: angles.iter().map(within).collect(),
    };
    Some((group.to_owned(), layout))
}
