//! The rollout thread: a lease in, its episodes out.

use crate::{
    losses::{Losses, LostLeases},
    run::cpu_ms,
    sink::{EpisodeSink, SinkError},
    weights::{Weights, WeightsError},
};
use rit_algo::{Acting, Model};
use rit_config::Config;
use rit_env::{
    Split,
    rollout::{Job, LostEpisode, Rollout},
};
use rit_episode::wire::{self, EncodeError, Frame, PayloadLayout, RunId};
use rit_proto::v1::{Done, Lease, Leaving, actor_message::Message};
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};
use tokio::{runtime::Handle, sync::mpsc};

/// Why rolling ended.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError {
    /// The weights a lease asks for cannot be had.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Environments that fail again and again. The learner was told of it.
    #[error("{rounds} times in a row every episode was lost, the last: {lost}")]
    Environment {
        /// As many as `environment.lost_rounds_max` allows.
        rounds: usize,
        /// The last.
        #[source]
        lost: LostEpisode,
    },
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
    pub(crate) lost_leases: LostLeases,
    /// Set when the actor shall end: a blocked send is given up.
    pub(crate) stop: Arc<AtomicBool>,
}

impl Roller {
    /// A rollout of the run's training tasks.
    pub(crate) fn rollout(config: &Config) -> Rollout {
        let tasks = config.tasks(Split::Training);
        let algorithm = &config.algorithm;
        Rollout::new(tasks, rit_worlds::factory(config), config.seed, algorithm.random_permutation)
            .with_exploration_persistence(algorithm.exploration_persistence)
            .with_time_limit(algorithm.time_limit)
    }

    /// Rolls leases until there are no more; says to the learner which are done.
    pub(crate) fn run(
        mut self,
        runtime: &Handle,
        mut leases: mpsc::Receiver<Lease>,
        to_learner: &mpsc::Sender<Message>,
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
            let (mut losses, mut brought_any) = (Losses::default(), false);
            for rolled in self.rollout.roll(acting, &jobs) {
                match rolled {
                    Ok(episode) => {
                        wire::encode(&episode, &self.layout, self.run_id, self.actor, &mut frame)?;
                        self.sink.send(&frame, &give_up)?;
                        brought_any = true;
                    }
                    Err(lost) => losses.note(lost),
                }
            }
            self.sink.flush(&give_up)?;
            let done =
                Message::Done(Done { lease: lease.lease, losses: losses.to_messages(), cpu_ms: cpu_ms() });
            if let Some(lost) = self.lost_leases.note(losses, brought_any) {
                // In this order, so that no other lease comes.
                for last in [Message::Leaving(Leaving {}), done] {
                    let _ = to_learner.blocking_send(last);
                }
                let rounds = self.lost_leases.max();
                return Err(RolloutError::Environment { rounds, lost });
            }
            if to_learner.blocking_send(done).is_err() {
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
