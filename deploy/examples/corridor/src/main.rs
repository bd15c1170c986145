//! An environment of one's own, and the whole program around it: `cargo run -p corridor -- train corridor`.
//!
//! Two agents stand in a corridor of so many places and want to meet at its lamp. Each sees where both are and where the
//! lamp is. A step costs the team a little; both at the lamp wins.

use rit::{
    Action, End, Environment, EnvironmentError, Observation, OwnTaskSet, Program, Rng, Spec, Step,
    rand::RngExt as _,
};
use std::process::ExitCode;

const CORRIDORS: OwnTaskSet = OwnTaskSet {
    name: "corridor",
    training: &["corridor-3", "corridor-5"],
    testing: &["corridor-7"],
    feature_names: &["agent", "lamp", "place"],
    action_names: &["stay", "left", "right"],
    make,
};

fn main() -> ExitCode {
    Program::new().task_set(CORRIDORS).main()
}

/// `corridor-N` has N places.
fn make(task: &str) -> Option<Box<dyn Environment>> {
    let places = task.strip_prefix("corridor-")?.parse().ok()?;
    (2..=99).contains(&places).then(|| Box::new(Corridor { places, agents: [0; 2], lamp: 0, steps: 0 }) as _)
}

struct Corridor {
    places: usize,
    agents: [usize; 2],
    lamp: usize,
    steps: usize,
}

impl Environment for Corridor {
    fn spec(&self) -> Spec {
        Spec {
            n_agents: 2,
            // Agents are entities, and come first; the lamp is the third.
            n_entities: 3,
            feature_dim: 3,
            n_actions: 3,
            steps_max: 2 * self.places,
            has_wins: true,
            has_scenes: false,
            is_reproducible: true,
        }
    }

    fn reset(&mut self, rng: &mut Rng) -> Result<(), EnvironmentError> {
        self.agents = [0, self.places - 1];
        self.lamp = rng.random_range(0..self.places);
        self.steps = 0;
        Ok(())
    }

    fn observe(&self, observation: &mut Observation) {
        let share = |place: usize| place as f32 / (self.places - 1) as f32;
        for (agent, &place) in self.agents.iter().enumerate() {
            observation.entity_mut(agent).copy_from_slice(&[1.0, 0.0, share(place)]);
        }
        observation.entity_mut(2).copy_from_slice(&[0.0, 1.0, share(self.lamp)]);
        observation.see_and_allow_all();
        // Walls.
        for (agent, &place) in self.agents.iter().enumerate() {
            observation.available_mut(agent)[1] = u8::from(place > 0);
            observation.available_mut(agent)[2] = u8::from(place + 1 < self.places);
        }
    }

    fn step(&mut self, actions: &[Action], _: &mut Rng) -> Result<Step, EnvironmentError> {
        for (place, action) in self.agents.iter_mut().zip(actions) {
            match action {
                1 => *place -= 1,
                2 => *place += 1,
                _ => {}
            }
        }
        self.steps += 1;
        let won = self.agents == [self.lamp; 2];
        let is_late = self.steps >= self.spec().steps_max;
        let end = if won { Some(End::Terminated) } else { is_late.then_some(End::Truncated) };
        Ok(Step { reward: if won { 10.0 } else { -0.1 }, shaping: 0.0, end, won })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corridors_keep_what_environments_promise() {
        for task in CORRIDORS.training.iter().chain(CORRIDORS.testing) {
            rit::conformance::check(|| make(task).unwrap());
        }
        assert!(make("corridor-1").is_none() && make("stairs-3").is_none());
    }
}
