//! A standalone program that reads a scan from disk and writes a volume: `conefield` is its only dependency.

use conefield::simulate::{Protocol, phantom};
use conefield::{Reconstruct, Result, io, read_scan};

fn main() -> Result<()> {
    let folder = std::env::temp_dir().join(format!("conefield-example-{}", std::process::id()));
    std::fs::create_dir_all(&folder).map_err(|e| conefield::Error::io(&folder, e))?;

    // A scan to read. Yours is a folder or a file of your own: docs/guide/scan-in.md.
    let truth = phantom(48);
    let protocol = Protocol::r2(&truth.grid).with_detector([64, 64]).with_views(40);
    io::write_scan(folder.join("scan"), &conefield::simulate::simulate(&truth, &protocol)?, Some(&truth))?;

    let scan = read_scan(folder.join("scan"))?;
    let result = Reconstruct::with("sirt").steps(20).reference(truth).run(scan)?;
    io::write_volume(folder.join("volume.nii.gz"), &result.volume)?;

    let psnr = result.scores.map_or(f64::NAN, |s| s.psnr);
    println!("{}: {} passes in {:.1} s, {psnr:.2} dB", result.spec, result.steps, result.train_s);
    println!("{:?} voxels written and removed again", io::read_volume(folder.join("volume.nii.gz"))?.data.dim());
    std::fs::remove_dir_all(&folder).map_err(|e| conefield::Error::io(&folder, e))
}
