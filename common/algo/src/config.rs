//! A model's configuration: its method, and every size that a method may ask for.

use crate::{
    Method, TerminalStates,
    method::{Encoder, Mixing},
};
use rit_nn::OptimizerKind;

/// What a [`Model`](crate::Model) is made from. A method takes the sizes that it has a use for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelConfig {
    /// The algorithm.
    pub method: Method,
    /// Its encoder: the method's own, or [`Encoder::Beside`] in place of [`Encoder::Within`].
    pub encoder: Encoder,
    /// d.
    pub entity_dim: usize,
    /// A.
    pub n_actions: usize,
    /// h.
    pub hidden_dim: usize,
    /// a: all heads together.
    pub attention_dim: usize,
    /// Heads of every attention.
    pub n_heads: usize,
    /// h_z.
    pub task_representation_dim: usize,
    /// r.
    pub reward_embed_dim: usize,
    /// Size of the mixing layers.
    pub mixing_embed_dim: usize,
    /// Hidden size of the hyper-networks.
    pub hypernet_embed_dim: usize,
}

/// A model that cannot be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ConfigError {
    /// A size of zero.
    #[error("{name} is 0; it must be at least 1")]
    Zero {
        /// Its name.
        name: &'static str,
    },
    /// Heads that do not split the attention evenly.
    #[error("attention_dim {attention_dim} is not a multiple of n_heads {n_heads}")]
    Heads {
        /// a.
        attention_dim: usize,
        /// Heads.
        n_heads: usize,
    },
    /// A method that is known and not there yet.
    #[error("the algorithm {method} is not built yet; these are: {}", built())]
    NotBuilt {
        /// It.
        method: Method,
    },
}

fn built() -> String {
    let built = Method::ALL.map(Method::facts).into_iter().filter(|facts| facts.built);
    built.map(|facts| facts.name).collect::<Vec<_>>().join(", ")
}

impl ModelConfig {
    /// Checks that there is such a model.
    ///
    /// # Errors
    /// The first thing that no model can have.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let facts = self.method.facts();
        if !facts.built {
            return Err(ConfigError::NotBuilt { method: self.method });
        }
        let mut sizes = vec![
            ("entity_dim", self.entity_dim),
            ("n_actions", self.n_actions),
            ("hidden_dim", self.hidden_dim),
            ("attention_dim", self.attention_dim),
            ("n_heads", self.n_heads),
        ];
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
        if let Some((name, _)) = sizes.into_iter().find(|(_, size)| *size == 0) {
            return Err(ConfigError::Zero { name });
        }
        if !self.attention_dim.is_multiple_of(self.n_heads) {
            return Err(ConfigError::Heads { attention_dim: self.attention_dim, n_heads: self.n_heads });
        }
        Ok(())
    }
}

/// Constants of the update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UpdateConfig {
    /// γ.
    pub gamma: f32,
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
}
