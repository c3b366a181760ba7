//! WGSL of a multi-layer perceptron, layer by layer with constant widths.
//!
//! Products are computed in blocks of outputs, so that each value read is used for all sums in registers. A row keeps its
//! features, every layer's outputs and the slopes of its activations; `backward` turns these into `∂L/∂z`.

use super::MlpStage;
use crate::linear::Linear;
use conefield_core::wgsl::{Sum, declare};
use std::fmt::Write;

/// Number of sums in a loop over inputs.
const BLOCK: usize = 8;

/// Number of sums in a loop over outputs. A whole row of the weights, where it fits, is read in one piece.
const COLUMNS: usize = 32;

/// The declarations, `stage_forward` and `stage_backward`.
pub fn functions(stage: &MlpStage) -> String {
    let last = stage.layers.len() - 1;
    let (features, width) = (stage.input, stage.settings.width);
    let mut forward = format!("    for (var k = 0u; k < {features}u; k++) {{ stage_keep(k, (*x)[k]); }}\n");
    for i in 0..=last {
        layer(stage, i, &mut forward);
    }
    let _ = writeln!(forward, "    (*y)[0] = h{last}[0];");
    let mut backward = String::new();
    gradients(stage, &mut backward);
    let keeps = features + 2 * width * last + 1;
    declare(keeps, &sums(stage)) + &conefield_core::wgsl::functions(features, 1, &forward, &backward)
}

/// The first kept channel of a hidden layer's outputs.
fn outputs(stage: &MlpStage, i: usize) -> usize {
    stage.input + 2 * i * stage.settings.width
}

/// The first kept channel of the slopes of a layer's activation.
fn slopes(stage: &MlpStage, i: usize) -> usize {
    let hidden = i + 1 < stage.layers.len();
    outputs(stage, i) + if hidden { stage.settings.width } else { 0 }
}

/// The gradients of weights and biases. A skip layer's first columns belong to the features.
fn sums(stage: &MlpStage) -> Vec<Sum> {
    let mut sums = vec![];
    for (i, layer) in stage.layers.iter().enumerate() {
        let Linear { skip, input, output, start } = *layer;
        let left = slopes(stage, i);
        let right = if i == 0 { 0 } else { outputs(stage, i - 1) };
        let columns = |at, right, inputs| Sum { at, ld: layer.ld(), left, outputs: output, right, inputs };
        sums.push(columns(start + skip, right, input));
        if skip > 0 {
            sums.push(columns(start, 0, skip));
        }
        sums.push(Sum::vector(layer.bias().start, left, output));
    }
    sums
}

/// The input of a layer: the features or the previous layer.
fn reads(i: usize) -> String {
    if i == 0 { "(*x)".into() } else { format!("h{}", i - 1) }
}

/// Computes `h{i}` and keeps what `backward` needs.
fn layer(stage: &MlpStage, i: usize, out: &mut String) {
    let layer = &stage.layers[i];
    let Linear { skip, input, output, .. } = *layer;
    let last = i + 1 == stage.layers.len();
    let act = if last { stage.settings.output } else { stage.settings.activation }.wgsl();
    let (kept, slope) = (outputs(stage, i), slopes(stage, i));
    let _ = writeln!(out, "    var h{i}: array<f32, {output}>;");
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
            if !last {
                let _ = writeln!(out, "        stage_keep({}u, f{o}.x);", kept + o);
            }
            let _ = writeln!(out, "        stage_keep({}u, f{o}.y);", slope + o);
        }
        out.push_str("    }\n");
    }
}

/// From the last layer to the first: `s{i}` is `∂L/∂z`, which takes the place of the slopes; `*dx` accumulates.
fn gradients(stage: &MlpStage, out: &mut String) {
    let last = stage.layers.len() - 1;
    let channel = slopes(stage, last);
    let _ = writeln!(out, "    var s{last}: array<f32, 1>;\n    s{last}[0] = stage_kept({channel}u) * (*dy)[0];");
    let _ = writeln!(out, "    stage_keep({channel}u, s{last}[0]);");
    let mut fresh = true;
    for (i, layer) in stage.layers.iter().enumerate().rev() {
        let Linear { skip, input, .. } = *layer;
        let features = if skip > 0 { skip } else { input };
        if skip > 0 || i == 0 {
            out.push_str("    if stage_wants_dx {\n");
            let how = if fresh { "=" } else { "+=" };
            back(i, layer, 0, features, out, |k| format!("(*dx)[{k}] {how} a{k};"));
            out.push_str("    }\n");
            fresh = false;
        }
        if i > 0 {
            let (before, first) = (i - 1, slopes(stage, i - 1));
            // All are read before the first is written, so that no read waits for another.
            let _ = write!(
                out,
                "    var s{before}: array<f32, {input}>;
    for (var k = 0u; k < {input}u; k++) {{ s{before}[k] = stage_kept({first}u + k); }}
"
            );
            back(i, layer, skip, input, out, |k| format!("s{before}[{k}] *= a{k};"));
            let _ =
                writeln!(out, "    for (var k = 0u; k < {input}u; k++) {{ stage_keep({first}u + k, s{before}[k]); }}");
        }
    }
}

/// `Wᵀ·∂L/∂z` of `count` columns from `column`; `put` writes the code that uses each.
fn back(i: usize, layer: &Linear, column: usize, count: usize, out: &mut String, put: impl Fn(usize) -> String) {
    // Four at a time where each row of the weights begins at a multiple of 4.
    let aligned = [layer.start, layer.ld(), column].iter().all(|n| n.is_multiple_of(4));
    for start in (0..count).step_by(COLUMNS) {
        let end = (start + COLUMNS).min(count);
        let fours = if aligned { start..start + (end - start) / 4 * 4 } else { start..start };
        out.push_str("    {\n");
        for k in start..end {
            let _ = writeln!(out, "        var a{k} = 0.0;");
        }
        let (rows, ld) = (layer.output, layer.ld());
        let _ = writeln!(out, "        for (var o = 0u; o < {rows}u; o++) {{\n            let d = s{i}[o];");
        let _ = writeln!(out, "            let at = {}u + o * {ld}u;", layer.start + column);
        for k in fours.clone().step_by(4) {
            let _ = writeln!(out, "            let w{k} = stage_param4(at + {k}u);");
            for (c, name) in ["x", "y", "z", "w"].into_iter().enumerate() {
                let _ = writeln!(out, "            a{} += w{k}.{name} * d;", k + c);
            }
        }
        for k in fours.end..end {
            let _ = writeln!(out, "            a{k} += stage_param(at + {k}u) * d;");
        }
        out.push_str("        }\n");
        for k in start..end {
            let _ = writeln!(out, "        {}", put(k));
        }
        out.push_str("    }\n");
    }
}
