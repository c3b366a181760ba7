//! WGSL of a multi-layer perceptron, layer by layer with constant widths.
//!
//! Products are computed in blocks of outputs, so that each value read is used for all sums in registers.

use super::MlpStage;
use crate::linear::Linear;
use std::fmt::Write;

/// Number of sums in a loop over inputs.
const BLOCK: usize = 8;

/// `stage_forward` and `stage_backward`.
pub fn functions(stage: &MlpStage) -> String {
    let last = stage.layers.len() - 1;
    let mut forward = String::new();
    for i in 0..=last {
        layer(stage, i, false, &mut forward);
    }
    let _ = writeln!(forward, "    (*y)[0] = h{last}[0];");
    let mut backward = String::new();
    for i in 0..=last {
        layer(stage, i, true, &mut backward);
    }
    gradients(stage, &mut backward);
    conefield_core::wgsl::functions(stage.input, 1, &forward, &backward)
}

/// The input of a layer: the features or the previous layer.
fn reads(i: usize) -> String {
    if i == 0 { "(*x)".into() } else { format!("h{}", i - 1) }
}

/// Computes `h{i}` and, if wanted, the activation's derivative `s{i}`.
fn layer(stage: &MlpStage, i: usize, slopes: bool, out: &mut String) {
    let layer = &stage.layers[i];
    let Linear { skip, input, output, .. } = *layer;
    let last = i + 1 == stage.layers.len();
    let act = if last { stage.settings.output } else { stage.settings.activation }.wgsl();
    let _ = writeln!(out, "    var h{i}: array<f32, {output}>;");
    if slopes {
        let _ = writeln!(out, "    var s{i}: array<f32, {output}>;");
    }
    for start in (0..output).step_by(BLOCK) {
        let block = start..(start + BLOCK).min(output);
        out.push_str("    {\n");
        for o in block.clone() {
            let _ = writeln!(out, "        var a{o} = stage_param({}u);", layer.bias().start + o);
        }
        for (name, count, column) in [("(*x)".to_owned(), skip, 0), (reads(i), input, skip)] {
            if count == 0 {
                continue;
            }
            let _ = writeln!(out, "        for (var k = 0u; k < {count}u; k++) {{\n            let v = {name}[k];");
            for o in block.clone() {
                let at = layer.start + o * layer.ld() + column;
                let _ = writeln!(out, "            a{o} += stage_param({at}u + k) * v;");
            }
            out.push_str("        }\n");
        }
        for o in block {
            let _ = writeln!(out, "        let f{o} = {act}(a{o});\n        h{i}[{o}] = f{o}.x;");
            if slopes {
                let _ = writeln!(out, "        s{i}[{o}] = f{o}.y;");
            }
        }
        out.push_str("    }\n");
    }
}

/// From the last layer to the first: `s{i}` becomes `∂L/∂z`, gradients are summed, `*dx` accumulates.
fn gradients(stage: &MlpStage, out: &mut String) {
    let last = stage.layers.len() - 1;
    let _ = writeln!(out, "    s{last}[0] *= (*dy)[0];");
    let mut fresh = true;
    for (i, layer) in stage.layers.iter().enumerate().rev() {
        let Linear { skip, input, output, start } = *layer;
        let ld = layer.ld();
        let from = if i == 0 { "x".to_owned() } else { format!("&h{}", i - 1) };
        let _ = writeln!(out, "    stage_outer_{output}_{input}({}u, {ld}u, &s{i}, {from});", start + skip);
        if skip > 0 {
            let _ = writeln!(out, "    stage_outer_{output}_{skip}({start}u, {ld}u, &s{i}, x);");
        }
        let _ = writeln!(out, "    stage_sum_{output}({}u, &s{i});", layer.bias().start);
        let features = if skip > 0 { skip } else { input };
        if skip > 0 || i == 0 {
            out.push_str("    if stage_wants_dx {\n");
            let how = if fresh { "=" } else { "+=" };
            back(i, layer, 0, features, out, |k| format!("(*dx)[{k}] {how} a{k};"));
            out.push_str("    }\n");
            fresh = false;
        }
        if i > 0 {
            back(i, layer, skip, input, out, |k| format!("s{}[{k}] *= a{k};", i - 1));
        }
    }
}

/// `Wᵀ·∂L/∂z` of `count` columns from `column`; `put` writes the code that uses each.
fn back(i: usize, layer: &Linear, column: usize, count: usize, out: &mut String, put: impl Fn(usize) -> String) {
    for start in (0..count).step_by(BLOCK) {
        let block = start..(start + BLOCK).min(count);
        out.push_str("    {\n");
        for k in block.clone() {
            let _ = writeln!(out, "        var a{k} = 0.0;");
        }
        let (rows, ld) = (layer.output, layer.ld());
        let _ = writeln!(out, "        for (var o = 0u; o < {rows}u; o++) {{\n            let d = s{i}[o];");
        let _ = writeln!(out, "            let at = {}u + o * {ld}u;", layer.start + column);
        for k in block.clone() {
            let _ = writeln!(out, "            a{k} += stage_param(at + {k}u) * d;");
        }
        out.push_str("        }\n");
        for k in block {
            let _ = writeln!(out, "        {}", put(k));
        }
        out.push_str("    }\n");
    }
}
