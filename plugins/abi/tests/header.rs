//! The C header matches `src/lib.rs`, and its declarations have not changed: plugins were built against them.

use conefield_plugin_abi::*;
use std::path::Path;

/// The tables as cbindgen, which expands no macros, can read them.
macro_rules! tables {
    ($(
        $(#[$about:meta])*
        $table:ident {
            $($(#[$doc:meta])* $need:ident $name:ident($($argument:ident: $type:ty),*) $(-> $result:ty)?
                $(, since $minor:literal)?;)*
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
            include: vec!["ConefieldPlugin".into()],
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

/// Plugins are built against the declarations of the header: its text without comments, as a number (FNV-1a).
#[test]
fn the_declarations_are_pinned() {
    let (first, rest) = HEADER.split_once("/*").unwrap();
    let code = rest.split("/*").filter_map(|part| Some(part.split_once("*/")?.1));
    let text: Vec<&str> = std::iter::once(first).chain(code).flat_map(str::split_whitespace).collect();
    let number = |n: u64, byte| (n ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
    let found = text.join(" ").bytes().fold(0xcbf2_9ce4_8422_2325, number);
    let pinned = (4, 0, 0xd65d_2887_9ba6_cb95);
    let why = "a table that grows at its end needs a new minor version, any other change a new major one";
    assert_eq!((CONEFIELD_ABI_MAJOR, CONEFIELD_ABI_MINOR, found), pinned, "{why}; found {found:#x}");
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
