//! What a run came to and how it ended: `summary.json`, which lies in the run directory from the run's end until it is
//! gone on with.

use crate::{
    checkpoint::{self, Progress},
    evaluation::TaskResult,
};
use rit_config::{RunDir, TEXT_BYTES_MAX, read_regular, write_whole};
use serde::{Deserialize, Serialize};
use serde_json::Value;
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
    /// A signal, Ctrl-C or a terminal that closed asked it to end, or the process that watched over it has gone.
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

/// What the keys of this build's `summary.json` mean. Raise it when that changes.
pub const SUMMARY_FORMAT: u32 = 1;

/// Files of builds that did not say it yet mean the same.
fn first_format() -> u32 {
    1
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// See [`SUMMARY_FORMAT`].
    #[serde(default = "first_format")]
    pub format_version: u32,
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
    /// What the last learner found or did that somebody should know of.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

impl Summary {
    /// The summary of a run that is over; nothing if none was written, as when all was killed.
    ///
    /// # Errors
    /// When it cannot be read, is none, or is a newer build's.
    pub fn read(run_dir: &RunDir) -> io::Result<Option<Self>> {
        match read_regular(&run_dir.summary(), TEXT_BYTES_MAX) {
            Ok(text) => Self::parse(&text).map(Some),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Of the file's text.
    fn parse(text: &[u8]) -> io::Result<Self> {
        check_format(&serde_json::from_slice(text)?)?;
        Ok(serde_json::from_slice(text)?)
    }

    /// Writes it, as a whole or not at all.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write(&self, run_dir: &RunDir) -> io::Result<()> {
        write_whole(&run_dir.summary(), &serde_json::to_vec_pretty(self)?)
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
            format_version: SUMMARY_FORMAT,
            ended: Ended::Failed,
            reason: Some(reason.to_owned()),
            progress: newest.as_ref().map(|manifest| manifest.progress).unwrap_or_default(),
            wall_s: newest.as_ref().map_or(0.0, |manifest| manifest.wall_s),
            weights_digest: newest.map(|manifest| manifest.weights_digest),
            evaluation: BTreeMap::new(),
            warnings: Vec::new(),
        };
        summary.write(run_dir)
    }
}

/// Whether this build knows what a summary's keys mean.
///
/// # Errors
/// When a newer build has written it.
pub fn check_format(summary: &Value) -> io::Result<()> {
    match summary.get("format_version") {
        None => Ok(()),
        Some(version) if *version == SUMMARY_FORMAT => Ok(()),
        Some(version) => Err(io::Error::new(
            ErrorKind::InvalidData,
            format!(
                "it has format version {version}, this build reads {SUMMARY_FORMAT}; use the build that wrote it"
            ),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_builds_summary_is_refused_in_words_and_an_older_ones_read() {
        let old = r#"{"ended":"stopped","env_steps":8,"episodes":4,"updates":1,"wall_s":0.5,"weights_digest":"ab"}"#;
        let summary = Summary::parse(old.as_bytes()).unwrap();
        assert_eq!((summary.format_version, summary.ended), (SUMMARY_FORMAT, Ended::Stopped));
        let written = serde_json::to_vec(&summary).unwrap();
        assert!(written.starts_with(br#"{"format_version":1,"#));
        assert_eq!(Summary::parse(&written).unwrap(), summary);
        // Whatever its keys are by then.
        let newer = Summary::parse(br#"{"format_version":2,"outcome":"stopped"}"#).unwrap_err();
        assert_eq!(
            newer.to_string(),
            "it has format version 2, this build reads 1; use the build that wrote it"
        );
    }
}
