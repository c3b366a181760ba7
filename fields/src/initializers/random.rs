//! Seeded random initialization of every stage by its own scheme.

use conefield_core::prelude::*;

/// Settings of `random`: none, as the schemes belong to the stages.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Random {}

conefield_core::stage_type!(InitializerSpec, "random", Random, "every stage by its own seeded scheme");

impl InitializerSpec for Random {
    fn build(&self, _: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        Ok(Box::new(self.clone()))
    }
}

impl Initializer for Random {
    fn apply(&self, layout: &Layout, _: &mut Arena) -> Result<InitReport> {
        let fresh = layout.blocks.iter().map(|b| (b.name.clone(), "random".into())).collect();
        Ok(InitReport { fresh, ..InitReport::default() })
    }

    fn describe(&self) -> String {
        "random: every stage by its own scheme".into()
    }
}
