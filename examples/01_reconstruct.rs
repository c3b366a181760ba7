//! From a known volume to its reconstruction, without files: simulate a scan, build a shipped spec with one setting
//! changed, solve, score.

use conefield::simulate::{Protocol, phantom, simulate};
use conefield_backend_cpu::Cpu;
use conefield_core::method::{Context, Job, Limits, Silent};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let truth = phantom(48);
    let protocol = Protocol::r2(&truth.grid).with_detector([48, 48]).with_views(30);
    let scan = simulate(&truth, &protocol)?;

    let loaded = conefield::specs::read("fast", &["field.width=16".into()])?;
    let backend = Cpu::new();
    let mut plan = loaded.spec.method.plan(&Context::new(&backend))?;
    let limits = Limits { steps: Some(200), ..Limits::default() };
    let solution = plan.run(&Job { limits, ..Job::new(&scan, &backend) }, &mut Silent)?;
    let volume = solution.result.volume(&backend)?;
    let psnr = conefield::metrics::psnr(volume.data.view(), truth.data.view(), 1.0)?;
    println!("{} steps in {:.1} s: {psnr:.2} dB", solution.steps, solution.train_s);
    Ok(())
}
