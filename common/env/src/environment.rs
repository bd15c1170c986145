//! What one task's world does.

use crate::combat::CombatOptions;
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

/// What a task is, as data: known without building its world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Spec {
    /// Number of agents, constant.
    pub n_agents: usize,
    /// Number of entities, agents included, constant.
    pub n_entities: usize,
    /// Features of one entity, without the last action, which [`crate::Seated`] adds.
    pub feature_dim: usize,
    /// Size of the action space.
    pub n_actions: usize,
    /// Most steps of an episode.
    pub steps_max: usize,
    /// Whether the task knows winning.
    pub has_wins: bool,
    /// Whether its states can be drawn: see [`Environment::scene`].
    pub has_scenes: bool,
    /// Whether the same random stream and actions give the same episode.
    pub is_reproducible: bool,
}

/// Sizes that make no task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{n_agents} agents, {n_entities} entities (agents included), {feature_dim} features, {n_actions} actions and \
     {steps_max} steps make no task; it needs at least one agent, as many entities as agents, a feature, an action and \
     a step"
)]
pub struct SpecError {
    /// Number of agents.
    pub n_agents: usize,
    /// Number of entities, agents included.
    pub n_entities: usize,
    /// Features of one entity.
    pub feature_dim: usize,
    /// Size of the action space.
    pub n_actions: usize,
    /// Most steps of an episode.
    pub steps_max: usize,
}

impl Spec {
    /// Features of one entity with its last action: d.
    pub fn entity_dim(&self) -> usize {
        self.feature_dim + self.n_actions
    }

    /// Checks that there is something to decide, and a step to decide it in. Every task that comes from outside is held
    /// to this.
    ///
    /// # Errors
    /// When no task has such sizes.
    pub fn check(&self) -> Result<(), SpecError> {
        let Self { n_agents, n_entities, feature_dim, n_actions, steps_max, .. } = *self;
        if n_agents == 0 || n_entities < n_agents || feature_dim == 0 || n_actions == 0 || steps_max == 0 {
            return Err(SpecError { n_agents, n_entities, feature_dim, n_actions, steps_max });
        }
        Ok(())
    }

    /// The first fact in which two tasks differ: its name, what it is here, and what it is there.
    pub(crate) fn first_difference(&self, other: &Self) -> Option<(&'static str, String, String)> {
        let differing = self.facts().into_iter().zip(other.facts()).find(|(here, there)| here != there);
        differing.map(|((name, here), (_, there))| (name, here, there))
    }

    fn facts(&self) -> [(&'static str, String); 8] {
        let Self {
            n_agents,
            n_entities,
            feature_dim,
            n_actions,
            steps_max,
            has_wins,
            has_scenes,
            is_reproducible,
        } = self;
        [
            ("n_agents", n_agents.to_string()),
            ("n_entities", n_entities.to_string()),
            ("feature_dim", feature_dim.to_string()),
            ("n_actions", n_actions.to_string()),
            ("steps_max", steps_max.to_string()),
            ("has_wins", has_wins.to_string()),
            ("has_scenes", has_scenes.to_string()),
            ("is_reproducible", is_reproducible.to_string()),
        ]
    }
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
    /// Cooperative navigation: whose world it is.
    pub physics: Physics,
    /// Of combat.
    pub combat: CombatOptions,
}

/// Which release of the multi-agent particle environment a particle world follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Physics {
    /// That of Lowe et al. (2017), which the paper trained on.
    #[default]
    Original,
    /// The package mpe2 (1.1): a body moves by the velocity that it had before the step, global and local rewards count
    /// half, no agent collides with itself, and an episode of full length is truncated.
    Mpe2,
}

/// What went wrong with an environment. Its name is what failures are counted under.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FailureKind {
    /// It reported an error of its own.
    Raised,
    /// It did not answer in time.
    TimedOut,
    /// Its process or connection is gone.
    Died,
    /// It answered something that no environment of its task may: a wrong shape, a number that is not finite, an agent
    /// without an available action.
    BadAnswer,
}

impl FailureKind {
    /// Every kind.
    pub const ALL: [Self; 4] = [Self::Raised, Self::TimedOut, Self::Died, Self::BadAnswer];

    /// A short name for counting.
    pub fn name(self) -> &'static str {
        match self {
            Self::Raised => "environment_raised",
            Self::TimedOut => "environment_timed_out",
            Self::Died => "environment_died",
            Self::BadAnswer => "environment_bad_answer",
        }
    }
}

/// Why an environment cannot go on with its episode. The episode is lost, and the environment is built anew.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{detail}")]
pub struct EnvironmentError {
    /// What it is counted under.
    pub kind: FailureKind,
    /// What happened, in words for a person.
    pub detail: String,
    /// Where in the environment's own code, if it raised an error there: lines, as its language has them.
    pub traceback: Option<String>,
}

impl EnvironmentError {
    /// Without a traceback.
    pub fn new(kind: FailureKind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), traceback: None }
    }
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
    /// A unit of the opponent's.
    Enemy,
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
    /// What else is shown of a unit in combat.
    pub unit: Option<SceneUnit>,
}

/// A unit in combat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneUnit {
    /// Its type's letter.
    pub letter: char,
    /// Share of its health that is left; 0 for the dead.
    pub health: f32,
    /// Share of its shield that is left; `None` for units without.
    pub shield: Option<f32>,
}

/// What one body did to another in the step before a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkKind {
    /// It attacked.
    Attack,
    /// It healed.
    Heal,
}

/// One body that did something to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SceneLink {
    /// Index of the body that acted.
    pub from: usize,
    /// Index of the other.
    pub to: usize,
    /// What it did.
    pub kind: LinkKind,
}

/// What can be drawn of a state: every entity, in the environment's order.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The entities.
    pub bodies: Vec<SceneBody>,
    /// What they did to each other in the step before.
    pub links: Vec<SceneLink>,
}

/// One task's world: real agents and entities only, agents in an order of its own.
///
/// An environment draws randomness from the stream it is given and from nowhere else, and
/// [`crate::conformance::check`] holds for it.
pub trait Environment: Send {
    /// What the task is. Constant.
    fn spec(&self) -> Spec;

    /// Tells the environment that an episode will begin, so that it can get to work; [`Self::reset`] follows. One that
    /// works in this process has nothing to do here. All environments of an actor are told before the first is
    /// waited for.
    ///
    /// # Errors
    /// When it cannot be told.
    fn begin_reset(&mut self, _rng: &mut Rng) -> Result<(), EnvironmentError> {
        Ok(())
    }

    /// Begins an episode, and waits until it has begun.
    ///
    /// # Errors
    /// When it did not.
    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError>;

    /// Writes the state: features into the first `feature_dim` columns of each entity's row (agents first),
    /// and all of `observable` and `available`, which arrive as zeros.
    fn observe(&self, observation: &mut Observation);

    /// Tells the environment the joint action, so that it can get to work; [`Self::step`] follows with the same one.
    /// As [`Self::begin_reset`].
    ///
    /// # Errors
    /// When it cannot be told.
    fn begin_step(&mut self, _actions: &[Action]) -> Result<(), EnvironmentError> {
        Ok(())
    }

    /// Takes one joint action, `[n_agents]`, each available, and waits for what it leads to.
    ///
    /// # Errors
    /// When the environment cannot go on.
    fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError>;

    /// Whether this world says [`End::Terminated`] where nothing but time has ended the episode. Only then may
    /// [`TimeLimit::Truncated`](crate::rollout::TimeLimit::Truncated) make a cut of such an end on the last step, unless
    /// the team has won. A world that says [`End::Truncated`] where time is up, or whose task itself ends on its last
    /// step, leaves this as it is. Constant.
    fn is_over_at_limit(&self) -> bool {
        false
    }

    /// What can be drawn of the state, where the entities have places.
    fn scene(&self) -> Option<Scene> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matrix_game::MatrixGame;

    #[test]
    fn sizes_that_make_no_task_are_refused() {
        let good = MatrixGame::SPEC;
        assert_eq!(good.check(), Ok(()));
        for wrong in [
            Spec { n_agents: 0, ..good },
            Spec { n_entities: 1, ..good },
            Spec { feature_dim: 0, ..good },
            Spec { n_actions: 0, ..good },
            Spec { steps_max: 0, ..good },
        ] {
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        assert_eq!(
            Spec { steps_max: 0, ..good }.check().unwrap_err().to_string(),
            "2 agents, 2 entities (agents included), 3 features, 3 actions and 0 steps make no task; it needs at least \
             one agent, as many entities as agents, a feature, an action and a step"
        );
    }

    #[test]
    fn specs_differ_by_name() {
        let spec = MatrixGame::SPEC;
        assert_eq!(spec.first_difference(&spec), None);
        let other = Spec { steps_max: 7, has_wins: false, ..spec };
        assert_eq!(other.first_difference(&spec), Some(("steps_max", "7".into(), "2".into())));
        let other = Spec { is_reproducible: false, ..spec };
        assert_eq!(other.first_difference(&spec), Some(("is_reproducible", "false".into(), "true".into())));
    }
}
