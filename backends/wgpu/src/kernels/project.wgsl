// Line integrals of a slab of voxels: one ray per invocation. `held` and `held_end` are the planes of x in the buffer.

struct VoxelRay {
    source: vec3<f32>,
    ahead: vec3<f32>,
    length: f32,
}

struct ProjectedView {
    // The source; if it is far away, pixel (0, 0): positions would round.
    start: vec3<f32>,
    // Share of the way from the pixel to the source at which a ray begins; 1 is the source.
    near: f32,
    // From the source to pixel (0, 0), and from pixel to pixel, in voxels.
    corner: vec3<f32>,
    column: vec3<f32>,
    row: vec3<f32>,
}

struct Projection {
    shape: vec3<u32>,
    // Pixels, all views.
    count: u32,
    spacing: vec3<f32>,
    columns: u32,
    // Planes of x that the buffer holds.
    held: u32,
    held_end: u32,
    // Pixels of a view.
    pixels: u32,
    // First pixel of this launch, and the first after it.
    begin: u32,
    end: u32,
}

// Neighbouring lanes have neighbouring rows of a column, whose rays meet neighbouring z: voxels that follow each other.
fn line_of(i: u32) -> u32 {
    let rows = projection.pixels / projection.columns;
    let place = i % projection.pixels;
    return i - place + (place % rows) * projection.columns + place / rows;
}

fn projected(i: u32) -> VoxelRay {
    let view = views[i / projection.pixels];
    let pixel = i % projection.pixels;
    let row = f32(pixel / projection.columns);
    let column = f32(pixel % projection.columns);
    let place = column * view.column + row * view.row;
    let ahead = view.near * (view.corner + place);
    let start = view.start + select(vec3<f32>(0.0), place - ahead, view.near < 1.0);
    return VoxelRay(start, ahead, length(ahead * projection.spacing));
}

fn walk_shape() -> vec3<u32> {
    return projection.shape;
}

fn walk_spacing() -> vec3<f32> {
    return projection.spacing;
}

fn walk_index(voxel: vec3<u32>) -> u32 {
    return ((voxel.x - projection.held) * projection.shape.y + voxel.y) * projection.shape.z + voxel.z;
}
