//! What the agents of one running episode see at one decision step.

use crate::Action;

/// The state at one decision step, real rows only: agents first, then the other entities.
///
/// Whoever fills it decides the agents' order; seen through a decision order, row k is the k-th to decide.
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
