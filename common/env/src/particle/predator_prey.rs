//! Predator and prey, and its pro series (paper, section VI-A): m predators hunt n faster prey between two
//! obstacles. The agents are the predators; the prey follow a rule.
//!
//! The paper states neither the scale of the prey's rule nor the pro series' penalty; both are inferred from
//! its figures.

use super::world::{Body, Vector, World, scaled, spec, squared_distance, squared_distance_to_nearest, sum};
use crate::{BodyKind, Environment, EnvironmentError, EnvironmentOptions, Scene, Spec, Step};
use rand::RngExt as _;
use rit_episode::{Action, Observation, Rng};

const PREDATOR: Body = Body {
    collides: true,
    movable: true,
    acceleration: 3.0,
    speed_max: 1.0,
    ..Body::new(BodyKind::Agent, 0.075)
};
const OBSTACLE: Body = Body { collides: true, start_within: 0.9, ..Body::new(BodyKind::Landmark, 0.2) };
const PREY: Body = Body {
    collides: true,
    movable: true,
    acceleration: 4.0,
    speed_max: 1.3,
    ..Body::new(BodyKind::Prey, 0.05)
};
const OBSTACLES: usize = 2;

/// Places a prey considers.
const CANDIDATES: usize = 100;
/// Team reward of a step with a catch.
const CATCH: f32 = 10.0;
/// Pro series: reward per predator, per unit of a predator's distance to its nearest prey.
const DISTANCE_REWARD: f32 = -0.1;

/// What a catch is, and whether distance is punished.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PredatorPreyReward {
    /// +10 on a step on which any predator overlaps any prey.
    Plain,
    /// +10 on a step on which two predators overlap the same prey; on every step −0.1 · m · Σ_predators
    /// distance to the nearest prey.
    Pro,
}

/// The task (m, n). Entities: the predators, two obstacles, the prey.
#[derive(Debug)]
pub struct PredatorPrey {
    world: World,
    reward: PredatorPreyReward,
    approach_shaping: f32,
}

impl PredatorPrey {
    /// What the task is.
    pub fn spec(predators: usize, prey: usize) -> Spec {
        spec(predators, predators + OBSTACLES + prey)
    }

    /// The task of this many predators and prey.
    ///
    /// # Panics
    /// Without predators or prey, or with a view radius that is negative or not a number.
    pub fn new(
        predators: usize,
        prey: usize,
        reward: PredatorPreyReward,
        options: EnvironmentOptions,
    ) -> Self {
        assert!(prey >= 1, "there is something to hunt");
        let bodies = [vec![PREDATOR; predators], vec![OBSTACLE; OBSTACLES], vec![PREY; prey]].concat();
        let approach_shaping = options.approach_shaping;
        Self { world: World::new(bodies, predators, options), reward, approach_shaping }
    }

    fn predators(&self) -> &[Body] {
        &self.world.bodies[..self.world.n_agents()]
    }

    fn prey(&self) -> &[Body] {
        &self.world.bodies[self.first_prey()..]
    }

    fn first_prey(&self) -> usize {
        self.world.n_agents() + OBSTACLES
    }

    fn team_reward(&self) -> f32 {
        let (predators, prey) = (self.predators(), self.prey());
        let caught_by = |prey: &Body| predators.iter().filter(|predator| predator.overlaps(prey)).count();
        let hunters_needed = match self.reward {
            PredatorPreyReward::Plain => 1,
            PredatorPreyReward::Pro => 2,
        };
        let caught = prey.iter().any(|prey| caught_by(prey) >= hunters_needed);
        let catch = if caught { CATCH } else { 0.0 };
        match self.reward {
            PredatorPreyReward::Plain => catch,
            PredatorPreyReward::Pro => {
                catch + DISTANCE_REWARD * predators.len() as f32 * self.distances_to_prey()
            }
        }
    }

    /// Σ_predators distance to the nearest prey.
    fn distances_to_prey(&self) -> f32 {
        let distance = |predator: &Body| {
            let places = self.prey().iter().map(|prey| prey.position);
            squared_distance_to_nearest(predator.position, places).sqrt()
        };
        self.predators().iter().map(distance).sum()
    }
}

impl Environment for PredatorPrey {
    fn spec(&self) -> Spec {
        Self::spec(self.predators().len(), self.prey().len())
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        self.world.reset(rng);
        Ok(())
    }

    fn observe(&self, observation: &mut Observation) {
        self.world.observe(observation);
    }

    fn step(&mut self, actions: &[Action], rng: &mut Rng) -> Result<Step, EnvironmentError> {
        self.world.set_forces(actions);
        // All prey decide by the state that the predators saw.
        for index in self.first_prey()..self.world.n_entities() {
            let offset = flight(self.world.bodies[index].position, self.predators(), rng);
            let prey = &mut self.world.bodies[index];
            prey.force = scaled(offset, prey.acceleration);
        }
        let distances = (self.approach_shaping != 0.0).then(|| self.distances_to_prey());
        let end = self.world.advance();
        let nearer = distances.map_or(0.0, |before| before - self.distances_to_prey());
        Ok(Step { reward: self.team_reward(), shaping: self.approach_shaping * nearer, end, won: false })
    }

    fn is_over_at_limit(&self) -> bool {
        self.world.is_over_at_limit()
    }

    fn scene(&self) -> Option<Scene> {
        Some(self.world.scene())
    }
}

/// Where a prey at this place flees to, as an offset: of [`CANDIDATES`] points of the unit disk around it, the
/// one farthest from the predator that is nearest now; the first of equals. Points at which it would overlap a
/// predator do not count, and without a point it stays: zero.
fn flight(prey: Vector, predators: &[Body], rng: &mut Rng) -> Vector {
    let touching = PREDATOR.radius + PREY.radius;
    let is_free = |place| {
        let free_of = |predator: &Body| squared_distance(place, predator.position) >= touching * touching;
        predators.iter().all(free_of)
    };
    let mut nearest = prey;
    let mut nearest_squared = f32::INFINITY;
    for predator in predators {
        let squared = squared_distance(prey, predator.position);
        if squared < nearest_squared {
            (nearest, nearest_squared) = (predator.position, squared);
        }
    }
    let mut best = [0.0; 2];
    let mut best_squared = f32::NEG_INFINITY;
    for _ in 0..CANDIDATES {
        let offset = point_of_unit_disk(rng);
        let place = sum(prey, offset);
        let squared = squared_distance(place, nearest);
        // Only a point that would win needs to be looked at closely: about five of a hundred.
        if squared > best_squared && is_free(place) {
            (best, best_squared) = (offset, squared);
        }
    }
    best
}

/// A uniform point of the unit disk: length √U(0, 1), angle 2π U(0, 1). Drawn as a point of the square around
/// it, x before y, until one lies in the disk: the same distribution, without a sine whose last bit
/// depends on the machine.
fn point_of_unit_disk(rng: &mut Rng) -> Vector {
    loop {
        let point = [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)];
        if squared_distance(point, [0.0; 2]) <= 1.0 {
            return point;
        }
    }
}

#[cfg(test)]
mod tests;
