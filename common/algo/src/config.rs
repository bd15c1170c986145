//! A model's configuration: its method, and every size that a method may ask for.

use crate::{
    Method, TerminalStates,
    method::{Encoder, Mixing},
};
use rit_nn::OptimizerKind;

/// What a [`Model`](crate::Model) is made from. A method takes the sizes that it has a use for.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelConfig {
    /// The algorithm.
    pub method: Method,
    /// Its encoder: the method's own, or [`Encoder::Beside`] in place of [`Encoder::Within`].
    pub encoder: Encoder,
    /// d.
    pub entity_dim: usize,
    /// A.
    pub n_actions: usize,
    /// n, over training and testing tasks: slots of inputs of fixed length.
    pub agents_max: usize,
    /// m, likewise.
    pub entities_max: usize,
    /// h; MAT's e.
    pub hidden_dim: usize,
    /// a: all heads together. MAT's are as wide as h.
    pub attention_dim: usize,
    /// Heads of every attention.
    pub n_heads: usize,
    /// Blocks of MAT's encoder, and of its decoder.
    pub n_blocks: usize,
    /// h_z.
    pub task_representation_dim: usize,
    /// r.
    pub reward_embed_dim: usize,
    /// Size of the mixing layers.
    pub mixing_embed_dim: usize,
    /// Hidden size of the hyper-networks.
    pub hypernet_embed_dim: usize,
    /// f: hidden size of UPDeT's feed-forward layers.
    pub feedforward_dim: usize,
    /// λ: what REFIL's imagined loss counts, out of 1.
    pub imagined_weight: f32,
    /// ROMA's roles.
    pub role: RoleConfig,
}

/// Sizes and losses of ROMA's roles. The default is the supplement's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoleConfig {
    /// l: numbers in a role.
    pub dim: usize,
    /// r: hidden size of the role encoder and of the hyper-networks that roles feed.
    pub hidden_dim: usize,
    /// No variance of a role is less.
    pub variance_floor: f32,
    /// w_H.
    pub entropy_weight: f32,
    /// w_KL.
    pub kl_weight: f32,
    /// w_D.
    pub dissimilarity_weight: f32,
    /// κ.
    pub soft_constraint: f32,
}

impl Default for RoleConfig {
    fn default() -> Self {
        Self {
            dim: 3,
            hidden_dim: 16,
            variance_floor: 0.002,
            entropy_weight: 1e-4,
            kl_weight: 1e-4,
            dissimilarity_weight: 1e-3,
            soft_constraint: 1.0,
        }
    }
}

/// Why there is no model of these sizes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ConfigError {
    /// A size of zero.
    #[error("{} is 0; it must be at least 1", shown(name))]
    Zero {
        /// Its name.
        name: &'static str,
    },
    /// Heads that do not split the attention evenly.
    #[error("network.{name} = {size} is not a multiple of network.n_heads = {n_heads}")]
    Heads {
        /// What they split: its name.
        name: &'static str,
        /// The size.
        size: usize,
        /// Heads.
        n_heads: usize,
    },
}

/// A size as people set it: those that follow from the tasks have no key.
fn shown(name: &str) -> String {
    let of_tasks = ["entity_dim", "n_actions", "agents_max", "entities_max"];
    if of_tasks.contains(&name) { name.to_owned() } else { format!("network.{name}") }
}

impl ModelConfig {
    /// A model of this method and these sizes, by name, the others 0; what its losses alone have is the default. What
    /// is missing, [`Self::validate`] tells.
    pub fn of_sizes(method: Method, encoder: Encoder, size: impl Fn(&str) -> usize) -> Self {
        Self {
            method,
            encoder,
            entity_dim: size("entity_dim"),
            n_actions: size("n_actions"),
            agents_max: size("agents_max"),
            entities_max: size("entities_max"),
            hidden_dim: size("hidden_dim"),
            attention_dim: size("attention_dim"),
            n_heads: size("n_heads"),
            n_blocks: size("n_blocks"),
            task_representation_dim: size("task_representation_dim"),
            reward_embed_dim: size("reward_embed_dim"),
            mixing_embed_dim: size("mixing_embed_dim"),
            hypernet_embed_dim: size("hypernet_embed_dim"),
            feedforward_dim: size("feedforward_dim"),
            imagined_weight: 0.5,
            role: RoleConfig {
                dim: size("role_dim"),
                hidden_dim: size("role_hidden_dim"),
                ..RoleConfig::default()
            },
        }
    }

    /// The sizes that its method has a use for, by name.
    pub fn sizes(&self) -> Vec<(&'static str, usize)> {
        let facts = self.method.facts();
        let mut sizes = vec![
            ("entity_dim", self.entity_dim),
            ("n_actions", self.n_actions),
            ("hidden_dim", self.hidden_dim),
        ];
        // MAPPO attends to nothing.
        if self.method != Method::Mappo {
            sizes.push(("n_heads", self.n_heads));
        }
        match facts.encoder {
            Encoder::Flat => {
                sizes.extend([("agents_max", self.agents_max), ("entities_max", self.entities_max)]);
            }
            Encoder::Beside | Encoder::Within | Encoder::Tokens => {
                sizes.push(("attention_dim", self.attention_dim));
            }
        }
        if self.method == Method::Mat {
            sizes.push(("n_blocks", self.n_blocks));
        }
        if facts.task_representations {
            sizes.extend([
                ("task_representation_dim", self.task_representation_dim),
                ("reward_embed_dim", self.reward_embed_dim),
            ]);
        }
        if facts.mixing == Some(Mixing::Network) {
            sizes.extend([
                ("mixing_embed_dim", self.mixing_embed_dim),
                ("hypernet_embed_dim", self.hypernet_embed_dim),
            ]);
        }
        if facts.encoder == Encoder::Tokens {
            sizes.push(("feedforward_dim", self.feedforward_dim));
        }
        if self.method == Method::Roma {
            sizes.extend([("role_dim", self.role.dim), ("role_hidden_dim", self.role.hidden_dim)]);
        }
        sizes
    }

    /// Checks that there is such a model.
    ///
    /// # Errors
    /// The first thing that no model can have.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some((name, _)) = self.sizes().into_iter().find(|(_, size)| *size == 0) {
            return Err(ConfigError::Zero { name });
        }
        let (name, size) = match self.method.facts().encoder {
            Encoder::Flat => ("hidden_dim", self.hidden_dim),
            _ => ("attention_dim", self.attention_dim),
        };
        if self.method != Method::Mappo && !size.is_multiple_of(self.n_heads) {
            return Err(ConfigError::Heads { name, size, n_heads: self.n_heads });
        }
        Ok(())
    }
}

/// Constants of the update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateConfig {
    /// γ.
    pub gamma: f32,
    /// What rewards are multiplied by in TD targets. What networks read of rewards stays as it is.
    pub reward_scale: f32,
    /// Learning rate.
    pub lr: f32,
    /// Which optimiser.
    pub optimizer: OptimizerKind,
    /// Gradients are scaled down to this norm.
    pub grad_norm_clip: f64,
    /// Parts the batch is cut into; at least 1. Part of the result.
    pub shards: usize,
    /// Threads that work on them; at least 1. Not part of the result.
    pub threads: usize,
    /// Whether states that no target needs are worked on. Not part of the result.
    pub terminal_states: TerminalStates,
    /// Those of on-policy methods alone.
    pub ppo: PpoConfig,
}

/// Constants of proximal policy optimisation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PpoConfig {
    /// λ of the advantages.
    pub gae_lambda: f64,
    /// c: how far a probability ratio, or a value, may go.
    pub clip: f64,
    /// Weight of the entropy.
    pub entropy_coef: f64,
    /// Weight of the value loss.
    pub value_coef: f64,
    /// Where the value loss becomes linear.
    pub huber_delta: f64,
    /// Passes over a batch; at least 1.
    pub epochs: usize,
    /// Parts of a batch, an optimiser step each; at least 1.
    pub minibatches: usize,
    /// How much of the value normaliser's old averages stays after a batch.
    pub value_norm_beta: f64,
}

impl Default for PpoConfig {
    /// MAPPO's, of its published scripts.
    fn default() -> Self {
        Self {
            gae_lambda: 0.95,
            clip: 0.2,
            entropy_coef: 0.01,
            value_coef: 1.0,
            huber_delta: 10.0,
            epochs: 10,
            minibatches: 1,
            value_norm_beta: 0.9999,
        }
    }
}
