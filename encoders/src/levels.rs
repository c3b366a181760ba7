//! What encoders of several levels, each with features of its own, share: how features start, which level a channel comes from,
//! and WGSL: calls of `stage_level_forward` and `stage_level_backward`, level by level, with the levels' settings written into them.

use conefield_core::random::{mix, unit};
use conefield_core::wgsl;
use std::fmt::Write;

/// Features start uniform in ± this (Müller et al. 2022, section 4).
const START: f32 = 1e-4;

/// Fills features as they start.
pub fn start(seed: u64, params: &mut [f32]) {
    for (i, p) in params.iter_mut().enumerate() {
        *p = (2.0 * unit(mix(seed, i as u64)) - 1.0) * START;
    }
}

/// Of each of `width` channels the cells along a side of the level that it comes from; levels are given with their output
/// channels.
pub fn by_channel<'a>(levels: impl Iterator<Item = (f64, &'a [Option<usize>])>, width: usize) -> Vec<f64> {
    let mut cells = vec![0.0; width];
    for (resolution, outputs) in levels {
        outputs.iter().flatten().for_each(|&c| cells[c] = resolution);
    }
    cells
}

/// A level as WGSL sees it.
pub struct LevelCode {
    /// A value of type `stage_Level`.
    pub value: String,
    /// Output channel of each feature, where it is read.
    pub outputs: Vec<Option<usize>>,
}

/// `stage_forward` and `stage_backward` of an encoder with `width` channels out.
pub fn functions(levels: &[LevelCode], width: usize) -> String {
    let (mut forward, mut backward) = (String::new(), String::new());
    for (l, LevelCode { value, outputs }) in levels.iter().enumerate() {
        let _ = writeln!(forward, "    let v{l} = stage_level_forward(p, {value});");
        let _ = writeln!(backward, "    var d{l}: array<f32, stage_FEATURES>;");
        for (f, c) in outputs.iter().enumerate().filter_map(|(f, c)| Some((f, (*c)?))) {
            let _ = writeln!(forward, "    (*y)[{c}] = v{l}[{f}];");
            let _ = writeln!(backward, "    d{l}[{f}] = (*dy)[{c}];");
        }
        let _ = writeln!(backward, "    slope += stage_level_backward(p, {value}, &d{l});");
    }
    let p = "    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);\n";
    let slope = "    (*dx)[0] = slope.x;\n    (*dx)[1] = slope.y;\n    (*dx)[2] = slope.z;\n";
    let backward = format!("{p}    var slope = vec3<f32>(0.0);\n{backward}{slope}");
    wgsl::functions(3, width, &format!("{p}{forward}"), &backward)
}
