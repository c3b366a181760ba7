//! All weights from a file, to continue training or rendering a model of an earlier run.

use conefield_core::input_file::InputFile;
use conefield_core::prelude::*;

/// Settings of `checkpoint`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CheckpointSettings {
    /// The weights file. It must contain every weight of the pipeline, in the same shape.
    pub weights: InputFile,
}

conefield_core::stage_type!(
    InitializerSpec,
    "checkpoint",
    CheckpointSettings,
    "every weight from a file",
    example = r#"{"weights": "weights.safetensors"}"#
);

impl InitializerSpec for CheckpointSettings {
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        ensure(!self.weights.is_empty(), "spec", "weights", "no name", "a weights file")?;
        Ok(Box::new(CheckpointInitializer { path: self.weights.to_string(), weights: weights(&self.weights)? }))
    }
}

/// The initializer that [`CheckpointSettings`] builds.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckpointInitializer {
    path: String,
    weights: Weights,
}

impl Initializer for CheckpointInitializer {
    fn check(&self, layout: &Layout) -> Result<()> {
        self.weights.check(&self.path, layout, |_| true).map(drop)
    }

    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        self.weights.load(&self.path, layout, &mut arena.params, |_| true)
    }

    fn describe(&self) -> String {
        format!("checkpoint: every weight from {}", self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::arena::Block;
    use conefield_core::error::Error;

    #[test]
    fn everything_is_loaded_and_a_missing_file_is_reported() {
        let block = Block { name: "encoder.0.table".into(), shape: vec![2], range: 0..2 };
        let layout = Layout { blocks: vec![block] };
        let weights = Weights::from_arena(&layout, &[1.0, 2.0], |_| true);
        let settings = CheckpointSettings { weights: "w".into() };
        let mut arena = Arena::new(2);
        let built = settings.build(&|_| Ok(weights.clone())).unwrap();
        assert_eq!(built.apply(&layout, &mut arena).unwrap().loaded, ["encoder.0.table"]);
        assert_eq!(*arena.params, [1.0, 2.0]);
        assert!(settings.build(&|p| Err(Error::invalid(p, "file", "nothing", "weights"))).is_err());
        assert!(CheckpointSettings { weights: InputFile::default() }.build(&|_| Ok(Weights::default())).is_err());
    }
}
