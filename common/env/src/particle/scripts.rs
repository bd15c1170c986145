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

/// The landmark of each agent, no landmark twice, so that the sum of distances is least. Agents beyond the number of
/// landmarks get none.
fn nearest_assignment(agents: &[Vector], landmarks: &[Vector]) -> Vec<usize> {
    let placed = agents.len().min(landmarks.len());
    let distance = |agent: usize, landmark: usize| {
        f64::from(squared_distance(agents[agent], landmarks[landmark]).sqrt())
    };
    least_assignment(placed, landmarks.len(), distance)
}

/// A column for each row, none twice, so that the sum of costs is least, for no more rows than columns: the Hungarian
/// algorithm, in O(rows² · columns) time.
///
/// Every row and every column has a price. No cost is less than the prices of its row and column together, and the cost of
/// an assigned pair is as much: so no other assignment costs less. Rows join one by one, each along the cheapest path
/// from it over assigned pairs to a free column.
fn least_assignment(rows: usize, columns: usize, cost: impl Fn(usize, usize) -> f64) -> Vec<usize> {
    // One column more, where a row stands as long as it has no other.
    let start = columns;
    let mut row_of: Vec<Option<usize>> = vec![None; columns + 1];
    let (mut row_prices, mut column_prices) = (vec![0.0; rows], vec![0.0; columns + 1]);
    for joining in 0..rows {
        row_of[start] = Some(joining);
        // What a step to each column still costs beyond prices, from which column it comes, and which have been reached.
        let (mut beyond, mut from) = (vec![f64::INFINITY; columns], vec![start; columns]);
        let mut reached = vec![false; columns + 1];
        let mut column = start;
        while let Some(row) = row_of[column] {
            reached[column] = true;
            for next in (0..columns).filter(|&next| !reached[next]) {
                let step = cost(row, next) - row_prices[row] - column_prices[next];
                if step < beyond[next] {
                    (beyond[next], from[next]) = (step, column);
                }
            }
            let unreached = (0..columns).filter(|&next| !reached[next]);
            let Some(next) = unreached.min_by(|&a, &b| beyond[a].total_cmp(&beyond[b])) else { break };
            let raise = beyond[next];
            for column in 0..=columns {
                if let Some(row) = row_of[column].filter(|_| reached[column]) {
                    row_prices[row] += raise;
                    column_prices[column] -= raise;
                }
            }
            (0..columns).filter(|&next| !reached[next]).for_each(|next| beyond[next] -= raise);
            column = next;
        }
        // Every row on the path moves one column on.
        while column != start {
            row_of[column] = row_of[from[column]];
            column = from[column];
        }
    }
    let mut column_of = vec![0; rows];
    for (column, row) in row_of[..columns].iter().enumerate() {
        if let Some(row) = *row {
            column_of[row] = column;
        }
    }
    column_of
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
