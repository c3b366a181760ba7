//! Whether kernels are right, and how fast they are.

use crate::{Asked, Result, file, say};
use conefield_backend_cpu::Cpu;
use conefield_backend_wgpu::{Limits, Wgpu};
use conefield_benches::{SAMPLES, Training, points, published, rays, spread};
use conefield_core::backend::Backend;
use conefield_core::method::{Context, Job, Method, Silent};
use conefield_core::place::{Array, ViewRays};
use conefield_projectors::simulate::{Protocol, phantom, simulate};
use conefield_projectors::voxel::Joseph;
use conefield_solvers::fdk::Fdk;
use ndarray::Array3;
use serde_json::{Value, json};
use std::process::Command;
use std::time::Instant;

fn open(asked: &Asked, limits: Limits) -> Result<Wgpu> {
    Ok(Wgpu::with_limits(Some(asked.adapter), limits)?)
}

/// Seconds that the kernels of the published configuration take to compile, the first time and again, and of the first step, in
/// which some drivers compile.
pub fn compile(asked: &Asked) -> Result<()> {
    let started = Instant::now();
    let backend = open(asked, Limits::default())?;
    let opened = started.elapsed().as_secs_f64();
    let mut seconds = vec![];
    let mut notes = vec![];
    for _ in 0..2 {
        let started = Instant::now();
        notes = backend.compile(&published(SAMPLES)?)?.1.notes;
        seconds.push(started.elapsed().as_secs_f64());
    }
    let rays = rays(16);
    let mut training = training_on(&backend)?;
    let started = Instant::now();
    training.step(&rays, 1)?;
    say(&json!({ "open_s": opened, "compile_s": seconds[0], "again_s": seconds[1],
        "first_step_s": started.elapsed().as_secs_f64(), "notes": notes }));
    Ok(())
}

/// Gradients of one step of the published configuration beside the CPU's.
pub fn quick_parity(asked: &Asked) -> Result<()> {
    let rays = rays(if asked.software { 16 } else { 64 });
    let gradients = |backend: &dyn Backend| -> Result<(f64, Vec<f32>)> {
        let mut training = Training::new(backend, published(64)?)?;
        let loss = training.gradients(&rays, 1)?.loss;
        training.exe.fetch(&mut training.model)?;
        Ok((loss, training.model.arena.grads.to_vec()))
    };
    let (cpu_loss, cpu) = gradients(&Cpu::new())?;
    let top = cpu.iter().fold(0.0f32, |m, g| m.max(g.abs()));
    let all = [("own limits", Limits::default()), ("no subgroups", Limits { no_subgroups: true, ..Limits::default() })];
    for (name, limits) in all {
        let (loss, found) = gradients(&open(asked, limits)?)?;
        // Not a fold by max, which would pass over a NaN.
        let off = cpu.iter().zip(&found).map(|(a, b)| (a - b).abs()).reduce(|a, b| if a >= b { a } else { b });
        let error = off.unwrap_or_default() / top;
        say(&json!({ "variant": name, "gradient_error": error, "loss": loss, "cpu_loss": cpu_loss }));
        let close = (loss - cpu_loss).abs() < 1e-4 * cpu_loss;
        if !(top > 0.0 && error < 1e-3 && close) {
            return Err(format!("{name}: gradients off by {error:e} of the largest, loss {loss} and {cpu_loss}").into());
        }
    }
    Ok(())
}

/// A model of the published configuration on a device.
fn training_on(backend: &Wgpu) -> Result<Training> {
    Ok(Training::new(backend, published(SAMPLES)?)?)
}

/// Seconds of a step with `count` rays: lowest, median, highest, over two seconds or 100 steps. What was timed before is
/// forgotten.
fn steps(training: &mut Training, count: usize) -> Result<([f64; 3], usize)> {
    let rays = rays(count);
    let mut times = vec![];
    let mut begin = Instant::now();
    for step in 1..=103 {
        if step == 4 {
            training.exe.profile();
            begin = Instant::now();
        }
        let seconds = training.step(&rays, step)?;
        if step > 3 {
            times.push(seconds);
            if begin.elapsed().as_secs_f64() > 2.0 {
                break;
            }
        }
    }
    let steps = times.len();
    Ok((spread(&mut times), steps))
}

/// `n` things in each of these times: median, lowest and highest rate.
fn rates(n: f64, [low, median, high]: [f64; 3]) -> Value {
    json!({ "median": n / median, "lowest": n / high, "highest": n / low })
}

/// Training by ray count and variant, the share of each kernel and of the CPU, and export, beside what the device can do.
pub fn kernels(asked: &Asked) -> Result<()> {
    let (counts, side): (&[usize], usize) =
        if asked.software { (&[64], 32) } else { (&[256, 1024, 4096, 16_384, 65_536], 256) };
    let backend = open(asked, Limits::default())?;
    let ceiling = backend.ceiling()?;
    // Multiply-adds: forward, forward once more on the way back, and two products backward. Table accesses: 8 corners of 10 levels,
    // read and then updated.
    let (macs, reads) = (4.0 * published(SAMPLES)?.macs() as f64, 2.0 * 8.0 * 10.0);
    say(&json!({ "bound_samples_per_s": {
        "by_multiply_adds": ceiling.multiply_adds / macs, "by_random_reads": ceiling.random_reads / reads,
    } }));
    let mut variants = vec![("own limits", Limits::default())];
    if backend.adapter().subgroups.is_some() {
        variants.push(("no subgroups", Limits { no_subgroups: true, ..Limits::default() }));
    }
    for (name, limits) in variants {
        let mut training = training_on(&open(asked, limits)?)?;
        let mut timed = training_on(&open(asked, Limits { profile: true, ..limits })?)?;
        for &count in counts {
            let samples = (count * SAMPLES) as f64;
            let (time, _) = steps(&mut training, count)?;
            let (_, counted) = steps(&mut timed, count)?;
            let kernels = timed.exe.profile();
            let on_device: f64 = kernels.iter().map(|(_, s)| s).sum::<f64>() / counted as f64;
            let each: Value = kernels.iter().map(|(k, s)| (k.clone(), json!(1e3 * s / counted as f64))).collect();
            let cpu = (on_device > 0.0).then(|| 1.0 - on_device / time[1]);
            say(&json!({ "variant": name, "rays": count, "samples_per_s": rates(samples, time),
                "kernels_ms": each, "share_outside_kernels": cpu }));
        }
    }
    let mut training = training_on(&backend)?;
    let points = points(side);
    let mut out = vec![0.0; points.len()];
    let time = repeated(|| Ok(training.exe.evaluate(&training.model, &points, &mut out)?))?;
    say(&json!({ "export_points_per_s": rates(points.len() as f64, time) }));
    Ok(())
}

/// Seconds of five runs after one to warm up: lowest, median, highest.
fn repeated(mut run: impl FnMut() -> Result<()>) -> Result<[f64; 3]> {
    run()?;
    let mut times = vec![];
    for _ in 0..5 {
        let start = Instant::now();
        run()?;
        times.push(start.elapsed().as_secs_f64());
    }
    Ok(spread(&mut times))
}

/// Forward projection and its adjoint on arrays that stay on the device, and FDK from host to host, in voxel updates a second (a
/// voxel and a view each).
pub fn voxels(asked: &Asked) -> Result<()> {
    let backend = open(asked, Limits::default())?;
    let (side, views) = if asked.software { (48, 12) } else { (256, 50) };
    let truth = phantom(side);
    let protocol = Protocol::r2(&truth.grid).with_views(views);
    let scan = simulate(&truth, &protocol.with_detector([side, side]))?;
    let g = &scan.geometry;
    let all: Vec<usize> = (0..views).collect();
    let rays = ViewRays { projector: &Joseph {}, geometry: g, views: &all };
    let place = backend.place();
    let (x, mut lines) = (place.adopt(truth.data.clone())?, place.zeros(scan.projections.dim().into())?);
    let mut volume = place.zeros(g.volume.shape)?;
    // Reading one number waits for all work.
    let done = |x: &Array| place.store(x, 0, Array3::zeros((1, side, side)).view_mut());
    let updates = (side * side * side * views) as f64;
    let report = |what: &str, time| say(&json!({ "work": what, "voxel_updates_per_s": rates(updates, time) }));

    let time = repeated(|| {
        place.forward(rays, &x, &mut lines)?;
        Ok(done(&lines)?)
    })?;
    report("forward projection", time);
    let time = repeated(|| {
        place.adjoint(rays, &lines, &mut volume)?;
        Ok(done(&volume)?)
    })?;
    report("its adjoint", time);
    let mut fdk = Fdk::default().plan(&Context::without_weights(&backend))?;
    let time = repeated(|| Ok(fdk.run(&Job::new(&scan, &backend), &mut Silent).map(drop)?))?;
    report("FDK from host to host", time);
    Ok(())
}

/// Runs the program with a spec on the kit's scan, as a user does: what it printed, its metrics, and the seconds it took.
fn program(spec: &str, backend: &str, arguments: &[&str]) -> Result<(Vec<u8>, std::io::Result<String>, f64)> {
    let run = std::env::temp_dir().join(format!("conefield-contact-{}", std::process::id()));
    let mut command = Command::new(file("conefield")?);
    command
        .arg("reconstruct")
        .arg(file("scan")?)
        .args(["--spec", spec, "--backend", backend, "--force", "-q", "-o"])
        .arg(&run);
    command.args(["--reference", "truth"]).args(arguments);
    let started = Instant::now();
    let done = command.output()?;
    let seconds = started.elapsed().as_secs_f64();
    let metrics = std::fs::read_to_string(run.join("metrics.jsonl"));
    let _ = std::fs::remove_dir_all(&run);
    if !done.status.success() {
        return Err(String::from_utf8_lossy(&done.stderr).into());
    }
    Ok((done.stdout, metrics, seconds))
}

/// `smooth-tv` on the device and on the CPU. A software device makes one pass per level.
pub fn classical(asked: &Asked) -> Result<()> {
    let few = ["methods.0.stop.passes=1", "methods.1.stop.passes=1", "methods.2.stop.passes=1"];
    let few = if asked.software { &few[..] } else { &[] };
    reconstruct("smooth-tv", &format!("wgpu:{}", asked.adapter), few)?;
    reconstruct("smooth-tv", "cpu", few)
}

/// `gaussians` on the device. A software device trains few of them for a few steps.
pub fn gaussians(asked: &Asked) -> Result<()> {
    let few = ["training.steps=40", "start.count=2000", "most=4000"];
    reconstruct("gaussians", &format!("wgpu:{}", asked.adapter), if asked.software { &few } else { &[] })
}

/// A spec on the kit's scan: seconds of the whole command and of the method alone, and PSNR.
fn reconstruct(spec: &str, backend: &str, settings: &[&str]) -> Result<()> {
    let settings = settings.iter().flat_map(|set| ["--set", *set]);
    let (said, _, seconds) = program(spec, backend, &["--json"].into_iter().chain(settings).collect::<Vec<_>>())?;
    let record: Value = serde_json::from_slice(&said)?;
    let (train_s, psnr) = (&record["train_s"], &record["scores"]["psnr"]);
    say(&json!({ "spec": spec, "backend": backend, "seconds": seconds, "train_s": train_s, "psnr": psnr }));
    Ok(())
}

/// Sixty seconds of `balanced` on the kit's scan: the seconds to marks of PSNR, and the last one.
pub fn training(asked: &Asked) -> Result<()> {
    let mut arguments = vec!["--seconds", "60s", "--set", "training.report_every=25"];
    if asked.software {
        arguments.extend(["--set", "training.rays=64", "--set", "projector.samples=64"]);
    }
    let (_, metrics, _) = program("balanced", &format!("wgpu:{}", asked.adapter), &arguments)?;
    let records: Vec<Value> = metrics?.lines().map(serde_json::from_str).collect::<std::result::Result<_, _>>()?;
    let points: Vec<(f64, f64)> =
        records.iter().filter_map(|r| r["seconds"].as_f64().zip(r["psnr"].as_f64())).collect();
    let reached = |mark: f64| points.iter().find(|(_, psnr)| *psnr >= mark).map(|(seconds, _)| *seconds);
    let marks: Value =
        [25, 30, 32, 34, 35, 36, 37].map(|mark| (mark.to_string(), json!(reached(mark.into())))).into_iter().collect();
    let steps = records.last().map(|r| r["step"].clone());
    say(&json!({ "seconds_to_psnr": marks, "last": points.last(), "steps": steps }));
    Ok(())
}
