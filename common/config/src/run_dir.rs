//! The run directory: where everything of one run lies, and under which names.

use crate::{Config, ConfigError, method_keys, resolve, resolve::may_go_on};
use rit_episode::wire::RunId;
use std::{
    fs::{self, DirBuilder, OpenOptions, Permissions},
    io::{self, ErrorKind, Write as _},
    os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
};

const RUN_ID: &str = "run_id";
const TOKEN: &str = "token";

/// One run's directory. Only its user may look inside.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunDir {
    root: PathBuf,
    run_id: RunId,
    token: String,
}

/// Why a run directory cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// It would be written over.
    #[error("{0} already holds a run; choose another --run-dir, or move it away")]
    Occupied(PathBuf),
    /// There is none.
    #[error("{0} holds no run: it has no config.toml")]
    Missing(PathBuf),
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
    /// Makes a directory for a new run and writes the resolved configuration into it.
    ///
    /// # Errors
    /// When the directory holds anything already, or cannot be written.
    pub fn create(root: &Path, config: &Config) -> Result<Self, RunDirError> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |error| RunDirError::Io { path, error }
        };
        match fs::read_dir(root).map(|mut entries| entries.next().is_some()) {
            Ok(true) => return Err(RunDirError::Occupied(root.to_owned())),
            Ok(false) => {
                fs::set_permissions(root, Permissions::from_mode(0o700)).map_err(io(root))?;
            }
            Err(error) if error.kind() == ErrorKind::NotFound => {
                DirBuilder::new().recursive(true).mode(0o700).create(root).map_err(io(root))?;
            }
            Err(error) => return Err(io(root)(error)),
        }
        let root = root.canonicalize().map_err(io(root))?;
        let (run_id, token) = (random_bytes().map_err(io(&root))?, hex(random_bytes().map_err(io(&root))?));
        let run_dir = Self { root, run_id, token };
        let write = |path: PathBuf, text: String| {
            let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path);
            file.and_then(|mut file| file.write_all(text.as_bytes())).map_err(io(&path))
        };
        write(run_dir.root.join(RUN_ID), hex(run_id) + "\n")?;
        write(run_dir.root.join(TOKEN), run_dir.token.clone() + "\n")?;
        write(run_dir.config_path(), run_dir.to_toml(config)?)?;
        for folder in [run_dir.logs(), run_dir.checkpoints()] {
            DirBuilder::new().mode(0o700).create(&folder).map_err(io(&folder))?;
        }
        Ok(run_dir)
    }

    fn to_toml(&self, config: &Config) -> Result<String, RunDirError> {
        config.to_toml().map_err(|error| RunDirError::Config { path: self.config_path(), error })
    }

    /// Makes the next free directory `{parent}/{name}-{n}`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn create_fresh(parent: &Path, name: &str, config: &Config) -> Result<Self, RunDirError> {
        let mut n = 1;
        loop {
            match Self::create(&parent.join(format!("{name}-{n}")), config) {
                Err(RunDirError::Occupied(_)) => n += 1,
                made_or_failed => return made_or_failed,
            }
        }
    }

    /// Opens a run's directory and reads its configuration.
    ///
    /// # Errors
    /// When it holds no run, or an altered one.
    pub fn open(root: &Path) -> Result<(Self, Config), RunDirError> {
        let missing = || RunDirError::Missing(root.to_owned());
        let root = root.canonicalize().map_err(|_| missing())?;
        let path = root.join("config.toml");
        let text = fs::read_to_string(&path).map_err(|_| missing())?;
        let config =
            resolve(&text, "config.toml", &[]).map_err(|error| RunDirError::Config { path, error })?;
        let digits = |name: &str| {
            let path = root.join(name);
            let text =
                fs::read_to_string(&path).map_err(|error| RunDirError::Io { path: path.clone(), error })?;
            from_hex(text.trim()).ok_or(RunDirError::NotHex(path))
        };
        let (run_id, token) = (digits(RUN_ID)?, hex(digits(TOKEN)?));
        Ok((Self { root, run_id, token }, config))
    }

    /// Opens a run's directory to go on with other settings, and writes the new configuration down.
    ///
    /// # Errors
    /// When it holds no run, or a setting would change the result of what has been trained already.
    pub fn resume(root: &Path, settings: &[toml::Table]) -> Result<(Self, Config), RunDirError> {
        let (run_dir, old) = Self::open(root)?;
        let path = run_dir.config_path();
        let io = |error| RunDirError::Io { path: path.clone(), error };
        let text = fs::read_to_string(&path).map_err(io)?;
        let wrong = |error| RunDirError::Config { path: path.clone(), error };
        method_keys::same(old.algorithm.name, settings).map_err(wrong)?;
        let new = resolve(&text, "config.toml", settings).map_err(wrong)?;
        may_go_on(&old, &new).map_err(wrong)?;
        if new != old {
            run_dir.write_config(&new)?;
        }
        Ok((run_dir, new))
    }

    /// Writes another configuration down, as a whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<(), RunDirError> {
        let path = self.config_path();
        let partial = path.with_extension("partial");
        fs::write(&partial, self.to_toml(config)?)
            .and_then(|()| fs::rename(&partial, &path))
            .map_err(|error| RunDirError::Io { path, error })
    }

    /// The directory itself, absolute.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What the run's frames carry.
    pub fn run_id(&self) -> RunId {
        self.run_id
    }

    /// The secret that whoever speaks to the run's learner must know.
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
        fs::read_to_string(self.web()).ok().map(|url| url.trim().to_owned())
    }

    /// The resolved configuration.
    pub fn config_path(&self) -> PathBuf {
        self.root.join("config.toml")
    }

    /// The learner's socket.
    pub fn socket(&self) -> PathBuf {
        self.root.join("learner.sock")
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

    /// Where the run's shared memory is administered: short, since socket paths lie below it, and the user's.
    pub fn shared_memory_root(&self) -> PathBuf {
        std::env::temp_dir().join(format!("rit-{}", &hex(self.run_id)[..8]))
    }
}

/// Sixteen bytes that no other run has and nobody guesses.
fn random_bytes() -> io::Result<RunId> {
    let mut bytes = RunId::default();
    // So few bytes come at once, or not at all.
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    Ok(bytes)
}

fn hex(bytes: RunId) -> String {
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

    fn config() -> Config {
        resolve("environment.task_set = \"matrix-game\"\nseed = 5", "test", &[]).unwrap()
    }

    #[test]
    fn what_is_created_can_be_opened_and_nothing_is_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("a/b");
        let made = RunDir::create(&root, &config()).unwrap();
        let (opened, read) = RunDir::open(&root).unwrap();
        assert_eq!((&made, config()), (&opened, read));
        assert_eq!(fs::metadata(&root).unwrap().permissions().mode() & 0o777, 0o700);
        assert!(matches!(RunDir::create(&root, &config()), Err(RunDirError::Occupied(_))));
        let other = RunDir::create(&folder.path().join("c"), &config()).unwrap();
        assert_ne!((made.run_id(), made.token()), (other.run_id(), other.token()));
    }

    #[test]
    fn a_run_goes_on_with_other_settings_unless_they_change_the_result() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("run");
        RunDir::create(&root, &config()).unwrap();
        let set = |text: &str| [crate::set(text).unwrap()];
        let (_, longer) = RunDir::resume(&root, &set("training.t_max=70000")).unwrap();
        assert_eq!(longer.training.t_max, 70_000);
        let (_, more) = RunDir::resume(&root, &set("actors.count=5")).unwrap();
        assert_eq!((more.training.t_max, more.actors.count), (70_000, 5), "what was set stays set");
        for setting in ["algorithm.gamma=0.5", "seed=6", "learner.shards=3", "network.hidden_dim=8"] {
            let error = RunDir::resume(&root, &set(setting)).unwrap_err().to_string();
            let key = setting.split('=').next().unwrap();
            assert!(error.contains(key) && error.contains("cannot change"), "{error}");
        }
        assert_eq!(RunDir::open(&root).unwrap().1, more);
    }

    #[test]
    fn fresh_directories_count_up() {
        let folder = tempfile::tempdir().unwrap();
        let name = |run_dir: RunDir| run_dir.root().file_name().unwrap().to_owned();
        for n in 1..4 {
            let made = RunDir::create_fresh(folder.path(), "matrix-game", &config()).unwrap();
            assert_eq!(name(made), *format!("matrix-game-{n}"));
        }
    }

    #[test]
    fn what_is_no_run_is_said_plainly() {
        let folder = tempfile::tempdir().unwrap();
        let error = |root: &Path| RunDir::open(root).unwrap_err().to_string();
        assert!(error(folder.path()).ends_with("holds no run: it has no config.toml"));
        let root = folder.path().join("run");
        let made = RunDir::create(&root, &config()).unwrap();
        fs::write(root.join("run_id"), "xyz").unwrap();
        assert!(error(&root).contains("was altered"));
        fs::write(made.config_path(), "environment.task_set = \"matrix-game\"\nalgorithm.gamma = 2").unwrap();
        assert!(error(&root).contains("algorithm.gamma = 2 is out of range"));
    }
}
