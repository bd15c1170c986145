//! What chooses joint actions: the acting networks, or a script.

use crate::{Action, Exploration, Observation};

/// One running episode's turn: what is seen, and where its joint action goes.
#[derive(Debug)]
pub struct Turn<'a> {
    /// Which of the policy's running episodes this is.
    pub slot: usize,
    /// The state, agents in decision order.
    pub observation: &'a Observation,
    /// Team reward of the previous step; 0 at the first.
    pub previous_reward: f32,
    /// Which actions are to be random.
    pub exploration: &'a mut Exploration,
    /// The joint action to be written, in decision order, `[n_agents]`.
    pub actions: &'a mut [Action],
}

/// Chooses joint actions for several running episodes at once.
///
/// What one episode gets must not depend on which others run beside it, or the same seed would end
/// elsewhere with another number of actors.
pub trait Policy: Send {
    /// A new episode begins in this slot: what was remembered of the last one is forgotten.
    fn begin(&mut self, slot: usize, n_agents: usize);

    /// Writes the joint action of every turn. Each slot appears at most once.
    fn act(&mut self, turns: &mut [Turn<'_>]);
}
