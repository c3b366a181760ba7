// Images of MAPS maps blurred along columns, at pixel i.
fn blurred(i: u32, pixels: u32) -> array<f32, MAPS> {
    let row = i / view.columns;
    var sums: array<f32, MAPS>;
    for (var k = 0u; k < 11u; k++) {
        if row + k >= 5u && row + k - 5u < view.rows {
            let at = i + k * view.columns - 5u * view.columns;
            for (var m = 0u; m < MAPSu; m++) {
                sums[m] += taps[k] * between[m * pixels + at];
            }
        }
    }
    return sums;
}
