//! Compares the metrics with values that `golden.py` computed with other code, and with values computed by hand.

use conefield_evaluation::metrics::{Scores, evaluate, psnr};
use ndarray::{Array3, ArrayView3, ShapeBuilder};
use serde_json::Value;

/// The pair that `golden.py` builds from the same settings.
fn pair(case: &Value) -> [Array3<f32>; 2] {
    let shape: [usize; 3] = std::array::from_fn(|k| case["shape"][k].as_u64().unwrap() as usize);
    let number = |name: &str| case[name].as_f64().unwrap();
    let (level, shift, peak) = (number("noise_level"), number("shift"), number("peak"));
    let empty = case["empty"].as_u64().unwrap() as usize;
    let body = |x: f64, y: f64, z: f64| {
        let inside = |c: [f64; 2], r: [f64; 3]| {
            ((x - c[0]) / r[0]).powi(2) + ((y - c[1]) / r[1]).powi(2) + (z / r[2]).powi(2) < 1.0
        };
        0.25 + 0.1 * (5.0 * x + 1.0).sin() * (4.0 * y).sin() * (3.0 * z + 0.5).sin()
            + if inside([0.0, 0.0], [0.8, 0.7, 0.9]) { 0.4 } else { 0.0 }
            + if inside([0.2, -0.1], [0.3, 0.25, 0.4]) { 0.2 } else { 0.0 }
    };
    let at = |i: usize, k: usize| (i as f64 + 0.5) / shape[k] as f64 * 2.0 - 1.0;
    let mut state = case["seed"].as_u64().unwrap();
    let result = Array3::from_shape_fn(shape, |(i, j, k)| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        let noise = (state >> 40) as f64 / 16777216.0 - 0.5;
        ((body(at(i, 0) + shift, at(j, 1), at(k, 2) - shift) + level * noise) * peak) as f32
    });
    let reference =
        Array3::from_shape_fn(
            shape,
            |(i, j, k)| {
                if i < empty { 0.0 } else { (body(at(i, 0), at(j, 1), at(k, 2)) * peak) as f32 }
            },
        );
    [result, reference]
}

fn cases() -> Vec<Value> {
    serde_json::from_str(include_str!("golden.json")).unwrap()
}

fn close(name: &str, found: f64, expected: &Value) {
    let expected = expected.as_f64().unwrap();
    assert!((found - expected).abs() < 1e-6, "{name}: found {found}, expected {expected}");
}

fn compare(scores: &Scores, golden: &Value) {
    close("psnr", scores.psnr, &golden["psnr"]);
    close("rmse", scores.rmse, &golden["rmse"]);
    close("ssim_2d", scores.ssim_2d.unwrap(), &golden["ssim_2d"]);
    close("ssim_3d", scores.ssim_3d.unwrap(), &golden["ssim_3d"]);
    close("ssim_skimage", scores.ssim_skimage.unwrap(), &golden["ssim_skimage"]);
    let json = serde_json::to_value(scores).unwrap();
    let [found, expected] = [&json, golden].map(|scores| scores["worst_slices"].as_array().unwrap());
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert_eq!((&found["axis"], &found["index"]), (&expected["axis"], &expected["index"]));
        close("worst slice", found["psnr"].as_f64().unwrap(), &expected["psnr"]);
    }
}

#[test]
fn all_metrics_agree_with_independent_code() {
    for case in cases() {
        let [result, reference] = pair(&case);
        let peak = case["peak"].as_f64().unwrap();
        let scores = evaluate(result.view(), reference.view(), peak).unwrap();
        compare(&scores, &case["scores"]);
        assert_eq!(psnr(result.view(), reference.view(), peak).unwrap(), scores.psnr);
    }
}

#[test]
fn memory_order_and_thread_count_do_not_matter() {
    let [a, b] = pair(&cases()[3]);
    let mut columns = Array3::zeros(a.dim().f());
    columns.assign(&a);
    let on = |threads: usize, a: ArrayView3<f32>| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| evaluate(a, b.view(), 1.0).unwrap())
    };
    let one = on(1, a.view());
    assert_eq!(one, on(3, a.view()));
    assert_eq!(one, on(2, columns.view()));
}

#[test]
fn equal_volumes_score_full_marks() {
    let [_, b] = pair(&cases()[0]);
    let scores = evaluate(b.view(), b.view(), 1.0).unwrap();
    assert_eq!((scores.psnr, scores.rmse), (f64::INFINITY, 0.0));
    for ssim in [scores.ssim_2d, scores.ssim_3d, scores.ssim_skimage] {
        assert!((ssim.unwrap() - 1.0).abs() < 1e-12);
    }
    assert_eq!(serde_json::to_value(&scores).unwrap()["psnr"], Value::Null);
}

#[test]
fn a_metric_that_is_not_defined_leaves_the_others() {
    let a = Array3::<f32>::from_elem((9, 9, 9), 0.5);
    let scores = evaluate(a.view(), a.view(), 1.0).unwrap();
    assert!(scores.ssim_2d.is_some() && scores.ssim_3d.is_none() && scores.ssim_skimage.is_some());
    let why = &scores.missing["ssim_3d"];
    assert!(why.contains("ssim_3d") && why.contains("[9, 9, 9]") && why.contains("11"), "{why}");

    let small = Array3::<f32>::zeros((20, 20, 6));
    let scores = evaluate(small.view(), small.view(), 1.0).unwrap();
    assert_eq!(scores.missing.keys().copied().collect::<Vec<_>>(), ["ssim_2d", "ssim_3d", "ssim_skimage"]);
    assert!(scores.missing["ssim_2d"].contains("no positive value"));
    assert_eq!(scores.rmse, 0.0);
}

#[test]
fn what_cannot_be_compared_is_refused_in_words() {
    let a = Array3::<f32>::zeros((12, 12, 12));
    let says = |x: &Array3<f32>, y: &Array3<f32>, peak: f64, words: &[&str]| {
        let e = evaluate(x.view(), y.view(), peak).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    says(&a, &Array3::zeros((12, 12, 13)), 1.0, &["[12, 12, 12]", "[12, 12, 13]"]);
    says(&Array3::zeros((0, 3, 3)), &Array3::zeros((0, 3, 3)), 1.0, &["at least one voxel"]);
    let mut bad = a.clone();
    bad[[3, 4, 5]] = f32::NAN;
    says(&bad, &a, 1.0, &["result[3, 4, 5]", "NaN"]);
    bad[[3, 4, 5]] = f32::INFINITY;
    says(&a, &bad, 1.0, &["reference[3, 4, 5]", "inf"]);
    for peak in [0.0, -1.0, f64::NAN] {
        says(&a, &a, peak, &["peak", "positive"]);
    }
}
