//! The writing thread: replay as it grows, checkpoints when they are due.
//!
//! The trainer hands over each episode that entered replay (shared, not copied) and, when a checkpoint is due, a
//! copy of its state (see [`crate::write_queue`]). A disk that refuses costs nothing but the checkpoint: episodes stay
//! queued, at most as many as replay holds, and the next checkpoint tries again.

use crate::{
    checkpoint::{self, CheckpointError, TrainingState},
    coordinator::{Event, Input},
    replay_log::ReplayLog,
    write_queue::{StateToWrite, ToWrite, WriteQueueReader},
};
use rit_algo::Model;
use rit_config::RunDir;
use rit_episode::Episode;
use rit_policy::TaskNames;
use std::{
    collections::VecDeque,
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::sync::mpsc as async_mpsc;

/// Where a checkpoint lies, relative to the run directory; or why it was not written, in words.
pub type Written = Result<PathBuf, String>;

/// What became of a checkpoint.
#[derive(Clone, Debug)]
pub struct CheckpointEnded {
    /// Environment steps collected by then.
    pub env_steps: u64,
    /// How long it took.
    pub duration: Duration,
    /// Why it is not on disk, if it is not.
    pub failed: Option<String>,
}

/// The writer.
#[derive(Debug)]
pub struct Writer {
    /// Where the run lies.
    pub run_dir: RunDir,
    /// Whose weights are written.
    pub model: Arc<Model>,
    /// What goes in and comes out of them is called.
    pub names: TaskNames,
    /// Replay on disk.
    pub log: ReplayLog,
    /// Episodes that replay holds; 0 without.
    pub replay_episodes: usize,
    /// Checkpoints kept.
    pub keep: usize,
    /// Leads to the coordinator, which is told of checkpoints.
    pub events: async_mpsc::Sender<Event>,
}

impl Writer {
    /// Writes until the queue's last sender has gone.
    pub fn run(mut self, queue: &WriteQueueReader) {
        let mut waiting: VecDeque<Arc<Episode>> = VecDeque::new();
        while let Some(next) = queue.next() {
            match next {
                ToWrite::Episode(episode) => {
                    waiting.push_back(episode);
                    // A failure is told by the checkpoint that needs what is missing.
                    let _ = self.append(&mut waiting);
                }
                ToWrite::Checkpoint(StateToWrite { state, answers }) => {
                    let begun = Instant::now();
                    let written = self.checkpoint(&mut waiting, &state);
                    let (env_steps, duration) = (state.manifest.progress.env_steps, begun.elapsed());
                    match &written {
                        Ok(path) => {
                            let ms = duration.as_millis();
                            tracing::info!(path = %path.display(), env_steps, ms, "wrote a checkpoint");
                        }
                        Err(error) => tracing::error!(%error, env_steps, "a checkpoint was not written"),
                    }
                    let written = written.map_err(|error| error.to_string());
                    let failed = written.as_ref().err().cloned();
                    let ended = CheckpointEnded { env_steps, duration, failed };
                    // At the end of a run the coordinator may have gone.
                    let _ = self.events.blocking_send(Input::CheckpointEnded(ended).into());
                    for answer in answers {
                        // The caller may have gone.
                        let _ = answer.send(written.clone());
                    }
                }
            }
        }
    }

    fn append(&mut self, waiting: &mut VecDeque<Arc<Episode>>) -> Result<(), CheckpointError> {
        // What replay has forgotten meanwhile is not needed on disk either.
        let forgotten = waiting.len().saturating_sub(self.replay_episodes);
        waiting.drain(..forgotten);
        while let Some(episode) = waiting.front() {
            self.log.append(episode)?;
            waiting.pop_front();
        }
        Ok(())
    }

    fn checkpoint(
        &mut self,
        waiting: &mut VecDeque<Arc<Episode>>,
        state: &TrainingState,
    ) -> Result<PathBuf, CheckpointError> {
        self.append(waiting)?;
        self.log.sync()?;
        let path = checkpoint::save(&self.run_dir, &self.model, &self.names, state, self.keep)?;
        // The checkpoint is on disk: replay that cannot be removed does not make it a failure.
        if let Err(error) = self.forget_replay() {
            tracing::warn!(%error, "old replay stays until the next checkpoint");
        }
        Ok(path)
    }

    /// Removes the replay that none of the checkpoints needs.
    fn forget_replay(&self) -> Result<(), CheckpointError> {
        Ok(self.log.forget_before(checkpoint::replay_needed_from(&self.run_dir, self.replay_episodes)?)?)
    }
}
