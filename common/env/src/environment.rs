//! What one task's world does.

use rit_episode::{Action, End, Observation, Rng};

/// What one joint action led to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Team reward.
    pub reward: f32,
    /// Set on the last step of the episode.
    pub end: Option<End>,
    /// Whether the team has won; only meaningful where the task knows winning.
    pub won: bool,
}

/// One task's world: real agents and entities only, agents in an order of its own.
///
/// An environment draws randomness from the stream it is given and from nowhere else, and
/// [`crate::conformance::check`] holds for it.
pub trait Environment: Send {
    /// Number of agents, constant.
    fn n_agents(&self) -> usize;

    /// Number of entities, agents included, constant.
    fn n_entities(&self) -> usize;

    /// Features of one entity, without the last action, which [`crate::Seated`] adds.
    fn feature_dim(&self) -> usize;

    /// Size of the action space.
    fn n_actions(&self) -> usize;

    /// Most steps of an episode.
    fn steps_max(&self) -> usize;

    /// Begins an episode.
    fn reset(&mut self, rng: &mut Rng);

    /// Writes the state: features into the first `feature_dim` columns of each entity's row (agents first),
    /// and all of `observable` and `available`, which arrive as zeros.
    fn observe(&self, observation: &mut Observation);

    /// Takes one joint action, `[n_agents]`, each available.
    fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Step;
}
