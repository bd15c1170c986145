//! What a run came to and how it ended: `summary.json`, which lies in the run directory from the run's end until it is
//! gone on with.

use crate::{Build, Host, Progress, TaskResult, line::named, number};
use rit_config::{RunDir, write_whole};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::{
    collections::BTreeMap,
    fmt, fs,
    io::{self, ErrorKind},
};

/// No summary is longer.
pub(crate) const BYTES_MAX: u64 = 64 << 20;

/// How a run ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ended {
    /// All steps of `training.t_max` are done.
    #[default]
    Finished,
    /// An evaluation has reached what `training.until` asks for.
    Until,
    /// It was asked to stop, by `rit ctl stop` or on the page.
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

    /// Whether all was done that was to be done.
    pub const fn is_whole(self) -> bool {
        matches!(self, Self::Finished | Self::Until)
    }

    /// As it stands in files.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Until => "until",
            Self::Stopped => "stopped",
            Self::Interrupted => "interrupted",
            Self::Failed => "failed",
        }
    }
}

impl fmt::Display for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Until => "finished: the goal of training.until is reached",
            ended => ended.word(),
        })
    }
}

/// What the keys of this build's `summary.json` mean. Raise it when that changes.
const FORMAT_VERSION: u32 = 1;

fn is_false(value: &bool) -> bool {
    !value
}

/// Files of builds that did not say it yet mean the same.
fn first_format() -> u32 {
    1
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// What its keys mean.
    #[serde(default = "first_format")]
    pub format_version: u32,
    /// How it ended. Builds that did not say so yet wrote a summary of finished runs only.
    #[serde(default)]
    pub ended: Ended,
    /// Why, if it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Whether it failed since a loss or gradient was no finite number: it would again.
    #[serde(default, skip_serializing_if = "is_false")]
    pub diverged: bool,
    /// How far training came; of a run that failed, where its newest checkpoint is.
    #[serde(flatten)]
    pub progress: Progress,
    /// Seconds that learners ran.
    #[serde(deserialize_with = "number::or_nan")]
    pub wall_s: f64,
    /// Seconds of processor time that all its processes took; of a run that was killed and gone on with, those that its
    /// weights took.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu_s: Option<f64>,
    /// The program that ended it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub build: Option<Build>,
    /// Where it ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<Host>,
    /// SHA-256 of the final weights; none if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights_digest: Option<String>,
    /// Greedy episodes of the final weights, by training task: means.
    #[serde(default, deserialize_with = "named")]
    pub evaluation: BTreeMap<String, TaskResult>,
    /// The same of testing tasks, where those are evaluated.
    #[serde(default, deserialize_with = "named", skip_serializing_if = "BTreeMap::is_empty")]
    pub testing: BTreeMap<String, TaskResult>,
    /// The best policy, where it is kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub best: Option<Best>,
    /// Warnings of the last learner.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// What this build does not know.
    #[serde(flatten)]
    pub other: Map<String, Value>,
}

impl Default for Summary {
    /// Of a run that has come to nothing yet, in this build's format.
    fn default() -> Self {
        Self {
            format_version: FORMAT_VERSION,
            ended: Ended::default(),
            reason: None,
            diverged: false,
            progress: Progress::default(),
            wall_s: 0.0,
            cpu_s: None,
            build: None,
            host: None,
            weights_digest: None,
            evaluation: BTreeMap::new(),
            testing: BTreeMap::new(),
            best: None,
            warnings: Vec::new(),
            other: Map::new(),
        }
    }
}

/// The best policy of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Best {
    /// What it is the best by: a mean over training tasks.
    pub measure: String,
    /// The measure's value.
    #[serde(deserialize_with = "number::or_nan")]
    pub value: f64,
    /// How far training had come.
    #[serde(flatten)]
    pub progress: Progress,
    /// SHA-256 of its weights.
    pub weights_digest: String,
    /// The absolute metric: ten times as many greedy episodes, by training task. Empty where it was not asked for.
    #[serde(default, deserialize_with = "named", skip_serializing_if = "BTreeMap::is_empty")]
    pub evaluation: BTreeMap<String, TaskResult>,
    /// The same of testing tasks.
    #[serde(default, deserialize_with = "named", skip_serializing_if = "BTreeMap::is_empty")]
    pub testing: BTreeMap<String, TaskResult>,
}

impl Summary {
    /// The summary of a run that is over; nothing if none was written, as when all was killed.
    ///
    /// # Errors
    /// When it cannot be read, is none, or is a newer build's.
    pub fn read(run_dir: &RunDir) -> io::Result<Option<Self>> {
        match rit_config::read_regular(&run_dir.summary(), BYTES_MAX) {
            Ok(text) => Self::parse(serde_json::from_slice(&text)?).map(Some),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Of the file's object. Whatever a newer build's keys are, its version is told.
    pub(crate) fn parse(object: Value) -> io::Result<Self> {
        match object.get("format_version") {
            Some(version) if *version != FORMAT_VERSION => Err(io::Error::new(
                ErrorKind::InvalidData,
                format!(
                    "it has format version {version}, this build reads {FORMAT_VERSION}; use the build that wrote it"
                ),
            )),
            _ => Ok(serde_json::from_value(object)?),
        }
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn summaries_of_older_builds_are_read_and_strange_fields_kept() {
        let old = r#"{"env_steps":50,"episodes":25,"updates":20,"wall_s":1.5,"weights_digest":"ab",
            "evaluation":{"game-1":{"episodes":32,"mean_return":88.0,"win_rate":1.0}},"moon":"full"}"#;
        let summary: Summary = serde_json::from_str(old).unwrap();
        assert_eq!((summary.ended, summary.cpu_s, summary.best.is_none()), (Ended::Finished, None, true));
        assert_eq!(summary.evaluation["game-1"].task, "game-1");
        let again: Value = serde_json::to_value(&summary).unwrap();
        assert_eq!((&again["moon"], &again["ended"]), (&Value::from("full"), &Value::from("finished")));
    }

    #[test]
    fn a_newer_builds_summary_is_refused_in_words() {
        let written = serde_json::to_value(Summary::default()).unwrap();
        assert_eq!(written["format_version"], 1);
        assert_eq!(Summary::parse(written).unwrap(), Summary::default());
        let newer = serde_json::json!({ "format_version": 2, "outcome": "stopped" });
        assert_eq!(
            Summary::parse(newer).unwrap_err().to_string(),
            "it has format version 2, this build reads 1; use the build that wrote it"
        );
    }

    #[test]
    fn what_is_no_number_makes_no_invalid_json() {
        let result = TaskResult { mean_return: f64::INFINITY, ..TaskResult::default() };
        let best = Best { evaluation: BTreeMap::from([("a".into(), result)]), ..Best::default() };
        let summary = Summary { best: Some(best), ..Summary::default() };
        let text = serde_json::to_string(&summary).unwrap();
        let again: Summary = serde_json::from_str(&text).unwrap();
        assert!(again.best.unwrap().evaluation["a"].mean_return.is_nan());
    }
}
