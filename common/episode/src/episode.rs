//! One finished episode, real rows only.

use crate::{Action, Observation};

/// Why an episode has no further step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The task is over: nothing more can be earned, so the target does not bootstrap.
    Terminated,
    /// Time ran out: the target bootstraps from the last state.
    Truncated,
}

/// One finished episode. With n agents, m entities, T steps, d features and A actions of its own:
/// state-like fields have T + 1 rows in time, the last being the bootstrap state.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    /// Its number in the run: the key of its random streams and its place in replay.
    pub number: u64,
    /// The weights it was rolled with, counted in updates.
    pub weights_version: u64,
    /// Index of its task among the run's training tasks.
    pub task: usize,
    /// Real agents, n.
    pub n_agents: usize,
    /// Real entities, m, agents included.
    pub n_entities: usize,
    /// `decision_order[k]` is the environment's agent that decides k-th and has row k everywhere here.
    pub decision_order: Vec<u8>,
    /// Features, `[T + 1, m, d]`.
    pub entities: Vec<f32>,
    /// Who sees what, 0 or 1, `[T + 1, n, m]`.
    pub observable: Vec<u8>,
    /// Who may do what, 0 or 1, `[T + 1, n, A]`.
    pub available: Vec<u8>,
    /// Joint actions, `[T, n]`.
    pub actions: Vec<Action>,
    /// Team rewards, `[T]`.
    pub rewards: Vec<f32>,
    /// What training adds to them, `[T]`: of the targets alone, not of returns or representations.
    pub shaping: Vec<f32>,
    /// Why it ended.
    pub end: End,
    /// Whether the environment calls it won.
    pub won: bool,
}

impl Episode {
    /// Decision steps, T.
    pub fn steps(&self) -> usize {
        self.rewards.len()
    }

    /// Undiscounted sum of team rewards, summed in f64.
    pub fn total_reward(&self) -> f64 {
        self.rewards.iter().map(|&reward| f64::from(reward)).sum()
    }

    /// The same episode with its agents in another decision order: row k is what row `rows[k]` was.
    ///
    /// # Panics
    /// When `rows` are not all rows of agents.
    #[must_use]
    pub fn reordered(&self, rows: &[usize]) -> Self {
        let (n, m, states) = (self.n_agents, self.n_entities, self.steps() + 1);
        assert_eq!(rows.len(), n, "one place for each agent");
        let [d, a] = [self.entities.len() / (states * m), self.available.len() / (states * n)];
        let entities: Vec<usize> = rows.iter().copied().chain(n..m).collect();
        let mut other = Self {
            decision_order: rows.iter().map(|&row| self.decision_order[row]).collect(),
            entities: Vec::with_capacity(self.entities.len()),
            observable: Vec::with_capacity(self.observable.len()),
            available: Vec::with_capacity(self.available.len()),
            actions: Vec::with_capacity(self.actions.len()),
            ..self.clone()
        };
        for time in 0..states {
            for &row in &entities {
                other.entities.extend_from_slice(&self.entities[(time * m + row) * d..][..d]);
            }
            for &agent in rows {
                let row = &self.observable[(time * n + agent) * m..][..m];
                other.observable.extend(entities.iter().map(|&entity| row[entity]));
                other.available.extend_from_slice(&self.available[(time * n + agent) * a..][..a]);
                if time < self.steps() {
                    other.actions.push(self.actions[time * n + agent]);
                }
            }
        }
        other
    }

    /// Bytes its own data takes.
    pub fn bytes(&self) -> usize {
        4 * (self.entities.len() + self.rewards.len() + self.shaping.len())
            + self.observable.len()
            + self.available.len()
            + self.actions.len()
            + self.decision_order.len()
    }
}

/// Grows an [`Episode`] step by step.
#[derive(Debug)]
pub struct EpisodeBuilder {
    episode: Episode,
}

impl EpisodeBuilder {
    /// Starts an episode from its first observation.
    pub fn new(
        number: u64,
        weights_version: u64,
        task: usize,
        decision_order: Vec<u8>,
        first: &Observation,
    ) -> Self {
        let mut builder = Self {
            episode: Episode {
                number,
                weights_version,
                task,
                n_agents: first.n_agents(),
                n_entities: first.n_entities(),
                decision_order,
                entities: Vec::new(),
                observable: Vec::new(),
                available: Vec::new(),
                actions: Vec::new(),
                rewards: Vec::new(),
                shaping: Vec::new(),
                end: End::Truncated,
                won: false,
            },
        };
        builder.observe(first);
        builder
    }

    /// Records a joint action, what it earned, what training adds, and the state it led to.
    pub fn step(&mut self, actions: &[Action], reward: f32, shaping: f32, next: &Observation) {
        debug_assert_eq!(actions.len(), self.episode.n_agents);
        self.episode.actions.extend_from_slice(actions);
        self.episode.rewards.push(reward);
        self.episode.shaping.push(shaping);
        self.observe(next);
    }

    /// The whole episode.
    pub fn finish(mut self, end: End, won: bool) -> Episode {
        (self.episode.end, self.episode.won) = (end, won);
        self.episode
    }

    fn observe(&mut self, observation: &Observation) {
        debug_assert_eq!(observation.n_agents(), self.episode.n_agents);
        debug_assert_eq!(observation.n_entities(), self.episode.n_entities);
        self.episode.entities.extend_from_slice(observation.entities());
        self.episode.observable.extend_from_slice(observation.observable());
        self.episode.available.extend_from_slice(observation.available());
    }
}
