//! The C header matches `src/lib.rs`, and the layout has not changed: plugins were built against both.

use conefield_plugin_abi::*;
use std::mem::offset_of;
use std::path::Path;

/// The tables as cbindgen, which expands no macros, can read them.
macro_rules! tables {
    ($(
        $(#[$about:meta])*
        $table:ident {
            $($(#[$doc:meta])* $need:ident $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?;)*
        }
    )*) => {
        stringify! {$(
            $(#[$about])*
            #[repr(C)]
            pub struct $table {
                /// Bytes of this table.
                pub size: usize,
                $($(#[$doc])* pub $name: Option<unsafe extern "C" fn($($argument: $type),*) $(-> $result)?>,)*
            }
        )*}
    };
}

/// `CONEFIELD_BLESS=1` writes the header.
#[test]
fn the_header_is_current() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config {
        language: cbindgen::Language::C,
        include_guard: Some("CONEFIELD_PLUGIN_H".into()),
        usize_is_size_t: true,
        cpp_compat: true,
        no_includes: true,
        sys_includes: vec!["stddef.h".into(), "stdint.h".into()],
        style: cbindgen::Style::Both,
        documentation_style: cbindgen::DocumentationStyle::C,
        header: Some(
            "/* The contract between conefield and its plugins, version 4.0. Made from plugins/abi/src/lib.rs. */"
                .into(),
        ),
        trailer: Some(
            "/* The one function that a plugin exports. What it returns lives as long as the library. */\n#ifdef \
             __cplusplus\nextern \"C\"\n#endif\nconst struct ConefieldPlugin *conefield_plugin(void);"
                .into(),
        ),
        export: cbindgen::ExportConfig {
            include: [
                "ConefieldPlugin", "ConefieldMap", "ConefieldProjector", "ConefieldInitializer", "ConefieldLoss",
                "ConefieldPrior", "ConefieldRegularizer", "ConefieldDataTerm", "ConefieldBasis", "ConefieldStage",
            ]
            .map(String::from)
            .to_vec(),
            exclude: ["ENTRY", "HEADER", "HELPERS", "ConefieldEntry"].map(String::from).to_vec(),
            ..Default::default()
        },
        ..Default::default()
    };
    let tables = Path::new(env!("CARGO_TARGET_TMPDIR")).join("tables.rs");
    std::fs::write(&tables, include!("../src/tables.rs")).unwrap();
    let sources = cbindgen::Builder::new().with_src(folder.join("src/lib.rs")).with_src(tables);
    let made = sources.with_config(config).generate().unwrap();
    let mut text = vec![];
    made.write(&mut text);
    let text = String::from_utf8(text).unwrap();
    let path = folder.join("include/conefield_plugin.h");
    if std::env::var_os("CONEFIELD_BLESS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(found == text, "{} is not current; CONEFIELD_BLESS=1 writes it", path.display());
}

/// A change here breaks all existing plugins and needs a new major version.
#[test]
#[cfg(target_pointer_width = "64")]
fn the_layout_is_pinned() {
    assert_eq!((CONEFIELD_ABI_MAJOR, CONEFIELD_ABI_MINOR), (4, 0));
    macro_rules! sizes {
        ($($table:ident)*) => { [$(size_of::<$table>()),*] };
    }
    let sizes = sizes! {
        ConefieldStr ConefieldText ConefieldTile ConefieldTileMut ConefieldGrads ConefieldInfo ConefieldParameter
        ConefieldRange ConefieldReduced ConefieldMap ConefieldRay ConefieldLengths ConefieldProjector ConefieldBlock
        ConefieldTensor ConefieldInitializer ConefieldNoise ConefieldLoss ConefieldBlocks ConefieldPrior ConefieldGrid
        ConefieldState ConefieldRegularizer ConefieldDataTerm ConefieldExpansion ConefieldBasis ConefieldStage
        ConefieldPlugin
    };
    let first = [16, 24, 32, 32, 24, 80, 32, 16, 40, 112, 44, 16, 56, 48, 48, 48, 32, 40, 32, 32];
    assert_eq!(sizes[..20], first);
    assert_eq!(sizes[20..], [72, 32, 64, 56, 88, 56, 152, 88]);
    macro_rules! offsets {
        ($table:ident: $($field:ident)*) => { [$(offset_of!($table, $field)),*] };
    }
    let plugin = offsets!(ConefieldPlugin: size abi_major abi_minor name version licence stages stage_count stage_size);
    assert_eq!(plugin, [0, 8, 12, 16, 32, 48, 64, 72, 80]);
    let stage = offsets! { ConefieldStage:
        kind name doc schema context create destroy describe map projector initializer loss prior regularizer data_term
        basis
    };
    assert_eq!(stage, [0, 8, 24, 40, 56, 64, 72, 80, 88, 96, 104, 112, 120, 128, 136, 144]);
    // In the tables a pointer follows the other.
    macro_rules! pointers {
        ($($table:ident: $($field:ident)*;)*) => {$(
            let found = offsets!($table: size $($field)*);
            assert!(found.iter().enumerate().all(|(i, at)| *at == 8 * i), "{}: {found:?}", stringify!($table));
            assert_eq!(8 * found.len(), size_of::<$table>(), "{}", stringify!($table));
        )*};
    }
    pointers! {
        ConefieldMap: info parameter init forward backward forward_f64 backward_f64 partition reduce wgsl passes forward_pass resolutions;
        ConefieldProjector: max_samples sample integrate adjoint fitted wgsl;
        ConefieldInitializer: apply check weights with_weights volume;
        ConefieldLoss: at needs_scan fitted wgsl;
        ConefieldPrior: blocks block wgsl;
        ConefieldRegularizer: bytes on weight value prox state adapt;
        ConefieldDataTerm: bytes of noise differentiate curve spread;
        ConefieldBasis: on info expand adjoint expand_f64 adjoint_f64;
    }
    let info = offsets! { ConefieldInfo:
        input output params blocks partitions tape macs scope grads identity coarse_to_fine double_precision
    };
    assert_eq!(info, [0, 8, 16, 24, 32, 40, 48, 56, 60, 64, 68, 72]);
    assert_eq!(offsets!(ConefieldGrid: shape spacing center), [0, 24, 48]);
    assert_eq!(offsets!(ConefieldExpansion: coefficients scratch samples double_precision), [0, 72, 80, 84]);
}

/// Numbers and lists of numbers, as `conefield_helpers.h` reads them.
#[test]
#[cfg(unix)]
fn settings_are_read_in_c() {
    use std::process::Command;
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("settings");
    let mut compile = Command::new(std::env::var_os("CC").unwrap_or("cc".into()));
    compile.args(["-Wall", "-Wextra", "-Werror", "-I"]).arg(folder.join("include"));
    compile.arg(folder.join("tests/settings.c")).arg("-o").arg(&program).arg("-lm");
    assert!(compile.status().unwrap().success());
    assert!(Command::new(&program).status().unwrap().success());
}
