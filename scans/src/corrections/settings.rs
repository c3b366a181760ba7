//! Parses the corrections of a command line.

use crate::corrections::Corrections;
use conefield_core::{Error, Result, written};
use toml::{Table, Value};

/// The place in errors.
const PLACE: &str = "corrections";
/// Largest nesting depth of a setting's name.
const DEEPEST: usize = 3;

impl Corrections {
    /// Parses texts such as `rings`, `rings.window=21` or `hardening.polynomial=[1.0, 0.05]`: the name of a correction,
    /// with its default settings, or one setting of it. Values are TOML; anything else is a string. Refuses unknown
    /// names and settings, and invalid values.
    pub fn parse<S: AsRef<str>>(texts: &[S]) -> Result<Self> {
        let mut all = Value::Table(Table::new());
        for text in texts {
            let text = text.as_ref().trim();
            let (path, value) = match text.split_once('=') {
                Some((path, value)) => (path.trim(), read(value.trim())),
                None => (text, Value::Table(Table::new())),
            };
            let keys: Vec<&str> = path.split('.').map(str::trim).collect();
            if keys.len() > DEEPEST || keys.iter().any(|k| k.is_empty()) {
                let expected =
                    "the name of a correction, such as rings, or one of its settings, such as rings.window=21";
                return Err(Error::invalid(PLACE, "name", format!("\"{text}\""), expected));
            }
            let one = keys.iter().rev().fold(value, |inner, key| Table::from_iter([(key.to_string(), inner)]).into());
            if !merge(&mut all, one) {
                let found = format!("\"{text}\" and another value for the same setting");
                return Err(Error::invalid(PLACE, path, found, "each setting once"));
            }
        }
        let text = toml::to_string(&all).map_err(|e| Error::invalid(PLACE, "settings", e, "TOML"))?;
        let read: Self = written::read(PLACE, &text).map_err(|mut e| {
            // Lines and columns of this text say nothing.
            if let Error::Invalid { place, .. } = &mut e {
                *place = PLACE.into();
            }
            e
        })?;
        read.validate()?;
        Ok(read)
    }
}

/// `error` with the name of the correction that it belongs to.
pub(crate) fn placed(error: Error, name: &str) -> Error {
    match error.within(name) {
        Error::Invalid { place, field, found, expected } if place == "spec" => {
            Error::invalid(PLACE, field, found, expected)
        }
        other => other,
    }
}

/// A TOML value, or else a string.
fn read(text: &str) -> Value {
    let parsed = format!("value = {text}").parse::<Table>().ok().filter(|t| t.len() == 1);
    parsed.and_then(|mut t| t.remove("value")).unwrap_or_else(|| Value::String(text.to_owned()))
}

/// Adds `more` to `there`; false if both give a setting.
fn merge(there: &mut Value, more: Value) -> bool {
    let (Value::Table(there), Value::Table(more)) = (there, more) else { return false };
    more.into_iter().all(|(key, value)| match there.get_mut(&key) {
        Some(old) => merge(old, value),
        None => there.insert(key, value).is_none(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::corrections::{Hardening, RingMethod, Rings};

    #[test]
    fn names_settings_and_words_are_read() {
        let c = Corrections::parse(&["rings", "flux"]).unwrap();
        assert_eq!((c.rings, c.flux.is_some(), c.pixels), (Some(Rings::default()), true, None));
        for order in [
            ["rings.window=21", "rings.method=sorting"],
            ["rings.method = \"sorting\"", "rings.window = 21"],
            ["rings={ window = 21 }", "rings={ method = 'sorting' }"],
        ] {
            let c = Corrections::parse(&order).unwrap();
            assert_eq!(c.rings, Some(Rings { window: 21, method: RingMethod::Sorting }));
        }
        let c = Corrections::parse(&["rings={ window = 21 }", "rings"]).unwrap();
        assert_eq!(c.rings, Some(Rings { window: 21, ..Rings::default() }));
        let c = Corrections::parse(&["hardening.polynomial=[1.0, 0.05]"]).unwrap();
        assert_eq!(c.hardening, Some(Hardening { polynomial: vec![1.0, 0.05], water: None }));
        let c = Corrections::parse(&["hardening.water.kvp=120"]).unwrap();
        assert_eq!(c.hardening.unwrap().water.unwrap().kvp, 120.0);
        assert!(Corrections::parse::<&str>(&[]).unwrap().is_none());
    }

    #[test]
    fn invalid_texts_are_refused_with_a_clear_message() {
        for (texts, words) in [
            (vec!["ring"], vec!["ring", "rings"]),
            (vec!["rings.windows=3"], vec!["windows", "window"]),
            (vec!["rings.window=4"], vec!["rings.window", "4", "odd"]),
            (vec!["rings.window=3", "rings.window=5"], vec!["window", "once"]),
            (
                vec!["rings.size=3"],
                vec!["rings.size: found a key that is not known here, expected one of method, window"],
            ),
            (vec!["rings=3"], vec!["corrections: rings: found 3, expected a table"]),
            (vec!["rings", "rings=3"], vec!["once"]),
            (vec!["rings..window=3"], vec!["rings..window=3"]),
            (vec!["a.b.c.d.e=1"], vec!["a.b.c.d.e=1"]),
            (vec!["hardening"], vec!["hardening", "polynomial", "water"]),
            (vec!["hardening.polynomial=[nan]"], vec!["hardening.polynomial"]),
            (vec!["low-counts"], vec!["photons"]),
            (vec!["low-counts.photons=0"], vec!["low-counts.photons"]),
            (vec!["scatter.share=2"], vec!["scatter.share"]),
            (vec!["flux.rows=[5, 5]"], vec!["flux.rows"]),
            (vec!["rings.window=5\nrest=7"], vec!["rest=7"]),
        ] {
            let e = Corrections::parse(&texts).unwrap_err().to_string();
            assert!(words.iter().all(|w| e.contains(w)), "{texts:?}: {e}");
        }
    }
}
