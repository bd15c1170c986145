//! Scripted policies of the particle worlds.

use super::world::{
    KIND, POSITION, VELOCITY, Vector, scaled, squared_distance, squared_distance_to_nearest, sum,
};
use crate::BodyKind;
use rit_episode::{Action, Observation, Turn};

/// What a body without force still travels, per unit of velocity: Δt (0.75 + 0.75² + …) = 0.3. In mpe2's physics it is
/// 0.4, which the script does not know: it turns back a little late there.
const COAST: f32 = 0.3;
/// An agent that will come to rest this near to its target does not accelerate: a landmark's radius.
const CLOSE_ENOUGH: f32 = 0.05;

/// Each agent to a landmark of its own, by the assignment of least total distance.
pub(crate) fn act_by_nearest_assignment(turn: &mut Turn<'_>) {
    let agents = positions(turn.observation, BodyKind::Agent);
    let landmarks = positions(turn.observation, BodyKind::Landmark);
    turn.actions.fill(0);
    for (agent, landmark) in nearest_assignment(&agents, &landmarks).into_iter().enumerate() {
        turn.actions[agent] = steer(turn.observation, agent, landmarks[landmark]);
    }
}

/// All predators to the prey that is nearest to any of them.
pub(crate) fn chase(turn: &mut Turn<'_>) {
    let predators = positions(turn.observation, BodyKind::Agent);
    let prey = positions(turn.observation, BodyKind::Prey);
    let distance = |&prey: &Vector| squared_distance_to_nearest(prey, predators.iter().copied());
    let hunted = prey.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    for (agent, action) in turn.actions.iter_mut().enumerate() {
        *action = hunted.map_or(0, |&prey| steer(turn.observation, agent, prey));
    }
}

/// The landmark of each agent, no landmark twice, so that the sum of distances is least: the optimum, by
/// dynamic programming over sets of landmarks. Agents beyond the number of landmarks get none.
fn nearest_assignment(agents: &[Vector], landmarks: &[Vector]) -> Vec<usize> {
    let placed = agents.len().min(landmarks.len());
    // least[set]: the least cost at which the first |set| agents take exactly the landmarks of the set, and
    // the landmark of the last of them.
    let mut least = vec![(f32::INFINITY, 0); 1 << landmarks.len()];
    least[0].0 = 0.0;
    let mut best = 0;
    for set in 0..least.len() {
        let agent = set.count_ones() as usize;
        if agent == placed && (best == 0 || least[set].0 < least[best].0) {
            best = set;
        }
        if agent >= placed {
            continue;
        }
        for (landmark, &position) in landmarks.iter().enumerate() {
            let with = set | 1 << landmark;
            let cost = least[set].0 + squared_distance(agents[agent], position).sqrt();
            if with != set && cost < least[with].0 {
                least[with] = (cost, landmark);
            }
        }
    }
    let mut assignment = vec![0; placed];
    for landmark in assignment.iter_mut().rev() {
        *landmark = least[best].1;
        best &= !(1 << *landmark);
    }
    assignment
}

/// The action that brings the agent nearer to its target: along the longer axis of what will still be missing
/// once its present velocity is spent.
fn steer(observation: &Observation, agent: usize, target: Vector) -> Action {
    let features = features(observation, agent);
    let rest = sum(vector(&features[POSITION]), scaled(vector(&features[VELOCITY]), COAST));
    let missing = sum(target, scaled(rest, -1.0));
    let (axis, [backward, forward]) =
        if missing[0].abs() >= missing[1].abs() { (0, [1, 2]) } else { (1, [3, 4]) };
    if missing[axis].abs() < CLOSE_ENOUGH {
        0
    } else if missing[axis] < 0.0 {
        backward
    } else {
        forward
    }
}

/// Positions of all entities of one kind, in the observation's order.
fn positions(observation: &Observation, kind: BodyKind) -> Vec<Vector> {
    (0..observation.n_entities())
        .map(|entity| features(observation, entity))
        .filter(|features| features[KIND][kind as usize] == 1.0)
        .map(|features| vector(&features[POSITION]))
        .collect()
}

fn features(observation: &Observation, entity: usize) -> &[f32] {
    &observation.entities()[entity * observation.entity_dim()..][..observation.entity_dim()]
}

fn vector(features: &[f32]) -> Vector {
    [features[0], features[1]]
}

#[cfg(test)]
mod tests;
