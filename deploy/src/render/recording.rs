//! What is kept of episodes that are to be drawn.

use rit_env::{BodyKind, Scene, Task};
use rit_episode::Episode;

/// Episodes of one task by one policy.
pub struct Film {
    /// What was played.
    pub task: Task,
    /// Who played it.
    pub policy: String,
    /// At least one.
    pub episodes: Vec<Recording>,
}

impl Film {
    /// What a body of this kind is called in the task.
    pub fn name_of(&self, kind: BodyKind) -> &'static str {
        match (kind, self.task) {
            (BodyKind::Agent, Task::PredatorPrey { .. }) => "predator",
            (BodyKind::Agent, Task::Combat { .. }) => "ally",
            (BodyKind::Agent, _) => "agent",
            (BodyKind::Landmark, Task::PredatorPrey { .. }) => "obstacle",
            (BodyKind::Landmark, _) => "landmark",
            (BodyKind::Prey, _) => "prey",
            (BodyKind::Enemy, _) => "enemy",
        }
    }

    /// The kinds of body there are.
    pub fn kinds(&self) -> impl Iterator<Item = BodyKind> {
        let first = self.episodes.first().and_then(|episode| episode.scenes.first());
        [BodyKind::Agent, BodyKind::Landmark, BodyKind::Prey, BodyKind::Enemy]
            .into_iter()
            .filter(move |&kind| first.is_some_and(|scene| scene.bodies.iter().any(|body| body.kind == kind)))
    }
}

/// One episode, with where everything was.
pub struct Recording {
    /// What was played.
    pub task: Task,
    /// The scene before each step, and after the last: one more than there are steps.
    pub scenes: Vec<Scene>,
    /// What was done and earned.
    pub episode: Episode,
}

impl Recording {
    /// Steps of the episode.
    pub fn steps(&self) -> usize {
        self.episode.steps()
    }

    /// Reward of a step, 1 to [`Self::steps`]; there is none before the first.
    pub fn reward(&self, step: usize) -> Option<f32> {
        self.episode.rewards.get(step.checked_sub(1)?).copied()
    }

    /// Rewards up to and including a step.
    pub fn total(&self, step: usize) -> f64 {
        self.episode.rewards[..step].iter().map(|&reward| f64::from(reward)).sum()
    }

    /// The agent's place in the decision order, counted from 1.
    pub fn place(&self, agent: usize) -> Option<usize> {
        let order = &self.episode.decision_order;
        order.iter().position(|&other| usize::from(other) == agent).map(|row| row + 1)
    }

    /// Where the agent's action of a step pushed it or sent it; `None` before the first step.
    pub fn push(&self, agent: usize, step: usize) -> Option<[f32; 2]> {
        let row = self.place(agent)? - 1;
        let at = step.checked_sub(1)? * self.episode.n_agents + row;
        self.task.direction(*self.episode.actions.get(at)?)
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use rit_env::SceneBody;
    use rit_episode::{End, Episode};

    /// Two agents, of whom the second decides first, a landmark and a prey; two steps, in which everything
    /// that moves goes by `speed` along x.
    pub fn film(speed: f32) -> Film {
        let body = |kind, x, y, radius| SceneBody { kind, x, y, radius, unit: None };
        let scene = |time: f32| Scene {
            bodies: vec![
                body(BodyKind::Agent, time * speed, 0.0, 0.15),
                body(BodyKind::Agent, 0.5 + time * speed, 0.5, 0.15),
                body(BodyKind::Landmark, -0.5, 0.5, 0.05),
                body(BodyKind::Prey, time * speed, -0.5, 0.05),
            ],
            links: Vec::new(),
        };
        let episode = Episode {
            number: 0,
            weights_version: 0,
            task: 0,
            n_agents: 2,
            n_entities: 4,
            decision_order: vec![1, 0],
            entities: Vec::new(),
            observable: Vec::new(),
            available: Vec::new(),
            actions: vec![2, 1, 0, 4],
            rewards: vec![-1.5, 0.25],
            shaping: vec![0.0; 2],
            end: End::Terminated,
            won: false,
        };
        let task = Task::CooperativeNavigation { n: 2 };
        Film {
            task,
            policy: "script:still".into(),
            episodes: vec![Recording { task, scenes: [0.0, 1.0, 2.0].map(scene).to_vec(), episode }],
        }
    }

    #[test]
    fn actions_and_places_are_those_of_the_environments_agents() {
        let film = film(0.1);
        let recording = &film.episodes[0];
        assert_eq!([0, 1, 2].map(|agent| recording.place(agent)), [Some(2), Some(1), None]);
        assert_eq!([0, 1].map(|agent| recording.push(agent, 0)), [None, None]);
        assert_eq!([0, 1].map(|agent| recording.push(agent, 1)), [Some([-1.0, 0.0]), Some([1.0, 0.0])]);
        assert_eq!([0, 1].map(|agent| recording.push(agent, 2)), [Some([0.0, 1.0]), Some([0.0, 0.0])]);
        assert_eq!([0, 1, 2].map(|step| recording.reward(step)), [None, Some(-1.5), Some(0.25)]);
        assert_eq!([0, 1, 2].map(|step| recording.total(step)), [0.0, -1.5, -1.25]);
        assert_eq!(
            film.kinds().map(|kind| film.name_of(kind)).collect::<Vec<_>>(),
            ["agent", "landmark", "prey"]
        );
    }
}
