fn ray_length(column: u32, row: u32) -> f32 {
    return length(view.first + f32(column) * view.u + f32(row) * view.v);
}
