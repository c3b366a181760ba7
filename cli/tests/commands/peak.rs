//! The data range of scores: derived from the reference if not given, and reported.

use crate::common::{conefield, json, text};
use conefield_projectors::simulate::phantom;
use serde_json::Value;
use std::path::Path;

/// A phantom in `[0, 1]`, and the same with an error of constant size and varying sign, both times `scale`.
fn pair(dir: &Path, scale: f32) -> [String; 2] {
    let truth = phantom(24).mapped(|x| scale * x);
    let mut found = truth.clone();
    found.data.iter_mut().enumerate().for_each(|(i, x)| *x += if i % 2 == 0 { 0.01 * scale } else { -0.01 * scale });
    [("truth", &truth), ("found", &found)].map(|(name, volume)| {
        let path = dir.join(format!("{name}-{scale}.nii.gz"));
        conefield_io::write_volume(&path, volume).unwrap();
        text(&path)
    })
}

fn scores(found: &str, truth: &str) -> [f64; 3] {
    let all = json(&["evaluate", found, truth, "--json"]);
    ["psnr", "ssim_2d", "peak"].map(|key| all[key].as_f64().unwrap())
}

#[test]
fn a_volume_scores_the_same_in_any_unit() {
    let dir = tempfile::tempdir().unwrap();
    let [truth, found] = pair(dir.path(), 1.0);
    let [psnr, ssim, peak] = scores(&found, &truth);
    assert!((psnr - 40.0).abs() < 0.01 && peak == 1.0, "{psnr} dB, peak {peak}");
    for scale in [0.02, 3000.0] {
        let [truth, found] = pair(dir.path(), scale);
        let [p, s, range] = scores(&found, &truth);
        // The phantom does not reach 1: its own range is slightly smaller.
        let share = range / f64::from(scale);
        assert!((0.5..=1.0).contains(&share), "x {scale}: {range}");
        let want = psnr + 20.0 * share.log10();
        assert!((p - want).abs() < 0.01 && (s - ssim).abs() < 0.05, "x {scale}: {p} dB, {s}; {want} dB, {ssim}");
        let said = conefield(&["evaluate", &found, &truth]).output().unwrap();
        assert!(String::from_utf8_lossy(&said.stdout).contains("peak"), "{said:?}");
    }
    let all = json(&["evaluate", &found, &truth, "--json", "--peak", "10"]);
    assert_eq!(all["peak"], Value::from(10.0));
}

#[test]
fn a_reference_in_another_unit_is_reported() {
    let dir = tempfile::tempdir().unwrap();
    let ([truth, found], [_, other]) = (pair(dir.path(), 1.0), pair(dir.path(), 0.02));
    let said = |volume: &str| {
        let mut command = conefield(&[]);
        // Without `--quiet`, which suppresses warnings.
        let program = command.get_program().to_owned();
        command = assert_cmd::Command::new(program);
        let output = command.args(["evaluate", volume, &truth]).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    assert!(said(&other).contains("multiplied by 49"), "{}", said(&other));
    assert!(!said(&found).contains("multiplied"), "{}", said(&found));
}
