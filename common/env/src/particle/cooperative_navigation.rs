//! Cooperative navigation (paper, section VI-A): n agents cover n landmarks without running into each other.
//! "Simple spread" rewards, the original's or mpe2's, paid as their sum over agents.

use super::world::{Body, World, spec, squared_distance_to_nearest};
use crate::{BodyKind, Environment, EnvironmentError, EnvironmentOptions, Physics, Scene, Spec, Step};
use rit_episode::{Action, Observation, Rng};

const AGENT: Body =
    Body { collides: true, movable: true, acceleration: 5.0, ..Body::new(BodyKind::Agent, 0.15) };
const LANDMARK: Body = Body::new(BodyKind::Landmark, 0.05);

/// Of global and of local rewards in mpe2: its `local_ratio`, and what is left.
const MPE2_SHARE: f32 = 0.5;

/// The task (n, n). Entities: the agents, then the landmarks.
#[derive(Debug)]
pub struct CooperativeNavigation {
    world: World,
}

impl CooperativeNavigation {
    /// What the task is.
    pub fn spec(n: usize) -> Spec {
        spec(n, 2 * n)
    }

    /// The task of `n` agents and as many landmarks.
    ///
    /// # Panics
    /// Without agents, or with a view radius that is negative or not a number.
    pub fn new(n: usize, options: EnvironmentOptions) -> Self {
        let bodies = [vec![AGENT; n], vec![LANDMARK; n]].concat();
        Self { world: World::new(bodies, n, options) }
    }

    /// The sum over agents of −(Σ_landmarks distance of the nearest agent) − (number of agents it overlaps,
    /// itself included as in the original). In mpe2 half of it, and no agent overlaps itself.
    fn team_reward(&self) -> f32 {
        let (agents, landmarks) = self.world.bodies.split_at(self.world.n_agents());
        let mut uncovered = 0.0;
        for landmark in landmarks {
            let places = agents.iter().map(|agent| agent.position);
            uncovered += squared_distance_to_nearest(landmark.position, places).sqrt();
        }
        // Two agents that overlap count each other.
        let mut overlaps = 0;
        for (index, agent) in agents.iter().enumerate() {
            overlaps += 2 * agents[..index].iter().filter(|other| agent.overlaps(other)).count();
        }
        let n = agents.len() as f32;
        match self.world.physics() {
            Physics::Original => -(n * uncovered + (overlaps + agents.len()) as f32),
            Physics::Mpe2 => -MPE2_SHARE * (n * uncovered + overlaps as f32),
        }
    }
}

impl Environment for CooperativeNavigation {
    fn spec(&self) -> Spec {
        Self::spec(self.world.n_agents())
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        self.world.reset(rng);
        Ok(())
    }

    fn observe(&self, observation: &mut Observation) {
        self.world.observe(observation);
    }

    fn step(&mut self, actions: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        self.world.set_forces(actions);
        let end = self.world.advance();
        Ok(Step { reward: self.team_reward(), shaping: 0.0, end, won: false })
    }

    fn is_over_at_limit(&self) -> bool {
        self.world.is_over_at_limit()
    }

    fn scene(&self) -> Option<Scene> {
        Some(self.world.scene())
    }
}

#[cfg(test)]
mod tests;
