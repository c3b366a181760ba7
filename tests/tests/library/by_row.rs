//! Stages that are written for one row at a time, as encoder, normalizer and field.

use conefield_conformance::{Options, check_encoder, check_field, check_normalizer};
use conefield_core::prelude::*;

/// `y_c = w_c·sin(x_a)·x_b + v`, where `a` and `b` are channels beside each other.
struct Products {
    input: usize,
    output: usize,
}

impl Products {
    fn pair(&self, c: usize) -> [usize; 2] {
        [c % self.input, (c + 1) % self.input]
    }
}

impl RowMap for Products {
    fn widths(&self) -> [usize; 2] {
        [self.input, self.output]
    }

    fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        vec![("factor".into(), vec![self.output]), ("shift".into(), vec![1])]
    }

    fn init(&self, seed: u64, params: &mut [f32]) {
        params.fill(0.5 + (seed % 3) as f32);
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        for c in 0..self.output {
            let [a, b] = self.pair(c);
            y.set(c, x.at(a).sin_cos().0 * x.at(b) * params[c] + params[self.output]);
        }
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, params: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        for c in 0..self.output {
            let [a, b] = self.pair(c);
            let (w, dy, (sin, cos)) = (params[c], dy.at(c), x.at(a).sin_cos());
            grads.param(c, dy * sin * x.at(b));
            grads.param(self.output, dy);
            grads.input(a, dy * cos * x.at(b) * w);
            grads.input(b, dy * sin * w);
        }
    }

    fn describe(&self) -> String {
        "products: of channels beside each other".into()
    }

    fn resolutions(&self) -> Option<Vec<f64>> {
        Some((0..self.output).map(|c| (c + 1) as f64).collect())
    }
}

fn products(input: usize, output: usize) -> ByRow<Products> {
    ByRow::new(Products { input, output })
}

#[test]
fn it_conforms_as_every_kind() {
    let report = check_encoder(&products(3, 5), &Options::encoder());
    assert!(report.passed(), "{report}");
    let report = check_normalizer(&products(4, 4), &Options::features());
    assert!(report.passed(), "{report}");
    let report = check_field(&products(4, 1), &Options::features());
    assert!(report.passed(), "{report}");
}

#[test]
fn channels_are_left_out() {
    let small = Encoder::keep_outputs(&products(3, 5), &[1, 4]).unwrap();
    assert_eq!(small.stage.info().output, 2);
    assert_eq!(small.stage.resolutions(), Some(vec![2.0, 5.0]));
    assert!(small.stage.describe().contains("2 of 5 channels"), "{}", small.stage.describe());
    assert_eq!(Field::keep_inputs(&products(4, 1), &[0, 3]).unwrap().stage.info().input, 2);
    // What a normalizer does without an input, only its author knows.
    assert!(Normalizer::keep_inputs(&products(4, 4), &[0]).is_err());
}

/// Many parameters are summed by one worker, in the order of the rows, and only those that it is asked for.
#[test]
fn many_parameters_are_scattered() {
    let many = products(3, 1 << 20);
    assert_eq!(many.info().grads, GradKind::Scatter);
    assert_eq!(products(3, 5).info().grads, GradKind::Dense);
    let (small, mut grads) = (products(3, 5), [7.0f32; 2]);
    let (params, x, dy) = ([1.0f32; 6], [1.0f32, 2.0, 3.0], [1.0f32; 5]);
    small.backward(Backward {
        params: &params,
        x: Tile::new(&x, 1),
        tape: TileMut::new(&mut [], 1),
        dy: Tile::new(&dy, 1),
        grads: Grads { values: &mut grads, range: 1..3 },
        dx: None,
    });
    let want = [7.0 + 2.0f32.sin() * 3.0, 7.0 + 3.0f32.sin() * 1.0];
    assert_eq!(grads, want);
}

/// `exp(s)`, `√(s + 2)` and `ln(s + 2)` of `s = sin(x)` of the first channel, without parameters.
struct Curves;

impl RowMap for Curves {
    fn widths(&self) -> [usize; 2] {
        [3, 3]
    }

    #[inline(always)]
    fn forward<N: Lanes>(&self, _: &[N::Real], x: Channels<N>, y: &mut ChannelsMut<N>) {
        let s = x.at(0).sin_cos().0;
        let two = s + N::Real::of(2.0);
        y.set(0, s.exp());
        y.set(1, two.sqrt());
        y.set(2, two.ln());
    }

    #[inline(always)]
    fn backward<N: Lanes>(&self, _: &[N::Real], x: Channels<N>, dy: Channels<N>, grads: &mut Gradients<N>) {
        let (s, cos) = x.at(0).sin_cos();
        let two = s + N::Real::of(2.0);
        grads.input(0, cos * (dy.at(0) * s.exp() + dy.at(1) * N::Real::of(0.5) / two.sqrt() + dy.at(2) / two));
    }

    fn describe(&self) -> String {
        "curves: of the first channel".into()
    }
}

#[test]
fn a_map_without_parameters_leaves_channels_out() {
    let all = ByRow::new(Curves);
    let small = Encoder::keep_outputs(&all, &[0, 2]).unwrap();
    assert_eq!((small.stage.info().output, small.params.len()), (2, 0));
    let report = check_encoder(&all, &Options::encoder());
    assert!(report.passed(), "{report}");
}
