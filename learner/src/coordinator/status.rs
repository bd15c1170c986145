//! What the coordinator answers when it is asked how the run stands: the one model of what is measured, which gRPC,
//! terminals and Prometheus show.

use super::{Actor, Coordinator, State};
use crate::{
    gauges::{Checkpoints, Happening, Rates},
    ledger::{ActorId, Counts},
    messages,
    trainer::Standing,
};
use rit_episode::wire::{Header, PayloadLayout};
use rit_proto::v1;
use rit_record::TaskResult;
use std::time::Duration;

impl Coordinator {
    /// How the run stands, at this moment since the learner's beginning.
    pub fn status(&self, now: Duration) -> v1::RunStatus {
        let Standing { progress, measured, recent, evaluation, replay_episodes } = &self.standing;
        let messages = |results: &[TaskResult]| results.iter().map(messages::task_result).collect();
        // All frames of a run have the same length.
        let frame_bytes = size_of::<Header>() + PayloadLayout::new(self.config.dims()).len();
        v1::RunStatus {
            state: v1::RunState::from(self.state).into(),
            env_steps: progress.env_steps,
            env_steps_max: self.config.training.t_max,
            episodes: progress.episodes,
            updates: progress.updates,
            epsilon: self.epsilon.into(),
            wall_s: now.as_secs_f64(),
            recent: messages(recent),
            evaluation: evaluation.as_ref().map(|(progress, results)| v1::Evaluation {
                env_steps: progress.env_steps,
                weights_version: progress.updates,
                tasks: messages(results),
            }),
            actors: self.actors.iter().map(|(&id, actor)| self.actor_status(id, actor, now)).collect(),
            ledger: Some(self.ledger_status()),
            replay_episodes: *replay_episodes as u64,
            pid: std::process::id(),
            replay_episodes_max: self.config.replay_episodes() as u64,
            rates: Some(self.rates.rates().into()),
            learner_waiting_s: self.learner_waiting.seconds(now),
            shared_memory_bytes: self.frames * frame_bytes as u64,
            checkpoints: Some(self.checkpoints.into()),
            happenings: self.happenings.list().iter().map(v1::Happening::from).collect(),
            actors_wanted: self.config.actors.count as u32,
            measures: messages::measures(measured, self.measures),
            algorithm: self.config.algorithm.name.to_string(),
        }
    }

    fn actor_status(&self, id: ActorId, actor: &Actor, now: Duration) -> v1::ActorStatus {
        v1::ActorStatus {
            name: actor.name.clone(),
            pid: actor.pid,
            episodes: actor.episodes,
            outstanding: self.ledger.outstanding_with(id).count() as u64,
            silent_s: now.saturating_sub(actor.heard).as_secs_f64(),
            hung: actor.hung,
            remote: actor.remote,
            waiting_s: actor.waiting.seconds(now),
        }
    }

    fn ledger_status(&self) -> v1::LedgerStatus {
        let Counts { handed_out, inserted, outstanding, rejected } = self.ledger.counts();
        v1::LedgerStatus {
            handed_out,
            inserted,
            outstanding,
            rejected: rejected.iter().map(|(reason, &count)| (reason.name().to_owned(), count)).collect(),
            frames_refused: self.frames_refused.iter().map(|(&name, &count)| (name.into(), count)).collect(),
            imbalances: self.imbalances,
        }
    }
}

impl From<State> for v1::RunState {
    fn from(state: State) -> Self {
        match state {
            State::Running => Self::Running,
            State::Paused => Self::Paused,
            State::Stopping => Self::Stopping,
        }
    }
}

impl From<Rates> for v1::Rates {
    fn from(Rates { env_steps_per_s, episodes_per_s, updates_per_s }: Rates) -> Self {
        Self { env_steps_per_s, episodes_per_s, updates_per_s }
    }
}

impl From<Checkpoints> for v1::CheckpointsStatus {
    fn from(Checkpoints { written, failed, total, last, env_steps }: Checkpoints) -> Self {
        let (total_s, last_s) = (total.as_secs_f64(), last.as_secs_f64());
        Self { written, failed, total_s, last_s, env_steps }
    }
}

impl From<&Happening> for v1::Happening {
    fn from(Happening { at, env_steps, what, warning }: &Happening) -> Self {
        Self { wall_s: at.as_secs_f64(), env_steps: *env_steps, what: what.clone(), warning: *warning }
    }
}
