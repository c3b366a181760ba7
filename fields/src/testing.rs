//! Shared checks for tests of several fields.

use conefield_core::stage::{Field, Stage, Tile, TileMut};

/// Checks that a field of the inputs `keep` equals the whole field with zeros in the other inputs.
pub(crate) fn left_out_inputs_are_zeros(field: &dyn Field, keep: &[usize]) {
    let mut params = vec![0.0; field.info().params];
    field.init(3, &mut params);
    let reduced = field.keep_inputs(keep).unwrap();
    let small: Vec<f32> = reduced.params.iter().flat_map(|r| params[r.clone()].iter().copied()).collect();
    let n = 5;
    let x: Vec<f32> = (0..keep.len() * n).map(|i| (i as f32 * 0.7).sin()).collect();
    let mut wide = vec![0.0; field.info().input * n];
    for (c, &k) in keep.iter().enumerate() {
        wide[k * n..(k + 1) * n].copy_from_slice(&x[c * n..(c + 1) * n]);
    }
    let eval = |s: &dyn Stage, p: &[f32], x: &[f32]| {
        let (mut y, mut tape) = (vec![0.0; n], vec![0.0; s.info().tape * n]);
        s.kernel().forward(p, Tile::new(x, n), TileMut::new(&mut y, n), TileMut::new(&mut tape, n));
        y
    };
    let (a, b) = (eval(field, &params, &wide), eval(reduced.stage.as_ref(), &small, &x));
    for (a, b) in a.iter().zip(&b) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
}
