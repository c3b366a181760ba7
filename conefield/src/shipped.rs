//! The files in this crate's folder `specs`, embedded in the program: specs by name, weights, levers and the front.

use conefield_core::spec::load::Shipped;

macro_rules! shipped {
    ($($name:literal)*) => {
        &[$(Shipped { name: $name, text: include_str!(concat!("../specs/", $name, ".toml")) },)*]
    };
}

/// The specs.
pub const SHIPPED: &[Shipped] = shipped! {
    "naf"
    "ni-naf"
    "ni-naf-published"
    "nerf"
    "sax-nerf"
    "dense"
    "accurate"
    "balanced"
    "fast"
    "field-tv"
    "accurate-tv"
    "fdk"
    "os-sart"
    "sirt"
    "fista-tv"
    "smooth-tv"
    "smooth-patches"
    "limited-angle"
    "smooth-gaussians"
    "gaussians"
    "gaussians-published"
};

/// MCI weights for the spec `fast`, as a safetensors file.
pub const FAST_WEIGHTS: &[u8] = include_bytes!("../specs/weights/fast.safetensors");

/// Which settings a search varies.
pub const LEVERS: &str = include_str!("../specs/tradeoff/levers.toml");

/// Methods none of which is beaten in time and accuracy.
pub const FRONT: &str = include_str!("../specs/tradeoff/front.toml");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_is_shipped() {
        let folder = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/specs")).unwrap();
        let mut files: Vec<String> = folder
            .filter_map(|e| e.unwrap().file_name().into_string().unwrap().strip_suffix(".toml").map(str::to_owned))
            .collect();
        let mut names: Vec<&str> = SHIPPED.iter().map(|s| s.name).collect();
        files.sort();
        names.sort();
        assert_eq!(files, names);
    }
}
