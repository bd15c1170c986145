//! What the agents of one running episode see at one decision step.

use crate::Action;

/// What no state may have.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ObservationFault {
    /// A feature that is no number.
    #[error("feature {feature} of entity {entity} is {value}; features are finite numbers")]
    Feature {
        /// Whose.
        entity: usize,
        /// Which column.
        feature: usize,
        /// It.
        value: f32,
    },
    /// A flag that is neither 0 nor 1.
    #[error("{what} of agent {agent} has {value} for {of}; flags are 0 or 1")]
    Flag {
        /// `observable` or `available`.
        what: &'static str,
        /// Whose.
        agent: usize,
        /// Of which entity or action.
        of: usize,
        /// It.
        value: u8,
    },
    /// An agent that sees others and not itself.
    #[error("agent {agent} sees others and not itself; an agent sees itself, or nothing")]
    NotItself {
        /// Which.
        agent: usize,
    },
    /// An agent without an action.
    #[error("agent {agent} has no available action; everyone has something to do, if only nothing")]
    NothingToDo {
        /// Which.
        agent: usize,
    },
}

/// The state at one decision step, real rows only: agents first, then the other entities.
///
/// The caller that fills it chooses the agents' order; seen through a decision order, row k is the k-th to decide.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observation {
    n_agents: usize,
    n_entities: usize,
    entity_dim: usize,
    n_actions: usize,
    entities: Vec<f32>,
    observable: Vec<u8>,
    available: Vec<u8>,
}

impl Observation {
    /// An observation of zeros; see [`Observation::reset`].
    pub fn new(n_agents: usize, n_entities: usize, entity_dim: usize, n_actions: usize) -> Self {
        let mut observation = Self::default();
        observation.reset(n_agents, n_entities, entity_dim, n_actions);
        observation
    }

    /// Takes these sizes and fills everything with zeros, keeping its memory.
    ///
    /// # Panics
    /// When there are more agents than entities: agents are entities.
    pub fn reset(&mut self, n_agents: usize, n_entities: usize, entity_dim: usize, n_actions: usize) {
        assert!(n_agents <= n_entities, "agents are entities");
        (self.n_agents, self.n_entities) = (n_agents, n_entities);
        (self.entity_dim, self.n_actions) = (entity_dim, n_actions);
        refill(&mut self.entities, n_entities * entity_dim);
        refill(&mut self.observable, n_agents * n_entities);
        refill(&mut self.available, n_agents * n_actions);
    }

    /// Real agents.
    pub fn n_agents(&self) -> usize {
        self.n_agents
    }

    /// Real entities, agents included.
    pub fn n_entities(&self) -> usize {
        self.n_entities
    }

    /// Features of one entity.
    pub fn entity_dim(&self) -> usize {
        self.entity_dim
    }

    /// Size of the action space.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    /// Features, `[n_entities, entity_dim]`.
    pub fn entities(&self) -> &[f32] {
        &self.entities
    }

    /// 1 where the row's agent sees the column's entity, `[n_agents, n_entities]`.
    pub fn observable(&self) -> &[u8] {
        &self.observable
    }

    /// 1 where the row's agent may take the column's action, `[n_agents, n_actions]`.
    pub fn available(&self) -> &[u8] {
        &self.available
    }

    /// Features of one entity, to be written.
    pub fn entity_mut(&mut self, entity: usize) -> &mut [f32] {
        &mut self.entities[entity * self.entity_dim..][..self.entity_dim]
    }

    /// What one agent sees, to be written, `[n_entities]`.
    pub fn observable_mut(&mut self, agent: usize) -> &mut [u8] {
        &mut self.observable[agent * self.n_entities..][..self.n_entities]
    }

    /// What one agent may do, to be written, `[n_actions]`.
    pub fn available_mut(&mut self, agent: usize) -> &mut [u8] {
        &mut self.available[agent * self.n_actions..][..self.n_actions]
    }

    /// What one agent may do, `[n_actions]`.
    pub fn available_to(&self, agent: usize) -> &[u8] {
        &self.available[agent * self.n_actions..][..self.n_actions]
    }

    /// Whether the agent may take the action.
    pub fn allows(&self, agent: usize, action: Action) -> bool {
        self.available_to(agent).get(usize::from(action)) == Some(&1)
    }

    /// Whether it is a state that may be: finite features, flags of 0 and 1, agents that see themselves or nothing, and
    /// an available action for everyone.
    ///
    /// # Errors
    /// The first thing that may not be.
    pub fn check(&self) -> Result<(), ObservationFault> {
        if let Some(at) = self.entities.iter().position(|feature| !feature.is_finite()) {
            let (entity, feature) = (at / self.entity_dim, at % self.entity_dim);
            return Err(ObservationFault::Feature { entity, feature, value: self.entities[at] });
        }
        for (what, flags, width) in [
            ("observable", &self.observable, self.n_entities),
            ("available", &self.available, self.n_actions),
        ] {
            if let Some(at) = flags.iter().position(|&flag| flag > 1) {
                let (agent, of) = (at / width, at % width);
                return Err(ObservationFault::Flag { what, agent, of, value: flags[at] });
            }
        }
        for agent in 0..self.n_agents {
            let seen = &self.observable[agent * self.n_entities..][..self.n_entities];
            if seen[agent] == 0 && seen.contains(&1) {
                return Err(ObservationFault::NotItself { agent });
            }
            if !self.available_to(agent).contains(&1) {
                return Err(ObservationFault::NothingToDo { agent });
            }
        }
        Ok(())
    }

    /// Makes every entity visible to every agent and every action available: the plain case.
    pub fn see_and_allow_all(&mut self) {
        self.observable.fill(1);
        self.available.fill(1);
    }
}

fn refill<T: Copy + Default>(buffer: &mut Vec<T>, len: usize) {
    buffer.clear();
    buffer.resize(len, T::default());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_thing_that_may_not_be_is_named() {
        let mut good = Observation::new(2, 3, 2, 2);
        good.see_and_allow_all();
        good.observable_mut(1).fill(0);
        assert_eq!(good.check(), Ok(()));
        let fault = |change: &dyn Fn(&mut Observation)| {
            let mut observation = good.clone();
            change(&mut observation);
            observation.check().unwrap_err().to_string()
        };
        assert_eq!(
            fault(&|o| o.entity_mut(2)[1] = f32::NAN),
            "feature 1 of entity 2 is NaN; features are finite numbers"
        );
        assert_eq!(
            fault(&|o| o.observable_mut(0)[2] = 2),
            "observable of agent 0 has 2 for 2; flags are 0 or 1"
        );
        assert_eq!(
            fault(&|o| o.available_mut(1)[0] = 7),
            "available of agent 1 has 7 for 0; flags are 0 or 1"
        );
        assert!(fault(&|o| o.observable_mut(1)[0] = 1).starts_with("agent 1 sees others and not itself"));
        assert!(fault(&|o| o.available_mut(0).fill(0)).starts_with("agent 0 has no available action"));
    }
}
