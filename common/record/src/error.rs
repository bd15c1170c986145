//! Why a record cannot be read or written.

use rit_config::RunDirError;
use std::{io, path::PathBuf};

/// Why a record cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The run directory cannot be opened.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// The system refused.
    #[error("{path}: {error}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A file that holds something else than it should.
    #[error("{path} is no {what}: {why}")]
    Other {
        /// The file.
        path: PathBuf,
        /// What it should be.
        what: &'static str,
        /// Why it is not.
        why: String,
    },
    /// Another build's.
    #[error(
        "{path} has format version {found}, this build reads {known}; read it with the build that wrote it"
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
        /// What this build reads.
        known: u32,
    },
    /// A path where there is no record.
    #[error("{0} holds no record of a run: give a run directory, a folder of them, or a NAME.jsonl")]
    None(PathBuf),
}

impl RecordError {
    pub(crate) fn io(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |error| Self::Io { path, error }
    }
}
