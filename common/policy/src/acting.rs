//! A trained policy acting: what agents see in, joint actions out. Greedy, as `rit evaluate` acts.

use crate::{Description, Weights, WeightsFileError};
use rit_algo::{Acting, method::Encoder};
use rit_episode::{
    Action, Choice, Dims, Exploration, Observation, ObservationFault, Policy as _, RunSeed, Seating, Stream,
    Turn, decision_order,
};
use std::path::Path;

/// What the agents of one running episode see. Agents are in an order of their own, which stays the same for an episode.
#[derive(Clone, Copy, Debug)]
pub struct State<'a> {
    /// Which episode.
    pub episode: usize,
    /// Agents first, then the other entities; without last actions, which the policy remembers by itself.
    pub observation: &'a Observation,
    /// Team reward of the previous step; 0 at the first.
    pub previous_reward: f32,
}

/// Why a policy does not act.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ActError {
    /// An episode that was never begun.
    #[error("episode {episode} has not begun; begin it with its number of agents first")]
    NotBegun {
        /// Which.
        episode: usize,
    },
    /// An episode that is there twice.
    #[error("episode {episode} is given twice; an episode acts once at a time")]
    Twice {
        /// Which.
        episode: usize,
    },
    /// Another size than what was trained, or than what the episode began with.
    #[error("episode {episode}: {found} {what}, not {expected}")]
    Size {
        /// Which episode.
        episode: usize,
        /// What there are so many of.
        what: &'static str,
        /// As many as there are.
        found: usize,
        /// As many as there should be.
        expected: usize,
    },
    /// More than the model has room for, or none.
    #[error("episode {episode}: {found} {what}; this policy takes {min} to {max}")]
    Count {
        /// Which episode.
        episode: usize,
        /// What there are too many of.
        what: &'static str,
        /// As many as there are.
        found: usize,
        /// The fewest it takes.
        min: usize,
        /// The most it takes.
        max: usize,
    },
    /// An observation that cannot be.
    #[error("episode {episode}: {fault}")]
    Observation {
        /// Which episode.
        episode: usize,
        /// What is wrong with it.
        fault: ObservationFault,
    },
    /// A reward that is no number.
    #[error("episode {episode}: previous_reward is {reward}; it must be a finite number")]
    Reward {
        /// Which episode.
        episode: usize,
        /// It.
        reward: f32,
    },
    /// A decision order that lacks an agent.
    #[error("episode {episode}: the decision order must have each of 0 to {} once", n_agents - 1)]
    Order {
        /// Which episode.
        episode: usize,
        /// How many agents there are.
        n_agents: usize,
    },
}

/// A trained policy, acting greedily in any number of running episodes.
pub struct TrainedPolicy {
    description: Description,
    /// A, and features without last actions.
    n_actions: usize,
    feature_dim: usize,
    /// h_z; 0 without task representations.
    representation_dim: usize,
    /// The most agents, and the most other entities, that inputs of fixed length hold.
    room: Option<[usize; 2]>,
    acting: Acting,
    episodes: Vec<Running>,
}

/// A running episode.
struct Running {
    /// 0 before it begins.
    n_agents: usize,
    seating: Seating,
    seated: Observation,
    exploration: Exploration,
    /// In decision order.
    actions: Vec<Action>,
    utilities: Vec<f32>,
    representations: Vec<f32>,
}

impl TrainedPolicy {
    /// Of these weights.
    pub fn new(weights: Weights) -> Self {
        let Weights { description, model, params } = weights;
        let config = model.config();
        let facts = config.method.facts();
        let others_max = config.entities_max.saturating_sub(config.agents_max);
        Self {
            n_actions: config.n_actions,
            feature_dim: config.entity_dim - config.n_actions,
            representation_dim: if facts.task_representations { config.task_representation_dim } else { 0 },
            room: (facts.encoder == Encoder::Flat).then_some([config.agents_max, others_max]),
            acting: Acting::new(&model, &params[model.acting()]),
            description,
            episodes: Vec::new(),
        }
    }

    /// Of a run's newest checkpoint, one of its checkpoints, or a weights file: see
    /// [`place::weights_path`](crate::place::weights_path).
    ///
    /// # Errors
    /// As [`Weights::load`].
    pub fn load(given: &Path) -> Result<Self, WeightsFileError> {
        Weights::load(given).map(Self::new)
    }

    /// What the weights file says of itself.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Features of an entity, without last actions.
    pub fn feature_dim(&self) -> usize {
        self.feature_dim
    }

    /// A.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    /// h_z: numbers in a task representation; 0 where the method has none.
    pub fn representation_dim(&self) -> usize {
        self.representation_dim
    }

    /// Begins an episode, whatever has run under its number before. Agents decide in `order`, `order[k]` being the k-th;
    /// in their own order without.
    ///
    /// # Errors
    /// When there are too many agents, or the order is none.
    pub fn begin(&mut self, episode: usize, n_agents: usize, order: Option<Vec<u8>>) -> Result<(), ActError> {
        let max = self.room.map_or(Dims::ENTITIES_LIMIT, |[agents, _]| agents);
        if !(1..=max).contains(&n_agents) {
            return Err(ActError::Count { episode, what: "agents", found: n_agents, min: 1, max });
        }
        let order = order.unwrap_or_else(|| decision_order::identity(n_agents));
        if order.len() != n_agents || !decision_order::is_permutation(&order) {
            return Err(ActError::Order { episode, n_agents });
        }
        while self.episodes.len() <= episode {
            self.episodes.push(Running::new());
        }
        let running = &mut self.episodes[episode];
        running.n_agents = n_agents;
        running.seating.begin(order);
        running.actions = vec![0; n_agents];
        running.utilities.clear();
        running.representations.clear();
        self.acting.begin(episode, n_agents);
        Ok(())
    }

    /// One joint action of each of these episodes; [`Self::actions`] has them. An episode's actions do not depend on
    /// which others act beside it.
    ///
    /// # Errors
    /// When a state is none that this policy can act in: then no episode has gone on.
    pub fn act(&mut self, states: &[State<'_>]) -> Result<(), ActError> {
        let mut places = vec![None; self.episodes.len()];
        for (at, state) in states.iter().enumerate() {
            self.check(state)?;
            if places[state.episode].replace(at).is_some() {
                return Err(ActError::Twice { episode: state.episode });
            }
        }
        let mut turns = Vec::with_capacity(states.len());
        for (slot, (running, at)) in self.episodes.iter_mut().zip(places).enumerate() {
            let Some(state) = at.map(|at| &states[at]) else { continue };
            running.seating.seat(state.observation, &mut running.seated);
            turns.push(Turn {
                slot,
                observation: &running.seated,
                previous_reward: state.previous_reward,
                exploration: &mut running.exploration,
                actions: &mut running.actions,
            });
        }
        self.acting.act(&mut turns);
        let slots: Vec<usize> = turns.iter().map(|turn| turn.slot).collect();
        let mut utilities = self.acting.utilities();
        let mut representations = self.acting.task_representations();
        for slot in slots {
            let running = &mut self.episodes[slot];
            running.seating.take(&running.actions);
            let order = running.seating.order();
            utilities = in_own_order(order, utilities, self.n_actions, &mut running.utilities);
            representations =
                in_own_order(order, representations, self.representation_dim, &mut running.representations);
        }
        Ok(())
    }

    /// The joint action of an episode's last step, agents in their own order; nothing before its first.
    pub fn actions(&self, episode: usize) -> &[Action] {
        self.episodes.get(episode).map_or(&[], |running| running.seating.last_actions())
    }

    /// What the last step's actions were chosen by, `[n_agents, n_actions]`, agents in their own order: each agent's
    /// utilities given the actions of those that decided before it, or logits of a method with a policy network.
    pub fn utilities(&self, episode: usize) -> &[f32] {
        self.episodes.get(episode).map_or(&[], |running| &running.utilities)
    }

    /// What each agent takes the task for, `[n_agents, h_z]`, in the last step; nothing where the method has no task
    /// representations.
    pub fn task_representations(&self, episode: usize) -> &[f32] {
        self.episodes.get(episode).map_or(&[], |running| &running.representations)
    }

    /// Whether it can act in a state.
    fn check(&self, state: &State<'_>) -> Result<(), ActError> {
        let State { episode, observation, previous_reward: reward } = *state;
        let running = self.episodes.get(episode).filter(|running| running.n_agents > 0);
        let running = running.ok_or(ActError::NotBegun { episode })?;
        for (what, found, expected) in [
            ("agents", observation.n_agents(), running.n_agents),
            ("features of an entity", observation.entity_dim(), self.feature_dim),
            ("actions", observation.n_actions(), self.n_actions),
        ] {
            if found != expected {
                return Err(ActError::Size { episode, what, found, expected });
            }
        }
        let others = observation.n_entities() - observation.n_agents();
        let max = self.room.map_or(Dims::ENTITIES_LIMIT - running.n_agents, |[_, others]| others);
        if others > max {
            return Err(ActError::Count {
                episode,
                what: "entities that are no agents",
                found: others,
                min: 0,
                max,
            });
        }
        observation.check().map_err(|fault| ActError::Observation { episode, fault })?;
        if reward.is_finite() { Ok(()) } else { Err(ActError::Reward { episode, reward }) }
    }
}

impl Running {
    fn new() -> Self {
        // Greedy: nothing is drawn from it.
        let exploration = Exploration::new(Choice::Greedy, 0.0, 0, RunSeed(0).stream(Stream::Exploration, 0));
        Self {
            n_agents: 0,
            seating: Seating::default(),
            seated: Observation::default(),
            exploration,
            actions: Vec::new(),
            utilities: Vec::new(),
            representations: Vec::new(),
        }
    }
}

/// Takes a row of `width` numbers for each agent from the front of `rows`, which are in decision order; returns what is
/// left.
fn in_own_order<'a>(order: &[u8], rows: &'a [f32], width: usize, own: &mut Vec<f32>) -> &'a [f32] {
    let (rows, rest) = rows.split_at(order.len() * width);
    own.clear();
    own.resize(rows.len(), 0.0);
    for (row, &agent) in order.iter().enumerate() {
        own[usize::from(agent) * width..][..width].copy_from_slice(&rows[row * width..][..width]);
    }
    rest
}
