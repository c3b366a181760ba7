//! Properties of a stage's settings: they are unchanged after writing and reading.

use crate::Report;
use crate::call::settle;
use conefield_core::registry::{Settings, read};
use serde::Serialize;
use serde_json::{Value, json};

/// Writes and reads the settings of the type `name`: the defaults, also given by the name only, and `settings`.
pub fn check_settings<T>(name: &str, settings: &Value) -> Report
where
    T: Settings + Serialize + ?Sized + 'static,
{
    let mut report = Report::of(format!("settings of {} {name:?}", T::KIND));
    let written = |value: Value| -> Result<Value, String> {
        let settings: Box<T> = read(value)?;
        serde_json::to_value(&settings).map_err(|e| e.to_string())
    };
    report.add("save and load", || {
        let mut table = settings.clone();
        table["type"] = json!(name);
        let twice = written(table.clone()).and_then(|once| Ok((once.clone(), written(once)?)));
        let complaint = match twice {
            Err(e) => Some(e),
            Ok((once, twice)) if once != twice => Some(format!("{once}, read again {twice}")),
            Ok((once, _)) => {
                let lost = table.as_object().into_iter().flatten().find(|(key, value)| once[key.as_str()] != **value);
                lost.map(|(key, value)| format!("{key} = {value} is written as {}", once[key.as_str()]))
            }
        };
        settle(complaint, "what was set is written and read again")
    });
    report.add("a name alone", || {
        let complaint = match (written(json!(name)), written(json!({ "type": name }))) {
            (Ok(a), Ok(b)) if a == b => None,
            (a, b) => Some(format!("{a:?} against {b:?}")),
        };
        settle(complaint, "stands for the default settings")
    });
    report
}
