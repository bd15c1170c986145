//! The physics that the particle worlds share: bodies, contact, integration, and what is seen of them.
//!
//! All bodies have mass 1, so force and acceleration are the same number. Units are the original's own: the
//! arena spans about ±1, a step lasts [`STEP_SECONDS`].

use crate::{BodyKind, EnvironmentOptions, Physics, Scene, SceneBody, Spec};
use rand::RngExt as _;
use rit_episode::{Action, End, Observation, Rng};
use std::ops::Range;

/// Steps of an episode.
const STEPS: usize = 25;
/// Δt.
const STEP_SECONDS: f32 = 0.1;
/// What is left of a velocity after a step: 1 − damping.
const KEPT_VELOCITY: f32 = 0.75;
/// Force per unit of penetration.
const CONTACT_FORCE: f32 = 100.0;
/// Length over which contact sets in: penetration is softplus((r_i + r_j − distance) / margin) · margin.
const CONTACT_MARGIN: f32 = 1e-3;
/// Bodies farther apart than this, edge to edge, are left out: softplus(−104) = e^−104 is less than half of the
/// smallest f32, so their contact force is exactly 0.
const NO_CONTACT_GAP: f32 = 104.0 * CONTACT_MARGIN;

/// Where each action pushes: nowhere, −x, +x, −y, +y.
pub const DIRECTIONS: [[f32; 2]; 5] = [[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]];

/// Columns of an entity's features that hold its position.
pub(super) const POSITION: Range<usize> = 0..2;
/// Columns that hold its velocity.
pub(super) const VELOCITY: Range<usize> = 2..4;
/// Columns that hold the one-hot of its [`BodyKind`], in the order of its variants.
pub(super) const KIND: Range<usize> = 4..7;
/// Features of one entity.
const FEATURES: usize = KIND.end;

/// What a particle world is. Features are position (2), velocity (2) and the kind's one-hot (3); actions none, −x, +x,
/// −y, +y.
pub(super) fn spec(n_agents: usize, n_entities: usize) -> Spec {
    Spec {
        n_agents,
        n_entities,
        feature_dim: FEATURES,
        n_actions: DIRECTIONS.len(),
        steps_max: STEPS,
        has_wins: false,
        has_scenes: true,
        is_reproducible: true,
    }
}

/// x and y.
pub(super) type Vector = [f32; 2];

/// One body: how it is made, and where it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Body {
    pub(super) kind: BodyKind,
    pub(super) radius: f32,
    /// Whether it pushes and is pushed by other colliding bodies.
    pub(super) collides: bool,
    pub(super) movable: bool,
    /// Acceleration of a unit action.
    pub(super) acceleration: f32,
    /// Infinite where there is no cap.
    pub(super) speed_max: f32,
    /// It starts anywhere in the square ± this.
    pub(super) start_within: f32,
    pub(super) position: Vector,
    pub(super) velocity: Vector,
    /// What acts on it during the step under way.
    pub(super) force: Vector,
}

impl Body {
    /// A fixed body without contact, to be changed by what it is.
    pub(super) const fn new(kind: BodyKind, radius: f32) -> Self {
        Self {
            kind,
            radius,
            collides: false,
            movable: false,
            acceleration: 0.0,
            speed_max: f32::INFINITY,
            start_within: 1.0,
            position: [0.0; 2],
            velocity: [0.0; 2],
            force: [0.0; 2],
        }
    }

    /// Whether two bodies overlap.
    pub(super) fn overlaps(&self, other: &Self) -> bool {
        let touching = self.radius + other.radius;
        squared_distance(self.position, other.position) < touching * touching
    }
}

/// The bodies of one task, agents first. Their number is constant: nothing here allocates after
/// [`World::new`].
#[derive(Debug)]
pub(super) struct World {
    pub(super) bodies: Vec<Body>,
    n_agents: usize,
    view_radius: Option<f32>,
    physics: Physics,
    step: usize,
}

impl World {
    /// A world of these bodies, the first `n_agents` of them agents.
    ///
    /// # Panics
    /// Without agents, or with a view radius that is negative or not a number.
    pub(super) fn new(bodies: Vec<Body>, n_agents: usize, options: EnvironmentOptions) -> Self {
        assert!((1..=bodies.len()).contains(&n_agents), "a world has at least one agent");
        assert!(options.view_radius.is_none_or(|radius| radius >= 0.0), "a view radius is not negative");
        Self { bodies, n_agents, view_radius: options.view_radius, physics: options.physics, step: 0 }
    }

    pub(super) fn physics(&self) -> Physics {
        self.physics
    }

    /// Whether [`World::advance`] calls an episode of full length over: nothing but time ends one.
    pub(super) fn is_over_at_limit(&self) -> bool {
        self.physics == Physics::Original
    }

    pub(super) fn n_agents(&self) -> usize {
        self.n_agents
    }

    pub(super) fn n_entities(&self) -> usize {
        self.bodies.len()
    }

    /// Begins an episode: every body at rest somewhere in its square, drawn in entity order, x before y.
    pub(super) fn reset(&mut self, rng: &mut Rng) {
        self.step = 0;
        for body in &mut self.bodies {
            let within = body.start_within;
            body.position = [rng.random_range(-within..within), rng.random_range(-within..within)];
            body.velocity = [0.0; 2];
        }
    }

    /// Replaces the forces of the last step: the agents' by those of a joint action, all others by zero.
    ///
    /// # Panics
    /// When there is not one valid action for each agent.
    pub(super) fn set_forces(&mut self, actions: &[Action]) {
        assert_eq!(actions.len(), self.n_agents, "one action for each agent");
        let (agents, others) = self.bodies.split_at_mut(self.n_agents);
        for (agent, &action) in agents.iter_mut().zip(actions) {
            agent.force = scaled(DIRECTIONS[usize::from(action)], agent.acceleration);
        }
        for other in others {
            other.force = [0.0; 2];
        }
    }

    /// Moves all bodies by one step under the forces set and those of contact; returns the end where this
    /// was the last step. The last step counts as terminal, as the authors store it; in mpe2 it is truncated.
    pub(super) fn advance(&mut self) -> Option<End> {
        self.add_contact_forces();
        for body in self.bodies.iter_mut().filter(|body| body.movable) {
            integrate(body, self.physics);
        }
        self.step += 1;
        let end = if self.is_over_at_limit() { End::Terminated } else { End::Truncated };
        (self.step >= STEPS).then_some(end)
    }

    /// Adds what each pair of colliding bodies does to each other, in the order of the pairs.
    fn add_contact_forces(&mut self) {
        for second in 1..self.bodies.len() {
            let (before, rest) = self.bodies.split_at_mut(second);
            let second = &mut rest[0];
            if !second.collides {
                continue;
            }
            for first in before.iter_mut().filter(|first| first.collides) {
                let touching = first.radius + second.radius;
                let Some(force) = contact_force(first.position, second.position, touching) else {
                    continue;
                };
                // What does not move is pushed in vain: its force is not read.
                first.force = sum(first.force, force);
                second.force = sum(second.force, scaled(force, -1.0));
            }
        }
    }

    /// Writes features and flags; see [`crate::Environment::observe`].
    pub(super) fn observe(&self, observation: &mut Observation) {
        for (entity, body) in self.bodies.iter().enumerate() {
            let features = observation.entity_mut(entity);
            features[POSITION].copy_from_slice(&body.position);
            features[VELOCITY].copy_from_slice(&body.velocity);
            features[KIND][body.kind as usize] = 1.0;
        }
        observation.see_and_allow_all();
        let Some(view_radius) = self.view_radius else {
            return;
        };
        for (agent, viewer) in self.bodies[..self.n_agents].iter().enumerate() {
            let seen = observation.observable_mut(agent);
            for (flag, body) in seen.iter_mut().zip(&self.bodies) {
                let near = squared_distance(viewer.position, body.position) <= view_radius * view_radius;
                *flag = u8::from(near);
            }
        }
    }

    pub(super) fn scene(&self) -> Scene {
        let bodies = self.bodies.iter().map(|body| SceneBody {
            kind: body.kind,
            x: body.position[0],
            y: body.position[1],
            radius: body.radius,
            unit: None,
        });
        Scene { bodies: bodies.collect(), links: Vec::new() }
    }
}

/// v ← 0.75 v + F Δt, capped, and p ← p + v Δt: by the new velocity, in mpe2 by the old one.
fn integrate(body: &mut Body, physics: Physics) {
    let old_velocity = body.velocity;
    body.velocity = sum(scaled(body.velocity, KEPT_VELOCITY), scaled(body.force, STEP_SECONDS));
    let squared_speed = squared_distance(body.velocity, [0.0; 2]);
    if squared_speed > body.speed_max * body.speed_max {
        body.velocity = scaled(body.velocity, body.speed_max / squared_speed.sqrt());
    }
    let velocity = match physics {
        Physics::Original => body.velocity,
        Physics::Mpe2 => old_velocity,
    };
    body.position = sum(body.position, scaled(velocity, STEP_SECONDS));
}

/// The force on the first of two colliding bodies, the second feels its opposite; `None` where it is exactly
/// zero. Two bodies at one point have no direction between them: the first is pushed along +x.
fn contact_force(first: Vector, second: Vector, touching: f32) -> Option<Vector> {
    let apart = touching + NO_CONTACT_GAP;
    let squared = squared_distance(first, second);
    if squared > apart * apart {
        return None;
    }
    let distance = squared.sqrt();
    let penetration = softplus((touching - distance) / CONTACT_MARGIN) * CONTACT_MARGIN;
    let size = CONTACT_FORCE * penetration;
    Some(if distance > 0.0 {
        let from_second = [first[0] - second[0], first[1] - second[1]];
        scaled(from_second, size / distance)
    } else {
        [size, 0.0]
    })
}

/// ln(1 + eˣ) without overflow. Not by the functions of the system's library, whose last bit differs from one machine
/// to the next: an episode is the same wherever it is rolled.
fn softplus(x: f32) -> f32 {
    x.max(0.0) + libm::log1pf(libm::expf(-x.abs()))
}

pub(super) fn squared_distance(a: Vector, b: Vector) -> f32 {
    let (x, y) = (a[0] - b[0], a[1] - b[1]);
    x * x + y * y
}

/// Infinite where there are no places.
pub(super) fn squared_distance_to_nearest(from: Vector, places: impl Iterator<Item = Vector>) -> f32 {
    places.fold(f32::INFINITY, |nearest, place| nearest.min(squared_distance(from, place)))
}

pub(super) fn sum(a: Vector, b: Vector) -> Vector {
    [a[0] + b[0], a[1] + b[1]]
}

pub(super) fn scaled(vector: Vector, factor: f32) -> Vector {
    [vector[0] * factor, vector[1] * factor]
}

#[cfg(test)]
impl World {
    /// Puts the bodies at these places, at rest.
    pub(super) fn place(&mut self, positions: &[Vector]) {
        assert_eq!(positions.len(), self.bodies.len(), "one place for each body");
        for (body, &position) in self.bodies.iter_mut().zip(positions) {
            (body.position, body.velocity) = (position, [0.0; 2]);
        }
    }
}

#[cfg(test)]
mod tests;
