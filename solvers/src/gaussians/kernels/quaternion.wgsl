// The density before softplus of a free slot.
const FREE = -1000.0;

// A quaternion of length 1, real part first, and its original length.
struct Unit {
    turn: vec4<f32>,
    length: f32,
}

fn unit(q: vec4<f32>) -> Unit {
    let length = length(q);
    if length > 1e-12 {
        return Unit(q / length, length);
    }
    return Unit(vec4<f32>(1.0, 0.0, 0.0, 0.0), 1.0);
}
