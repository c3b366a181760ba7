//! Adam (Kingma & Ba 2015, algorithm 1) over the whole arena in one pass.

use conefield_core::arena::Arena;
use conefield_core::backend::Adam;
use conefield_core::parallel;
use conefield_core::simd::{Op, Select, Simd, SimdBase, SimdFloat, V, load, run, store};

const BLOCK: usize = 16_384;

/// One step with the arena's gradients, which are reset to zero.
pub fn update(arena: &mut Arena, adam: &Adam) {
    let bias1 = 1.0 - adam.beta1.powf(adam.step as f64);
    let bias2 = 1.0 - adam.beta2.powf(adam.step as f64);
    let rule = Rule {
        rate: (adam.lr / bias1) as f32,
        beta1: adam.beta1 as f32,
        beta2: adam.beta2 as f32,
        root: (1.0 / bias2.sqrt()) as f32,
        eps: adam.eps as f32,
    };
    let Arena { params, grads, first, second } = arena;
    let blocks = params.chunks_mut(BLOCK).zip(grads.chunks_mut(BLOCK));
    let moments = first.chunks_mut(BLOCK).zip(second.chunks_mut(BLOCK));
    parallel::over(blocks.zip(moments), |_, ((p, g), (m, v))| run(Block { rule, p, g, m, v }));
}

#[derive(Clone, Copy)]
struct Rule {
    rate: f32,
    beta1: f32,
    beta2: f32,
    root: f32,
    eps: f32,
}

struct Block<'a> {
    rule: Rule,
    p: &'a mut [f32],
    g: &'a mut [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
}

impl Op for Block<'_> {
    type Number = f32;
    type Out = ();
    #[inline(always)]
    fn call<S: Simd>(self, s: S) {
        let Self { rule, p, g, m, v } = self;
        let number = |x: f32| V::<S, f32>::splat(s, x);
        let zero = number(0.0);
        let mut i = 0;
        while i < p.len() {
            let grad = load(s, g, i);
            let first = load(s, m, i).mul_add(number(rule.beta1), grad * number(1.0 - rule.beta1));
            let second = load(s, v, i).mul_add(number(rule.beta2), grad * grad * number(1.0 - rule.beta2));
            let step = first * number(rule.rate) / second.sqrt().mul_add(number(rule.root), number(rule.eps));
            store::<S, f32>(load(s, p, i) - step, p, i);
            // Decaying moments are flushed to zero instead of becoming denormals, which are slow.
            store::<S, f32>(first.abs().simd_gt(number(1e-30)).select(first, zero), m, i);
            store::<S, f32>(second.simd_gt(number(1e-36)).select(second, zero), v, i);
            store::<S, f32>(zero, g, i);
            i += V::<S, f32>::LEN;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_the_algorithm_in_double_precision() {
        let n = 37;
        let mut arena = Arena::new(n);
        let (mut p, mut m, mut v) = (vec![0.0f64; n], vec![0.0f64; n], vec![0.0f64; n]);
        for step in 1..=50u64 {
            for i in 0..n {
                let g = ((step * 31 + i as u64 * 17) % 23) as f64 / 11.0 - 1.0;
                arena.grads[i] = g as f32;
                let g = f64::from(g as f32);
                m[i] = 0.9 * m[i] + 0.1 * g;
                v[i] = 0.999 * v[i] + 0.001 * g * g;
                let (mh, vh) = (m[i] / (1.0 - 0.9f64.powi(step as i32)), v[i] / (1.0 - 0.999f64.powi(step as i32)));
                p[i] -= 1e-2 * mh / (vh.sqrt() + 1e-8);
            }
            update(&mut arena, &Adam { lr: 1e-2, beta1: 0.9, beta2: 0.999, eps: 1e-8, step });
            assert!(arena.grads.iter().all(|&g| g == 0.0));
        }
        for i in 0..n {
            assert!((f64::from(arena.params[i]) - p[i]).abs() < 1e-5, "{} {}", arena.params[i], p[i]);
        }
    }

    #[test]
    fn decaying_moments_end_at_zero() {
        let mut arena = Arena::new(16);
        arena.first.fill(1e-29);
        arena.second.fill(1e-35);
        for step in 1..=4000 {
            update(&mut arena, &Adam { lr: 1e-3, beta1: 0.9, beta2: 0.999, eps: 1e-8, step });
        }
        assert!(arena.first.iter().chain(arena.second.iter()).all(|&x| x == 0.0));
    }
}
