//! The run directory: where everything of one run lies, and under which names.

use crate::{
    Config, ConfigError, read_text,
    regular_file::write_whole,
    run_lock,
    saved::{self, Saved, resolve_saved},
};
use rit_episode::wire::RunId;
use std::{
    env, fs,
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

pub(crate) const CONFIG: &str = "config.toml";
pub(crate) const RUN_ID: &str = "run_id";
pub(crate) const TOKEN: &str = "token";
/// In a copy: the identity of the run that it was copied from.
pub(crate) const LINEAGE: &str = "lineage";
/// Weights of another run that this one begins with.
pub(crate) const INITIAL_WEIGHTS: &str = "initial.safetensors";

/// One run's directory. Only its user may look inside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunDir {
    pub(crate) root: PathBuf,
    pub(crate) run_id: RunId,
    pub(crate) lineage: RunId,
    pub(crate) token: String,
}

/// Why a run directory cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// It would be written over.
    #[error("{0} already holds a run; choose another --run-dir, or move it away")]
    Occupied(PathBuf),
    /// The folder holds files that are not the run's.
    #[error("{root} is not empty, {entry} lies there; choose another --run-dir, or an empty one")]
    NotEmpty {
        /// The directory.
        root: PathBuf,
        /// What lies in it.
        entry: String,
    },
    /// Another process writes to it.
    #[error(
        "{root} is in use by {}; stop that run first (`rit ctl --run {root} stop`), or wait for its end",
        .holder.map_or_else(|| "another process".to_owned(), |pid| format!("process {pid}"))
    )]
    InUse {
        /// The directory.
        root: PathBuf,
        /// The process, if it says so.
        holder: Option<u32>,
    },
    /// There is none.
    #[error("{root} holds no run: {why}")]
    Missing {
        /// The directory.
        root: PathBuf,
        /// What is not there.
        why: &'static str,
    },
    /// A link that leads nowhere.
    #[error("{link} is a link to {target}, which does not exist; make that folder, or remove the link")]
    DanglingLink {
        /// The link.
        link: PathBuf,
        /// Where it leads.
        target: PathBuf,
    },
    /// A file, where a directory belongs.
    #[error("{0} is a file and no directory; choose another, or move it away")]
    NotADirectory(PathBuf),
    /// A file system that takes no folder there, as /proc.
    #[error("{0} cannot be made: the system takes no folder there; choose another --run-dir")]
    NotMade(PathBuf),
    /// A relative path, and nothing that it is relative to.
    #[error("the current folder, from which {0} is meant, has been deleted; change to one that exists")]
    CurrentFolderDeleted(PathBuf),
    /// Configurations, addresses and messages are text, and so are the paths in them.
    #[error("{0:?}: a run directory's path has to be UTF-8; rename it, or choose another")]
    NotUtf8(PathBuf),
    /// Its configuration cannot be used.
    #[error("{path}: {error}")]
    Config {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: ConfigError,
    },
    /// A file of ours that holds something else.
    #[error("{0} does not hold 32 hexadecimal digits; it was altered")]
    NotHex(PathBuf),
    /// The system refused.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

impl RunDir {
    pub(crate) fn to_toml(&self, config: &Config) -> Result<String, RunDirError> {
        saved::to_text(config).map_err(|error| RunDirError::Config { path: self.config_path(), error })
    }

    /// Opens a run's directory to look at it, and reads its configuration. To write to it, see
    /// [`OwnedRunDir`](crate::OwnedRunDir).
    ///
    /// # Errors
    /// When it holds no run, or an altered one.
    pub fn open(root: &Path) -> Result<(Self, Config), RunDirError> {
        let root = existing(root)?;
        let text = read_config(&root)?;
        let Saved { config, .. } = resolve_saved(&text, &[])
            .map_err(|error| RunDirError::Config { path: root.join(CONFIG), error })?;
        let digits = |name: &str| {
            let path = root.join(name);
            let text = read_text(&path).map_err(|error| RunDirError::Io { path: path.clone(), error })?;
            from_hex(text.trim()).ok_or(RunDirError::NotHex(path))
        };
        let (run_id, token) = (digits(RUN_ID)?, hex(digits(TOKEN)?));
        let lineage = if root.join(LINEAGE).exists() { digits(LINEAGE)? } else { run_id };
        Ok((Self { root, run_id, lineage, token }, config))
    }

    /// Writes another configuration down, as a whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<(), RunDirError> {
        let path = self.config_path();
        write_whole(&path, self.to_toml(config)?.as_bytes()).map_err(|error| RunDirError::Io { path, error })
    }

    /// The directory itself, absolute.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What the run's frames carry on their way to the learner.
    pub fn run_id(&self) -> RunId {
        self.run_id
    }

    /// What the run's files carry: in a copy of a run, the identity of the first one, whose files it goes on with.
    pub fn lineage(&self) -> RunId {
        self.lineage
    }

    /// The secret that programs must know that speak to the run's learner.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// Where the learner listens on this host: a line of text, there while it does.
    pub fn address(&self) -> PathBuf {
        self.root.join("address")
    }

    /// Where the learner listens for other hosts: likewise, if it does.
    pub fn remote_address(&self) -> PathBuf {
        self.root.join("remote_address")
    }

    /// The file of [`Self::web_url`], for the run's user alone.
    pub fn web(&self) -> PathBuf {
        self.root.join("web")
    }

    /// The web page's address with the token, if a learner of this run serves or served one.
    pub fn web_url(&self) -> Option<String> {
        read_text(&self.web()).ok().map(|url| url.trim().to_owned())
    }

    /// The resolved configuration.
    pub fn config_path(&self) -> PathBuf {
        self.root.join(CONFIG)
    }

    /// The learner's socket.
    pub fn socket(&self) -> PathBuf {
        self.root.join("learner.sock")
    }

    /// The weights that the run began with, where they are another run's.
    pub fn initial_weights(&self) -> PathBuf {
        self.root.join(INITIAL_WEIGHTS)
    }

    /// One JSON object a line.
    pub fn metrics(&self) -> PathBuf {
        self.root.join("metrics.jsonl")
    }

    /// Event files for TensorBoard.
    pub fn tensorboard(&self) -> PathBuf {
        self.root.join("tensorboard")
    }

    /// What the run came to.
    pub fn summary(&self) -> PathBuf {
        self.root.join("summary.json")
    }

    /// One folder a checkpoint, and `latest`.
    pub fn checkpoints(&self) -> PathBuf {
        self.root.join("checkpoints")
    }

    /// The episodes that replay holds, and those that checkpoints still need.
    pub fn replay(&self) -> PathBuf {
        self.root.join("replay")
    }

    /// One file a process.
    pub fn logs(&self) -> PathBuf {
        self.root.join("logs")
    }

    /// Whether a process writes to it now.
    pub fn is_in_use(&self) -> bool {
        run_lock::is_taken(&self.root)
    }

    /// The other host whose process wrote to it last, on a file system that several hosts share: whether that lives, this
    /// one cannot know.
    pub fn other_host(&self) -> Option<String> {
        run_lock::other_host(&self.root)
    }

    /// An empty file that is there while the run is paused, for the learner that takes over from a killed one.
    pub fn paused(&self) -> PathBuf {
        self.root.join("paused")
    }

    /// Where the learner's shared memory is administered: a line of text, written anew by each learner.
    pub fn shared_memory(&self) -> PathBuf {
        self.root.join("shared_memory")
    }

    /// Writes down where the learner's shared memory is administered.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_shared_memory(&self, directory: &Path) -> io::Result<()> {
        write_whole(&self.shared_memory(), format!("{}\n", directory.display()).as_bytes())
    }
}

/// An existing directory's canonical path.
pub(crate) fn existing(root: &Path) -> Result<PathBuf, RunDirError> {
    let found = match root.canonicalize() {
        Ok(found) => found,
        Err(error) => return Err(why_missing(root, error)),
    };
    if !found.is_dir() {
        return Err(RunDirError::NotADirectory(root.to_owned()));
    }
    utf8(&found)?;
    Ok(found)
}

/// What is wrong with a path that leads nowhere.
pub(crate) fn why_missing(root: &Path, error: io::Error) -> RunDirError {
    if root.is_relative() && env::current_dir().is_err() {
        return RunDirError::CurrentFolderDeleted(root.to_owned());
    }
    // The run directory itself, or a folder on the way to it.
    for link in root.ancestors().filter(|path| path.is_symlink() && !path.exists()) {
        if let Ok(target) = fs::read_link(link) {
            return RunDirError::DanglingLink { link: link.to_owned(), target };
        }
    }
    match error.kind() {
        ErrorKind::NotFound => RunDirError::Missing { root: root.to_owned(), why: "there is no such folder" },
        ErrorKind::NotADirectory => {
            let file = root.ancestors().find(|path| path.is_file()).unwrap_or(root);
            RunDirError::NotADirectory(file.to_owned())
        }
        _ => RunDirError::Io { path: root.to_owned(), error },
    }
}

pub(crate) fn utf8(path: &Path) -> Result<(), RunDirError> {
    path.to_str().map(|_| ()).ok_or_else(|| RunDirError::NotUtf8(path.to_owned()))
}

/// The configuration's text.
pub(crate) fn read_config(root: &Path) -> Result<String, RunDirError> {
    let path = root.join(CONFIG);
    read_text(&path).map_err(|error| match error.kind() {
        ErrorKind::NotFound if !path.is_symlink() => {
            RunDirError::Missing { root: root.to_owned(), why: "it has no config.toml" }
        }
        _ => RunDirError::Io { path, error },
    })
}

/// Sixteen bytes that no other run has and that cannot be guessed.
pub(crate) fn random_bytes() -> io::Result<RunId> {
    let mut bytes = RunId::default();
    // So few bytes come at once, or not at all.
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    Ok(bytes)
}

pub(crate) fn hex(bytes: RunId) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn from_hex(digits: &str) -> Option<RunId> {
    let mut bytes = RunId::default();
    if digits.len() != 2 * bytes.len() || !digits.is_ascii() {
        return None;
    }
    for (at, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&digits[2 * at..2 * at + 2], 16).ok()?;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::OwnedRunDir;
    use crate::resolve;
    use std::os::unix::{ffi::OsStrExt as _, fs::symlink};

    #[test]
    fn what_is_no_run_is_said_plainly() {
        let folder = tempfile::tempdir().unwrap();
        let error = |root: &Path| RunDir::open(root).unwrap_err().to_string();
        assert!(error(folder.path()).ends_with("holds no run: it has no config.toml"));
        assert!(error(&folder.path().join("nowhere")).ends_with("holds no run: there is no such folder"));
        let link = folder.path().join("link");
        symlink("gone", &link).unwrap();
        for path in [link.clone(), link.join("run")] {
            assert!(
                error(&path).contains("link is a link to gone, which does not exist"),
                "{}",
                error(&path)
            );
        }
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        for path in [file.clone(), file.join("run")] {
            assert!(error(&path).contains("file is a file and no directory"), "{}", error(&path));
        }
        let strange = folder.path().join(std::ffi::OsStr::from_bytes(b"\xff"));
        fs::create_dir(&strange).unwrap();
        assert!(error(&strange).contains("has to be UTF-8"), "{}", error(&strange));
    }

    #[test]
    fn an_altered_run_is_said_plainly() {
        let folder = tempfile::tempdir().unwrap();
        let error = |root: &Path| RunDir::open(root).unwrap_err().to_string();
        let root = folder.path().join("run");
        let config = resolve("environment.task_set = \"matrix-game\"", "test", &[]).unwrap();
        let made = OwnedRunDir::create(&root, &config).unwrap().run_dir().clone();
        fs::write(root.join(RUN_ID), "xyz").unwrap();
        assert!(error(&root).contains("was altered"));
        fs::write(made.config_path(), "environment.task_set = \"matrix-game\"\nalgorithm.gamma = 2").unwrap();
        assert!(error(&root).contains("algorithm.gamma = 2 is out of range"));
        // Whatever hinders reading, it is no missing file.
        fs::remove_file(made.config_path()).unwrap();
        fs::create_dir(made.config_path()).unwrap();
        assert!(error(&root).contains("config.toml: it is no regular file"), "{}", error(&root));
    }
}
