//! What a run came to and how it ended: `summary.json`, which lies in the run directory from the run's end until it is
//! gone on with.

use crate::{
    checkpoint::{self, Progress},
    evaluation::TaskResult,
};
use rit_config::RunDir;
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    fmt, fs,
    io::{self, ErrorKind},
};

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ended {
    /// All steps of `training.t_max` are done.
    Finished,
    /// An evaluation has reached what `training.until` asks for.
    Until,
    /// Somebody asked it to stop: `rit ctl stop`, or the page.
    Stopped,
    /// A signal or Ctrl-C asked it to end, or the process that watched over it has gone.
    Interrupted,
    /// Something went wrong; `reason` says what.
    Failed,
}

impl Ended {
    /// The exit code of `rit train` and `rit learner`.
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::Finished | Self::Until => 0,
            Self::Failed => 1,
            Self::Stopped => 3,
            // As shells have it for Ctrl-C.
            Self::Interrupted => 130,
        }
    }
}

impl fmt::Display for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Finished => "finished",
            Self::Until => "finished: the goal of training.until is reached",
            Self::Stopped => "stopped",
            Self::Interrupted => "interrupted",
            Self::Failed => "failed",
        })
    }
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// How it ended.
    pub ended: Ended,
    /// Why, if it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// How far training came; of a run that failed, where its newest checkpoint is.
    #[serde(flatten)]
    pub progress: Progress,
    /// Seconds that learners ran.
    pub wall_s: f64,
    /// SHA-256 of the final weights; none if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights_digest: Option<String>,
    /// Greedy episodes of the final weights, by training task.
    #[serde(default)]
    pub evaluation: BTreeMap<String, TaskResult>,
}

impl Summary {
    /// The summary of a run that is over; nothing if none was written, as when all was killed.
    ///
    /// # Errors
    /// When it cannot be read, or is none.
    pub fn read(run_dir: &RunDir) -> io::Result<Option<Self>> {
        match fs::read(run_dir.summary()) {
            Ok(text) => Ok(Some(serde_json::from_slice(&text)?)),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Writes it, as a whole or not at all.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&self, run_dir: &RunDir) -> io::Result<()> {
        let path = run_dir.summary();
        let partial = path.with_extension("partial");
        fs::write(&partial, serde_json::to_vec_pretty(self)?).and_then(|()| fs::rename(&partial, &path))
    }

    /// Takes away what was said of the run's end when it goes on.
    ///
    /// # Errors
    /// When it would not go.
    pub fn remove(run_dir: &RunDir) -> io::Result<()> {
        match fs::remove_file(run_dir.summary()) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }

    /// Writes that a run has failed, with the figures of the checkpoint that it can be gone on from; unless its learner
    /// has said so itself.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write_failed(run_dir: &RunDir, reason: &str) -> io::Result<()> {
        if Self::read(run_dir).ok().flatten().is_some_and(|summary| summary.ended == Ended::Failed) {
            return Ok(());
        }
        let newest = checkpoint::newest_manifest(run_dir);
        let summary = Self {
            ended: Ended::Failed,
            reason: Some(reason.to_owned()),
            progress: newest.as_ref().map(|manifest| manifest.progress).unwrap_or_default(),
            wall_s: newest.as_ref().map_or(0.0, |manifest| manifest.wall_s),
            weights_digest: newest.map(|manifest| manifest.weights_digest),
            evaluation: BTreeMap::new(),
        };
        summary.write(run_dir)
    }
}
