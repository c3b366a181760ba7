// Derivatives with respect to the parameters, from those with respect to a shape: centre, rows of M, density.
fn learn(i: u32, s: Shape, opens: bool, centre: vec3<f32>, d0: vec3<f32>, d1: vec3<f32>, d2: vec3<f32>, density: f32) {
    let p = i * 11u;
    let q = unit(vec4<f32>(params[p + 6u], params[p + 7u], params[p + 8u], params[p + 9u]));
    let w = q.turn.x;
    let x = q.turn.y;
    let y = q.turn.z;
    let z = q.turn.w;
    // Column k of the derivative with respect to the rotation is that of row k of M over s_k.
    let r0 = d0 / s.s0;
    let r1 = d1 / s.s1;
    let r2 = d2 / s.s2;
    let by = vec4<f32>(
        2.0 * (x * (r1.z - r2.y) + y * (r2.x - r0.z) + z * (r0.y - r1.x)),
        2.0 * (y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r1.z - r2.y)) - 4.0 * x * (r1.y + r2.z),
        2.0 * (x * (r0.y + r1.x) + z * (r1.z + r2.y) + w * (r2.x - r0.z)) - 4.0 * y * (r0.x + r2.z),
        2.0 * (x * (r0.z + r2.x) + y * (r1.z + r2.y) + w * (r0.y - r1.x)) - 4.0 * z * (r0.x + r1.y),
    );
    // The norm of a quaternion does not matter.
    let turn = (by - dot(by, q.turn) * q.turn) / q.length;
    let slope = density / (1.0 + exp(-params[p + 10u]));
    let all = array<f32, 11>(
        centre.x, centre.y, centre.z,
        -dot(d0, s.m0), -dot(d1, s.m1), -dot(d2, s.m2),
        turn.x, turn.y, turn.z, turn.w,
        slope,
    );
    for (var k = 0u; k < 11u; k++) {
        grads[p + k] = select(grads[p + k], 0.0, opens) + all[k];
    }
}

// A Gaussian without derivatives.
fn rest(i: u32, opens: bool) {
    for (var k = 0u; k < 11u && opens; k++) {
        grads[11u * i + k] = 0.0;
    }
}
