//! Properties of a stage's settings: they are unchanged after writing and reading.

use crate::call::{failed, require, settle};
use crate::{Report, Unmet};
use conefield_core::registry::{Settings, read};
use serde::Serialize;
use serde_json::{Value, json};

/// Writes and reads the settings of the type `name`: the defaults, also given by the name only, and `settings`.
pub fn check_settings<T>(name: &str, settings: &Value) -> Report
where
    T: Settings + Serialize + ?Sized + 'static,
{
    let mut report = Report::of(format!("settings of {} {name:?}", T::KIND));
    let written = |value: Value| -> Result<Value, Unmet> {
        let settings: Box<T> = read(value).or_else(failed)?;
        serde_json::to_value(&settings).or_else(|e| failed(e.to_string()))
    };
    report.add("save and load", || {
        let mut table = settings.clone();
        table["type"] = json!(name);
        let once = written(table.clone())?;
        let twice = written(once.clone())?;
        require(once == twice, || format!("{once}, read again {twice}"))?;
        let lost = table.as_object().into_iter().flatten().find(|(key, value)| once[key.as_str()] != **value);
        let complaint = lost.map(|(key, value)| format!("{key} = {value} is written as {}", once[key.as_str()]));
        settle(complaint, "what was set is written and read again")
    });
    report.add("a name alone", || {
        let (a, b) = (written(json!(name))?, written(json!({ "type": name }))?);
        require(a == b, || format!("{a} against {b}"))?;
        Ok("stands for the default settings".into())
    });
    report
}
