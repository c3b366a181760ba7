use conefield_plugin::prelude::*;

conefield_plugin::export!();
stage_type!(@kind@Spec, "@name@", Settings, @doc@);

/// Settings in a spec.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
@settings@
}

impl Default for Settings {
    fn default() -> Self {
        Self { @defaults@ }
    }
}
