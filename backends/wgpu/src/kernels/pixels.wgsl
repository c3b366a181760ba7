// Pixels of a launch.
struct Pixels {
    begin: u32,
    end: u32,
    // Pixels of a view.
    pixels: u32,
}

// In place of the index of an image that the bound part does not hold.
const NONE = 0xffffffffu;
