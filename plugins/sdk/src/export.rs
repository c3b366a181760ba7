//! The table of a plugin, built from the stage types that its crate registers.

#![allow(unsafe_code)]

use crate::shims;
use conefield_core::registry::{Kind, Origin, StageType, stage_types};
use conefield_plugin_abi::*;
use std::panic::catch_unwind;
use std::ptr;
use std::sync::OnceLock;

/// A plugin crate's name and version, from which its table is built on demand.
pub struct Plugin {
    name: &'static str,
    version: &'static str,
    licence: &'static str,
    table: OnceLock<Table>,
}

/// An immutable table.
struct Table(ConefieldPlugin);

// SAFETY: it points to statics and to leaked memory that is never written again.
unsafe impl Send for Table {}
// SAFETY: as above.
unsafe impl Sync for Table {}

impl Plugin {
    /// The plugin of the crate `name`.
    pub const fn new(name: &'static str, version: &'static str, licence: &'static str) -> Self {
        Self { name, version, licence, table: OnceLock::new() }
    }

    /// Its table; NULL if it cannot be built.
    pub fn table(&'static self) -> *const ConefieldPlugin {
        catch_unwind(|| ptr::from_ref(&self.table.get_or_init(|| Table(self.make())).0)).unwrap_or(ptr::null())
    }

    fn make(&self) -> ConefieldPlugin {
        // Dependencies may register types of their own, which are not exported here.
        let own = |t: &&StageType| matches!(t.origin, Origin::Linked { package, .. } if package == self.name);
        let stages: Vec<ConefieldStage> = stage_types().into_iter().filter(own).filter_map(stage).collect();
        let stages = stages.leak();
        ConefieldPlugin {
            size: size_of::<ConefieldPlugin>(),
            abi_major: CONEFIELD_ABI_MAJOR,
            abi_minor: CONEFIELD_ABI_MINOR,
            name: ConefieldStr::of(self.name),
            version: ConefieldStr::of(self.version),
            licence: ConefieldStr::of(self.licence),
            stages: stages.as_ptr(),
            stage_count: stages.len(),
            stage_size: size_of::<ConefieldStage>(),
        }
    }
}

/// The entry of one stage type; `None` for kinds that cannot be exported.
fn stage(t: &'static StageType) -> Option<ConefieldStage> {
    macro_rules! filled {
        ($($table:ident $field:ident: $($kind:ident $name:ident $code:ident $spec:ident $place:literal),+;)*) => {{
            let mut stage = ConefieldStage {
                kind: 0,
                name: ConefieldStr::of(t.name),
                doc: ConefieldStr::of(t.doc),
                schema: ConefieldStr::of(t.schema().to_string().leak()),
                context: ptr::from_ref(t).cast(),
                create: Some(shims::create),
                destroy: Some(shims::destroy),
                describe: Some(shims::describe),
                $($field: ptr::null(),)*
            };
            match t.kind {
                $($(Kind::$kind => (stage.kind, stage.$field) = ($code, &shims::$field::TABLE),)+)*
                _ => return None,
            }
            Some(stage)
        }};
    }
    conefield_plugin_abi::kinds! { filled }
}
