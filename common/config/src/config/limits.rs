//! The range of every number.

use super::Config;
use crate::{ConfigError, number};

impl Config {
    /// Every number's name, value, smallest and largest.
    pub(crate) fn limits(&self) -> Vec<(&'static str, Number, f64, f64)> {
        let (algorithm, network, evaluation) = (&self.algorithm, &self.network, &self.evaluation);
        // Beyond all that is run; they keep a slip of the keyboard from taking all memory.
        const COUNT: f64 = 1e6;
        const STEPS: f64 = 1e12;
        const SIZE: f64 = 4096.0;
        vec![
            ("environment.view_radius", self.environment.view_radius.into(), 0.0, f64::INFINITY),
            ("environment.approach_shaping", self.environment.approach_shaping.into(), 0.0, 1e3),
            ("environment.lost_rounds_max", self.environment.lost_rounds_max.into(), 1.0, COUNT),
            (
                "environment.environments_per_worker",
                self.environment.environments_per_worker.into(),
                1.0,
                1024.0,
            ),
            ("environment.timeout_ms", self.environment.timeout_ms.into(), 1.0, 1e9),
            ("environment.worker_memory_mb", self.environment.worker_memory_mb.into(), 0.0, 1e9),
            ("algorithm.gamma", algorithm.gamma.into(), 0.0, 1.0),
            ("algorithm.reward_scale", algorithm.reward_scale.into(), 1e-6, 1e6),
            ("algorithm.lr", algorithm.lr.into(), 1e-12, 1.0),
            // At 1 it would never take a gradient in, and every step would be a division by almost nothing.
            ("algorithm.rmsprop_alpha", algorithm.rmsprop_alpha.into(), 0.0, 0.999_999),
            ("algorithm.optimizer_eps", algorithm.optimizer_eps.into(), 1e-12, 1.0),
            ("algorithm.grad_norm_clip", algorithm.grad_norm_clip.into(), 1e-6, f64::INFINITY),
            ("algorithm.epsilon_start", algorithm.epsilon_start.into(), 0.0, 1.0),
            ("algorithm.epsilon_finish", algorithm.epsilon_finish.into(), 0.0, 1.0),
            ("algorithm.exploration_persistence", algorithm.exploration_persistence.into(), 0.0, 1.0),
            ("algorithm.epsilon_anneal_steps", algorithm.epsilon_anneal_steps.into(), 1.0, STEPS),
            ("algorithm.n_rollout_threads", algorithm.n_rollout_threads.into(), 1.0, 4096.0),
            ("algorithm.buffer_size", algorithm.buffer_size.into(), 1.0, COUNT),
            ("algorithm.batch_size", algorithm.batch_size.into(), 1.0, algorithm.buffer_size as f64),
            ("algorithm.target_update_interval", algorithm.target_update_interval.into(), 1.0, STEPS),
            ("algorithm.policy_lag", algorithm.policy_lag.into(), 0.0, 64.0),
            ("algorithm.imagined_weight", algorithm.imagined_weight.into(), 0.0, 1.0),
            ("algorithm.role_entropy_weight", algorithm.role_entropy_weight.into(), 0.0, 1e6),
            ("algorithm.role_kl_weight", algorithm.role_kl_weight.into(), 0.0, 1e6),
            ("algorithm.role_dissimilarity_weight", algorithm.role_dissimilarity_weight.into(), 0.0, 1e6),
            ("algorithm.role_soft_constraint", algorithm.role_soft_constraint.into(), 0.0, 1e6),
            ("algorithm.epochs", algorithm.epochs.into(), 1.0, 1000.0),
            ("algorithm.minibatches", algorithm.minibatches.into(), 1.0, algorithm.n_rollout_threads as f64),
            ("algorithm.clip", algorithm.clip.into(), 1e-6, 1e6),
            ("algorithm.gae_lambda", algorithm.gae_lambda.into(), 0.0, 1.0),
            ("algorithm.entropy_coef", algorithm.entropy_coef.into(), 0.0, 1e6),
            ("algorithm.value_coef", algorithm.value_coef.into(), 0.0, 1e6),
            ("algorithm.huber_delta", algorithm.huber_delta.into(), 1e-6, 1e6),
            // At 1 the normaliser would never take a return in.
            ("algorithm.value_norm_beta", algorithm.value_norm_beta.into(), 0.0, 0.999_999),
            ("network.hidden_dim", network.hidden_dim.into(), 1.0, SIZE),
            ("network.attention_dim", network.attention_dim.into(), 1.0, SIZE),
            ("network.n_heads", network.n_heads.into(), 1.0, 64.0),
            ("network.task_representation_dim", network.task_representation_dim.into(), 1.0, SIZE),
            ("network.reward_embed_dim", network.reward_embed_dim.into(), 1.0, SIZE),
            ("network.mixing_embed_dim", network.mixing_embed_dim.into(), 1.0, SIZE),
            ("network.hypernet_embed_dim", network.hypernet_embed_dim.into(), 1.0, SIZE),
            ("network.feedforward_dim", network.feedforward_dim.into(), 1.0, SIZE),
            ("network.role_dim", network.role_dim.into(), 1.0, SIZE),
            ("network.role_hidden_dim", network.role_hidden_dim.into(), 1.0, SIZE),
            ("network.role_variance_floor", network.role_variance_floor.into(), 1e-12, 1e6),
            ("network.n_blocks", network.n_blocks.into(), 1.0, 64.0),
            ("training.t_max", self.training.t_max.into(), 1.0, STEPS),
            ("evaluation.every_env_steps", evaluation.every_env_steps.into(), 1.0, STEPS),
            ("evaluation.episodes", evaluation.episodes.into(), 1.0, COUNT),
            ("evaluation.testing_every_env_steps", evaluation.testing_every_env_steps.into(), 0.0, STEPS),
            ("evaluation.testing_episodes", evaluation.testing_episodes.into(), 1.0, COUNT),
            ("checkpoints.every_env_steps", self.checkpoints.every_env_steps.into(), 1.0, STEPS),
            ("checkpoints.keep", self.checkpoints.keep.into(), 1.0, COUNT),
            ("checkpoints.last_retry_ms", self.checkpoints.last_retry_ms.into(), 0.0, 86_400_000.0),
            ("actors.count", self.actors.count.into(), 0.0, 256.0),
            ("actors.count_max", self.actors.count_max.into(), 1.0, 256.0),
            ("actors.remote", self.actors.remote.into(), 0.0, 256.0),
            ("actors.episodes_at_once", self.actors.episodes_at_once.into(), 1.0, 4096.0),
            ("actors.heartbeat_timeout_ms", self.actors.heartbeat_timeout_ms.into(), 2000.0, 3_600_000.0),
            ("learner.shards", self.learner.shards.into(), 1.0, 256.0),
            ("learner.threads", self.learner.threads.into(), 1.0, 256.0),
            ("learner.metrics_every_env_steps", self.learner.metrics_every_env_steps.into(), 1.0, STEPS),
            ("starcraft.base_build", u64::from(self.starcraft.base_build).into(), 0.0, 1e9),
            ("starcraft.custom_types", u64::from(self.starcraft.custom_types).into(), 0.0, 1e9),
            ("starcraft.timeout_ms", self.starcraft.timeout_ms.into(), 1000.0, 3_600_000.0),
            ("learner.stall_timeout_ms", self.learner.stall_timeout_ms.into(), 1000.0, 86_400_000.0),
        ]
    }
}

/// A number of the configuration, in its own precision: a bound typed as 1e-12 is within the bound 1e-12.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Number {
    Whole(u64),
    Single(f32),
    Real(f64),
}

impl Number {
    /// Whether it lies in this range; a NaN lies in none.
    pub(crate) fn check(self, key: &str, min: f64, max: f64) -> Result<(), ConfigError> {
        let (within, value, min, max) = match self {
            Self::Whole(value) => {
                let (min, max) = (min as u64, max as u64);
                ((min..=max).contains(&value), value.to_string(), min.to_string(), max.to_string())
            }
            Self::Single(value) => {
                let (min, max) = (min as f32, max as f32);
                ((min..=max).contains(&value), number::shown(value), number::shown(min), number::shown(max))
            }
            Self::Real(value) => {
                ((min..=max).contains(&value), number::shown(value), number::shown(min), number::shown(max))
            }
        };
        if within { Ok(()) } else { Err(ConfigError::Range { key: key.to_owned(), value, min, max }) }
    }
}

impl From<u64> for Number {
    fn from(value: u64) -> Self {
        Self::Whole(value)
    }
}

impl From<usize> for Number {
    fn from(value: usize) -> Self {
        Self::Whole(value as u64)
    }
}

impl From<f32> for Number {
    fn from(value: f32) -> Self {
        Self::Single(value)
    }
}

impl From<f64> for Number {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}
