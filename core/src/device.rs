//! A device that runs kernels in WGSL on its buffers. A field with its own line integrals uses it to train on a GPU.
//! Other stages give WGSL of one row instead ([`crate::wgsl`]).

use crate::error::{Error, Result};
use crate::wgsl::{self, Fragment};

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

/// The text of a kernel in pieces, and the buffers that it uses. Its entry point is `main`.
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

    /// An error in line `line` (from 1) of the text.
    pub fn fault(&self, line: Option<usize>, why: &str) -> Error {
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

/// The WGSL of the stage called `name`. Refuses a stage without WGSL, and names that could collide with another stage's.
pub fn fragment_of(name: &str, fragment: Option<Fragment>) -> Result<Fragment> {
    let refused = |why: &str| Error::unsupported(format!("{name} on the wgpu backend"), why);
    let fragment = fragment.ok_or_else(|| refused("the stage offers no WGSL; it runs with --backend cpu"))?;
    match fragment.stray() {
        Some(stray) => {
            Err(refused(&format!("its WGSL declares {stray}, expected names that begin with {}", wgsl::PREFIX)))
        }
        None => Ok(fragment),
    }
}

/// Kernels and named buffers on a device. A kernel finds its buffers by their names.
pub trait Device: Send {
    /// Its name for users.
    fn name(&self) -> String;
    /// Whether the machine's own memory and processors do the work.
    fn is_software(&self) -> bool;
    /// Bytes of the largest buffer.
    fn most_bytes(&self) -> u64;
    /// Refuses a program that cannot run here.
    fn admits(&self, program: &Program) -> Result<()>;
    /// Makes sure that there is a buffer `name` of at least `bytes`. A new one is zero, and replaces a smaller one.
    fn reserve(&mut self, name: &str, bytes: u64) -> Result<()>;
    /// Overwrites the first bytes of a buffer, which is made if it is missing or too small.
    fn write(&mut self, name: &str, data: &[u8]) -> Result<()>;
    /// Reads a buffer from byte `at` on, when all kernels have ended.
    fn read(&mut self, name: &str, at: u64, out: &mut [u8]) -> Result<()>;
    /// Copies bytes from one buffer to the beginning of another.
    fn copy(&mut self, from: &str, at: u64, to: &str, bytes: u64) -> Result<()>;
    /// Runs kernels one after another. Does not wait for their end.
    fn run(&mut self, launches: &[Launch<'_>]) -> Result<()>;
}

/// A kernel with its name for messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Program {
    /// Its name, one of a kind on its device.
    pub label: String,
    /// Its text and its buffers.
    pub source: Source,
}

/// A kernel, and the number of its workgroups: at most this many, as the device allows. A kernel uses `num_workgroups`.
pub type Launch<'a> = (&'a Program, usize);
