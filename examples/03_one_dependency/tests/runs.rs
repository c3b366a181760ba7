//! The program runs, and its volume is like the phantom.

use std::process::Command;

#[test]
fn a_scan_becomes_a_volume() {
    let output = Command::new(env!("CARGO_BIN_EXE_one-dependency")).output().unwrap();
    let (said, wrong) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{wrong}");
    let psnr = said.split(" dB").next().and_then(|s| s.rsplit(' ').next()).and_then(|s| s.parse::<f64>().ok());
    assert!(psnr.is_some_and(|psnr| psnr > 25.0), "{said}");
    assert!(said.contains("(48, 48, 48) voxels"), "{said}");
}
