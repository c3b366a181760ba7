//! WGSL of an encoder of several levels, each with features of its own: calls of `stage_level_forward` and
//! `stage_level_backward`, level by level, with the levels' settings written into them.

use std::fmt::Write;

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
    format!(
        "fn stage_forward(x: ptr<function, array<f32, 3>>, y: ptr<function, array<f32, {width}>>) {{
    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);
{forward}}}

fn stage_backward(
    x: ptr<function, array<f32, 3>>,
    dy: ptr<function, array<f32, {width}>>,
    dx: ptr<function, array<f32, 3>>,
) {{
    let p = vec3<f32>((*x)[0], (*x)[1], (*x)[2]);
    var slope = vec3<f32>(0.0);
{backward}    (*dx)[0] = slope.x;
    (*dx)[1] = slope.y;
    (*dx)[2] = slope.z;
}}
"
    )
}
