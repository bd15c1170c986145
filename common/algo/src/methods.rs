//! The methods, each in a file of its own, and the one place that tells them apart.

pub mod mappo;
pub mod mat;
mod recurrent;
pub mod refil;
pub mod roma;
mod updet;

pub use recurrent::Recurrent;
pub use refil::Refil;
pub use roma::Roma;
pub use updet::Updet;

use crate::{
    Learner, Model, UpdateConfig,
    drive::{TdLearner, ValueActing},
    methods::{mappo::MappoActing, mat::MatActing},
    model::Network,
    on_policy::PpoLearner,
};
use rayon::ThreadPoolBuildError;
use rit_episode::{Policy, Turn};
use std::sync::Arc;

/// A method's learner that goes on from these parameters.
///
/// # Errors
/// When the update's threads cannot be started.
///
/// # Panics
/// When `params` is not of the layout's length.
pub fn learner(
    model: Arc<Model>,
    update: UpdateConfig,
    params: Vec<f32>,
) -> Result<Box<dyn Learner>, ThreadPoolBuildError> {
    Ok(match model.network.clone() {
        Network::Recurrent(network) => Box::new(TdLearner::new(model, network, update, params)?),
        Network::Mappo(network) => Box::new(PpoLearner::new(model, network, update, params)?),
        Network::Mat(network) => Box::new(PpoLearner::new(model, network, update, params)?),
        Network::Updet(network) => Box::new(TdLearner::new(model, network, update, params)?),
        Network::Refil(network) => Box::new(TdLearner::new(model, network, update, params)?),
        Network::Roma(network) => Box::new(TdLearner::new(model, network, update, params)?),
    })
}

/// A method's networks choosing joint actions, for several running episodes at once.
pub struct Acting(Box<dyn Actor>);

/// What a method's acting networks must do.
pub(crate) trait Actor: Policy {
    /// Utilities, or logits, of the last step.
    fn utilities(&self) -> &[f32];

    /// z of the last step; nothing without task representations.
    fn task_representations(&self) -> &[f32] {
        &[]
    }

    /// Takes other acting parameters. Between episodes only: a running one would go on with histories of the old.
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    fn set_params(&mut self, params: &[f32]);
}

impl Acting {
    /// Acts with these acting parameters (see [`Model::acting`]).
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn new(model: &Model, params: &[f32]) -> Self {
        Self(match model.network.clone() {
            Network::Recurrent(network) => Box::new(ValueActing::new(network, params)),
            Network::Mappo(network) => Box::new(MappoActing::new(network, params)),
            Network::Mat(network) => Box::new(MatActing::new(network, params)),
            Network::Updet(network) => Box::new(ValueActing::new(network, params)),
            Network::Refil(network) => Box::new(ValueActing::new(network, params)),
            Network::Roma(network) => Box::new(ValueActing::new(network, params)),
        })
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
