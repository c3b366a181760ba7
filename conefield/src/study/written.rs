//! A study file as written by the user.

use crate::backend::BackendChoice;
use crate::parse::{self, AnglesOption, HoldOut};
use conefield_core::words::plural;
use conefield_projectors::simulate::DetectorNoise;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::value::MapAccessDeserializer;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::borrow::Cow;
use std::fmt;
use std::marker::PhantomData;
use std::num::{NonZeroU16, NonZeroU64, NonZeroUsize};
use std::str::FromStr;
use toml::Spanned;

/// A study: methods on scans with several seeds. Paths are relative to this file.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "conefield study")]
pub struct Written {
    /// Short name, the title of the table [default: the file's name].
    pub name: Option<String>,
    /// The purpose of the study, in a sentence.
    #[serde(default)]
    pub description: String,
    /// Volumes to simulate: a scan for each seed and number of views. A string is the volume.
    #[serde(default)]
    #[schemars(with = "Vec<Entry<WrittenVolume>>")]
    pub volumes: Vec<Spanned<Entry<WrittenVolume>>>,
    /// Existing scans. A string is the scan.
    #[serde(default)]
    #[schemars(with = "Vec<Entry<WrittenScan>>")]
    pub scans: Vec<Spanned<Entry<WrittenScan>>>,
    /// The methods, in the order of the table. A string is the spec.
    #[schemars(with = "Vec<Entry<WrittenSpec>>")]
    pub specs: Vec<Spanned<Entry<WrittenSpec>>>,
    /// Seeds of the simulated noise and of all random numbers of a method [default: 0].
    #[schemars(with = "Option<Vec<u64>>")]
    pub seeds: Option<Spanned<Vec<u64>>>,
    /// Numbers of views to simulate [default: the protocol's; r2: 50].
    #[schemars(with = "Option<Vec<NonZeroUsize>>")]
    pub views: Option<Spanned<Vec<NonZeroUsize>>>,
    /// The method that the others are compared with, on the same scan and with the same seed.
    #[schemars(with = "Option<String>")]
    pub baseline: Option<Spanned<String>>,
    /// Values shown as black and white in pictures, in 1/unit of the scan [default: the range of the reference].
    #[schemars(with = "Option<[f32; 2]>")]
    pub window: Option<Spanned<[f32; 2]>>,
    /// How scans are simulated, as in "conefield simulate".
    #[serde(default)]
    #[schemars(with = "WrittenSimulation")]
    pub simulate: Option<Spanned<WrittenSimulation>>,
    /// Options of every run, as in "conefield compare".
    #[serde(default)]
    #[schemars(with = "Protocol")]
    pub protocol: Option<Spanned<Protocol>>,
}

/// A volume to simulate.
#[derive(Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WrittenVolume {
    /// A file, or phantom:head, phantom:abdomen or phantom:random:SEED, each optionally with :SIZE.
    pub volume: String,
    /// Its name in tables and folders [default: the file's name].
    pub name: Option<String>,
    /// Meaning of the voxel values: as-is, hu:MU_WATER or clip:LO,HI [default: as-is].
    pub values: Option<String>,
    /// Average blocks with this many voxels per side first [default: 1].
    pub downsample: Option<NonZeroU16>,
    /// The window of this volume.
    pub window: Option<[f32; 2]>,
}

/// An existing scan.
#[derive(Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WrittenScan {
    /// The file or folder.
    pub scan: String,
    /// Its name in tables and folders [default: the file's name].
    pub name: Option<String>,
    /// The reference: a file, or "truth" for the one in the scan [default: the protocol's].
    pub reference: Option<String>,
    /// The window of this scan.
    pub window: Option<[f32; 2]>,
}

/// A method.
#[derive(Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WrittenSpec {
    /// A shipped spec, a method type or a file.
    pub spec: String,
    /// Its name in tables and folders [default: the spec's own].
    pub name: Option<String>,
    /// Settings to change, as in --set: "encoder.levels=8".
    #[serde(default)]
    pub set: Vec<String>,
    /// Weights of "conefield pretrain", or a volume, to start from.
    pub init: Option<String>,
}

/// How scans are simulated.
#[derive(Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WrittenSimulation {
    /// The geometry: r2, the published synthetic set-up, or a TOML or JSON file [default: r2].
    pub protocol: Option<String>,
    /// Rows and columns of the detector at the same size in mm, such as 256x256 [default: the protocol's; r2: 512x512].
    #[serde(deserialize_with = "detector")]
    #[schemars(with = "Option<String>")]
    pub detector: Option<[usize; 2]>,
    /// Shift of the detector along v (from row to row) and u (from column to column), V,U in mm.
    #[serde(deserialize_with = "offset")]
    #[schemars(with = "Option<String>")]
    pub offset: Option<[f64; 2]>,
    /// Angles in degrees: START:RANGE for even steps, or a file with one per line.
    #[serde(deserialize_with = "angles")]
    #[schemars(with = "Option<String>")]
    pub angles: Option<AnglesOption>,
    /// none, tigre:I0,SIGMA such as tigre:1e4,10 (the published one), or poisson:I0 [default: the protocol's; r2:
    /// none].
    #[serde(deserialize_with = "noise")]
    #[schemars(with = "Option<String>")]
    pub noise: Option<DetectorNoise>,
}

/// Options of every run.
#[derive(Debug, Clone, Default, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Protocol {
    /// Stop training after this time, such as 600s or 10m.
    #[serde(deserialize_with = "seconds", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub seconds: Option<f64>,
    /// Stop training after this many steps or passes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<NonZeroU64>,
    /// Stop training after this time at the latest.
    #[serde(deserialize_with = "seconds", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub at_most: Option<f64>,
    /// Time of the whole run.
    #[serde(deserialize_with = "seconds", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub budget: Option<f64>,
    /// Views to hold out and predict, such as 3,17 or every:10.
    #[serde(deserialize_with = "hold_out", serialize_with = "shown", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub hold_out: Option<HoldOut>,
    /// The reference of existing scans: a file, or "truth" for the one in the scan. Simulated scans are compared with
    /// their truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference: Option<String>,
    /// The data range for PSNR and SSIM [default: 1 for a reference in [0, 1] that exceeds 0.5, else its range].
    #[serde(deserialize_with = "above_zero", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<f64>")]
    pub peak: Option<f64>,
    /// Settings to change in every spec, as in --set.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
    /// auto, cpu, wgpu, wgpu:N or wgpu:N,M [default: auto].
    #[serde(deserialize_with = "backend", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub backend: Option<BackendChoice>,
    /// Time between two checkpoints [default: 60s].
    #[serde(deserialize_with = "seconds", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<String>")]
    pub checkpoint_every: Option<f64>,
}

impl Protocol {
    /// Text for people, without the reference.
    pub fn words(&self) -> Vec<String> {
        use conefield_evaluation::report::text::{duration, number};
        let mut words: Vec<String> = vec![];
        words.extend(self.hold_out.as_ref().map(|h| format!("views {h} held out")));
        words.extend(self.steps.map(|n| format!("{} {}", number(n.get()), plural(n.get(), "step"))));
        words.extend(self.seconds.map(|t| format!("{} of training", duration(t))));
        words.extend(self.budget.map(|t| format!("budget {}", duration(t))));
        words.extend(self.at_most.map(|t| format!("at most {}", duration(t))));
        words.extend(self.set.iter().map(|s| format!("`{s}`")));
        words
    }
}

/// A table, or a string as a short form for a table with only its first key.
#[derive(Debug)]
pub struct Entry<T>(pub T);

impl From<String> for WrittenVolume {
    fn from(volume: String) -> Self {
        Self { volume, ..Self::default() }
    }
}

impl From<String> for WrittenScan {
    fn from(scan: String) -> Self {
        Self { scan, ..Self::default() }
    }
}

impl From<String> for WrittenSpec {
    fn from(spec: String) -> Self {
        Self { spec, ..Self::default() }
    }
}

impl<'de, T: Deserialize<'de> + From<String>> Deserialize<'de> for Entry<T> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Either<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de> + From<String>> Visitor<'de> for Either<T> {
            type Value = Entry<T>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a text or a table")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
                Ok(Entry(T::from(text.into())))
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Self::Value, A::Error> {
                T::deserialize(MapAccessDeserializer::new(map)).map(Entry)
            }
        }
        from.deserialize_any(Either(PhantomData))
    }
}

impl<T: JsonSchema> JsonSchema for Entry<T> {
    fn inline_schema() -> bool {
        true
    }
    fn schema_name() -> Cow<'static, str> {
        format!("{}Entry", T::schema_name()).into()
    }
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        json_schema!({ "anyOf": [{ "type": "string" }, generator.subschema_for::<T>()] })
    }
}

/// A string or a number.
struct Text(String);

impl<'de> Deserialize<'de> for Text {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Any;
        impl Visitor<'_> for Any {
            type Value = Text;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a text or a number")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Text, E> {
                Ok(Text(text.into()))
            }
            fn visit_u64<E: Error>(self, number: u64) -> Result<Text, E> {
                Ok(Text(number.to_string()))
            }
            fn visit_i64<E: Error>(self, number: i64) -> Result<Text, E> {
                Ok(Text(number.to_string()))
            }
            fn visit_f64<E: Error>(self, number: f64) -> Result<Text, E> {
                Ok(Text(number.to_string()))
            }
        }
        from.deserialize_any(Any)
    }
}

/// Parses a value in the notation of the command line.
fn said<'de, D: Deserializer<'de>, T>(
    from: D,
    parse: impl Fn(&str) -> Result<T, String>,
) -> Result<Option<T>, D::Error> {
    let Text(text) = Text::deserialize(from)?;
    parse(&text).map(Some).map_err(|e| {
        let expected = e.rsplit_once("expected ").map_or(&e[..], |(_, expected)| expected);
        D::Error::custom(format_args!("{text:?}, expected {expected}"))
    })
}

/// Functions that deserialize a setting which is written as on the command line.
macro_rules! as_on_the_command_line {
    ($($name:ident: $type:ty = $parse:path;)*) => {$(
        fn $name<'de, D: Deserializer<'de>>(from: D) -> Result<Option<$type>, D::Error> {
            said(from, $parse)
        }
    )*};
}

as_on_the_command_line! {
    seconds: f64 = parse::seconds;
    above_zero: f64 = parse::above_zero;
    hold_out: HoldOut = parse::hold_out;
    backend: BackendChoice = BackendChoice::from_str;
    detector: [usize; 2] = parse::detector;
    offset: [f64; 2] = parse::offset;
    angles: AnglesOption = parse::angles;
    noise: DetectorNoise = parse::noise;
}

fn shown<S: Serializer>(held: &Option<HoldOut>, to: S) -> Result<S::Ok, S::Error> {
    match held {
        Some(held) => to.collect_str(held),
        None => to.serialize_none(),
    }
}
