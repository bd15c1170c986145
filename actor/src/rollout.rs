//! The rollout thread: a lease in, its episodes out.

use crate::{
    sink::{EpisodeSink, SinkError},
    weights::{Weights, WeightsError},
};
use rit_algo::{Acting, Model};
use rit_config::Config;
use rit_env::{
    Split,
    rollout::{Job, LostEpisode, Rolled, Rollout},
};
use rit_episode::{
    Episode,
    wire::{self, EncodeError, Frame, PayloadLayout, RunId},
};
use rit_proto::v1::Lease;
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};
use tokio::{runtime::Handle, sync::mpsc};

/// An actor that loses so many episodes in a row ends: its environments do not work.
const FAILURES_MAX: usize = 5;

/// Episodes lost since the last that was not.
#[derive(Debug, Default)]
pub(crate) struct Failures(usize);

impl Failures {
    /// The episode, if there is one. A lost one is logged and left out: the learner misses it when the lease is done,
    /// and hands its number out again.
    fn note(&mut self, rolled: Rolled) -> Result<Option<Episode>, RolloutError> {
        match rolled {
            Ok(episode) => {
                self.0 = 0;
                Ok(Some(episode))
            }
            Err(lost) => {
                self.0 += 1;
                tracing::warn!(%lost, reason = lost.error.kind.name(), "an episode is lost");
                if self.0 >= FAILURES_MAX { Err(RolloutError::Environment(lost)) } else { Ok(None) }
            }
        }
    }
}

/// Why rolling ended.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The weights a lease asks for cannot be had.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Environments that fail again and again.
    #[error("{FAILURES_MAX} episodes in a row were lost, the last: {0}")]
    Environment(LostEpisode),
    /// An episode that does not fit the run's dims.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// A frame that could not be sent.
    #[error(transparent)]
    Send(#[from] SinkError),
}

/// What the rollout thread works with.
pub(crate) struct Roller {
    pub(crate) model: Arc<Model>,
    pub(crate) rollout: Rollout,
    pub(crate) sink: EpisodeSink,
    pub(crate) layout: PayloadLayout,
    pub(crate) run_id: RunId,
    pub(crate) actor: u32,
    pub(crate) weights: Weights,
    pub(crate) failures: Failures,
    /// Set when the actor shall end: a blocked send is given up.
    pub(crate) stop: Arc<AtomicBool>,
}

impl Roller {
    /// A rollout of the run's training tasks.
    pub(crate) fn rollout(config: &Config) -> Rollout {
        let tasks = config.tasks(Split::Training);
        let options = config.environment_options();
        let algorithm = &config.algorithm;
        Rollout::new(tasks, options, config.seed, algorithm.random_permutation)
            .with_exploration_persistence(algorithm.exploration_persistence)
            .with_time_limit_bootstraps(algorithm.time_limit_bootstraps)
    }

    /// Rolls leases until there are no more; says which are `done`.
    pub(crate) fn run(
        mut self,
        runtime: &Handle,
        mut leases: mpsc::Receiver<Lease>,
        done: &mpsc::Sender<u64>,
    ) -> Result<(), RolloutError> {
        let mut frame = Frame::new(&self.layout);
        let stop = Arc::clone(&self.stop);
        let give_up = || stop.load(Ordering::Relaxed);
        let mut acting: Option<(u64, Acting)> = None;
        while let Some(lease) = leases.blocking_recv() {
            let version = lease.weights_version;
            let acting = match &mut acting {
                Some((held, acting)) => {
                    if *held != version {
                        acting.set_params(&self.params(runtime, version)?);
                        *held = version;
                    }
                    acting
                }
                None => {
                    let params = self.params(runtime, version)?;
                    &mut acting.insert((version, Acting::new(&self.model, &params))).1
                }
            };
            let choice = self.model.method().exploring(lease.epsilon);
            let job = |&number| Job { number, weights_version: version, choice, task: None };
            let jobs: Vec<Job> = lease.episodes.iter().map(job).collect();
            for rolled in self.rollout.roll(acting, &jobs) {
                let Some(episode) = self.failures.note(rolled)? else { continue };
                wire::encode(&episode, &self.layout, self.run_id, self.actor, &mut frame)?;
                self.sink.send(&frame, &give_up)?;
            }
            self.sink.flush(&give_up)?;
            if done.blocking_send(lease.lease).is_err() {
                break;
            }
        }
        Ok(())
    }

    fn params(&mut self, runtime: &Handle, version: u64) -> Result<Vec<f32>, RolloutError> {
        // As many as the model has: others are refused where they come in.
        let snapshot = runtime.block_on(self.weights.get(version))?;
        let (words, _) = snapshot.params.as_chunks::<4>();
        Ok(words.iter().map(|&word| f32::from_le_bytes(word)).collect())
    }
}
