//! Translates kernels to HLSL (for DX12) and to Metal's language, to find constructs that these lack. No driver of those
//! systems compiles the result here.

use naga::back::{hlsl, msl};
use naga::valid::ModuleInfo;
use naga::{Module, Scalar, TypeInner};

/// Refuses a module that a language cannot say.
pub fn check(module: &Module, info: &ModuleInfo) -> Result<(), String> {
    all(module, info).into_iter().try_for_each(|(language, text)| match text {
        Ok(_) => Ok(()),
        Err(why) => Err(format!("{language}: {why}")),
    })
}

/// The module in each language that its devices could be asked for, or why not.
fn all(module: &Module, info: &ModuleInfo) -> Vec<(&'static str, Result<String, String>)> {
    // DX12 has no atomic sums of f32, and never reports them.
    let sums = module.types.iter().any(|(_, t)| t.inner == TypeInner::Atomic(Scalar::F32));
    let hlsl = (!sums).then(|| ("HLSL", hlsl(module, info)));
    hlsl.into_iter().chain([("Metal", metal(module, info))]).collect()
}

fn hlsl(module: &Module, info: &ModuleInfo) -> Result<String, String> {
    let options = hlsl::Options { shader_model: hlsl::ShaderModel::V6_0, ..Default::default() };
    let (mut text, pipeline) = (String::new(), hlsl::PipelineOptions::default());
    hlsl::Writer::new(&mut text, &options, &pipeline).write(module, info, None).map_err(|e| e.to_string())?;
    Ok(text)
}

fn metal(module: &Module, info: &ModuleInfo) -> Result<String, String> {
    let options = msl::Options { lang_version: (3, 0), ..Default::default() };
    let pipeline = msl::PipelineOptions::default();
    msl::write_string(module, info, &options, &pipeline).map(|(text, _)| text).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use naga::front::wgsl::parse_str;
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    fn translated(text: &str) -> Vec<(&'static str, Result<String, String>)> {
        let module = parse_str(text).unwrap();
        let info = Validator::new(ValidationFlags::all(), Capabilities::all()).validate(&module).unwrap();
        all(&module, &info)
    }

    #[test]
    fn a_kernel_is_said_in_both_languages() {
        let text = "@group(0) @binding(0) var<storage, read_write> a: array<f32>;
            @compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3<u32>) { a[id.x] *= 2.0; }";
        let found = translated(text);
        let holds = |language, word| found.iter().any(|(l, t)| *l == language && t.as_ref().unwrap().contains(word));
        assert!(holds("HLSL", "numthreads(64, 1, 1)") && holds("Metal", "kernel void"), "{found:?}");
    }

    /// Constants that are known only when a pipeline is made.
    #[test]
    fn what_cannot_be_said_is_an_error() {
        let found = translated(
            "override factor: f32;
            @group(0) @binding(0) var<storage, read_write> a: array<f32>;
            @compute @workgroup_size(64) fn main(@builtin(global_invocation_id) id: vec3<u32>) { a[id.x] *= factor; }",
        );
        assert!(found.len() == 2 && found.iter().all(|(_, t)| t.is_err()), "{found:?}");
    }
}
