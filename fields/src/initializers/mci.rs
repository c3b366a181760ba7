//! Mapping-consistency initialization (Xu et al. 2025, NI-NeRF, section 2.4): the map from features to attenuation
//! comes from a model trained on a known volume; the features themselves start afresh.
//!
//! Loads the weights of the normalizers and the field, that is every block whose name does not start with `encoder.`.
//! Refuses a file that lacks a block or has it in another shape.

use super::checkpoint::FromWeights;
use conefield_core::input_file::InputFile;
use conefield_core::prelude::*;

/// Settings of `mci`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Mci {
    /// The weights file of the trained model.
    pub weights: InputFile,
}

conefield_core::stage_type!(
    InitializerSpec,
    "mci",
    Mci,
    "normalizers and field from a trained model, a fresh encoder",
    example = r#"{"weights": "weights.safetensors"}"#
);

impl InitializerSpec for Mci {
    fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
        FromWeights::read(&self.weights, weights, false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::arena::Block;

    fn layout() -> Layout {
        let block =
            |name: &str, from: usize, to: usize| Block { name: name.into(), shape: vec![to - from], range: from..to };
        Layout {
            blocks: vec![
                block("encoder.0.table", 0, 3),
                block("normalizers.0.weight", 3, 5),
                block("field.0.weight", 5, 6),
            ],
        }
    }

    fn build(weights: Weights) -> Box<dyn Initializer> {
        Mci { weights: "w.safetensors".into() }.build(&|_| Ok(weights.clone())).unwrap()
    }

    #[test]
    fn the_encoder_stays_fresh_and_the_rest_is_loaded() {
        let weights = Weights::from_arena(&layout(), &[9.0; 6], |_| true);
        let mut arena = Arena::new(6);
        let report = build(weights).apply(&layout(), &mut arena).unwrap();
        assert_eq!(*arena.params, [0.0, 0.0, 0.0, 9.0, 9.0, 9.0]);
        assert_eq!(report.loaded, ["normalizers.0.weight", "field.0.weight"]);
        assert_eq!(report.fresh[0].0, "encoder.0.table");
        assert_eq!(report.unused[0].0, "encoder.0.table");
    }

    #[test]
    fn missing_and_misshapen_weights_are_refused() {
        let mut weights = Weights::from_arena(&layout(), &[9.0; 6], |_| true);
        weights.tensors.remove("field.0.weight");
        let mut arena = Arena::new(6);
        let e = build(weights.clone()).apply(&layout(), &mut arena).unwrap_err().to_string();
        assert!(e.contains("w.safetensors") && e.contains("field.0.weight"), "{e}");
        weights.tensors.insert("field.0.weight".into(), (vec![1, 1], vec![1.0]));
        let e = build(weights).apply(&layout(), &mut arena).unwrap_err().to_string();
        assert!(e.contains("[1, 1]") && e.contains("[1]"), "{e}");
        assert_eq!(*arena.params, [0.0; 6]);
    }

    #[test]
    fn a_pipeline_without_anything_to_load_is_refused() {
        let mut bare = layout();
        bare.blocks.truncate(1);
        let e = build(Weights::default()).apply(&bare, &mut Arena::new(3)).unwrap_err().to_string();
        assert!(e.contains("mci"), "{e}");
    }
}
