//! Wakes the learner: one page of shared memory with a count of rings and a mark that says whether anyone sleeps.
//!
//! A ring costs an addition and a load while the learner is awake, and one system call when it sleeps. No
//! wake-up is lost: the sleeper notes the count, raises its mark, looks for frames once more, and lets the kernel
//! compare the count with what it noted before it sleeps; the ringer adds first and looks at the mark after.
//!
//! iceoryx2's event service does the same with datagrams. There one waking cost the learner twice the CPU (3.3 µs per
//! frame against 1.6), the socket limits the path's length, and by its source its state may be left at "notified"
//! while the listener sleeps, if a notifier is preempted between its datagram and its mark: every later notification
//! is then swallowed.

use rustix::fs::{FallocateFlags, Mode, OFlags};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::thread::futex;
use std::os::fd::AsFd;
use std::path::Path;
use std::ptr::{NonNull, null_mut};
use std::sync::atomic::{AtomicU32, Ordering::SeqCst};
use std::time::Duration;

/// What lies in the page. Atomics only, and every bit pattern is valid. Each on a cache line of its own.
#[repr(C)]
struct Page {
    rings: Line,
    asleep: Line,
}

#[repr(C, align(64))]
struct Line(AtomicU32);

/// Its file, after the run's prefix.
pub(crate) const NAME: &str = "bell";

const PAGE_LEN: usize = 4096;
const _: () = assert!(size_of::<Page>() <= PAGE_LEN && align_of::<Page>() <= PAGE_LEN);

/// A mapping of the page. Many ring, one sleeps.
#[derive(Debug)]
pub(crate) struct Bell {
    page: NonNull<Page>,
}

// SAFETY: the mapping belongs to the process, not to a thread, and what lies in it is only touched atomically.
unsafe impl Send for Bell {}
// SAFETY: as above.
unsafe impl Sync for Bell {}

impl Bell {
    /// Makes the page, or takes over the one a former learner made: senders that still live have it mapped.
    pub(crate) fn create(path: &Path) -> Result<Self, Errno> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::CLOEXEC;
        let file = rustix::fs::open(path, flags, Mode::RUSR | Mode::WUSR)?;
        // Not truncate: that would leave the page to be found at the first write, or not, with SIGBUS.
        rustix::fs::fallocate(&file, FallocateFlags::empty(), 0, PAGE_LEN as u64)?;
        let bell = Self::map(file)?;
        bell.page().asleep.0.store(0, SeqCst);
        Ok(bell)
    }

    pub(crate) fn open(path: &Path) -> Result<Self, Errno> {
        let file = rustix::fs::open(path, OFlags::RDWR | OFlags::CLOEXEC, Mode::empty())?;
        if rustix::fs::fstat(&file)?.st_size < PAGE_LEN as i64 {
            return Err(Errno::INVAL);
        }
        Self::map(file)
    }

    fn map(file: impl AsFd) -> Result<Self, Errno> {
        let protection = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a fresh mapping at an address of the kernel's choice overlaps nothing.
        let page = unsafe { mmap(null_mut(), PAGE_LEN, protection, MapFlags::SHARED, file, 0) }?;
        let page = NonNull::new(page.cast()).ok_or(Errno::NOMEM)?;
        Ok(Self { page })
    }

    fn page(&self) -> &Page {
        // SAFETY: mapped, aligned and large enough from `map` to `drop`; other processes change it through the
        // same atomics only.
        unsafe { self.page.as_ref() }
    }

    /// Says that something has changed.
    pub(crate) fn ring(&self) {
        let Page { rings, asleep } = self.page();
        rings.0.fetch_add(1, SeqCst);
        if asleep.0.load(SeqCst) != 0 {
            // A failure leaves the sleeper to its time limit.
            let _woken = futex::wake(&rings.0, futex::Flags::empty(), i32::MAX as u32);
        }
    }

    /// Sleeps until a ring, the time limit or a signal, unless `look` finds something before.
    pub(crate) fn sleep_unless<E>(
        &self,
        time_limit: Duration,
        look: impl FnOnce() -> Result<bool, E>,
    ) -> Result<(), E> {
        let Page { rings, asleep } = self.page();
        let seen = rings.0.load(SeqCst);
        asleep.0.store(1, SeqCst);
        let found = look();
        if let Ok(false) = found {
            let time_limit = time_limit.try_into().ok();
            // However it ends, the caller looks again.
            let _outcome = futex::wait(&rings.0, futex::Flags::empty(), seen, time_limit.as_ref());
        }
        asleep.0.store(0, SeqCst);
        found.map(|_| ())
    }
}

impl Drop for Bell {
    fn drop(&mut self) {
        // SAFETY: mapped by `map` with this length; no reference outlives `self`.
        let _unmapped = unsafe { munmap(self.page.as_ptr().cast(), PAGE_LEN) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicUsize;

    const LONG: Duration = Duration::from_secs(60);

    fn bells() -> (tempfile::TempDir, Bell, Bell) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bell");
        let (sleeper, ringer) = (Bell::create(&path).unwrap(), Bell::open(&path).unwrap());
        (dir, sleeper, ringer)
    }

    #[test]
    fn a_ring_between_the_look_and_the_sleep_is_not_lost() {
        let (_dir, sleeper, ringer) = bells();
        let look = || {
            ringer.ring();
            Ok::<_, ()>(false)
        };
        // Would take a minute.
        sleeper.sleep_unless(LONG, look).unwrap();
    }

    #[test]
    fn what_is_found_is_not_slept_over() {
        let (_dir, sleeper, _ringer) = bells();
        sleeper.sleep_unless(LONG, || Ok::<_, ()>(true)).unwrap();
        assert_eq!(sleeper.sleep_unless(LONG, || Err("broken")), Err("broken"));
    }

    #[test]
    fn the_time_limit_ends_the_sleep() {
        let (_dir, sleeper, _ringer) = bells();
        let nothing = || Ok::<_, ()>(false);
        sleeper.sleep_unless(Duration::from_millis(1), nothing).unwrap();
    }

    #[test]
    fn every_ring_of_many_is_answered() {
        const RINGS: usize = 20_000;
        let (_dir, sleeper, ringer) = bells();
        let done = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    for _ in 0..RINGS {
                        done.fetch_add(1, SeqCst);
                        ringer.ring();
                    }
                });
            }
            let mut seen = 0;
            while seen < 2 * RINGS {
                // A lost one among the last would take a minute.
                sleeper.sleep_unless(LONG, || Ok::<_, ()>(done.load(SeqCst) > seen)).unwrap();
                seen = done.load(SeqCst);
            }
        });
    }

    #[test]
    fn a_page_too_short_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(Bell::open(file.path()).unwrap_err(), Errno::INVAL);
    }
}
