//! Arrays beyond a memory limit: large allocations live in files, mapped into memory.
//!
//! [`Allocator`] is the program's allocator, and counts what it holds. After [`begin`], an allocation of at least
//! [`LARGE`] bytes that does not fit beside the others gets a file of its own. Its pages come into memory when they are
//! used. When the process exceeds the limit, a thread frees these pages: the system keeps them in its cache, and writes
//! them to the disk when it needs the memory. Kernels and their order do not depend on where a number is, so results do
//! not either.
//!
//! The files have no name: no other process can open them, and the system removes them however this process ends. Their
//! space is reserved at the start, so that a disk that fills up later is no error.

#![allow(unsafe_code)]

use crate::allowance;
use crate::error::{Error, Result};
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Smaller allocations stay in memory.
pub const LARGE: usize = 16 << 20;

/// The smallest limit: allocations below [`LARGE`], threads and libraries need a part of it.
pub const LEAST: u64 = 256 << 20;

/// Bytes in memory, besides mapped ones.
static HELD: AtomicU64 = AtomicU64::new(0);

/// Bytes in files.
static MAPPED: AtomicU64 = AtomicU64::new(0);

/// Bytes beyond which large allocations go to files.
static STAYS: AtomicU64 = AtomicU64::new(u64::MAX);

/// Bytes that the process allocates now.
pub fn allocated() -> u64 {
    HELD.load(Relaxed) + MAPPED.load(Relaxed)
}

/// An allocator that counts, and that uses files after [`begin`].
pub struct Allocator;

impl Allocator {
    /// Whether an allocation of `bytes` goes to a file.
    fn leaves(bytes: usize) -> bool {
        bytes >= LARGE && (bytes as u64).saturating_add(HELD.load(Relaxed)) > STAYS.load(Relaxed)
    }
}

// SAFETY: every block comes from the system's allocator, or is a mapping of its own with at least `layout.size()`
// bytes, aligned to a page; no layout in this program needs more. `files::release` tells the two apart by address.
unsafe impl GlobalAlloc for Allocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as in the contract of the caller.
        counted(layout, || unsafe { System.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // A new file holds zeros too. SAFETY: as in the contract of the caller.
        counted(layout, || unsafe { System.alloc_zeroed(layout) })
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        if layout.size() >= LARGE && files::release(at) {
            return;
        }
        HELD.fetch_sub(layout.size() as u64, Relaxed);
        // SAFETY: the block is no mapping, so it is the system's.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        if layout.size().max(size) >= LARGE && (Self::leaves(size) || files::holds(at)) {
            // SAFETY: the caller guarantees that the size is valid with this alignment, and that `at` holds the block.
            unsafe {
                let new = self.alloc(Layout::from_size_align_unchecked(size, layout.align()));
                if !new.is_null() {
                    new.copy_from_nonoverlapping(at, layout.size().min(size));
                    self.dealloc(at, layout);
                }
                return new;
            }
        }
        // SAFETY: the block is no mapping, so it is the system's.
        let new = unsafe { System.realloc(at, layout, size) };
        if !new.is_null() {
            HELD.fetch_add(size as u64, Relaxed);
            HELD.fetch_sub(layout.size() as u64, Relaxed);
        }
        new
    }
}

/// A block in a file if it leaves memory and there is room for it, else the one that `system` returns.
fn counted(layout: Layout, system: impl FnOnce() -> *mut u8) -> *mut u8 {
    if Allocator::leaves(layout.size())
        && let Some(block) = files::block(layout.size())
    {
        return block;
    }
    let block = system();
    if !block.is_null() {
        HELD.fetch_add(layout.size() as u64, Relaxed);
    }
    block
}

/// Keeps the process below `limit` bytes of memory from now on, with up to `bytes` in files on the disk of `folder`.
///
/// # Errors
/// Too little space on the disk, a folder in which no file can be made, or a system without unnamed files.
pub fn begin(folder: &Path, limit: u64, bytes: u64) -> Result<()> {
    if HELD.load(Relaxed) == 0 {
        return Err(Error::unsupported(
            "scratch files",
            "this program has another allocator than `scratch::Allocator`",
        ));
    }
    files::begin(folder, limit, bytes)?;
    STAYS.store(limit / 3, Relaxed);
    allowance::set_room(room(limit), files::trim);
    Ok(())
}

/// Bytes of an array that a process with this limit has in memory at once.
pub fn room(limit: u64) -> u64 {
    limit / 16 * 5
}

/// Free bytes on the disk of `folder`, if the system says so.
pub fn free(folder: &Path) -> Option<u64> {
    files::free(folder).ok()
}

#[cfg(target_os = "linux")]
mod files {
    use super::*;
    use rustix::fs::{FallocateFlags, fallocate, statvfs};
    use rustix::io::Errno;
    use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap, munmap};
    use std::fs::File;
    use std::io::Read;
    use std::path::PathBuf;
    use std::ptr;
    use std::sync::{Mutex, MutexGuard, PoisonError};
    use std::time::{Duration, Instant};

    /// Time between two looks of the thread at the resident memory.
    const PAUSE: Duration = Duration::from_millis(2);

    /// Least time between two looks, whoever looks.
    const REST: Duration = Duration::from_micros(500);

    /// Resident bytes beyond which mapped pages are taken out of the process.
    static MOST: AtomicU64 = AtomicU64::new(u64::MAX);

    /// The files in use.
    static SCRATCH: Mutex<Option<Scratch>> = Mutex::new(None);

    struct Scratch {
        folder: PathBuf,
        /// A file that keeps space for the others.
        reserve: File,
        reserved: u64,
        /// Address and bytes of each mapping.
        maps: Vec<(usize, usize)>,
    }

    impl Scratch {
        /// Gives space back to the reserve, if nothing else has taken it.
        fn give_back(&mut self, bytes: u64) {
            let reserved = self.reserved + bytes;
            if allocate(&self.reserve, reserved).is_ok() {
                self.reserved = reserved;
            }
        }
    }

    fn scratch() -> MutexGuard<'static, Option<Scratch>> {
        SCRATCH.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Gives `file` space on the disk for `bytes`.
    fn allocate(file: &File, bytes: u64) -> rustix::io::Result<()> {
        fallocate(file, FallocateFlags::empty(), 0, bytes)
    }

    pub fn free(folder: &Path) -> rustix::io::Result<u64> {
        statvfs(folder).map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize))
    }

    pub fn begin(folder: &Path, limit: u64, bytes: u64) -> Result<()> {
        let failed = |e| Error::io(folder, e);
        let mut scratch = scratch();
        if scratch.is_none() {
            let folder = folder.canonicalize().map_err(failed)?;
            let reserve = tempfile::tempfile_in(&folder).map_err(failed)?;
            // The rest is for what comes in until the thread has its turn.
            MOST.store(limit / 4 * 3, Relaxed);
            let watch = || loop {
                std::thread::sleep(PAUSE);
                trim();
            };
            std::thread::Builder::new().name("scratch".into()).spawn(watch).map_err(failed)?;
            *scratch = Some(Scratch { folder, reserve, reserved: 0, maps: vec![] });
        }
        let Some(scratch) = scratch.as_mut() else { return Ok(()) };
        // A second estimate extends what the first one reserved.
        let more = bytes.saturating_sub(scratch.reserved);
        let free = free(&scratch.folder).map_err(|e| failed(e.into()))?;
        let short = || {
            let [free, more] = [free, more].map(allowance::mib);
            let expected = format!("{more} for arrays that do not fit into memory");
            Error::invalid(folder.display().to_string(), "free space", free, expected)
        };
        if free < more {
            return Err(short());
        }
        let reserved = scratch.reserved.max(bytes);
        allocate(&scratch.reserve, reserved).map_err(|e| if e == Errno::NOSPC { short() } else { failed(e.into()) })?;
        scratch.reserved = reserved;
        Ok(())
    }

    /// A mapped block of zeros; `None` without room for it.
    pub fn block(bytes: usize) -> Option<*mut u8> {
        let mut scratch = scratch();
        let scratch = scratch.as_mut()?;
        let file = tempfile::tempfile_in(&scratch.folder).ok()?;
        // The block takes its space from the reserve.
        let taken = scratch.reserved.min(bytes as u64);
        scratch.reserve.set_len(scratch.reserved - taken).ok()?;
        scratch.reserved -= taken;
        let mapped = allocate(&file, bytes as u64).and_then(|()| {
            let access = ProtFlags::READ | ProtFlags::WRITE;
            // SAFETY: a new mapping at an address that the system chooses. No other process can open its file.
            unsafe { mmap(ptr::null_mut(), bytes, access, MapFlags::SHARED, &file, 0) }
        });
        let Ok(at) = mapped else {
            drop(file);
            scratch.give_back(taken);
            return None;
        };
        scratch.maps.push((at as usize, bytes));
        MAPPED.fetch_add(bytes as u64, Relaxed);
        Some(at.cast())
    }

    /// Whether a mapping begins at this address.
    pub fn holds(at: *mut u8) -> bool {
        scratch().as_ref().is_some_and(|s| s.maps.iter().any(|map| map.0 == at as usize))
    }

    /// Ends the mapping that begins at this address, if there is one.
    pub fn release(at: *mut u8) -> bool {
        let mut scratch = scratch();
        let Some(scratch) = scratch.as_mut() else { return false };
        let Some(i) = scratch.maps.iter().position(|map| map.0 == at as usize) else { return false };
        let (_, bytes) = scratch.maps.swap_remove(i);
        // SAFETY: the caller gives up the block, which is this whole mapping.
        let _ = unsafe { munmap(at.cast(), bytes) };
        MAPPED.fetch_sub(bytes as u64, Relaxed);
        scratch.give_back(bytes as u64);
        true
    }

    /// Resident bytes of the process, and those of them that are in files.
    fn resident() -> Option<(u64, u64)> {
        let mut text = [0; 128];
        let read = File::open("/proc/self/statm").and_then(|mut statm| statm.read(&mut text)).ok()?;
        let word =
            |word: &[u8]| word.iter().filter(|c| c.is_ascii_digit()).fold(0u64, |n, c| 10 * n + u64::from(c - b'0'));
        let mut bytes = text[..read].split(|c| *c == b' ').map(|pages| word(pages) * rustix::param::page_size() as u64);
        Some((bytes.nth(1)?, bytes.next()?))
    }

    /// Takes mapped pages out of the process if it holds more than [`MOST`] bytes, unless they are the smaller part.
    /// Cheap enough for every part of a loop: it looks at most once in [`REST`]. Other threads wait meanwhile: they would
    /// bring pages in faster than they go.
    pub fn trim() {
        static LAST: Mutex<Option<Instant>> = Mutex::new(None);
        let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
        if last.is_some_and(|last| last.elapsed() < REST) {
            return;
        }
        *last = Some(Instant::now());
        let most = MOST.load(Relaxed);
        if resident().is_none_or(|(all, mapped)| all <= most || mapped < most / 8) {
            return;
        }
        for &(at, bytes) in scratch().iter().flat_map(|s| &s.maps) {
            // SAFETY: the mapping is in use while the lock is held. It is shared, so its numbers stay in the file.
            let _ = unsafe { madvise(at as *mut _, bytes, Advice::LinuxDontNeed) };
        }
    }

    #[test]
    fn a_block_without_room_leaves_the_reserve_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        begin(folder.path(), u64::MAX, 1 << 20).unwrap();
        // More than any file has.
        assert_eq!(block(isize::MAX as usize), None);
        assert_eq!(scratch().as_ref().map(|s| s.reserved), Some(1 << 20));
    }
}

#[cfg(not(target_os = "linux"))]
mod files {
    use super::*;

    pub fn free(_: &Path) -> std::io::Result<u64> {
        Err(std::io::ErrorKind::Unsupported.into())
    }

    pub fn begin(folder: &Path, _: u64, _: u64) -> Result<()> {
        let what = format!("scratch files in {}", folder.display());
        Err(Error::unsupported(what, "this system has no unnamed files; use Linux, or more memory"))
    }

    pub fn block(_: usize) -> Option<*mut u8> {
        None
    }

    pub fn holds(_: *mut u8) -> bool {
        false
    }

    pub fn release(_: *mut u8) -> bool {
        false
    }

    pub fn trim() {}
}
