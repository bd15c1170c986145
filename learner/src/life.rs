//! One life of a run, from a learner's start to its end, and its place for shared memory: a fresh one for each, whose
//! name cannot be guessed, written into the run directory so that actors find it.

use rit_config::{RunDir, read_text};
use rit_ipc::{FreshError, RunSpace};
use std::{
    env, fs, io,
    path::{Path, PathBuf},
};

/// No place for shared memory.
#[derive(Debug, thiserror::Error)]
pub enum LifeError {
    /// No folder would do.
    #[error("{folder} is no place for shared memory, and neither are others: {error}")]
    NoPlace {
        /// The folder for temporary files.
        folder: String,
        /// What is wrong with it.
        error: FreshError,
    },
    /// The run directory cannot be written to.
    #[error("{path}: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

/// Removes what a dead life has left, and makes a place for the next: in the folder for temporary files, or else where
/// it can be. Then the second value says so.
///
/// # Errors
/// When it can be nowhere.
pub fn begin(run_dir: &RunDir) -> Result<(RunSpace, Option<String>), LifeError> {
    remove_dead(run_dir);
    let folders = [env::temp_dir(), "/tmp".into(), "/dev/shm".into()];
    for folder in &folders {
        for place in RunSpace::sweep(folder) {
            tracing::info!(place = %place.display(), "removed what a run that is gone has left in shared memory");
        }
    }
    let named = env::var_os("TMPDIR").map_or_else(String::new, |_| "TMPDIR = ".into());
    let wanted = format!("{named}{}", folders[0].display());
    let mut unfit = None;
    for folder in &folders {
        match RunSpace::make_fresh(folder, |directory| run_dir.write_shared_memory(directory)) {
            Ok(space) => {
                let notice = unfit.map(|error| {
                    format!("{wanted} is no place for shared memory, {} is used: {error}", folder.display())
                });
                return Ok((space, notice));
            }
            Err(FreshError::Tell(error)) => {
                return Err(LifeError::Io { path: run_dir.shared_memory(), error });
            }
            Err(error) => unfit = unfit.or(Some(error)),
        }
    }
    match unfit {
        Some(error) => Err(LifeError::NoPlace { folder: wanted, error }),
        None => Err(LifeError::Io { path: run_dir.shared_memory(), error: io::ErrorKind::NotFound.into() }),
    }
}

/// Removes the place that the run directory names, unless its learner lives. For the process that has the run's lock.
pub fn remove_dead(run_dir: &RunDir) {
    let file = run_dir.shared_memory();
    let Ok(directory) = read_text(&file) else { return };
    let place = Path::new(directory.trim_end());
    if !RunSpace::is_called_fresh(place) {
        tracing::warn!(file = %file.display(), "it names no place that a learner makes: nothing is removed there");
        return;
    }
    let removed = RunSpace::new(place)
        .map_err(|error| error.to_string())
        .and_then(|space| space.remove_if_dead().map_err(|error| error.to_string()));
    match removed {
        // Without the file no actor looks for it any more.
        Ok(true) => {
            let _ = fs::remove_file(file);
        }
        Ok(false) => tracing::warn!(directory = directory.trim_end(), "another learner uses the place"),
        Err(error) => tracing::warn!(%error, "something of the run is still in shared memory"),
    }
}

/// Ends a life when it is dropped, however that comes about. Make it before the receiver.
#[derive(Debug)]
pub struct EndOfLife<'a>(pub &'a RunDir);

impl Drop for EndOfLife<'_> {
    fn drop(&mut self) {
        remove_dead(self.0);
    }
}
