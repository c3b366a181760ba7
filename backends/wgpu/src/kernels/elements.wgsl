// Elements of a launch, and two constants.
struct Elements {
    begin: u32,
    end: u32,
    a: f32,
    b: f32,
}
