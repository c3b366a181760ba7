var<private> value: f32;

fn walk_visit(voxel: vec3<u32>, weight: f32) {
    if voxel.x >= projection.held && voxel.x < projection.held_end {
        let i = walk_index(voxel);
        WHAT
    }
}
