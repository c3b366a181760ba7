//! A device's kernels, compiled while a scan is read.

use crate::method;
use crate::tradeoff::speed;
use conefield_core::backend::Backend;
use conefield_core::method::{Job, Limits, Quiet};
use conefield_core::spec::load::Loaded;
use conefield_core::{Error, Result};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use tracing::debug;
use tracing::subscriber::{NoSubscriber, with_default};

/// Ends a rehearsal when it is dropped, also where reading panics.
struct Curtain<'a>(&'a AtomicBool);

impl Drop for Curtain<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Runs `read`. Meanwhile a backend with a device runs a step of the method of `loaded` on a tiny scan, which compiles the
/// kernels that the run needs: their text does not depend on sizes. The later methods of a chain go on until the inputs are
/// read. If this fails, the run says why.
pub fn meanwhile<T>(loaded: &Loaded, backend: &dyn Backend, read: impl FnOnce() -> Result<T>) -> Result<T> {
    if backend.device().is_none() {
        return read();
    }
    let done = AtomicBool::new(false);
    std::thread::scope(|threads| {
        let begin = Instant::now();
        let rehearsal = threads.spawn(|| with_default(NoSubscriber::default(), || rehearse(loaded, backend, &done)));
        let curtain = Curtain(&done);
        let found = read();
        drop(curtain);
        let read_s = begin.elapsed().as_secs_f64();
        let all = if matches!(rehearsal.join(), Ok(Ok(()))) { "all" } else { "not all" };
        debug!("inputs read after {read_s:.2} s, {all} kernels compiled after {:.2} s", begin.elapsed().as_secs_f64());
        found
    })
}

/// One step of the method, unless `done`.
fn rehearse(loaded: &Loaded, backend: &dyn Backend, done: &AtomicBool) -> Result<()> {
    let mut plan = method::plan_without_files(loaded, backend)?;
    let done = || done.load(Ordering::Relaxed);
    if done() {
        return Err(Error::Interrupted { step: 0 });
    }
    let scan = speed::scan(4, 16, 16);
    let limits = Limits { steps: Some(1), ..Limits::default() };
    plan.run(&Job { limits, ..Job::new(&scan, backend) }, &mut Quiet(&done)).map(drop)
}

#[cfg(all(test, feature = "wgpu"))]
mod tests {
    use super::*;
    use crate::shipped::SHIPPED;
    use conefield_backend_wgpu::Wgpu;
    use conefield_core::method::Silent;
    use conefield_core::spec::load::Draft;

    #[test]
    fn a_run_finds_its_kernels_compiled() {
        let all: [(&str, &[&str]); 8] = [
            ("smooth-tv", &[]),
            ("fdk", &[]),
            ("fista-tv", &[]),
            ("sart", &[]),
            ("cgls", &[]),
            ("asd-pocs", &[]),
            ("gaussians", &["start.count=500"]),
            ("naf", &["training.rays=32"]),
        ];
        for (spec, sets) in all {
            let Ok(backend) = Wgpu::open(None) else { return eprintln!("SKIPPED: no adapter for rehearsals") };
            let sets: Vec<_> = sets.iter().map(|set| set.to_string()).collect();
            let loaded = Draft::find(spec, &sets, SHIPPED).unwrap().finish().unwrap();
            rehearse(&loaded, &backend, &AtomicBool::new(false)).unwrap();
            let rehearsed = backend.kernels();
            assert!(rehearsed.len() > 2, "{spec}: {rehearsed:?}");
            let scan = speed::scan(6, 24, 20);
            let limits = Limits { steps: Some(2), ..Limits::default() };
            let mut plan = method::plan(&loaded, &backend).unwrap();
            plan.run(&Job { limits, ..Job::new(&scan, &backend) }, &mut Silent).unwrap();
            assert_eq!(backend.kernels(), rehearsed, "{spec}");
        }
    }

    #[test]
    fn an_error_of_reading_ends_a_rehearsal() {
        let Ok(backend) = Wgpu::open(None) else { return eprintln!("SKIPPED: no adapter for rehearsals") };
        let loaded = Draft::find("smooth-tv", &[], SHIPPED).unwrap().finish().unwrap();
        let found = meanwhile(&loaded, &backend, || Err::<(), _>(Error::unsupported("scan", "it ends too early")));
        assert!(found.unwrap_err().to_string().contains("it ends too early"));
    }
}
