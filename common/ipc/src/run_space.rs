//! A place of its own for one life of a run, from a learner's start to its end: a directory, a prefix for what lies in
//! /dev/shm, and an end to both.

use crate::shared_memory;
use iceoryx2::config::Config;
use iceoryx2::prelude::{FileName, Path as IceoryxPath, SemanticString as _};
use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::fs::DirBuilder;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Longest directory and prefix together. iceoryx2 appends a node's number, a port's and a suffix, and panics when
/// that does not fit into 255 bytes.
const LENGTH_LIMIT: usize = 100;

/// What a place is called that [`RunSpace::make_fresh`] makes, before its number.
const FRESH: &str = "rit-";

/// A place is taken for a dead life's only if it is older: between making one and locking it a learner needs
/// milliseconds.
const ABANDONED_AFTER: Duration = Duration::from_secs(3600);

/// What iceoryx2 makes in its root.
const NODES: &str = "nodes";
const SERVICES: &str = "services";

/// Names one life's own place for shared memory. Processes that name the same directory share a life.
#[derive(Clone, Debug)]
pub struct RunSpace {
    directory: PathBuf,
    prefix: String,
    config: Config,
}

/// A directory that cannot name a place for shared memory.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RunSpaceError {
    /// Two processes may have different working directories.
    #[error("the folder {directory} for shared memory is not absolute: give the whole path")]
    NotAbsolute {
        /// The directory.
        directory: PathBuf,
    },
    /// Names made from it would not fit.
    #[error(
        "the folder {directory} for shared memory has {length} bytes where {limit} are allowed: choose a shorter one, \
         such as /tmp/rit-1a2b3c4d"
    )]
    TooLong {
        /// The directory.
        directory: PathBuf,
        /// Its length in bytes.
        length: usize,
        /// Most bytes.
        limit: usize,
    },
    /// iceoryx2 takes no such path.
    #[error("the folder {directory} has characters that a name in shared memory cannot have")]
    Characters {
        /// The directory.
        directory: PathBuf,
    },
}

/// A directory that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DirectoryError {
    /// Not made, or not read.
    #[error("the folder {directory} for shared memory cannot be used: {source}")]
    Io {
        /// The directory.
        directory: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Other users may write there.
    #[error("the folder {directory} for shared memory is not private: it has to be yours, with mode 700")]
    NotPrivate {
        /// The directory.
        directory: PathBuf,
    },
}

/// A place that could not be made.
#[derive(Debug, thiserror::Error)]
pub enum FreshError {
    /// The folder's name gives no usable name.
    #[error(transparent)]
    Name(#[from] RunSpaceError),
    /// The folder cannot be written to.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// Its name could not be drawn or written down.
    #[error("the name of a place for shared memory cannot be written down: {0}")]
    Tell(io::Error),
}

/// Something of the run is still there.
#[derive(Debug, thiserror::Error)]
pub enum RemoveError {
    /// Nothing is removed from a directory that is not ours alone.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// A file or directory would not go.
    #[error("{path} of the finished run could not be removed: {source}")]
    Io {
        /// What is left.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl RunSpace {
    /// Names the place that belongs to a directory, such as `/tmp/rit-<uid>/<8 hex>`. Nothing is made yet.
    ///
    /// # Errors
    /// When the path is relative, too long or of strange characters.
    pub fn new(directory: &Path) -> Result<Self, RunSpaceError> {
        // Without trailing and doubled slashes: the same directory has to give the same prefix.
        let directory: PathBuf = directory.components().collect();
        if !directory.is_absolute() {
            return Err(RunSpaceError::NotAbsolute { directory });
        }
        let bytes = directory.as_os_str().as_encoded_bytes();
        let prefix = format!("rit_{:016x}_", fnv1a(bytes));
        let (length, limit) = (bytes.len(), LENGTH_LIMIT - prefix.len());
        if length > limit {
            return Err(RunSpaceError::TooLong { directory, length, limit });
        }
        let (Ok(root), Ok(file_prefix)) = (IceoryxPath::new(bytes), FileName::new(prefix.as_bytes())) else {
            return Err(RunSpaceError::Characters { directory });
        };

        let mut config = Config::default();
        config.global.set_root_path(&root);
        config.global.prefix = file_prefix;
        // Dead processes are not cleaned up in passing: see `EpisodeReceiver::reap_dead`.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        Ok(Self { directory, prefix, config })
    }

    /// Makes a fresh place with an unguessable name in this folder. `tell` is given its name before it is made, so that
    /// it can be found and removed even if this process dies at any point after that.
    ///
    /// # Errors
    /// When the folder is no good for it, or `tell` fails.
    pub fn make_fresh(
        folder: &Path,
        mut tell: impl FnMut(&Path) -> io::Result<()>,
    ) -> Result<Self, FreshError> {
        loop {
            let mut name = [0; size_of::<u64>()];
            // So few bytes come at once, or not at all.
            rustix::rand::getrandom(&mut name, rustix::rand::GetRandomFlags::empty())
                .map_err(|error| FreshError::Tell(error.into()))?;
            let space = Self::new(&folder.join(format!("{FRESH}{:016x}", u64::from_le_bytes(name))))?;
            if !space.leftovers().map_err(|source| space.directory_error(source))?.is_empty() {
                continue;
            }
            tell(space.directory()).map_err(FreshError::Tell)?;
            match DirBuilder::new().mode(0o700).create(space.directory()) {
                Ok(()) => return Ok(space),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(space.directory_error(error).into()),
            }
        }
    }

    /// Whether a path is called like a place that [`Self::make_fresh`] makes.
    pub fn is_called_fresh(path: &Path) -> bool {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let is_digit = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
        name.strip_prefix(FRESH).is_some_and(|digits| digits.len() == 16 && digits.bytes().all(is_digit))
    }

    /// Removes the places in this folder that dead lives have left, whatever became of the run directories that told of
    /// them: those of this user, made more than an hour ago, whose learner's lock is free. Returns which. What
    /// cannot be looked at or removed stays.
    pub fn sweep(folder: &Path) -> Vec<PathBuf> {
        let mut removed = Vec::new();
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            let age = entry.metadata().and_then(|metadata| metadata.modified());
            let age = age.ok().and_then(|modified| modified.elapsed().ok());
            if !Self::is_called_fresh(&path) || age.is_none_or(|age| age < ABANDONED_AFTER) {
                continue;
            }
            if Self::new(&path).is_ok_and(|space| space.remove_if_dead().is_ok_and(|dead| dead)) {
                removed.push(path);
            }
        }
        removed
    }

    /// The directory.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Removes everything of a life whose learner has ended, and says whether it has: one that lives is left alone.
    ///
    /// # Errors
    /// With the first thing that would not go, after all have been tried.
    pub fn remove_if_dead(&self) -> Result<bool, RemoveError> {
        let _lock = match self.lock() {
            Ok(Some(lock)) => Some(lock),
            Ok(None) => return Ok(false),
            // The directory was removed, and a learner that lost it has made another.
            Err(DirectoryError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(error.into()),
        };
        self.remove().map(|()| true)
    }

    /// Whether all that a learner has made here is still there.
    pub(crate) fn is_whole(&self) -> bool {
        let made = [NODES, SERVICES].map(|name| self.directory.join(name));
        self.check_directory().is_ok()
            && made.iter().chain([&self.segment(crate::bell::NAME)]).all(|path| path.exists())
    }

    /// Everything of this user's that exists here, in /dev/shm and in its directory: nothing before, and nothing after
    /// [`RunSpace::remove`].
    ///
    /// # Errors
    /// When a directory cannot be read.
    pub fn leftovers(&self) -> io::Result<Vec<PathBuf>> {
        let mut found = shared_memory::segments(&self.prefix)?;
        let ours = [NODES, SERVICES].map(|name| self.directory.join(name));
        for path in ours.into_iter().chain([self.directory.clone()]) {
            if path.try_exists()? {
                found.push(path);
            }
        }
        Ok(found)
    }

    /// Removes everything the run has left, however its processes ended. Only for when all have ended. The
    /// directory itself stays if something else lies in it.
    ///
    /// # Errors
    /// With the first thing that would not go, after all have been tried.
    pub fn remove(&self) -> Result<(), RemoveError> {
        match self.check_directory() {
            Err(DirectoryError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
            outcome => outcome?,
        }
        let at = |path: &Path| {
            let path = path.to_path_buf();
            move |source| RemoveError::Io { path, source }
        };
        let mut outcome = Ok(());
        for path in self.leftovers().map_err(at(&self.directory))? {
            let removed = if path == self.directory {
                std::fs::remove_dir(&path)
            } else if path.starts_with(&self.directory) {
                std::fs::remove_dir_all(&path)
            } else {
                std::fs::remove_file(&path)
            };
            match removed {
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) if error.kind() == io::ErrorKind::DirectoryNotEmpty && path == self.directory => {}
                removed => outcome = outcome.and(removed.map_err(at(&path))),
            }
        }
        outcome
    }

    pub(crate) fn config(&self) -> &Config {
        &self.config
    }

    /// What every file of the run in /dev/shm begins with.
    pub(crate) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// A file of the run in /dev/shm.
    pub(crate) fn segment(&self, name: &str) -> PathBuf {
        Path::new(shared_memory::DIRECTORY).join(format!("{}{name}", self.prefix))
    }

    /// Makes the directory, for this user only, or finds it like that.
    pub(crate) fn make_directory(&self) -> Result<(), DirectoryError> {
        let made = DirBuilder::new().recursive(true).mode(0o700).create(&self.directory);
        made.map_err(|source| self.directory_error(source))?;
        self.check_directory()
    }

    /// Whether the directory is there and belongs to this user alone.
    pub(crate) fn check_directory(&self) -> Result<(), DirectoryError> {
        let metadata = std::fs::symlink_metadata(&self.directory);
        let metadata = metadata.map_err(|source| self.directory_error(source))?;
        let ours = metadata.uid() == rustix::process::geteuid().as_raw();
        if metadata.is_dir() && ours && metadata.mode() & 0o077 == 0 {
            return Ok(());
        }
        Err(DirectoryError::NotPrivate { directory: self.directory.clone() })
    }

    /// Takes the learner's lock, which ends with the process however it ends. Nothing if another learner has it.
    pub(crate) fn lock(&self) -> Result<Option<OwnedFd>, DirectoryError> {
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let failed = |error: Errno| self.directory_error(error.into());
        let directory = rustix::fs::open(&self.directory, flags, Mode::empty()).map_err(failed)?;
        match rustix::fs::flock(&directory, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(directory)),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(error) => Err(failed(error)),
        }
    }

    /// Forgets every service. Only under the lock.
    pub(crate) fn remove_services(&self) -> Result<(), DirectoryError> {
        let removed = std::fs::remove_dir_all(self.directory.join(SERVICES));
        removed.map_err(|source| self.directory_error(source))
    }

    fn directory_error(&self, source: io::Error) -> DirectoryError {
        DirectoryError::Io { directory: self.directory.clone(), source }
    }
}

/// FNV-1a, 64 bits: the same on every side and in every build, which the standard library's hash does not promise.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{self, File};
    use std::time::SystemTime;

    /// Makes it look as if it had not been touched for two hours.
    fn age(directory: &Path) {
        let then = SystemTime::now() - 2 * ABANDONED_AFTER;
        File::open(directory).unwrap().set_modified(then).unwrap();
    }

    #[test]
    fn what_dead_lives_have_left_is_swept_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let fresh = || RunSpace::make_fresh(folder.path(), |_| Ok(())).unwrap();
        let (dead, young, living) = (fresh(), fresh(), fresh());
        for space in [&dead, &young, &living] {
            for name in [NODES, SERVICES] {
                fs::create_dir(space.directory().join(name)).unwrap();
            }
            fs::write(space.segment("data"), "frames").unwrap();
        }
        let lock = living.lock().unwrap().unwrap();
        // Of another program, of another kind, and one that others may write to.
        let others = ["rit-0123", "rit-0123456789ABCDEF", "other", "rit-0123456789abcdef"];
        for name in others {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        let open = folder.path().join("rit-0123456789abcdef");
        fs::set_permissions(&open, std::os::unix::fs::PermissionsExt::from_mode(0o777)).unwrap();
        let all: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        all.iter().filter(|path| *path != young.directory()).for_each(|path| age(path));

        assert_eq!(RunSpace::sweep(folder.path()), [dead.directory()]);
        assert!(dead.leftovers().unwrap().is_empty());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), all.len() - 1);
        drop(lock);
        assert_eq!(RunSpace::sweep(folder.path()), [living.directory()]);
        assert!(young.remove_if_dead().unwrap());
        assert!(RunSpace::sweep(Path::new("/no/such/folder")).is_empty());
    }
}
