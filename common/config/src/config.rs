//! The resolved configuration: complete, and within its limits. `presets/all.toml` says what each key means.

mod limits;
mod words;

pub use words::{Backend, EncoderName, KeepBest, OptimizerName, SpawnRotate, Until, WebListen};

use crate::{
    ConfigError, foreign,
    method_keys::{self, by_name},
    number,
    resolve::is_free,
};
use rit_algo::{
    Method, ModelConfig, PpoConfig, Regime, RoleConfig, TerminalStates, UpdateConfig, method::Encoder,
};
use rit_env::{
    EnvironmentOptions, Physics, Split, Task, TaskSet,
    combat::{CombatOptions, StatsVersion, world::ScriptedMedivac},
    rollout::TimeLimit,
};
use rit_episode::{Dims, RunSeed};
use rit_nn::OptimizerKind;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use toml::Table;

/// Everything a run is made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Config {
    pub seed: RunSeed,
    pub environment: Environment,
    pub algorithm: Algorithm,
    pub network: Network,
    pub training: Training,
    pub evaluation: Evaluation,
    pub checkpoints: Checkpoints,
    pub actors: Actors,
    pub learner: Learner,
    pub web: Web,
    pub starcraft: StarCraft,
}

/// `[environment]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Environment {
    pub task_set: TaskSet,
    pub backend: Backend,
    pub training_tasks: Vec<String>,
    pub testing_tasks: Vec<String>,
    #[serde(serialize_with = "number::shortest")]
    pub view_radius: f32,
    #[serde(serialize_with = "number::shortest")]
    pub approach_shaping: f32,
    pub physics: Physics,
    pub spawn_rotate: SpawnRotate,
    pub stats: StatsVersion,
    pub enemy_medivac: ScriptedMedivac,
    pub lost_rounds_max: usize,
    pub python: String,
    pub interpreter: String,
    pub environments_per_worker: usize,
    pub timeout_ms: u64,
    pub worker_memory_mb: u64,
    pub worlds: Vec<World>,
    pub feature_names: Vec<String>,
    pub action_names: Vec<String>,
}

/// What a task in Python is: `rit train` asks before a run begins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct World {
    pub task: String,
    pub n_agents: usize,
    pub n_entities: usize,
    pub steps_max: usize,
    pub has_wins: bool,
    pub is_reproducible: bool,
}

/// `[algorithm]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Algorithm {
    #[serde(with = "by_name")]
    pub name: Method,
    pub encoder: EncoderName,
    pub random_permutation: bool,
    #[serde(serialize_with = "number::shortest")]
    pub gamma: f32,
    #[serde(serialize_with = "number::shortest")]
    pub reward_scale: f32,
    pub time_limit: TimeLimit,
    pub optimizer: OptimizerName,
    #[serde(serialize_with = "number::shortest")]
    pub lr: f32,
    #[serde(serialize_with = "number::shortest")]
    pub rmsprop_alpha: f32,
    #[serde(serialize_with = "number::shortest")]
    pub optimizer_eps: f32,
    pub grad_norm_clip: f64,
    pub epsilon_start: f64,
    pub epsilon_finish: f64,
    pub epsilon_anneal_steps: u64,
    #[serde(serialize_with = "number::shortest")]
    pub exploration_persistence: f32,
    pub n_rollout_threads: usize,
    pub buffer_size: usize,
    pub batch_size: usize,
    pub target_update_interval: u64,
    pub policy_lag: usize,
    #[serde(serialize_with = "number::shortest")]
    pub imagined_weight: f32,
    #[serde(serialize_with = "number::shortest")]
    pub role_entropy_weight: f32,
    #[serde(serialize_with = "number::shortest")]
    pub role_kl_weight: f32,
    #[serde(serialize_with = "number::shortest")]
    pub role_dissimilarity_weight: f32,
    #[serde(serialize_with = "number::shortest")]
    pub role_soft_constraint: f32,
    pub epochs: usize,
    pub minibatches: usize,
    pub clip: f64,
    pub gae_lambda: f64,
    pub entropy_coef: f64,
    pub value_coef: f64,
    pub huber_delta: f64,
    pub value_norm_beta: f64,
}

/// `[network]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Network {
    pub hidden_dim: usize,
    pub attention_dim: usize,
    pub n_heads: usize,
    pub task_representation_dim: usize,
    pub reward_embed_dim: usize,
    pub mixing_embed_dim: usize,
    pub hypernet_embed_dim: usize,
    pub feedforward_dim: usize,
    pub role_dim: usize,
    pub role_hidden_dim: usize,
    #[serde(serialize_with = "number::shortest")]
    pub role_variance_floor: f32,
    pub n_blocks: usize,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub initial_weights: String,
}

/// `[training]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Training {
    pub t_max: u64,
    pub until: Until,
}

/// `[evaluation]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Evaluation {
    pub every_env_steps: u64,
    pub episodes: usize,
    pub testing_every_env_steps: u64,
    pub testing_episodes: usize,
    pub absolute_metric: bool,
}

/// `[checkpoints]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Checkpoints {
    pub every_env_steps: u64,
    pub keep: usize,
    pub keep_best: KeepBest,
    pub last_retry_ms: u64,
    pub rescue_dir: String,
}

/// `[actors]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Actors {
    pub count: usize,
    pub count_max: usize,
    pub remote: usize,
    pub episodes_at_once: usize,
    pub heartbeat_timeout_ms: u64,
}

/// `[learner]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Learner {
    pub listen: String,
    pub token_file: String,
    pub tls: Tls,
    pub shards: usize,
    pub threads: usize,
    pub metrics_every_env_steps: u64,
    pub stall_timeout_ms: u64,
}

/// `[learner.tls]`. An empty path is none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Tls {
    pub certificate: String,
    pub key: String,
    pub client_ca: String,
}

/// `[starcraft]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct StarCraft {
    pub map: String,
    pub base_build: u32,
    pub data_version: String,
    pub custom_types: u32,
    pub timeout_ms: u64,
}

/// `[web]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs, reason = "presets/all.toml documents every key, for users too")]
pub struct Web {
    pub listen: WebListen,
}

impl Config {
    /// The keys that weights follow from, with their values.
    ///
    /// # Errors
    /// When TOML cannot say it.
    pub fn result_settings(&self) -> Result<BTreeMap<String, String>, ConfigError> {
        let mut settings = self.settings()?;
        settings.retain(|key, _| !is_free(key));
        Ok(settings)
    }

    /// Every `section.key` that the method has with its value, texts without quotation marks.
    ///
    /// # Errors
    /// When TOML cannot say it.
    pub fn settings(&self) -> Result<BTreeMap<String, String>, ConfigError> {
        crate::resolve::settings(self)
    }

    /// The text that [`resolve`](crate::resolve) makes the same configuration of.
    ///
    /// # Errors
    /// When TOML cannot say it.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(&self.to_table()?).map_err(|error| ConfigError::Value(error.to_string()))
    }

    /// Every key that the method has.
    pub(crate) fn to_table(&self) -> Result<Table, ConfigError> {
        let mut table = Table::try_from(self).map_err(|error| ConfigError::Value(error.to_string()))?;
        method_keys::retain(&mut table, self.algorithm.name);
        foreign::retain(&mut table, self);
        if self.environment.backend == Backend::Embedded {
            table.remove("starcraft");
        }
        Ok(table)
    }

    /// The model's method and sizes.
    pub fn model(&self) -> ModelConfig {
        let (dims, network) = (self.dims(), &self.network);
        let method = self.algorithm.name;
        let own = method.facts().encoder;
        ModelConfig {
            method,
            encoder: match self.algorithm.encoder {
                EncoderName::Beside if own == Encoder::Within => Encoder::Beside,
                _ => own,
            },
            entity_dim: dims.entity_dim,
            n_actions: dims.n_actions,
            agents_max: dims.agents_max,
            entities_max: dims.entities_max,
            hidden_dim: network.hidden_dim,
            attention_dim: network.attention_dim,
            n_heads: network.n_heads,
            n_blocks: network.n_blocks,
            task_representation_dim: network.task_representation_dim,
            reward_embed_dim: network.reward_embed_dim,
            mixing_embed_dim: network.mixing_embed_dim,
            hypernet_embed_dim: network.hypernet_embed_dim,
            feedforward_dim: network.feedforward_dim,
            imagined_weight: self.algorithm.imagined_weight,
            role: RoleConfig {
                dim: network.role_dim,
                hidden_dim: network.role_hidden_dim,
                variance_floor: network.role_variance_floor,
                entropy_weight: self.algorithm.role_entropy_weight,
                kl_weight: self.algorithm.role_kl_weight,
                dissimilarity_weight: self.algorithm.role_dissimilarity_weight,
                soft_constraint: self.algorithm.role_soft_constraint,
            },
        }
    }

    /// The update's constants.
    pub fn update(&self) -> UpdateConfig {
        let algorithm = &self.algorithm;
        UpdateConfig {
            gamma: algorithm.gamma,
            reward_scale: algorithm.reward_scale,
            lr: algorithm.lr,
            optimizer: match algorithm.optimizer {
                OptimizerName::RmsProp => {
                    OptimizerKind::RmsProp { alpha: algorithm.rmsprop_alpha, eps: algorithm.optimizer_eps }
                }
                OptimizerName::Adam => {
                    OptimizerKind::Adam { beta1: 0.9, beta2: 0.999, eps: algorithm.optimizer_eps }
                }
            },
            grad_norm_clip: algorithm.grad_norm_clip,
            shards: self.learner.shards,
            threads: self.learner.threads,
            terminal_states: TerminalStates::LeftOut,
            ppo: PpoConfig {
                gae_lambda: algorithm.gae_lambda,
                clip: algorithm.clip,
                entropy_coef: algorithm.entropy_coef,
                value_coef: algorithm.value_coef,
                huber_delta: algorithm.huber_delta,
                epochs: algorithm.epochs,
                minibatches: algorithm.minibatches,
                value_norm_beta: algorithm.value_norm_beta,
            },
        }
    }

    /// The tasks of one split: the configuration's own list, or else the task set's. A task's index is its place among
    /// the training tasks.
    pub fn tasks(&self, split: Split) -> Vec<Task> {
        let Environment { task_set, training_tasks, testing_tasks, .. } = &self.environment;
        let names = match split {
            Split::Training => training_tasks,
            Split::Testing => testing_tasks,
        };
        if names.is_empty() {
            return task_set.tasks(split);
        }
        // `resolve` has refused names that are none.
        names.iter().filter_map(|name| task_set.task(name).ok()).collect()
    }

    /// The padded sizes over all tasks, testing tasks included (paper, appendix A).
    pub fn dims(&self) -> Dims {
        TaskSet::dims_of([Split::Training, Split::Testing].into_iter().flat_map(|split| self.tasks(split)))
    }

    /// How the environments differ from what their task says.
    pub fn environment_options(&self) -> EnvironmentOptions {
        let Environment {
            view_radius, approach_shaping, physics, spawn_rotate, stats, enemy_medivac, ..
        } = self.environment;
        EnvironmentOptions {
            view_radius: view_radius.is_finite().then_some(view_radius),
            approach_shaping,
            physics,
            combat: CombatOptions {
                spawn_rotate: spawn_rotate.rotates(),
                stats,
                enemy_medivac,
                mirror: false,
            },
        }
    }

    /// Episodes that replay holds; 0 where the method learns from each batch once.
    pub fn replay_episodes(&self) -> usize {
        match self.algorithm.name.facts().regime {
            Regime::Replay => self.algorithm.buffer_size,
            Regime::OnPolicy => 0,
        }
    }

    /// ε after so many collected environment steps; 0 where the method samples its actions.
    pub fn epsilon(&self, env_steps: u64) -> f32 {
        if self.algorithm.name.facts().regime == Regime::OnPolicy {
            return 0.0;
        }
        let Algorithm { epsilon_start, epsilon_finish, epsilon_anneal_steps, .. } = self.algorithm;
        let progress = (env_steps as f64 / epsilon_anneal_steps.max(1) as f64).min(1.0);
        (epsilon_start + (epsilon_finish - epsilon_start) * progress) as f32
    }
}
