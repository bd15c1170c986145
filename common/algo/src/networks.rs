//! A method's networks as the rest of the service knows them, whatever their objective.

use crate::{Learner, UpdateConfig};
use rayon::ThreadPoolBuildError;
use rit_episode::{Action, Episode, Policy};
use rit_nn::Layout;
use std::{fmt::Debug, ops::Range};

/// The networks of a method. [`ByUtilities`](crate::drive::ByUtilities) and [`ByPolicy`](crate::on_policy::ByPolicy) are
/// the two kinds: each makes all of this of what its objective asks of a method.
pub(crate) trait Networks: Debug + Send + Sync {
    /// Names and shapes of all parameters.
    fn layout(&self) -> &Layout;

    /// The parameters that acting needs.
    fn acting(&self) -> Range<usize>;

    /// A learner that goes on from these parameters.
    ///
    /// # Errors
    /// When the update's threads cannot be started.
    ///
    /// # Panics
    /// When `params` is not of the layout's length.
    fn learner(
        &self,
        update: UpdateConfig,
        params: Vec<f32>,
    ) -> Result<Box<dyn Learner>, ThreadPoolBuildError>;

    /// The networks choosing joint actions with these acting parameters.
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    fn actor(&self, params: &[f32]) -> Box<dyn Actor>;

    /// Values joint actions, see [`Model::value`](crate::Model::value).
    fn value(&self, params: &[f32], episode: &Episode, actions: &[Action]) -> Option<EpisodeValues>;
}

/// Networks choosing joint actions, for several running episodes at once.
pub trait Actor: Policy {
    /// Utilities, or logits, of the last step, turn after turn, agents in decision order, `[agent rows, A]`.
    fn utilities(&self) -> &[f32];

    /// z of the last step, `[agent rows, h_z]`; nothing without task representations.
    fn task_representations(&self) -> &[f32] {
        &[]
    }

    /// Takes other acting parameters. Between episodes only: a running one would go on with histories of the old.
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    fn set_params(&mut self, params: &[f32]);
}

/// Values of an episode of n agents and T steps, agents in decision order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EpisodeValues {
    /// z, `[T, n, h_z]`; empty where a method has none.
    pub representations: Vec<f32>,
    /// Each agent's utility of its action, given those before it, `[T, n]`.
    pub utilities: Vec<f32>,
    /// Q_total of each joint action, `[T]`.
    pub q_total: Vec<f32>,
}
