// A view. Lengths of rays are relative to that of the ray to pixel (0, 0), so that a source far away is no large number.
struct View {
    // From a displacement from the cube's centre to (t·column, t·row, t), with t = 1 on the detector; w is the value at the centre.
    across: vec4<f32>,
    down: vec4<f32>,
    ahead: vec4<f32>,
    source: vec3<f32>,
    columns: u32,
    // The ray to pixel (0, 0), and from pixel to pixel.
    first: vec3<f32>,
    rows: u32,
    u: vec3<f32>,
    // Whether this is the first view of a step.
    opens: u32,
    v: vec3<f32>,
    // Factor of a pixel's derivative.
    scale: f32,
    // Structural similarity: its two constants, and the factor of its derivative.
    c1: f32,
    c2: f32,
    ssim_scale: f32,
    pad: f32,
}

// How a view sees a Gaussian. The ray to a pixel is D = y/t + du·u + dv·v, and M·D = z·(1/t + du·along.x + dv·along.y)
// + du·pu + dv·pv with pu and pv perpendicular to z.
struct Seen {
    // Column and row of the point where the line through the centre meets the detector, and the factor from D to y.
    at: vec2<f32>,
    t: f32,
    // From the source to the centre, and M times it.
    y: vec3<f32>,
    z: vec3<f32>,
    zz: f32,
    mu: vec3<f32>,
    mv: vec3<f32>,
    along: vec2<f32>,
    pu: vec3<f32>,
    pv: vec3<f32>,
}

fn seen_by(view: View, s: Shape) -> Seen {
    let d = s.centre - 0.5;
    let t = dot(view.ahead.xyz, d) + view.ahead.w;
    let at = vec2<f32>(dot(view.across.xyz, d) + view.across.w, dot(view.down.xyz, d) + view.down.w) / t;
    let y = s.centre - view.source;
    let z = to_deviations(s, y);
    let mu = to_deviations(s, view.u);
    let mv = to_deviations(s, view.v);
    let zz = dot(z, z);
    let along = vec2<f32>(dot(z, mu), dot(z, mv)) / zz;
    return Seen(at, t, y, z, zz, mu, mv, along, mu - along.x * z, mv - along.y * z);
}
