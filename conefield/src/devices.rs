//! Several devices for one run. Each has a thread, which runs the method on its part of every array; see
//! [`conefield_core::place::Ranks`].

use conefield_core::backend::{Backend, Executable, Explain};
use conefield_core::pipeline::Pipeline;
use conefield_core::place::{Moved, Place, Ranks, Threads};
use conefield_core::{Error, Result};
use std::sync::Arc;

/// A backend among several that share the arrays of a method.
pub(crate) struct Member {
    pub(crate) device: Box<dyn Backend>,
    pub(crate) place: Arc<Ranks>,
}

/// The backend of several devices: the first one leads.
struct Devices {
    members: Vec<Member>,
    threads: Arc<Threads>,
}

/// The backend of `devices`, which share the arrays of a method. A field is trained by one device only.
pub fn join(devices: Vec<Box<dyn Backend>>) -> Box<dyn Backend> {
    let threads = Threads::new(devices.len());
    let member = |(device, peers): (Box<dyn Backend>, _)| {
        let place = Arc::new(Ranks::new(peers, device.place()));
        Member { device, place }
    };
    Box::new(Devices { members: devices.into_iter().zip(threads.peers()).map(member).collect(), threads })
}

impl Backend for Member {
    fn name(&self) -> &'static str {
        self.device.name()
    }

    fn describe(&self) -> String {
        self.device.describe()
    }

    fn compile(&self, _: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        Err(Error::unsupported("method", "several processes or devices: a field is trained by one"))
    }

    fn place(&self) -> Arc<dyn Place> {
        self.place.clone()
    }

    fn moved(&self) -> Moved {
        self.device.moved()
    }
}

impl Backend for Devices {
    fn name(&self) -> &'static str {
        self.members[0].name()
    }

    fn describe(&self) -> String {
        self.members.iter().map(|member| member.device.describe()).collect::<Vec<_>>().join("; ")
    }

    fn compile(&self, pipeline: &Pipeline) -> Result<(Box<dyn Executable>, Explain)> {
        self.members[0].compile(pipeline)
    }

    fn place(&self) -> Arc<dyn Place> {
        self.members[0].place()
    }

    fn moved(&self) -> Moved {
        self.members.iter().fold(Moved::default(), |sum, member| {
            let Moved { to_device, from_device } = member.moved();
            Moved { to_device: sum.to_device + to_device, from_device: sum.from_device + from_device }
        })
    }

    fn run(
        &self,
        lead: &mut dyn FnMut() -> Result<()>,
        follow: &(dyn Fn(&dyn Backend) -> Result<()> + Sync),
    ) -> Result<()> {
        self.threads.run(lead, |rank| follow(&self.members[rank])).map(drop)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conefield_backend_cpu::Cpu;
    use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn three() -> Box<dyn Backend> {
        join((0..3).map(|_| Box::new(Cpu::new()) as Box<dyn Backend>).collect())
    }

    /// Waits for a member that agrees.
    fn wait(backend: &dyn Backend) -> Result<()> {
        while !backend.place().agree(false) {}
        Ok(())
    }

    #[test]
    fn all_members_run_and_agree() {
        let (backend, agreed) = (three(), AtomicUsize::new(0));
        let meet = |backend: &dyn Backend, flag: bool| {
            agreed.fetch_add(usize::from(backend.place().agree(flag)), Ordering::Relaxed);
            Ok(())
        };
        backend.run(&mut || meet(backend.as_ref(), true), &|other| meet(other, false)).unwrap();
        assert_eq!(agreed.into_inner(), 3);
    }

    #[test]
    fn the_failure_of_one_ends_all() {
        let (backend, count) = (three(), AtomicUsize::new(0));
        let one_fails = |other: &dyn Backend| match count.fetch_add(1, Ordering::Relaxed) {
            1 => Err(Error::unsupported("device", "out of memory")),
            _ => wait(other),
        };
        let e = backend.run(&mut || wait(backend.as_ref()), &one_fails).unwrap_err().to_string();
        assert!(e.contains("out of memory"), "{e}");
        let meet = |backend: &dyn Backend| {
            backend.place().agree(false);
            Ok(())
        };
        backend.run(&mut || meet(backend.as_ref()), &meet).expect("the next run can succeed");
    }

    #[test]
    fn a_panic_reaches_the_caller() {
        let backend = three();
        let panics = |_: &dyn Backend| -> Result<()> { resume_unwind(Box::new("lost")) };
        let run = || backend.run(&mut || wait(backend.as_ref()), &panics);
        let panic = catch_unwind(AssertUnwindSafe(run)).unwrap_err();
        assert_eq!(panic.downcast_ref::<&str>(), Some(&"lost"));
    }
}
