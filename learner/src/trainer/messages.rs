//! What the trainer is asked, what it says, and why it may end early.

use crate::{ledger::Terms, metrics_repair::MetricsError, writer::Written};
use rit_algo::learner::{NotFinite, StateError};
use rit_config::Config;
use rit_env::rollout::LostEpisode;
use rit_episode::Episode;
use rit_record::{Ended, Measured, Progress, TaskResult};
use std::{io, path::PathBuf, sync::Arc};
use tokio::sync::oneshot;

/// What the trainer is asked to do, one after another.
#[derive(Debug)]
pub enum Work {
    /// The next batch in order of number.
    Batch(Vec<Episode>),
    /// Write a checkpoint now.
    Checkpoint(oneshot::Sender<Checkpointed>),
    /// Go on with other settings.
    Set(Arc<Config>),
    /// End the run, as this.
    Stop(Ended),
}

/// A checkpoint that was asked for.
#[derive(Debug)]
pub struct Checkpointed {
    /// How far training had come.
    pub progress: Progress,
    /// Digest of the weights.
    pub weights_digest: String,
    /// Comes when it is on disk.
    pub written: oneshot::Receiver<Written>,
}

/// How training stands: what status answers are made of.
#[derive(Clone, Debug, Default)]
pub struct Standing {
    /// How far it has come.
    pub progress: Progress,
    /// What the last update reported, in the learner's order; nothing before the first update.
    pub measured: Measured,
    /// Exploring episodes of late.
    pub recent: Vec<TaskResult>,
    /// The newest scheduled evaluation of the training tasks, with the progress it was made at: means.
    pub evaluation: Option<(Progress, Vec<TaskResult>)>,
    /// Episodes in replay.
    pub replay_episodes: usize,
}

/// What the trainer says while it works.
#[derive(Debug)]
pub enum News {
    /// A batch is done: another may be rolled on these terms.
    Trained(Terms, Standing),
    /// The run is over and will take no further batch; its last files are being written.
    Ending,
    /// A warning for the person who runs it.
    Warning(String),
}

/// Why training ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The metrics that are there cannot be gone on with.
    #[error("{path}: {error}")]
    Metrics {
        /// The file.
        path: PathBuf,
        /// Why.
        error: MetricsError,
    },
    /// The configuration cannot be written down.
    #[error(transparent)]
    Config(#[from] rit_config::ConfigError),
    /// The last checkpoint could not be written.
    #[error("the last checkpoint was not written: {0}; `rit train --resume` goes on from the one before")]
    Checkpoint(String),
    /// The summary could not be written.
    #[error("summary.json was not written: {0}; checkpoints are whole")]
    Summary(String),
    /// A file of the run directory could not be written.
    #[error("{path}: {error}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// An environment of an evaluation could not go on.
    #[error("the evaluation failed: {0}; `rit train --resume` goes on from the newest checkpoint")]
    Evaluation(#[from] LostEpisode),
    /// A checkpoint that is not this learner's.
    #[error("the checkpoint cannot be gone on from: {0}")]
    State(#[from] StateError),
    /// An update that would make weights that are no numbers.
    #[error(
        "{error} in update {update}: training has diverged, and would again from its checkpoints, whose weights are \
         whole; start a new run with a smaller algorithm.lr or algorithm.grad_norm_clip, such as \
         --set algorithm.lr={lr:.0e}"
    )]
    NotFinite {
        /// Its number, from 1.
        update: u64,
        /// What is not finite.
        error: NotFinite,
        /// A learning rate that may do better.
        lr: f32,
    },
}
