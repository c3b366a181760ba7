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
        FromWeights::read(&self.weights, weights, true)
    }
}

/// Fills parameters from a weights file: all, or all but those of the encoder.
pub(crate) struct FromWeights {
    path: String,
    weights: Weights,
    encoder: bool,
}

impl FromWeights {
    /// Reads `file`; `encoder` says whether the encoder is filled, too.
    pub fn read(
        file: &InputFile,
        weights: &dyn Fn(&str) -> Result<Weights>,
        encoder: bool,
    ) -> Result<Box<dyn Initializer>> {
        ensure(!file.is_empty(), "spec", "weights", "no name", "a weights file")?;
        Ok(Box::new(Self { path: file.to_string(), weights: weights(file)?, encoder }))
    }

    /// Whether a block of this name is filled.
    fn takes(&self, name: &str) -> bool {
        self.encoder || !name.starts_with("encoder.")
    }
}

impl Initializer for FromWeights {
    fn check(&self, layout: &Layout) -> Result<()> {
        if !self.encoder && !layout.blocks.iter().any(|b| self.takes(&b.name)) {
            return Err(Error::unsupported("mci", "neither normalizers nor field of this pipeline have weights"));
        }
        self.weights.check(&self.path, layout, |name| self.takes(name)).map(drop)
    }

    fn apply(&self, layout: &Layout, arena: &mut Arena) -> Result<InitReport> {
        self.check(layout)?;
        let mut report = self.weights.load(&self.path, layout, &mut arena.params, |name| self.takes(name))?;
        for (_, why) in &mut report.fresh {
            *why = "the encoder starts afresh".into();
        }
        Ok(report)
    }

    fn describe(&self) -> String {
        match (self.encoder, &self.path) {
            (true, path) => format!("checkpoint: every weight from {path}"),
            (false, path) => format!("mci: normalizers and field from {path}, a fresh encoder"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::arena::Block;

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
