//! Parsers of values from the command line and elsewhere. Errors are reported before any work.

use conefield_core::error::ensure;
use conefield_core::finite::range;
use conefield_core::scan::Volume;
use conefield_io::I0;
use conefield_projectors::simulate::{DetectorNoise, HuMapping};
use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::PathBuf;
use std::str::FromStr;

/// A hundred years: sums with the system clock stay far from overflow.
const LONGEST: f64 = 100.0 * 365.25 * 86400.0;

/// `600`, `600s`, `10m` or `1.5h` in seconds.
pub fn seconds(text: &str) -> Result<f64, String> {
    let (number, unit) = match text.trim_end_matches(|c: char| c.is_ascii_alphabetic()) {
        digits if digits.len() < text.len() => text.split_at(digits.len()),
        _ => (text, "s"),
    };
    let factor = match unit {
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("expected seconds (600s), minutes (10m) or hours (1h)".into()),
    };
    match number.parse::<f64>() {
        Ok(x) if x > 0.0 && x * factor <= LONGEST => Ok(x * factor),
        _ => Err("expected a positive time of at most 100 years, such as 600s, 10m or 1h".into()),
    }
}

/// `8GiB`, `500MiB`, `1.5G` or a number of bytes.
pub fn bytes(text: &str) -> Result<u64, String> {
    let form = "expected bytes such as 8GiB, 500MiB or 1000000000";
    let number = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let power = match text[number.len()..].to_ascii_lowercase().as_str() {
        "" | "b" => 0,
        "k" | "kib" => 1,
        "m" | "mib" => 2,
        "g" | "gib" => 3,
        "t" | "tib" => 4,
        _ => return Err(form.into()),
    };
    positive(number, form.trim_start_matches("expected ")).map(|x| (x * 1024f64.powi(power)) as u64)
}

/// Two numbers, separated by `separator`.
fn pair<T: FromStr>(text: &str, separator: char, form: &str) -> Result<[T; 2], String> {
    let parsed = text.split_once(separator).and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    parsed.ok_or_else(|| format!("expected {form}"))
}

/// `ROWSxCOLS`.
pub fn detector(text: &str) -> Result<[usize; 2], String> {
    let form = "ROWSxCOLS, such as 256x256";
    match pair(text, 'x', form)? {
        d if d.contains(&0) => Err(format!("expected {form}, both above 0")),
        d => Ok(d),
    }
}

/// `V,U` in mm.
pub fn offset(text: &str) -> Result<[f64; 2], String> {
    finite(pair(text, ',', "V,U in mm, such as 0,12.5")?)
}

/// `SIZE` or `V,U` in mm.
pub fn pixel(text: &str) -> Result<[f64; 2], String> {
    let form = "a size above 0 in mm, such as 0.8, or V,U such as 0.8,0.5";
    let both = if text.contains(',') { pair(text, ',', form)? } else { [positive(text, form)?; 2] };
    if finite(both)?.iter().all(|x| *x > 0.0) { Ok(both) } else { Err(format!("expected {form}")) }
}

fn finite(numbers: [f64; 2]) -> Result<[f64; 2], String> {
    if numbers.iter().all(|x| x.is_finite()) { Ok(numbers) } else { Err("expected finite numbers".into()) }
}

fn positive(text: &str, what: impl Display) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x.is_finite() => Ok(x),
        _ => Err(format!("expected {what}")),
    }
}

/// `none`, `tigre:I0,SIGMA` or `poisson:I0`.
pub fn noise(text: &str) -> Result<DetectorNoise, String> {
    text.parse().map_err(|e: conefield_core::Error| e.to_string())
}

/// `air` or a number of counts.
pub fn i0(text: &str) -> Result<I0, String> {
    match text {
        "air" => Ok(I0::Air),
        _ => positive(text, "a number of counts above 0, or air").map(I0::Number),
    }
}

/// Held-out views.
#[derive(Debug, Clone, PartialEq)]
pub enum HoldOut {
    /// The views with these indices, from 0.
    Views(Vec<usize>),
    /// One view of every n, from their middle.
    Every(usize),
}

impl HoldOut {
    /// Indices out of `n` views, unique and in ascending order.
    pub fn views(&self, n: usize) -> Vec<usize> {
        match self {
            Self::Views(v) => v.iter().copied().collect::<BTreeSet<_>>().into_iter().collect(),
            Self::Every(k) => (0..n).skip(k / 2).step_by(*k).collect(),
        }
    }
}

impl Display for HoldOut {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Views(views) => write!(f, "{}", views.iter().map(usize::to_string).collect::<Vec<_>>().join(",")),
            Self::Every(k) => write!(f, "every:{k}"),
        }
    }
}

/// `3,17` or `every:10`.
pub fn hold_out(text: &str) -> Result<HoldOut, String> {
    let form = || "expected view numbers from 0, such as 3,17, or every:10".to_owned();
    match text.split_once(':') {
        Some(("every", k)) => k.parse().ok().filter(|k| *k > 1).map(HoldOut::Every).ok_or_else(form),
        Some(_) => Err(form()),
        None => {
            let views: Option<Vec<usize>> = text.split(',').map(|v| v.trim().parse().ok()).collect();
            views.map(HoldOut::Views).ok_or_else(form)
        }
    }
}

/// Angles of the views.
#[derive(Debug, Clone, PartialEq)]
pub enum AnglesOption {
    /// Evenly spaced from `start` over `range` degrees, without the end.
    Even {
        /// The first angle, degrees.
        start: f64,
        /// Range in degrees.
        range: f64,
    },
    /// A file with one angle in degrees per line.
    File(PathBuf),
}

/// `START:RANGE` in degrees, or a file.
pub fn angles(text: &str) -> Result<AnglesOption, String> {
    match pair::<f64>(text, ':', "") {
        Ok([start, range]) if start.is_finite() && range.is_finite() && range != 0.0 => {
            Ok(AnglesOption::Even { start, range })
        }
        Ok(_) => Err("expected START:RANGE in degrees, such as 0:360, with a range other than 0".into()),
        Err(_) => Ok(AnglesOption::File(text.into())),
    }
}

/// `LO,HI` in Hounsfield units.
pub fn hu(text: &str) -> Result<[f64; 2], String> {
    let form = "LO,HI in Hounsfield units with LO below HI, such as -1000,2000";
    let both = finite(pair(text, ',', form)?)?;
    if both[0] < both[1] { Ok(both) } else { Err(format!("expected {form}")) }
}

/// Meaning of voxel values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Values {
    /// Attenuation in the unit of the scan.
    AsIs,
    /// Hounsfield units, mapped to attenuation in 1/mm or to [0, 1].
    Hu(HuMapping),
}

/// Attenuation is not negative. The noise of a reconstruction stays above this; Hounsfield units of air are far below.
const LEAST: f32 = -50.0;

/// Refuses the volume `name` if its values are not attenuation, but probably Hounsfield units.
pub fn must_be_attenuation(name: &str, volume: &Volume) -> conefield_core::Result<()> {
    let [low, high] = range(&volume.data);
    let expected = "attenuation, which is not negative (Hounsfield units? --values hu:0.02 of simulate and convert makes \
                    attenuation, with water 0.02 per mm; clip:-1000,2000 numbers from 0 to 1)";
    ensure(low >= LEAST, name, "values", format!("{low} to {high}"), expected)
}

impl Values {
    /// Maps the volume `name`, which is to be projected, to attenuation. Refuses values taken as they are that are not attenuation,
    /// and warns of negative ones.
    pub fn attenuation(self, name: &str, volume: Volume) -> conefield_core::Result<Volume> {
        let volume = self.apply(volume)?;
        if self == Self::AsIs {
            must_be_attenuation(name, &volume)?;
            let [low, high] = range(&volume.data);
            if low < -0.1 * high.max(0.0) {
                tracing::warn!("{name} has values from {low} to {high}: attenuation is not negative (--values)");
            }
        }
        Ok(volume)
    }

    /// Maps the volume to attenuation.
    pub fn apply(self, volume: Volume) -> conefield_core::Result<Volume> {
        match self {
            Self::AsIs => Ok(volume),
            Self::Hu(mapping) => mapping.apply(volume),
        }
    }
}

/// `as-is`, `hu:MU_WATER` or `clip:LO,HI`.
pub fn values(text: &str) -> Result<Values, String> {
    let form = "as-is, hu:MU_WATER (in 1/mm) such as hu:0.02, or clip:LO,HI such as clip:-1000,2000";
    match text.split_once(':') {
        None if text == "as-is" => Ok(Values::AsIs),
        Some(("hu", water)) => Ok(Values::Hu(HuMapping::Mu { mu_water: positive(water, form)? })),
        Some(("clip", both)) => match finite(pair(both, ',', form)?)? {
            [low, high] if low < high => Ok(Values::Hu(HuMapping::Clip { low, high })),
            _ => Err("expected clip:LO,HI with LO below HI".into()),
        },
        _ => Err(format!("expected {form}")),
    }
}

/// A positive finite number.
pub fn above_zero(text: &str) -> Result<f64, String> {
    positive(text, "a number above 0")
}

/// A share: above 0, at most 1.
pub fn share(text: &str) -> Result<f64, String> {
    let form = "a share above 0 and at most 1, such as 0.5";
    positive(text, form).and_then(|x| if x <= 1.0 { Ok(x) } else { Err(format!("expected {form}")) })
}

/// `K/N`: the K-th of N parts, starting at 1.
pub fn part(text: &str) -> Result<[usize; 2], String> {
    let form = "K/N, such as 1/4: the first of four";
    match pair(text, '/', form)? {
        [k, n] if (1..=n).contains(&k) => Ok([k, n]),
        _ => Err(format!("expected {form}, K from 1 to N")),
    }
}

/// Held-out views, or none.
#[derive(Debug, Clone, PartialEq)]
pub struct HoldOutOrNone(pub Option<HoldOut>);

/// Like [`hold_out`], or `none`.
pub fn hold_out_or_none(text: &str) -> Result<HoldOutOrNone, String> {
    let views = if text == "none" { None } else { Some(hold_out(text)?) };
    Ok(HoldOutOrNone(views))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_parse_and_refuse() {
        assert_eq!(seconds("600s"), Ok(600.0));
        assert_eq!(seconds("10m"), Ok(600.0));
        assert_eq!(seconds("1.5h"), Ok(5400.0));
        assert_eq!(seconds("90"), Ok(90.0));
        for bad in ["", "s", "-3s", "3x", "nan", "inf", "0", "1e999s", "1e20"] {
            assert!(seconds(bad).is_err(), "{bad}");
        }
        assert_eq!([bytes("8GiB"), bytes("1.5m"), bytes("77")], [Ok(8 << 30), Ok(3 << 19), Ok(77)]);
        for bad in ["", "GiB", "-1G", "3 GiB", "1GB", "nan"] {
            assert!(bytes(bad).is_err(), "{bad}");
        }
        assert_eq!(detector("64x96"), Ok([64, 96]));
        assert_eq!((pixel("0.8"), pixel("0.8,0.5")), (Ok([0.8; 2]), Ok([0.8, 0.5])));
        assert!(["0", "0,1", "-1", "inf", "1,", "a"].iter().all(|bad| pixel(bad).is_err()));
        assert!(detector("64").is_err() && detector("0x4").is_err() && detector("4x-1").is_err());
        assert_eq!(noise("tigre:1e4,10"), Ok(DetectorNoise::Tigre { i0: 1e4, sigma: 10.0 }));
        assert_eq!(noise("poisson:1e5"), Ok(DetectorNoise::Poisson { i0: 1e5 }));
        assert!(noise("poisson:0").is_err() && noise("tigre:1e4").is_err() && noise("salt").is_err());
        assert_eq!((i0("air"), i0("2e4")), (Ok(I0::Air), Ok(I0::Number(2e4))));
        assert!(i0("0").is_err() && i0("water").is_err());
        assert_eq!(hold_out("3,17"), Ok(HoldOut::Views(vec![3, 17])));
        assert_eq!(hold_out("every:10").unwrap().views(25), [5, 15]);
        assert_eq!(hold_out("7,3,7").unwrap().views(25), [3, 7]);
        assert_eq!(hold_out_or_none("none"), Ok(HoldOutOrNone(None)));
        assert!(hold_out_or_none("no").is_err());
        assert_eq!(share("1"), Ok(1.0));
        assert_eq!((part("2/3"), part("1/1")), (Ok([2, 3]), Ok([1, 1])));
        assert!(part("0/3").is_err() && part("4/3").is_err() && part("2").is_err() && part("1/0").is_err());
        assert!(share("0").is_err() && share("1.01").is_err() && share("nan").is_err());
        assert!(hold_out("every:1").is_err() && hold_out("a").is_err());
        assert_eq!(angles("0:360"), Ok(AnglesOption::Even { start: 0.0, range: 360.0 }));
        assert_eq!(angles("a.txt"), Ok(AnglesOption::File("a.txt".into())));
        assert!(angles("0:0").is_err());
        assert_eq!(values("hu:0.02"), Ok(Values::Hu(HuMapping::Mu { mu_water: 0.02 })));
        assert_eq!(values("clip:-1000,2000"), Ok(Values::Hu(HuMapping::Clip { low: -1000.0, high: 2000.0 })));
        assert_eq!(hu("-1000,2000"), Ok([-1000.0, 2000.0]));
        assert!(hu("2,1").is_err() && hu("1").is_err() && hu("0,inf").is_err());
        assert!(values("clip:3,1").is_err() && values("hu:-1").is_err());
    }
}
