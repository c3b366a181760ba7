// A level of a dense grid, as in dense_grid.rs.

struct stage_Level {
    side: vec3<u32>,
    strides: vec3<u32>,
    cells: f32,
    // First parameter.
    start: u32,
}

const stage_CORNERS = 8u;

fn stage_locate(x: vec3<f32>, level: stage_Level) -> stage_Located {
    return stage_trilinear_locate(x, level.side, level.strides, vec3<f32>(level.cells), 0.0);
}

fn stage_corner(at: stage_Located, level: stage_Level, c: u32) -> stage_Corner {
    let entry = level.start + stage_trilinear_index(at, level.strides, c) * stage_FEATURES;
    return stage_Corner(entry, stage_trilinear_weight(at, c));
}
