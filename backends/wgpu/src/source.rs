//! Checks the text of kernels. An error names the piece that causes it.

use conefield_core::device::Source;
use conefield_core::error::Result;
use std::sync::OnceLock;
use wgpu::naga;

/// Checks a valid kernel.
pub type Check = fn(&naga::Module, &naga::valid::ModuleInfo) -> Result<(), String>;

/// A further check of every kernel. Tests set it, to translate kernels for systems that are not at hand.
pub static EXTRA_CHECK: OnceLock<Check> = OnceLock::new();

/// Refuses invalid WGSL; the error names the piece and the line in it.
pub fn validate(source: &Source) -> Result<()> {
    let module = match naga::front::wgsl::parse_str(source.text()) {
        Ok(module) => module,
        Err(e) => return Err(source.fault(e.location(source.text()).map(|l| l.line_number as usize), e.message())),
    };
    use naga::valid::Capabilities;
    let capabilities =
        Capabilities::SHADER_FLOAT32_ATOMIC | Capabilities::SHADER_FLOAT16_IN_FLOAT32 | Capabilities::SUBGROUP;
    let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
    let info = validator.validate(&module).map_err(|e| {
        let line = e.location(source.text()).map(|l| l.line_number as usize);
        let mut why = e.as_inner().to_string();
        let mut cause = std::error::Error::source(e.as_inner());
        while let Some(c) = cause {
            why += &format!(": {c}");
            cause = c.source();
        }
        source.fault(line, &why)
    })?;
    EXTRA_CHECK.get().map_or(Ok(()), |check| check(&module, &info).map_err(|why| source.fault(None, &why)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_core::device::Access;

    /// Native sums of gradients are no part of plain WGSL. Uniform values take no storage buffer.
    #[test]
    fn sums_of_numbers_are_valid_and_their_buffers_are_counted() {
        let mut source = Source::default();
        source.bind("rule", Access::Uniform, "vec4<f32>");
        source.bind("values", Access::Read, "array<f32>");
        source.bind("sums", Access::Write, "array<atomic<f32>>");
        source.add("sum", "@compute @workgroup_size(1) fn main() { atomicAdd(&sums[0], rule.x * values[0]); }");
        validate(&source).unwrap();
        assert_eq!(source.storage_buffers(), 2);
    }

    #[test]
    fn an_error_names_the_piece_and_its_line() {
        let mut source = Source::default();
        source.add("first", "fn one() -> f32 {\n    return 1.0;\n}\n");
        source.add("encoder (mine)", "fn two() -> f32 {\n    let x = one();\n    return y;\n}");
        source.add("last", "fn three() {}");
        let e = validate(&source).unwrap_err().to_string();
        assert!(e.contains("encoder (mine), line 3") && e.contains("return y;"), "{e}");
        let mut source = Source::default();
        source.add("first", "fn one() -> f32 { return 1.0; }");
        source.add("field (mine)", "\nfn two() -> u32 {\n    return one();\n}");
        let e = validate(&source).unwrap_err().to_string();
        assert!(e.contains("field (mine), line"), "{e}");
    }
}
