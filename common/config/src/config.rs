//! The resolved configuration: complete, and within its limits. `presets/all.toml` says what each key means.

use crate::{
    ConfigError, foreign,
    keys::quoted,
    method_keys::{self, by_name},
    number,
    resolve::is_free,
};
use rit_algo::{
    Method, ModelConfig, PpoConfig, Regime, RoleConfig, TerminalStates, UpdateConfig, method::Encoder,
};
use rit_env::{
    EnvironmentOptions, Split, Task, TaskSet,
    combat::{CombatOptions, StatsVersion, world::ScriptedMedivac},
};
use rit_episode::{Dims, RunSeed};
use rit_nn::OptimizerKind;
use serde::{Deserialize, Serialize};
use std::{collections::BTreeMap, net::SocketAddr};
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
    pub spawn_rotate: SpawnRotate,
    pub stats: StatsVersion,
    pub enemy_medivac: ScriptedMedivac,
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

/// Where environments play.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// In the processes of the run.
    Embedded,
    /// In games of StarCraft II, which actors start and speak to.
    Starcraft,
}

/// Whether armies face each other at a random angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SpawnRotate {
    /// As the authors' code does it for the task set.
    Published,
    /// Always.
    Always,
    /// Never.
    Never,
}

impl SpawnRotate {
    /// Whether they do; as the task set has it where `None`.
    pub fn rotates(self) -> Option<bool> {
        match self {
            Self::Published => None,
            Self::Always => Some(true),
            Self::Never => Some(false),
        }
    }
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
    pub time_limit_bootstraps: bool,
}

/// Which encoder, where there is a choice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EncoderName {
    /// An agent is one of the entities it attends to.
    Within,
    /// Its own features stand beside what it attends to.
    Beside,
}

/// Which optimiser.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerName {
    /// RMSprop.
    RmsProp,
    /// Adam.
    Adam,
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

/// What ends a run before T_max: every training task of an evaluation has reached it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Until {
    /// Nothing does.
    Never,
    /// A share of episodes won.
    WinRate(f64),
    /// A mean return.
    MeanReturn(f64),
}

impl TryFrom<String> for Until {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let error = || {
            let text = quoted(&text);
            format!(
                "training.until = {text}; write win_rate=NUMBER or mean_return=NUMBER; a win rate lies in 0..=1"
            )
        };
        if text.is_empty() {
            return Ok(Self::Never);
        }
        let (metric, value) = text.split_once('=').ok_or_else(error)?;
        let value: f64 = value.trim().parse().map_err(|_| error())?;
        match metric.trim() {
            "win_rate" if (0.0..=1.0).contains(&value) => Ok(Self::WinRate(value)),
            "mean_return" if value.is_finite() => Ok(Self::MeanReturn(value)),
            _ => Err(error()),
        }
    }
}

impl From<Until> for String {
    fn from(until: Until) -> Self {
        match until {
            Until::Never => Self::new(),
            Until::WinRate(value) => format!("win_rate={value}"),
            Until::MeanReturn(value) => format!("mean_return={value}"),
        }
    }
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

/// The measure that the best policy is kept by: a mean over the training tasks of a scheduled evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum KeepBest {
    /// None is kept.
    Never,
    /// Mean return.
    MeanReturn,
    /// Share of episodes won.
    WinRate,
}

impl KeepBest {
    /// The measure as it is typed; empty where none is kept.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Never => "",
            Self::MeanReturn => "mean_return",
            Self::WinRate => "win_rate",
        }
    }
}

impl TryFrom<String> for KeepBest {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let known = [Self::Never, Self::MeanReturn, Self::WinRate];
        known.into_iter().find(|it| it.name() == text).ok_or_else(|| {
            let text = quoted(&text);
            format!("checkpoints.keep_best = {text}; write mean_return, win_rate, or nothing between quotation marks")
        })
    }
}

impl From<KeepBest> for String {
    fn from(keep_best: KeepBest) -> Self {
        keep_best.name().to_owned()
    }
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

/// Where the learner's web page is served. It speaks plain HTTP, so only this machine gets to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum WebListen {
    /// Nowhere.
    Off,
    /// On this loopback address; with port 0 the system chooses one.
    On(SocketAddr),
}

impl TryFrom<String> for WebListen {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        if text == "off" {
            return Ok(Self::Off);
        }
        match text.parse::<SocketAddr>() {
            Ok(address) if address.ip().is_loopback() => Ok(Self::On(address)),
            Ok(address) => Err(format!(
                "web.listen = {text:?}: the page is served to this machine only; write \"127.0.0.1:{port}\", and \
                 reach it from another machine with ssh -L {port}:127.0.0.1:{port} THIS-MACHINE",
                port = address.port()
            )),
            Err(_) => Err(format!("web.listen = {}; write \"127.0.0.1:PORT\" or \"off\"", quoted(&text))),
        }
    }
}

impl From<WebListen> for String {
    fn from(listen: WebListen) -> Self {
        match listen {
            WebListen::Off => "off".into(),
            WebListen::On(address) => address.to_string(),
        }
    }
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
        let Environment { view_radius, approach_shaping, spawn_rotate, stats, enemy_medivac, .. } =
            self.environment;
        EnvironmentOptions {
            view_radius: view_radius.is_finite().then_some(view_radius),
            approach_shaping,
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

    /// Every number's name, value, smallest and largest.
    pub(crate) fn limits(&self) -> Vec<(&'static str, Number, f64, f64)> {
        let (algorithm, network, evaluation) = (&self.algorithm, &self.network, &self.evaluation);
        // Beyond what anybody runs; they keep a slip of the keyboard from taking all memory.
        const COUNT: f64 = 1e6;
        const STEPS: f64 = 1e12;
        const SIZE: f64 = 4096.0;
        vec![
            ("environment.view_radius", self.environment.view_radius.into(), 0.0, f64::INFINITY),
            ("environment.approach_shaping", self.environment.approach_shaping.into(), 0.0, 1e3),
            (
                "environment.environments_per_worker",
                self.environment.environments_per_worker.into(),
                1.0,
                1024.0,
            ),
            ("environment.timeout_ms", self.environment.timeout_ms.into(), 1.0, 1e9),
            ("environment.worker_memory_mb", self.environment.worker_memory_mb.into(), 0.0, 1e9),
            ("algorithm.gamma", algorithm.gamma.into(), 0.0, 1.0),
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
            ("algorithm.value_norm_beta", algorithm.value_norm_beta.into(), 0.0, 1.0),
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
