// Structural similarity of each pixel's window, and its derivatives with respect to the blurred images: see the module `ssim`.
@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let pixels = view.rows * view.columns;
    var sum = 0.0;
    for (var i = id.x * 64u + lane; i < pixels; i += groups.x * 64u) {
        let b = blurred(i, pixels);
        let x = b[0];
        let y = b[1];
        let a1 = 2.0 * x * y + view.c1;
        let a2 = 2.0 * (b[4] - x * y) + view.c2;
        let b1 = x * x + y * y + view.c1;
        let b2 = b[2] - x * x + b[3] - y * y + view.c2;
        let s = a1 * a2 / (b1 * b2);
        sum += s;
        slopes[i] = 2.0 * view.ssim_scale * (y * (a2 - a1) / (b1 * b2) + x * s * (1.0 / b2 - 1.0 / b1));
        slopes[pixels + i] = -view.ssim_scale * s / b2;
        slopes[2u * pixels + i] = 2.0 * view.ssim_scale * a1 / (b1 * b2);
    }
    let all = total(lane, sum);
    if lane == 0u {
        partial[id.x].y = all / f32(pixels);
    }
}
