//! Who sits where: agents in decision order, each with its last action.

use crate::{Action, Observation, decision_order};

/// One episode's seats. Row k of what is shown is the k-th agent to decide. The order reorders every axis that indexes
/// agents, and joint actions are mapped back. Each agent's features are followed by the one-hot of its last action: zeros
/// at the first step and for entities that are no agents.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Seating {
    order: Vec<u8>,
    /// Last joint action in the agents' own order; `None` at the first step.
    last_actions: Option<Vec<Action>>,
}

impl Seating {
    /// Begins an episode in this decision order.
    ///
    /// # Panics
    /// When the order is no permutation.
    pub fn begin(&mut self, order: Vec<u8>) {
        assert!(decision_order::is_permutation(&order), "a decision order is a permutation");
        self.order = order;
        self.last_actions = None;
    }

    /// Who decides when: `order[k]` is the k-th agent to decide.
    pub fn order(&self) -> &[u8] {
        &self.order
    }

    /// Shows what is seen from the seats: `own` has the agents in their own order and no last actions.
    pub fn seat(&self, own: &Observation, seated: &mut Observation) {
        let (n, m, features, n_actions) =
            (own.n_agents(), own.n_entities(), own.entity_dim(), own.n_actions());
        seated.reset(n, m, features + n_actions, n_actions);
        for row in 0..m {
            let entity = self.entity_at(row);
            let to = seated.entity_mut(row);
            to[..features].copy_from_slice(&own.entities()[entity * features..][..features]);
            if let Some(actions) = self.last_actions.as_ref().filter(|_| row < n) {
                to[features + usize::from(actions[entity])] = 1.0;
            }
        }
        for row in 0..n {
            let agent = self.entity_at(row);
            for column in 0..m {
                let entity = self.entity_at(column);
                seated.observable_mut(row)[column] = own.observable()[agent * m + entity];
            }
            seated.available_mut(row).copy_from_slice(own.available_to(agent));
        }
    }

    /// Takes a joint action in decision order.
    pub fn take(&mut self, actions: &[Action]) {
        let last = self.last_actions.get_or_insert_default();
        last.resize(actions.len(), 0);
        for (&agent, &action) in self.order.iter().zip(actions) {
            last[usize::from(agent)] = action;
        }
    }

    /// The joint action taken last, in the agents' own order; nothing before the first.
    pub fn last_actions(&self) -> &[Action] {
        self.last_actions.as_deref().unwrap_or_default()
    }

    /// The entity that sits in this row.
    fn entity_at(&self, row: usize) -> usize {
        self.order.get(row).map_or(row, |&agent| usize::from(agent))
    }
}
