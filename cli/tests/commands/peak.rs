//! The data range of scores: derived from the reference if not given, and reported.

use crate::common::{Folder, number};
use conefield_projectors::simulate::phantom;

/// Adds a phantom in `[0, 1]`, and the same with an error of constant size and varying sign, both times `scale`.
fn pair(d: &Folder, scale: f32) {
    let truth = phantom(24).mapped(|x| scale * x);
    let mut found = truth.clone();
    found.data.iter_mut().enumerate().for_each(|(i, x)| *x += if i % 2 == 0 { 0.01 * scale } else { -0.01 * scale });
    for (name, volume) in [("truth", &truth), ("found", &found)] {
        conefield_io::write_volume(d.at(format!("{name}-{scale}.nii.gz")), volume).unwrap();
    }
}

#[test]
fn a_volume_scores_the_same_in_any_unit() {
    let d = Folder::new();
    let scores = |scale: f32| {
        pair(&d, scale);
        let all = d.json(&format!("evaluate found-{scale}.nii.gz truth-{scale}.nii.gz --json"));
        ["psnr", "ssim_2d", "peak"].map(|key| number(&all[key]))
    };
    let [psnr, ssim, peak] = scores(1.0);
    assert!((psnr - 40.0).abs() < 0.01 && peak == 1.0, "{psnr} dB, peak {peak}");
    for scale in [0.02, 3000.0] {
        let [p, s, range] = scores(scale);
        // The phantom does not reach 1: its own range is slightly smaller.
        let share = range / f64::from(scale);
        assert!((0.5..=1.0).contains(&share), "x {scale}: {range}");
        let want = psnr + 20.0 * share.log10();
        assert!((p - want).abs() < 0.01 && (s - ssim).abs() < 0.05, "x {scale}: {p} dB, {s}; {want} dB, {ssim}");
        let said = d.done(&format!("evaluate found-{scale}.nii.gz truth-{scale}.nii.gz"));
        assert!(said.contains("peak"), "{said}");
    }
    assert_eq!(d.json("evaluate found-1.nii.gz truth-1.nii.gz --json --peak 10")["peak"], 10.0);
    // A reference in another unit is reported.
    for (found, reported) in [("found-0.02.nii.gz", true), ("found-1.nii.gz", false)] {
        let output = d.loud(&format!("evaluate {found} truth-1.nii.gz")).assert().success().get_output().clone();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(said.contains("multiplied by 49"), reported, "{said}");
        assert_eq!(said.contains("multiplied"), reported, "{said}");
    }
}
