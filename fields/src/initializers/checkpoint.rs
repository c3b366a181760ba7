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
    use crate::initializers::mci::Mci;
    use conefield_core::arena::Block;

    fn layout() -> Layout {
        let names = ["encoder.0.table", "normalizers.0.weight", "field.0.weight"].into_iter().zip([0..3, 3..5, 5..6]);
        let block = |(name, range): (&str, std::ops::Range<usize>)| Block {
            name: name.to_owned(),
            shape: vec![range.len()],
            range,
        };
        Layout { blocks: names.map(block).collect() }
    }

    fn weights() -> Weights {
        Weights::from_arena(&layout(), &[9.0; 6], |_| true)
    }

    fn mci(weights: Weights) -> Box<dyn Initializer> {
        Mci { weights: "w.safetensors".into() }.build(&|_| Ok(weights.clone())).unwrap()
    }

    #[test]
    fn everything_or_everything_but_the_encoder_is_loaded() {
        let mut arena = Arena::new(6);
        let report = mci(weights()).apply(&layout(), &mut arena).unwrap();
        assert_eq!(*arena.params, [0.0, 0.0, 0.0, 9.0, 9.0, 9.0]);
        assert_eq!(report.loaded, ["normalizers.0.weight", "field.0.weight"]);
        assert_eq!(report.fresh[0].0, "encoder.0.table");
        assert_eq!(report.unused[0].0, "encoder.0.table");
        let all = CheckpointSettings { weights: "w".into() }.build(&|_| Ok(weights())).unwrap();
        assert_eq!(all.apply(&layout(), &mut arena).unwrap().loaded.len(), 3);
        assert_eq!(*arena.params, [9.0; 6]);
    }

    #[test]
    fn missing_files_and_weights_are_refused() {
        let settings = CheckpointSettings { weights: "w".into() };
        assert!(settings.build(&|p| Err(Error::invalid(p, "file", "nothing", "weights"))).is_err());
        assert!(CheckpointSettings { weights: InputFile::default() }.build(&|_| Ok(Weights::default())).is_err());
        let (mut weights, mut arena) = (weights(), Arena::new(6));
        let mut refused = |weights: &Weights, words: &[&str]| {
            let e = mci(weights.clone()).apply(&layout(), &mut arena).unwrap_err().to_string();
            assert!(words.iter().all(|word| e.contains(word)), "{e}");
        };
        weights.tensors.remove("field.0.weight");
        refused(&weights, &["w.safetensors", "field.0.weight"]);
        weights.tensors.insert("field.0.weight".into(), (vec![1, 1], vec![1.0]));
        refused(&weights, &["[1, 1]", "[1]"]);
        assert_eq!(*arena.params, [0.0; 6]);
        let bare = Layout { blocks: layout().blocks[..1].to_vec() };
        let e = mci(Weights::default()).apply(&bare, &mut Arena::new(3)).unwrap_err().to_string();
        assert!(e.contains("mci"), "{e}");
    }
}
