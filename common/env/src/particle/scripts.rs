//! Scripted policies: reference points between which a learned policy's reward can be placed.

use super::world::{
    KIND, POSITION, VELOCITY, Vector, scaled, squared_distance, squared_distance_to_nearest, sum,
};
use crate::{BodyKind, TaskSet, UnknownName};
use rit_episode::{Action, Observation, Policy, Turn};
use std::{fmt, str::FromStr};

/// What a body without force still travels, per unit of velocity: Δt (0.75 + 0.75² + …) = 0.3.
const COAST: f32 = 0.3;
/// An agent that will come to rest this near to its target does not accelerate: a landmark's radius.
const CLOSE_ENOUGH: f32 = 0.05;

/// A policy without parameters. It reads the whole state, also what an agent does not see: it is a reference
/// point, not a rival.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Script {
    /// Any available action, uniformly. For every environment.
    Random,
    /// Action 0 always. For every environment in which it is available.
    Still,
    /// Each agent to a landmark of its own, by the assignment of least total distance at each step. Made for
    /// cooperative navigation; needs the features of a particle world.
    NearestAssignment,
    /// All predators to the same prey, at each step the one that is nearest to any of them. Made for predator
    /// and prey; needs the features of a particle world.
    Chase,
}

impl Script {
    /// Every script.
    pub const ALL: [Self; 4] = [Self::Random, Self::Still, Self::NearestAssignment, Self::Chase];

    /// Whether it has something to do in the tasks of this set.
    ///
    /// # Errors
    /// When it was made for others: it would stand still, or look for features that are not there.
    pub fn check(self, task_set: TaskSet) -> Result<(), UnfitScript> {
        if self.fits(task_set) { Ok(()) } else { Err(UnfitScript { script: self, task_set }) }
    }

    fn fits(self, task_set: TaskSet) -> bool {
        match self {
            Self::Random | Self::Still => true,
            Self::NearestAssignment => task_set == TaskSet::CooperativeNavigation,
            Self::Chase => matches!(task_set, TaskSet::PredatorPrey | TaskSet::PredatorPreyPro),
        }
    }
}

/// A script made for other tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("script {script} is not made for {task_set}; those that are: {}", fitting(*task_set))]
pub struct UnfitScript {
    /// The script.
    pub script: Script,
    /// The task set it does not fit.
    pub task_set: TaskSet,
}

fn fitting(task_set: TaskSet) -> String {
    let fitting = Script::ALL.into_iter().filter(|script| script.fits(task_set));
    fitting.map(|script| script.to_string()).collect::<Vec<_>>().join(", ")
}

impl Policy for Script {
    fn begin(&mut self, _: usize, _: usize) {}

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        for turn in turns {
            match self {
                Self::Random => act_randomly(turn),
                Self::Still => turn.actions.fill(0),
                Self::NearestAssignment => act_by_nearest_assignment(turn),
                Self::Chase => chase(turn),
            }
        }
    }
}

fn act_randomly(turn: &mut Turn<'_>) {
    for (agent, to) in turn.actions.iter_mut().enumerate() {
        *to = turn.exploration.any(turn.observation.available_to(agent));
    }
}

fn act_by_nearest_assignment(turn: &mut Turn<'_>) {
    let agents = positions(turn.observation, BodyKind::Agent);
    let landmarks = positions(turn.observation, BodyKind::Landmark);
    turn.actions.fill(0);
    for (agent, landmark) in nearest_assignment(&agents, &landmarks).into_iter().enumerate() {
        turn.actions[agent] = steer(turn.observation, agent, landmarks[landmark]);
    }
}

fn chase(turn: &mut Turn<'_>) {
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

impl fmt::Display for Script {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Random => "random",
            Self::Still => "still",
            Self::NearestAssignment => "nearest-assignment",
            Self::Chase => "chase",
        })
    }
}

impl FromStr for Script {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        UnknownName::look_up("script", name, &Self::ALL)
    }
}

#[cfg(test)]
mod tests;
