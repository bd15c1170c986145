//! One writer a run: an OS lock on the run's directory. It ends with the processes that hold it, however they end.

use crate::{RunDirError, open_regular, read_text};
use rustix::{fs::FlockOperation, io::Errno};
use std::{
    fs::{self, File, OpenOptions},
    io::{self, Write as _},
    os::{
        fd::{AsFd, BorrowedFd},
        unix::fs::{MetadataExt as _, OpenOptionsExt as _},
    },
    path::{Path, PathBuf},
    process, thread,
    time::{Duration, Instant},
};

/// The file that names the lock's holders: a line with process number and host for each, the first holder first. On file
/// systems that cannot lock folders (NFS), this file is what is locked.
pub(crate) const LOCK: &str = "lock";

/// How long to wait for the lock if its first holder has died: the processes that inherited it are about to end.
const ORPHANS_TIMEOUT: Duration = Duration::from_secs(15);

/// Time between two attempts to take the lock meanwhile.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// A run's lock. A process that writes to a run's directory has it, or was handed it by the process that started it.
#[derive(Debug)]
pub struct RunLock {
    locked: File,
}

impl RunLock {
    /// The descriptor at which a child process finds the lock that its parent hands down. While the child lives, the
    /// lock is held, though the parent die.
    pub const CHILD_FD: i32 = 3;

    /// Takes the lock of an existing directory. Makes and changes nothing there, but where only files can be locked.
    ///
    /// # Errors
    /// When another run has it, or the system knows no locks there.
    pub(crate) fn take(root: &Path) -> Result<Self, RunDirError> {
        let begun = Instant::now();
        loop {
            if let Some(locked) = try_lock(root)? {
                return Ok(Self { locked });
            }
            let holders = holders_here(root);
            let living = holders.iter().copied().find(|&pid| is_alive(pid));
            let first_lives = living.is_some() && living == holders.first().copied();
            if first_lives || begun.elapsed() >= ORPHANS_TIMEOUT {
                return Err(RunDirError::InUse { root: root.to_owned(), holder: living });
            }
            thread::sleep(LOOK_EVERY);
        }
    }

    /// Whether the process that started this one has handed the run's lock down.
    pub(crate) fn is_handed_down(root: &Path) -> bool {
        let at = |path: PathBuf| fs::metadata(path).map(|metadata| (metadata.dev(), metadata.ino())).ok();
        let handed = at(format!("/proc/self/fd/{}", Self::CHILD_FD).into());
        let ours = [at(root.to_owned()), at(root.join(LOCK))];
        handed.is_some() && ours.contains(&handed) && matches!(try_lock(root), Ok(None))
    }

    /// Says who has the lock, for the message to the next process that wants it.
    pub(crate) fn tell_holder(root: &Path, is_first: bool) {
        let mut options = OpenOptions::new();
        options.create(true).mode(0o600);
        let file = if is_first { options.write(true).truncate(true) } else { options.append(true) };
        // The lock holds without it: only the message is poorer.
        let _ = open_regular(&root.join(LOCK), file)
            .and_then(|mut file| writeln!(file, "{} {}", process::id(), this_host()));
    }
}

impl AsFd for RunLock {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.locked.as_fd()
    }
}

/// The lock, or nothing if it is taken.
fn try_lock(root: &Path) -> Result<Option<File>, RunDirError> {
    let failed = |error: io::Error| RunDirError::Io { path: root.to_owned(), error };
    let folder = File::open(root).map_err(failed)?;
    match rustix::fs::flock(&folder, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => return Ok(Some(folder)),
        Err(Errno::WOULDBLOCK) => return Ok(None),
        // NFS locks what can be written to, and a folder cannot.
        Err(Errno::BADF | Errno::NOLCK | Errno::OPNOTSUPP | Errno::INVAL | Errno::ISDIR) => {}
        Err(error) => return Err(failed(error.into())),
    }
    let path = root.join(LOCK);
    let mut options = OpenOptions::new();
    let file = open_regular(&path, options.create(true).append(true).mode(0o600)).map_err(failed)?;
    match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(Some(file)),
        Err(Errno::WOULDBLOCK) => Ok(None),
        Err(error) => Err(RunDirError::Io { path, error: error.into() }),
    }
}

/// Whether a process has the lock of this directory. A look alone: only where a process of the holder's number lives is
/// the lock itself touched, and given back at once.
pub(crate) fn is_taken(root: &Path) -> bool {
    holders_here(root).into_iter().any(is_alive) && matches!(try_lock(root), Ok(None))
}

/// The other host whose process had the lock last; nothing where it was one of this host. Of processes there this host
/// knows nothing, and whether it sees their locks is the file system's affair.
pub(crate) fn other_host(root: &Path) -> Option<String> {
    let (_, host) = holders(root).pop()?;
    host.filter(|host| *host != this_host())
}

/// Processes with their hosts; of builds that did not say it without.
fn holders(root: &Path) -> Vec<(u32, Option<String>)> {
    let text = read_text(&root.join(LOCK)).unwrap_or_default();
    let holder = |line: &str| {
        let mut words = line.split_whitespace();
        Some((words.next()?.parse().ok()?, words.next().map(str::to_owned)))
    };
    text.lines().filter_map(holder).collect()
}

/// Those that may be looked for here.
fn holders_here(root: &Path) -> Vec<u32> {
    let (all, here) = (holders(root), this_host());
    let is_here = |host: &Option<String>| host.as_ref().is_none_or(|host| *host == here);
    all.into_iter().filter(|(_, host)| is_here(host)).map(|(pid, _)| pid).collect()
}

/// A word; "unknown" where the system does not say.
fn this_host() -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name: String = name.split_whitespace().collect();
    if name.is_empty() { "unknown".to_owned() } else { name }
}

/// Whether a process runs; one that was killed and not yet waited for does not.
fn is_alive(pid: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // "PID (NAME) STATE …", and a name may hold anything.
    let state = stat.rsplit_once(')').and_then(|(_, rest)| rest.trim_start().chars().next());
    state.is_some_and(|state| !"ZX".contains(state))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::sync::{PoisonError, RwLock, RwLockReadGuard};

    /// A process that is being started holds what this one holds until it has become another program. Tests that take a
    /// lock again which they have just given up let no other test start one meanwhile.
    static STARTING: RwLock<()> = RwLock::new(());

    /// While it lives, tests of this process start none.
    pub(crate) type NoProcessStarts = RwLockReadGuard<'static, ()>;

    pub(crate) fn no_process_starts() -> NoProcessStarts {
        STARTING.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// A process that ends at once.
    fn start() -> process::Child {
        let _alone = STARTING.write().unwrap_or_else(PoisonError::into_inner);
        process::Command::new("true").spawn().unwrap()
    }

    #[test]
    fn one_at_a_time_and_the_other_is_named() {
        let _no_process_starts = no_process_starts();
        let folder = tempfile::tempdir().unwrap();
        let lock = RunLock::take(folder.path()).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "taking it makes nothing");
        RunLock::tell_holder(folder.path(), true);
        assert!(is_taken(folder.path()));
        let error = RunLock::take(folder.path()).unwrap_err();
        assert!(
            matches!(error, RunDirError::InUse { holder: Some(pid), .. } if pid == process::id()),
            "{error}"
        );
        assert!(error.to_string().contains(&format!("process {}", process::id())), "{error}");
        assert_eq!(other_host(folder.path()), None);
        drop(lock);
        assert!(!is_taken(folder.path()), "though this process lives");
        RunLock::take(folder.path()).unwrap();
    }

    #[test]
    fn of_processes_on_another_host_nothing_is_known_but_the_host() {
        let folder = tempfile::tempdir().unwrap();
        let lock = RunLock::take(folder.path()).unwrap();
        fs::write(folder.path().join(LOCK), format!("{} elsewhere\n", process::id())).unwrap();
        assert!(!is_taken(folder.path()), "its number is another process' here");
        assert_eq!(other_host(folder.path()).as_deref(), Some("elsewhere"));
        // A build that did not say it meant this host.
        fs::write(folder.path().join(LOCK), format!("{}\n", process::id())).unwrap();
        assert!(is_taken(folder.path()) && other_host(folder.path()).is_none());
        drop(lock);
    }

    #[test]
    fn the_processes_of_a_first_that_has_died_are_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let mut first = start();
        let dead = first.id();
        first.wait().unwrap();
        let lock = RunLock::take(folder.path()).unwrap();
        fs::write(folder.path().join(LOCK), format!("{dead}\n{}\n", process::id())).unwrap();
        let root = folder.path().to_owned();
        let waiting = thread::spawn(move || RunLock::take(&root).map(drop));
        // Whichever comes first, this end or that look: it gets the lock.
        drop(lock);
        waiting.join().unwrap().unwrap();
    }

    #[test]
    fn a_zombie_does_not_run() {
        let mut child = start();
        assert!(is_alive(process::id()));
        // Ended, and not waited for.
        while is_alive(child.id()) {
            thread::yield_now();
        }
        child.wait().unwrap();
    }
}
