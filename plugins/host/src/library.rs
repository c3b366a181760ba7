//! Libraries and their tables.

// All unsafe code here reads what a library says about itself. Wrong pointers cannot be detected; lengths, versions,
// numbers and texts are checked before use.
#![allow(unsafe_code)]

use crate::examine;
use crate::exit::inside;
use conefield_core::error::{Error, Result, ensure};
use conefield_core::registry::Kind;
use conefield_plugin_abi::*;
use serde_json::Value;
use std::any::Any;
use std::collections::BTreeMap;
use std::ffi::c_void;
use std::mem::{MaybeUninit, offset_of};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::{fmt, ptr, slice};

/// Longest text in a table.
const LONGEST_TEXT: usize = 1 << 20;
/// Size in bytes of a stage's table in the first minor version, which ended with `basis`.
const FIRST_STAGE: usize = offset_of!(ConefieldStage, basis) + size_of::<*const ConefieldBasis>();
/// Maximum number of stages in a library.
const MOST_STAGES: usize = 1024;

/// Largest entry of the table of stages, in bytes: later versions may append fields.
const MOST_STAGE: usize = 4096;

/// A loaded library.
pub struct Library {
    /// Its file.
    pub path: PathBuf,
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Its licence.
    pub licence: String,
    /// The contract version that it was built with.
    pub abi: (u32, u32),
    /// Its stage types; their tables have been checked.
    pub types: Vec<Arc<Type>>,
}

/// A stage type of a library.
pub struct Type {
    /// Its kind.
    pub kind: Kind,
    /// Its name in specs.
    pub name: String,
    /// A one-line description.
    pub doc: String,
    /// JSON Schema of its settings.
    pub schema: Value,
    /// The library in readable form.
    pub owner: String,
    pub(crate) functions: Functions,
    context: *const c_void,
    create: CreateFn,
    destroy: unsafe extern "C" fn(*mut c_void),
    describe: unsafe extern "C" fn(*const c_void, *mut ConefieldText) -> ConefieldStatus,
}

type CreateFn =
    unsafe extern "C" fn(*const c_void, ConefieldStr, usize, *mut *mut c_void, *mut ConefieldText) -> ConefieldStatus;

// SAFETY: its pointers lead into the library, which is never unloaded, and the contract allows its functions to be
// called from any thread.
unsafe impl Send for Type {}
// SAFETY: as above; nothing here is mutated.
unsafe impl Sync for Type {}

/// The table of functions of one kind, such as a [`ConefieldMap`].
pub(crate) type Functions = Box<dyn Any + Send + Sync>;

/// Reads the functions of a stage as the list of the contract has them.
macro_rules! tables {
    ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {
        /// The kind of the stage `t` and its functions; `at` describes the stage in words.
        unsafe fn functions(t: &ConefieldStage, place: &str, at: &str) -> Result<(Kind, Functions)> {
            match t.kind {
                $($($code)|+ => {
                    let kind = [$(($code, Kind::$kind)),+].into_iter().find(|(code, _)| *code == t.kind);
                    let (what, least) = (format!("{at}: functions"), $table::FIRST_SIZE);
                    // SAFETY: see the top of this file.
                    let table = unsafe { sized(t.$field, place, &what, least)? };
                    if let Some(missing) = table.missing() {
                        return Err(Error::invalid(place, at, format!("no function {missing}"), "one"));
                    }
                    kind.map(|(_, kind)| (kind, Box::new(table) as Functions))
                })*
                _ => None,
            }
            .ok_or_else(|| {
                let known = [$($($code),+),*].len() - 1;
                Error::invalid(place, at, format!("kind {}", t.kind), format!("0 to {known}"))
            })
        }
    };
}

conefield_plugin_abi::kinds! { tables }

/// Checks dependencies between functions, beyond the required ones.
fn consistent(functions: &dyn Any) -> Result<(), (&'static str, &'static str)> {
    let of_projector = |p: &ConefieldProjector| p.integrate.is_some() != p.adjoint.is_some();
    if functions.downcast_ref().is_some_and(of_projector) {
        return Err(("one of integrate and adjoint", "both or none"));
    }
    let of_initializer = |i: &ConefieldInitializer| i.weights.is_some() && i.with_weights.is_none();
    if functions.downcast_ref().is_some_and(of_initializer) {
        return Err(("no function with_weights", "one"));
    }
    Ok(())
}

impl Library {
    /// Loads the library at `path` and reads its tables. A file loaded before is read again from memory.
    pub fn open(path: &Path) -> Result<Self> {
        let real = path.canonicalize().map_err(|e| Error::io(path, e))?;
        let place = path.display().to_string();
        ensure(real.is_file(), &place, "plugin", "no file", "a shared library")?;
        examine::whole(&real, &place)?;
        let plugin = table_of(&real, &place)?;
        // SAFETY: the library returned this table, which lives as long as the library.
        unsafe { Self::read(&real, &place, plugin) }
    }

    unsafe fn read(path: &Path, place: &str, plugin: *const ConefieldPlugin) -> Result<Self> {
        // Size and version come first and are read before any field that may differ between versions.
        let bad = |field: &str, found: &dyn fmt::Display, expected: &str| Error::invalid(place, field, found, expected);
        ensure(!plugin.is_null() && plugin.is_aligned(), place, "plugin table", "nothing", "a table")?;
        // SAFETY: see the top of this file; both fields are at the start of the table in every version.
        let (size, major) =
            unsafe { (ptr::addr_of!((*plugin).size).read(), ptr::addr_of!((*plugin).abi_major).read()) };
        if size < offset_of!(ConefieldPlugin, name) {
            return Err(bad("plugin table", &format!("{size} bytes"), "a table with a version"));
        }
        // SAFETY: as above.
        let minor = unsafe { ptr::addr_of!((*plugin).abi_minor).read() };
        if major != CONEFIELD_ABI_MAJOR {
            let expected = format!(
                "{CONEFIELD_ABI_MAJOR}.x, as this conefield has it; build the plugin against conefield {}",
                env!("CARGO_PKG_VERSION")
            );
            return Err(bad("ABI version", &format!("{major}.{minor}"), &expected));
        }
        // SAFETY: see the top of this file.
        let t: ConefieldPlugin = unsafe { sized(plugin, place, "plugin table", size_of::<ConefieldPlugin>())? };
        // SAFETY: as above.
        let (name, version, licence) = unsafe {
            (text(t.name, place, "name")?, text(t.version, place, "version")?, text(t.licence, place, "licence")?)
        };
        ensure(!name.is_empty(), place, "name", "nothing", "the plugin's name")?;
        ensure((1..=MOST_STAGES).contains(&t.stage_count), place, "stages", t.stage_count, "1 to 1024")?;
        ensure(
            (FIRST_STAGE..=MOST_STAGE).contains(&t.stage_size)
                && t.stage_size.is_multiple_of(align_of::<ConefieldStage>()),
            place,
            "stage table",
            format!("{} bytes per stage", t.stage_size),
            format!("{FIRST_STAGE} to {MOST_STAGE}"),
        )?;
        ensure(!t.stages.is_null() && t.stages.is_aligned(), place, "stages", "nothing", "a table")?;
        let owner = format!("{name} {version} ({})", path.display());
        let mut types = vec![];
        for i in 0..t.stage_count {
            // SAFETY: see the top of this file.
            let stage = unsafe { grown(t.stages.byte_add(i * t.stage_size), t.stage_size) };
            // SAFETY: as above.
            types.push(Arc::new(unsafe { Type::read(&stage, place, i, &owner)? }));
        }
        Ok(Self { path: path.into(), name, version, licence, abi: (major, minor), types })
    }

    /// The library in readable form.
    pub fn owner(&self) -> String {
        format!("{} {} ({})", self.name, self.version, self.path.display())
    }
}

/// Tables of loaded libraries, by file. Libraries are never unloaded: stages and thread-local data of the system may
/// outlive any point at which that would be safe.
static TABLES: Mutex<BTreeMap<PathBuf, usize>> = Mutex::new(BTreeMap::new());

/// The table of the library at `path`.
fn table_of(path: &Path, place: &str) -> Result<*const ConefieldPlugin> {
    let mut tables = TABLES.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(&table) = tables.get(path) {
        return Ok(table as *const ConefieldPlugin);
    }
    // SAFETY: the system runs the library's constructors. That is what the user asks for by naming the file.
    let library = unsafe { libloading::Library::new(path) };
    let library = library.map_err(|e| {
        let why = std::error::Error::source(&e).map_or_else(|| e.to_string(), ToString::to_string);
        Error::invalid(place, "plugin", why, "a shared library for this system")
    })?;
    // SAFETY: a function of this name has the contract's signature, or the file is not a plugin.
    let entry = unsafe { library.get::<ConefieldEntry>(ENTRY) }.map(|f| *f);
    let Ok(entry) = entry else {
        let found = format!("a library without the function {ENTRY}");
        return Err(Error::invalid(place, "plugin", found, "a conefield plugin"));
    };
    // SAFETY: as above.
    let table = inside(|| unsafe { entry() });
    std::mem::forget(library);
    tables.insert(path.into(), table as usize);
    Ok(table)
}

/// Reads a table that starts with its size.
///
/// It has at least the first `least` bytes, the size in the first minor version. Missing functions become NULL.
unsafe fn sized<T>(table: *const T, place: &str, what: &str, least: usize) -> Result<T> {
    ensure(!table.is_null() && table.is_aligned(), place, what, "nothing", "a table")?;
    // SAFETY: every table begins with its size.
    let size = unsafe { table.cast::<usize>().read() };
    ensure(size >= least, place, what, format!("{size} bytes"), format!("at least {least}: the table is too short"))?;
    // SAFETY: the table states this size.
    Ok(unsafe { grown(table, size) })
}

/// Copies a table of `size` bytes, which may be larger in a later version.
unsafe fn grown<T>(table: *const T, size: usize) -> T {
    let mut own = MaybeUninit::<T>::zeroed();
    // SAFETY: the table has as many bytes as are copied. `T` is plain data, and zeros mean NULL.
    unsafe {
        ptr::copy_nonoverlapping(table.cast::<u8>(), own.as_mut_ptr().cast(), size.min(size_of::<T>()));
        own.assume_init()
    }
}

/// A text from a table.
pub(crate) unsafe fn text(s: ConefieldStr, place: &str, what: &str) -> Result<String> {
    let fits = s.length <= LONGEST_TEXT && (s.length == 0 || !s.data.is_null());
    ensure(fits, place, what, format!("a text of {} bytes", s.length), "at most 1 MiB at some address")?;
    // SAFETY: the table states this length.
    let bytes = if s.length == 0 { &[] } else { unsafe { slice::from_raw_parts(s.data, s.length) } };
    let text = std::str::from_utf8(bytes).map_err(|e| Error::invalid(place, what, e, "UTF-8"))?;
    Ok(text.into())
}

impl Type {
    unsafe fn read(t: &ConefieldStage, place: &str, index: usize, owner: &str) -> Result<Self> {
        let at = format!("stage {index}");
        // SAFETY: see the top of this file.
        let (name, doc, schema) = unsafe {
            (text(t.name, place, &at)?, text(t.doc, place, &at)?, text(t.schema, place, &format!("{at}: schema"))?)
        };
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        let good = (1..=64).contains(&name.len()) && name.chars().all(plain);
        ensure(good, place, &format!("{at}: name"), format!("{name:?}"), "lower-case letters, digits and hyphens")?;
        let at = format!("stage {name:?}");
        let mut schema: Value = serde_json::from_str(&schema)
            .map_err(|e| Error::invalid(place, format!("{at}: schema"), e, "a JSON Schema"))?;
        let Some(keys) = schema.as_object_mut() else {
            return Err(Error::invalid(place, format!("{at}: schema"), schema, "a JSON Schema of an object"));
        };
        // A setting missing in the schema is a mistake, whether the schema says so or not.
        keys.entry("additionalProperties").or_insert(Value::Bool(false));
        // SAFETY: see the top of this file.
        let (kind, functions) = unsafe { functions(t, place, &at)? };
        consistent(functions.as_ref()).map_err(|(found, expected)| Error::invalid(place, &at, found, expected))?;
        let missing = |what: &str| Error::invalid(place, &at, format!("no function {what}"), "one");
        Ok(Self {
            kind,
            name,
            doc,
            schema,
            owner: owner.into(),
            functions,
            context: t.context,
            create: t.create.ok_or_else(|| missing("create"))?,
            destroy: t.destroy.ok_or_else(|| missing("destroy"))?,
            describe: t.describe.ok_or_else(|| missing("describe"))?,
        })
    }

    /// Creates a stage from settings without their type, for `width` input channels. Errors name the setting.
    pub(crate) fn create(self: &Arc<Self>, settings: &Value, width: usize) -> Result<Handle> {
        let settings = settings.to_string();
        let mut stage = ptr::null_mut();
        let mut error = Text::new();
        // SAFETY: all arguments live during the call.
        let status = inside(|| unsafe {
            (self.create)(self.context, ConefieldStr::of(&settings), width, &mut stage, error.room())
        });
        if status != CONEFIELD_OK {
            return Err(self.refusal("create", status, &error.text()));
        }
        if stage.is_null() {
            return Err(self.failed("create", CONEFIELD_FAILED, "it made nothing"));
        }
        Ok(Handle { ty: self.clone(), stage })
    }

    /// The error for settings refused by `create` or `fitted`; the caller adds their path.
    pub(crate) fn refusal(&self, call: &str, status: ConefieldStatus, text: &str) -> Error {
        let parts = text.split_once(": found ").and_then(|(field, rest)| {
            let (found, expected) = rest.rsplit_once(", expected ")?;
            Some((field, found, expected))
        });
        match (status, parts) {
            (CONEFIELD_INVALID, Some((field, found, expected))) => Error::invalid("spec", field, found, expected),
            (CONEFIELD_INVALID, None) => Error::invalid("spec", "", text, "settings that make a stage"),
            _ => self.failed(call, status, text),
        }
    }

    /// The type and its library in words.
    pub(crate) fn words(&self) -> String {
        format!("{} {:?} of plugin {}", self.kind, self.name, self.owner)
    }

    /// The error for a failed call.
    pub(crate) fn failed(&self, call: &str, status: ConefieldStatus, text: &str) -> Error {
        let how = match status {
            CONEFIELD_INVALID => "refused",
            CONEFIELD_UNSUPPORTED => "cannot",
            CONEFIELD_PANICKED => "panicked",
            _ => "failed",
        };
        let text = text.strip_prefix("panicked: ").unwrap_or(text);
        let text = if text.is_empty() { "it gave no reason" } else { text };
        Error::unsupported(self.words(), format!("{call} {how}: {text}"))
    }
}

/// A stage created by a library.
pub(crate) struct Handle {
    pub ty: Arc<Type>,
    pub stage: *mut c_void,
}

// SAFETY: the contract allows a stage to be called from many threads and freed from any.
unsafe impl Send for Handle {}
// SAFETY: as above.
unsafe impl Sync for Handle {}

impl Drop for Handle {
    fn drop(&mut self) {
        // SAFETY: the library returned it, and nothing uses it any more.
        unsafe { (self.ty.destroy)(self.stage) };
    }
}

impl Handle {
    /// The stage's own description; its type if it has none. A panic is an error.
    pub fn describe(&self) -> Result<String> {
        let mut text = Text::new();
        // SAFETY: the stage is alive.
        let status = unsafe { (self.ty.describe)(self.stage, text.room()) };
        let text = text.text();
        let line = match status {
            CONEFIELD_OK => text.lines().next().unwrap_or_default(),
            CONEFIELD_PANICKED => return Err(self.ty.failed("describe", status, &text)),
            _ => &self.ty.name,
        };
        Ok(if line.starts_with(&self.ty.name) { line.into() } else { format!("{}: {line}", self.ty.name) })
    }
}

/// A buffer for a line from a library.
pub(crate) struct Text {
    bytes: [u8; 512],
    room: ConefieldText,
}

impl Text {
    pub fn new() -> Self {
        Self { bytes: [0; 512], room: ConefieldText { data: ptr::null_mut(), capacity: 0, length: 0 } }
    }

    /// The buffer as an argument of one call.
    pub fn room(&mut self) -> *mut ConefieldText {
        self.room = ConefieldText { data: self.bytes.as_mut_ptr(), capacity: self.bytes.len(), length: 0 };
        &mut self.room
    }

    /// The text written.
    pub fn text(&self) -> String {
        let n = self.room.length.min(self.bytes.len());
        String::from_utf8_lossy(&self.bytes[..n]).into_owned()
    }
}

/// A text of any length: calls again if it did not fit.
pub(crate) fn whole_text(
    mut ask: impl FnMut(*mut ConefieldText) -> ConefieldStatus,
) -> Result<String, (ConefieldStatus, String)> {
    let mut bytes = vec![0u8; 4096];
    for _ in 0..2 {
        let mut room = ConefieldText { data: bytes.as_mut_ptr(), capacity: bytes.len(), length: 0 };
        let status = ask(&mut room);
        let n = room.length;
        if status == CONEFIELD_OK && n > bytes.len() && n <= LONGEST_TEXT {
            bytes.resize(n, 0);
            continue;
        }
        let text = String::from_utf8_lossy(&bytes[..n.min(bytes.len())]).into_owned();
        if status == CONEFIELD_OK && n > bytes.len() {
            return Err((CONEFIELD_FAILED, format!("its text has {n} bytes, more than {LONGEST_TEXT}")));
        }
        return if status == CONEFIELD_OK { Ok(text) } else { Err((status, text)) };
    }
    Err((CONEFIELD_FAILED, "its text changes in length".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    unsafe extern "C" fn volume(_: *const c_void, _: *mut ConefieldStr, _: *mut u64) -> ConefieldStatus {
        CONEFIELD_OK
    }

    #[test]
    fn what_a_table_of_an_earlier_version_does_not_reach_is_null() {
        let first = offset_of!(ConefieldInitializer, check);
        let table = |size| ConefieldInitializer {
            size,
            apply: None,
            check: None,
            weights: None,
            with_weights: None,
            volume: Some(volume),
        };
        // SAFETY: the tables are complete, whatever size they state.
        let read = |size| unsafe { sized(&table(size), "p", "table", first) };
        assert!(read(size_of::<ConefieldInitializer>()).unwrap().volume.is_some());
        assert!(read(first).unwrap().volume.is_none());
        assert!(read(first - 1).is_err_and(|e| e.to_string().contains("too short")));
    }
}
