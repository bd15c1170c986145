//! What one task's world does.

use rit_episode::{Action, End, Observation, Rng};
use serde::{Deserialize, Serialize};

/// What one joint action led to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Team reward.
    pub reward: f32,
    /// What training adds to it by [`EnvironmentOptions`]; no return counts it. 0 for most.
    pub shaping: f32,
    /// Set on the last step of the episode.
    pub end: Option<End>,
    /// Whether the team has won; only meaningful where the task knows winning.
    pub won: bool,
}

/// How the environments of a run differ from what their task says. The default changes nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvironmentOptions {
    /// How far an agent sees in a particle world, from centre to centre; everything where `None`.
    pub view_radius: Option<f32>,
    /// Predator and prey: [`Step::shaping`] is this · what a step takes off Σ_predators distance to the nearest
    /// prey.
    pub approach_shaping: f32,
}

/// What a body is to the agents.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum BodyKind {
    /// An agent; a predator.
    Agent,
    /// A landmark; an obstacle.
    Landmark,
    /// A prey.
    Prey,
}

/// One body of a [`Scene`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneBody {
    /// What it is.
    pub kind: BodyKind,
    /// Place of its centre.
    pub x: f32,
    /// Place of its centre.
    pub y: f32,
    /// Its size.
    pub radius: f32,
}

/// What can be drawn of a state: every entity, in the environment's order.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The entities.
    pub bodies: Vec<SceneBody>,
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

    /// What can be drawn of the state, where the entities have places.
    fn scene(&self) -> Option<Scene> {
        None
    }
}
