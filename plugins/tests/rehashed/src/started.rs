//! The built-in initializers `mci` and `volume` as plugin types: one gets weights read by the host, the other a known
//! volume.

use conefield_fields::initializers::mci::Mci;
use conefield_fields::initializers::volume::FromVolume;
use conefield_plugin::prelude::*;

macro_rules! stands_for {
    ($($name:literal $own:ident $other:ident;)*) => {$(
        stage_type!(InitializerSpec, $name, $own, "as the built-in one does it");

        #[derive(Serialize, Deserialize, JsonSchema)]
        #[serde(transparent)]
        struct $own($other);

        impl InitializerSpec for $own {
            fn build(&self, weights: &dyn Fn(&str) -> Result<Weights>) -> Result<Box<dyn Initializer>> {
                self.0.build(weights)
            }
        }
    )*};
}

stands_for! {
    "again-mci" AgainMci Mci;
    "again-volume" AgainVolume FromVolume;
}
