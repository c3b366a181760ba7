// Line integrals of single rays. The 64 rays of a group have similar directions: a Gaussian further from the first of them than
// `spread` and its own reach meets none.
struct LineRay {
    origin: vec3<f32>,
    // 0 for a ray that misses the box.
    meets: f32,
    direction: vec3<f32>,
    // Of the first ray of a group: the distance of the others from it at most.
    spread: f32,
}

var<workgroup> near: array<u32, 64>;
var<workgroup> found: atomic<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let count = arrayLength(&shapes);
    for (var at = id.x * 64u; at < grid.count; at += groups.x * 64u) {
        let axis = rays[at];
        let ray = rays[min(at + lane, grid.count - 1u)];
        var sum = 0.0;
        for (var first = 0u; first < count; first += 64u) {
            if lane == 0u {
                atomicStore(&found, 0u);
            }
            workgroupBarrier();
            if first + lane < count && shapes[first + lane].density > 0.0 {
                let s = shapes[first + lane];
                let off = cross(s.centre - axis.origin, axis.direction);
                let far = axis.spread + sqrt(LINE_CUT) * max(s.s0, max(s.s1, s.s2));
                if dot(off, off) <= far * far {
                    near[atomicAdd(&found, 1u)] = first + lane;
                }
            }
            workgroupBarrier();
            let candidates = atomicLoad(&found);
            for (var k = 0u; k < candidates; k++) {
                let s = shapes[near[k]];
                // The part across the ray first: the whole distance would round.
                let y = s.centre - ray.origin;
                let z = to_deviations(s, y - dot(y, ray.direction) * ray.direction);
                let w = to_deviations(s, ray.direction);
                let a = dot(w, w);
                let off = cross(z, w);
                let e = dot(off, off) / a;
                if e <= LINE_CUT {
                    sum += s.density * ROOT_TAU * inverseSqrt(a) * exp(-0.5 * e);
                }
            }
            workgroupBarrier();
        }
        if at + lane < grid.count {
            values[at + lane] = sum * ray.meets;
        }
    }
}
