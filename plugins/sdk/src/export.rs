//! The table of a plugin, built from the stage types that its crate registers.

use crate::shims;
use conefield_core::registry::{Kind, Origin, StageType, stage_types};
use conefield_plugin_abi::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::ptr;
use std::sync::OnceLock;

/// The address of the table of a plugin crate with this name, version and licence, which is made once; NULL if that
/// fails.
pub fn table(made: &OnceLock<usize>, of: [&'static str; 3]) -> *const ConefieldPlugin {
    let address = || ptr::from_ref(Box::leak(Box::new(make(of)))) as usize;
    catch_unwind(AssertUnwindSafe(|| *made.get_or_init(address))).unwrap_or(0) as *const ConefieldPlugin
}

fn make([name, version, licence]: [&'static str; 3]) -> ConefieldPlugin {
    // Dependencies may register types of their own, which are not exported here.
    let own = |t: &&StageType| matches!(t.origin, Origin::Linked { package, .. } if package == name);
    let stages: Vec<ConefieldStage> = stage_types().into_iter().filter(own).filter_map(stage).collect();
    let stages = stages.leak();
    ConefieldPlugin {
        size: size_of::<ConefieldPlugin>(),
        abi_major: CONEFIELD_ABI_MAJOR,
        abi_minor: CONEFIELD_ABI_MINOR,
        name: ConefieldStr::of(name),
        version: ConefieldStr::of(version),
        licence: ConefieldStr::of(licence),
        stages: stages.as_ptr(),
        stage_count: stages.len(),
        stage_size: size_of::<ConefieldStage>(),
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
