//! An environment seen in decision order.

use crate::{Environment, Step};
use rit_episode::{Action, Observation, Rng, decision_order};

/// An environment whose agents sit in decision order: row k is the k-th to decide. The order reorders every
/// axis that indexes agents, and joint actions are mapped back before the environment steps. Each agent's
/// features are followed by the one-hot of its last action: zeros at the first step and for non-agents.
pub struct Seated {
    environment: Box<dyn Environment>,
    decision_order: Vec<u8>,
    /// The environment's own view, agents in its own order.
    inner: Observation,
    /// Last joint action in the environment's order; `None` at the first step.
    last_actions: Option<Vec<Action>>,
}

impl Seated {
    /// Takes an environment; [`Seated::reset`] comes before anything else.
    pub fn new(environment: Box<dyn Environment>) -> Self {
        let decision_order = decision_order::identity(environment.n_agents());
        Self { environment, decision_order, inner: Observation::default(), last_actions: None }
    }

    /// Features of one entity, its last action included: d.
    pub fn entity_dim(&self) -> usize {
        self.environment.feature_dim() + self.environment.n_actions()
    }

    /// The environment itself.
    pub fn environment(&self) -> &dyn Environment {
        self.environment.as_ref()
    }

    /// Begins an episode in this decision order.
    ///
    /// # Panics
    /// When the order is not a permutation of the environment's agents.
    pub fn reset(&mut self, order: Vec<u8>, rng: &mut Rng) {
        assert_eq!(order.len(), self.environment.n_agents(), "one place for each agent");
        assert!(decision_order::is_permutation(&order), "a decision order is a permutation");
        self.decision_order = order;
        self.last_actions = None;
        self.environment.reset(rng);
    }

    /// The state with agents in decision order.
    pub fn observe(&mut self, observation: &mut Observation) {
        let (n, m) = (self.environment.n_agents(), self.environment.n_entities());
        let (features, n_actions) = (self.environment.feature_dim(), self.environment.n_actions());
        self.inner.reset(n, m, features, n_actions);
        self.environment.observe(&mut self.inner);

        observation.reset(n, m, features + n_actions, n_actions);
        for row in 0..m {
            let entity = self.entity_at(row);
            let to = observation.entity_mut(row);
            to[..features].copy_from_slice(&self.inner.entities()[entity * features..][..features]);
            if let Some(actions) = self.last_actions.as_ref().filter(|_| row < n) {
                to[features + usize::from(actions[entity])] = 1.0;
            }
        }
        for row in 0..n {
            let agent = self.entity_at(row);
            for column in 0..m {
                let entity = self.entity_at(column);
                observation.observable_mut(row)[column] = self.inner.observable()[agent * m + entity];
            }
            observation.available_mut(row).copy_from_slice(self.inner.available_to(agent));
        }
    }

    /// Takes a joint action in decision order.
    pub fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Step {
        let last = self.last_actions.get_or_insert_default();
        last.resize(actions.len(), 0);
        for (&agent, &action) in self.decision_order.iter().zip(actions) {
            last[usize::from(agent)] = action;
        }
        self.environment.step(last, rng)
    }

    /// The environment's entity that sits in this row.
    fn entity_at(&self, row: usize) -> usize {
        self.decision_order.get(row).map_or(row, |&agent| usize::from(agent))
    }
}
