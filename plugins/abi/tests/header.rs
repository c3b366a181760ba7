//! The C header matches `src/lib.rs`, and the layout has not changed: plugins were built against both.

use conefield_plugin_abi::*;
use std::mem::offset_of;
use std::path::Path;

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
            "/* The contract between conefield and its plugins, version 3.0. Made from plugins/abi/src/lib.rs. */"
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
            exclude: ["ENTRY", "HEADER", "ConefieldEntry"].map(String::from).to_vec(),
            ..Default::default()
        },
        ..Default::default()
    };
    let made = cbindgen::Builder::new().with_src(folder.join("src/lib.rs")).with_config(config).generate().unwrap();
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
    assert_eq!((CONEFIELD_ABI_MAJOR, CONEFIELD_ABI_MINOR), (3, 0));
    let sizes = [
        size_of::<ConefieldStr>(),
        size_of::<ConefieldText>(),
        size_of::<ConefieldTile>(),
        size_of::<ConefieldTileMut>(),
        size_of::<ConefieldGrads>(),
        size_of::<ConefieldInfo>(),
        size_of::<ConefieldParameter>(),
        size_of::<ConefieldRange>(),
        size_of::<ConefieldReduced>(),
        size_of::<ConefieldMap>(),
        size_of::<ConefieldRay>(),
        size_of::<ConefieldLengths>(),
        size_of::<ConefieldProjector>(),
        size_of::<ConefieldBlock>(),
        size_of::<ConefieldTensor>(),
        size_of::<ConefieldInitializer>(),
        size_of::<ConefieldNoise>(),
        size_of::<ConefieldLoss>(),
        size_of::<ConefieldBlocks>(),
        size_of::<ConefieldPrior>(),
        size_of::<ConefieldGrid>(),
        size_of::<ConefieldState>(),
        size_of::<ConefieldRegularizer>(),
        size_of::<ConefieldDataTerm>(),
        size_of::<ConefieldExpansion>(),
        size_of::<ConefieldBasis>(),
        size_of::<ConefieldStage>(),
        size_of::<ConefieldPlugin>(),
    ];
    let first = [16, 24, 32, 32, 24, 80, 32, 16, 40, 144, 44, 16, 56, 48, 48, 48, 32, 40, 32, 32];
    assert_eq!(sizes[..20], first);
    assert_eq!(sizes[20..], [72, 32, 64, 56, 88, 56, 152, 88]);
    let plugin = [
        offset_of!(ConefieldPlugin, size),
        offset_of!(ConefieldPlugin, abi_major),
        offset_of!(ConefieldPlugin, abi_minor),
        offset_of!(ConefieldPlugin, name),
        offset_of!(ConefieldPlugin, version),
        offset_of!(ConefieldPlugin, licence),
        offset_of!(ConefieldPlugin, stages),
        offset_of!(ConefieldPlugin, stage_count),
        offset_of!(ConefieldPlugin, stage_size),
    ];
    assert_eq!(plugin, [0, 8, 12, 16, 32, 48, 64, 72, 80]);
    let stage = [
        offset_of!(ConefieldStage, kind),
        offset_of!(ConefieldStage, name),
        offset_of!(ConefieldStage, doc),
        offset_of!(ConefieldStage, schema),
        offset_of!(ConefieldStage, context),
        offset_of!(ConefieldStage, create),
        offset_of!(ConefieldStage, destroy),
        offset_of!(ConefieldStage, describe),
        offset_of!(ConefieldStage, map),
        offset_of!(ConefieldStage, projector),
        offset_of!(ConefieldStage, initializer),
        offset_of!(ConefieldStage, loss),
        offset_of!(ConefieldStage, prior),
        offset_of!(ConefieldStage, regularizer),
        offset_of!(ConefieldStage, data_term),
        offset_of!(ConefieldStage, basis),
    ];
    assert_eq!(stage, [0, 8, 24, 40, 56, 64, 72, 80, 88, 96, 104, 112, 120, 128, 136, 144]);
    let map = [
        offset_of!(ConefieldMap, size),
        offset_of!(ConefieldMap, info),
        offset_of!(ConefieldMap, parameter),
        offset_of!(ConefieldMap, init),
        offset_of!(ConefieldMap, forward),
        offset_of!(ConefieldMap, backward),
        offset_of!(ConefieldMap, forward_f64),
        offset_of!(ConefieldMap, backward_f64),
        offset_of!(ConefieldMap, partition),
        offset_of!(ConefieldMap, reduce),
        offset_of!(ConefieldMap, wgsl),
        offset_of!(ConefieldMap, passes),
        offset_of!(ConefieldMap, forward_pass),
        offset_of!(ConefieldMap, resolutions),
        offset_of!(ConefieldMap, project),
        offset_of!(ConefieldMap, backproject),
        offset_of!(ConefieldMap, project_f64),
        offset_of!(ConefieldMap, backproject_f64),
    ];
    let at: Vec<usize> = (0..18).map(|i| 8 * i).collect();
    assert_eq!(map[..], at);
    let projector = [
        offset_of!(ConefieldProjector, size),
        offset_of!(ConefieldProjector, max_samples),
        offset_of!(ConefieldProjector, sample),
        offset_of!(ConefieldProjector, integrate),
        offset_of!(ConefieldProjector, adjoint),
        offset_of!(ConefieldProjector, fitted),
        offset_of!(ConefieldProjector, wgsl),
    ];
    assert_eq!(projector, [0, 8, 16, 24, 32, 40, 48]);
    let info = [
        offset_of!(ConefieldInfo, input),
        offset_of!(ConefieldInfo, output),
        offset_of!(ConefieldInfo, params),
        offset_of!(ConefieldInfo, blocks),
        offset_of!(ConefieldInfo, partitions),
        offset_of!(ConefieldInfo, tape),
        offset_of!(ConefieldInfo, macs),
        offset_of!(ConefieldInfo, scope),
        offset_of!(ConefieldInfo, grads),
        offset_of!(ConefieldInfo, identity),
        offset_of!(ConefieldInfo, coarse_to_fine),
        offset_of!(ConefieldInfo, double_precision),
    ];
    assert_eq!(info, [0, 8, 16, 24, 32, 40, 48, 56, 60, 64, 68, 72]);
}

#[test]
#[cfg(target_pointer_width = "64")]
fn the_layout_of_pieces_of_iterative_methods_is_pinned() {
    let regularizer = [
        offset_of!(ConefieldRegularizer, size),
        offset_of!(ConefieldRegularizer, bytes),
        offset_of!(ConefieldRegularizer, on),
        offset_of!(ConefieldRegularizer, weight),
        offset_of!(ConefieldRegularizer, value),
        offset_of!(ConefieldRegularizer, prox),
        offset_of!(ConefieldRegularizer, state),
    ];
    let data_term = [
        offset_of!(ConefieldDataTerm, size),
        offset_of!(ConefieldDataTerm, bytes),
        offset_of!(ConefieldDataTerm, of),
        offset_of!(ConefieldDataTerm, noise),
        offset_of!(ConefieldDataTerm, differentiate),
        offset_of!(ConefieldDataTerm, curve),
        offset_of!(ConefieldDataTerm, spread),
    ];
    let basis = [
        offset_of!(ConefieldBasis, size),
        offset_of!(ConefieldBasis, on),
        offset_of!(ConefieldBasis, info),
        offset_of!(ConefieldBasis, expand),
        offset_of!(ConefieldBasis, adjoint),
        offset_of!(ConefieldBasis, expand_f64),
        offset_of!(ConefieldBasis, adjoint_f64),
    ];
    assert_eq!([regularizer, data_term, basis], [[0, 8, 16, 24, 32, 40, 48]; 3]);
    assert_eq!(offset_of!(ConefieldRegularizer, adapt), 56);
    let grid =
        [offset_of!(ConefieldGrid, shape), offset_of!(ConefieldGrid, spacing), offset_of!(ConefieldGrid, center)];
    assert_eq!(grid, [0, 24, 48]);
    let expansion = [
        offset_of!(ConefieldExpansion, coefficients),
        offset_of!(ConefieldExpansion, scratch),
        offset_of!(ConefieldExpansion, samples),
        offset_of!(ConefieldExpansion, double_precision),
    ];
    assert_eq!(expansion, [0, 72, 80, 84]);
}
