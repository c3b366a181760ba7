//! The text of a kernel in pieces. An error names the piece that causes it.

use conefield_core::error::{Error, Result};
use std::sync::OnceLock;
use wgpu::naga;

/// Checks a valid kernel.
pub type Check = fn(&naga::Module, &naga::valid::ModuleInfo) -> Result<(), String>;

/// A further check of every kernel. Tests set it, to translate kernels for systems that are not at hand.
pub static EXTRA_CHECK: OnceLock<Check> = OnceLock::new();

/// How a kernel accesses a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Uniform values.
    Uniform,
    /// Read only.
    Read,
    /// Read and written.
    Write,
}

/// A buffer that a kernel uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Binding {
    /// Its name in the text and among the buffers.
    pub name: String,
    /// How the kernel accesses it.
    pub access: Access,
}

/// The text of a kernel and the buffers that it uses.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Source {
    text: String,
    /// Of each piece: its name, and the line after its last.
    pieces: Vec<(String, usize)>,
    bindings: Vec<Binding>,
}

impl Source {
    /// Appends a piece. Errors in it name `name`.
    pub fn add(&mut self, name: &str, text: &str) {
        self.text += text;
        self.text.push('\n');
        self.pieces.push((name.into(), self.text.lines().count()));
    }

    /// Declares a buffer of WGSL type `ty`.
    pub fn bind(&mut self, name: &str, access: Access, ty: &str) {
        let space = match access {
            Access::Uniform => "uniform",
            Access::Read => "storage, read",
            Access::Write => "storage, read_write",
        };
        let at = self.bindings.len();
        self.add("bindings", &format!("@group(0) @binding({at}) var<{space}> {name}: {ty};"));
        self.bindings.push(Binding { name: name.into(), access });
    }

    /// The whole text.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The buffers, in order.
    pub fn bindings(&self) -> &[Binding] {
        &self.bindings
    }

    /// Storage buffers among them.
    pub fn storage_buffers(&self) -> u32 {
        self.bindings.iter().filter(|b| b.access != Access::Uniform).count() as u32
    }

    /// Refuses invalid WGSL; the error names the piece and the line in it.
    pub fn validate(&self) -> Result<()> {
        let module = match naga::front::wgsl::parse_str(&self.text) {
            Ok(module) => module,
            Err(e) => return Err(self.fault(e.location(&self.text).map(|l| l.line_number as usize), e.message())),
        };
        use naga::valid::Capabilities;
        let capabilities =
            Capabilities::SHADER_FLOAT32_ATOMIC | Capabilities::SHADER_FLOAT16_IN_FLOAT32 | Capabilities::SUBGROUP;
        let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
        let info = validator.validate(&module).map_err(|e| {
            let line = e.location(&self.text).map(|l| l.line_number as usize);
            let mut why = e.as_inner().to_string();
            let mut cause = std::error::Error::source(e.as_inner());
            while let Some(c) = cause {
                why += &format!(": {c}");
                cause = c.source();
            }
            self.fault(line, &why)
        })?;
        EXTRA_CHECK.get().map_or(Ok(()), |check| check(&module, &info).map_err(|why| self.fault(None, &why)))
    }

    /// An error in line `line` (from 1) of the text.
    fn fault(&self, line: Option<usize>, why: &str) -> Error {
        let Some(line) = line else { return Error::unsupported("the composed WGSL", why) };
        let mut first = 1;
        for (name, end) in &self.pieces {
            if line <= *end {
                let text = self.text.lines().nth(line - 1).unwrap_or_default().trim();
                return Error::unsupported(
                    format!("WGSL of {name}, line {}", line - first + 1),
                    format!("{why}: {text}"),
                );
            }
            first = end + 1;
        }
        Error::unsupported("the composed WGSL", why)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_piece_and_its_line() {
        let mut source = Source::default();
        source.add("first", "fn one() -> f32 {\n    return 1.0;\n}\n");
        source.add("encoder (mine)", "fn two() -> f32 {\n    let x = one();\n    return y;\n}");
        source.add("last", "fn three() {}");
        let e = source.validate().unwrap_err().to_string();
        assert!(e.contains("encoder (mine), line 3") && e.contains("return y;"), "{e}");
        let mut source = Source::default();
        source.add("first", "fn one() -> f32 { return 1.0; }");
        source.add("field (mine)", "\nfn two() -> u32 {\n    return one();\n}");
        let e = source.validate().unwrap_err().to_string();
        assert!(e.contains("field (mine), line"), "{e}");
    }

    #[test]
    fn what_is_valid_passes() {
        let mut source = Source::default();
        source.bind("a", Access::Write, "array<atomic<f32>>");
        source.add("main", "@compute @workgroup_size(64) fn main() { atomicAdd(&a[0], 1.0); }");
        source.validate().unwrap();
        assert_eq!(source.storage_buffers(), 1);
    }
}
