// Visits the bins of each box.
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    for (var i = id.x; i < arrayLength(&boxes); i += groups.x * 64u) {
        let begin = begin_of(boxes[i]);
        let end = end_of(boxes[i]);
        for (var x = begin.x; x < end.x; x++) {
            for (var y = begin.y; y < end.y; y++) {
                for (var z = begin.z; z < end.z; z++) {
                    let bin = (x * bins.shape.y + y) * bins.shape.z + z;
                    VISIT
                }
            }
        }
    }
}
