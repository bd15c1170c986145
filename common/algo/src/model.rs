//! Which networks a method has: the one place that tells all methods apart. And these networks, under training and
//! acting.

use crate::{
    ConfigError, Learner, Mappo, MappoConfig, Mat, MatConfig, Method, ModelConfig, UpdateConfig,
    drive::ByUtilities,
    flat::Slots,
    methods::{Recurrent, Refil, Roma, Updet},
    networks::{Actor, EpisodeValues, Networks},
    on_policy::ByPolicy,
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Action, Episode, Policy, Rng, Turn};
use rit_nn::Layout;
use std::{ops::Range, sync::Arc};

/// The networks of a method, of one set of sizes.
#[derive(Clone, Debug)]
pub struct Model {
    config: ModelConfig,
    networks: Arc<dyn Networks>,
}

impl Model {
    /// Declares the model.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn new(config: ModelConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let ModelConfig { entity_dim, n_actions, agents_max, entities_max, hidden_dim, .. } = config;
        let slots = Slots { agents_max, entities_max, entity_dim };
        let networks: Arc<dyn Networks> = match config.method {
            Method::Rit
            | Method::RitVdn
            | Method::RitNoTaskRepresentations
            | Method::QmixAttn
            | Method::VdnAttn
            | Method::QmixInt
            | Method::VdnInt => Arc::new(ByUtilities::new(Recurrent::new(&config))),
            Method::UpdetMix | Method::UpdetVdn => Arc::new(ByUtilities::new(Updet::new(&config))),
            Method::Refil => Arc::new(ByUtilities::new(Refil::new(&config))),
            Method::Roma => Arc::new(ByUtilities::new(Roma::new(&config))),
            Method::Mappo => {
                Arc::new(ByPolicy::new(Mappo::new(MappoConfig { slots, n_actions, hidden_dim })))
            }
            Method::Mat => {
                let ModelConfig { hidden_dim: embed_dim, n_heads, n_blocks, .. } = config;
                let sizes = MatConfig { slots, n_actions, embed_dim, n_heads, n_blocks };
                Arc::new(ByPolicy::new(Mat::new(sizes)))
            }
        };
        Ok(Self { config, networks })
    }

    /// What it was made from.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Its method.
    pub fn method(&self) -> Method {
        self.config.method
    }

    /// Names and shapes of all parameters.
    pub fn layout(&self) -> &Layout {
        self.networks.layout()
    }

    /// The parameters that acting needs.
    pub fn acting(&self) -> Range<usize> {
        self.networks.acting()
    }

    /// Initial parameters.
    pub fn initial(&self, rng: &mut Rng) -> Vec<f32> {
        self.layout().initial(rng)
    }

    /// A learner that goes on from these parameters.
    ///
    /// # Errors
    /// When the update's threads cannot be started.
    ///
    /// # Panics
    /// When `params` is not of the layout's length.
    pub fn learner(
        &self,
        update: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Box<dyn Learner>, ThreadPoolBuildError> {
        self.networks.learner(update, params)
    }

    /// Values the joint actions `[T, n]`, each in the episode's state at that step. The agents' memories are those of the
    /// actions that were really taken. Returns `None` for methods without utilities, and for REFIL and ROMA.
    ///
    /// # Panics
    /// When `params` or `actions` are not as many as there are parameters or actions taken.
    pub fn value(&self, params: &[f32], episode: &Episode, actions: &[Action]) -> Option<EpisodeValues> {
        assert_eq!(actions.len(), episode.actions.len(), "an action for each agent and step");
        self.networks.value(params, episode, actions)
    }
}

/// A method's networks choosing joint actions, for several running episodes at once.
pub struct Acting(Box<dyn Actor>);

impl Acting {
    /// Acts with these acting parameters (see [`Model::acting`]).
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn new(model: &Model, params: &[f32]) -> Self {
        Self(model.networks.actor(params))
    }

    /// The utilities of the last step, turn after turn, agents in decision order, `[agent rows, A]`: each agent's Q given
    /// the actions chosen before its own; logits where the method has a policy network. Unavailable actions have theirs
    /// too.
    pub fn utilities(&self) -> &[f32] {
        self.0.utilities()
    }

    /// The task representations z of the last step, turn after turn, agents in decision order, `[agent rows, h_z]`;
    /// nothing where the method has none.
    pub fn task_representations(&self) -> &[f32] {
        self.0.task_representations()
    }

    /// Takes other weights. Between episodes only: a running one would go on with histories of the old.
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn set_params(&mut self, params: &[f32]) {
        self.0.set_params(params);
    }
}

impl Policy for Acting {
    fn begin(&mut self, slot: usize, n_agents: usize) {
        self.0.begin(slot, n_agents);
    }

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        self.0.act(turns);
    }
}
