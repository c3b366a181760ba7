//! Sets the flag `fast_weights` where the demonstration's weights have been trained.

fn main() {
    let weights = "../specs/weights/fast.safetensors";
    println!("cargo::rustc-check-cfg=cfg(fast_weights)");
    println!("cargo::rerun-if-changed={weights}");
    if std::path::Path::new(weights).is_file() {
        println!("cargo::rustc-cfg=fast_weights");
    }
}
